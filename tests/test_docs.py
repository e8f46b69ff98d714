"""Commands in the documentation run, each in a folder that holds the files it names; what it names is in the code."""

import ast
import math
import os
import pty
import re
import runpy
import shlex
import shutil
import sys
import tokenize
from functools import cache
from io import StringIO
from pathlib import Path

import matplotlib as mpl
import pytest
from cyclopts import MissingArgumentError
from mkdocs.config import load_config
from mkdocs.structure.files import get_files

from jaxfinger.cli import main
from jaxfinger.cli.app import app
from jaxfinger.rig import open_rig, parse_plan, parse_rig
from jaxfinger.rig import run as record
from jaxfinger.rig.simulated.examples import rig_toml
from tests.rig.conftest import SHORT

ROOT = Path(__file__).parents[1]
BENCHMARK = ROOT / "datasets" / "sealed" / "README.md"
GUIDE = ROOT / "docs" / "your-own-data.md"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "datasets").rglob("*.md"))]

# Additions to the guide's `finger.toml` with which it can be simulated: moment arms, and terms of the model.
PATHS = ({"T1": "[0.008, 1e-3]", "T2": "[-0.008, -1e-3]"}, "[terms.joints.MCP]\nelastic = [-0.01, 0.03]\n")
# Files of the shelf for placeholders in the pages.
MEANS = {"SESSION": "session.h5", "SESSION.h5": "session.h5", "B.h5": "session.h5", "C.h5": "unseen.h5"}
MEANS |= {"FILE": "session.h5", "FIT": "fit.json", "A-fit.json": "fit.json", "LOG": "LOG.csv", "bench.toml": "rig.toml"}
MEANS |= {"…": ""}  # stands for more arguments of the same kind
FENCED = r"```(\w*)[^\n]*\n(.*?)```"
MATRIX = "jaxfinger.rig.matrix"  # tests/rig/test_matrix.py runs it and compares its table with the page


def commands(page: Path) -> list[str]:
    """Commands of jaxfinger on a page, from shell blocks and from within sentences."""
    text = page.read_text(encoding="utf-8")
    shells = {"sh", "console"} if page == GUIDE else {"sh", "bash", "console"}  # test_guide runs its `bash` blocks
    blocks = [block for language, block in re.findall(FENCED, text, re.DOTALL) if language in shells]
    prose = re.sub(FENCED, "", text, flags=re.DOTALL)
    blocks += re.findall(r"\n\n((?:    [^\n]*\n)+)", prose)
    lines = "".join(blocks).replace("\\\n", " ").replace("&&", "\n").replace(".venv/bin/", "").splitlines()
    lines += [" ".join(inline.split()) for inline in re.findall(r"`([^`]+)`", prose)]
    return [" ".join(shlex.split(line, comments=True)) for line in lines if re.match(r"\s*jaxfinger \S", line)]


def modules(page: Path) -> list[str]:
    """Modules that a page runs by `python -m`."""
    return re.findall(r"python -m (jaxfinger[\w.]*)", page.read_text(encoding="utf-8"))


def is_a_name(line: str) -> bool:
    """Whether a line names a command without the files that it needs."""
    try:
        app.parse_args(shlex.split(line)[1:], exit_on_error=False, print_error=False)
    except MissingArgumentError:
        return True
    return False


def typed(line: str) -> None:
    """Run a line as typed at a prompt; assert that it exits with 0."""
    code = 0
    try:
        main(shlex.split(line)[1:])
    except SystemExit as end:
        code = end.code or 0
    assert code == 0, line


@pytest.fixture(scope="module")
def shelf(tmp_path_factory):
    """Folder with a reader's files, made by the same commands: sessions of the guide's finger, a fit, a stopped run."""
    folder = tmp_path_factory.mktemp("shelf")
    (text,) = re.findall(r"```toml finger\.toml\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    arms, terms = PATHS
    for tendon, arm in arms.items():
        text = text.replace(f'name = "{tendon}"\n', f'name = "{tendon}"\nexcursion = {{ MCP = {arm} }}\n')
    (folder / "finger.toml").write_text(f"{text}\n{terms}", encoding="utf-8")
    page = (ROOT / "docs" / "add-an-effect.md").read_text(encoding="utf-8")
    (folder / "drag.py").write_text(re.findall(r"```python\n(.*?)```", page, re.DOTALL)[0], encoding="utf-8")
    columns = "time,angle knuckle,angle middle,force A (N),force B (N),length A (mm),length B (mm)"
    swing = [40.0 - 30.0 * math.cos(0.02 * k) for k in range(1200)]
    rows = [f"{0.02 * k:.2f},{q:.4f},20,2,2,{0.14 * q:.5f},{-0.14 * q:.5f}" for k, q in enumerate(swing)]
    hand = "<worldbody>{}</worldbody>"
    for name in ("MCP", "PIP", "DIP"):
        body = f'<body pos="0.03 0 0"><joint name="{name}" axis="0 1 0" range="0 90"/>'
        hand = hand.format(body + '<geom type="capsule" fromto="0 0 0 0.03 0 0" size="0.006" mass="0.02"/>{}</body>')
    (folder / "hand.xml").write_text(f"<mujoco>{hand.format('')}</mujoco>", encoding="utf-8")
    (folder / "LOG.csv").write_text("\n".join([columns, *rows]), encoding="utf-8")
    (folder / "plan.toml").write_text(SHORT, encoding="utf-8")
    (folder / "rig.toml").write_text(rig_toml(), encoding="utf-8")
    rig, seen = parse_rig(rig_toml()), []

    def interrupt(view):
        if view.number == 2 and view.recording and not seen:
            seen.append(view.number)
            raise KeyboardInterrupt

    outcome = record(parse_plan(SHORT, rig), open_rig(rig), folder / "interrupted.h5", observe=interrupt)
    assert len(outcome.complete) == 1
    outcome.log.rename(folder / "session.h5.wal")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for line in (
            "jaxfinger new logged.toml mapping.toml LOG.csv --joints knuckle,middle --tendons A,B",
            "jaxfinger simulate finger.toml -o session.h5",
            "jaxfinger simulate finger.toml -o unseen.h5 --seed 3",
            "jaxfinger identify session.h5 -o fit.json",
            "jaxfinger predict fit.json session.h5 -o simulator.h5",
        ):
            typed(line)
    return folder


@pytest.fixture
def reader(shelf, tmp_path, monkeypatch):
    """Folder with the files that a command reads, a terminal, which `record` needs, and a shell."""

    def prepare(line: str) -> tuple[str, list[Path]]:
        words = [MEANS.get(word, word) for word in shlex.split(line)]
        written = {words[k + 1] for k, word in enumerate(words) if word in ("-o", "--output")}
        written |= set(words[2:4]) if words[1] == "new" else set()
        for word in {*words, "logged.toml"} - written:  # the finger that mapping.toml names
            for place in (shelf / word, ROOT / word):
                if place.is_file():
                    (tmp_path / word).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy(place, tmp_path / word)
        if "--resume" in words:
            shutil.copy(shelf / "interrupted.h5", tmp_path / "session.h5")
            shutil.copy(shelf / "session.h5.wal", tmp_path / "session.h5.wal")
        return shlex.join(filter(None, words)), [] if "--dry-run" in words else [tmp_path / name for name in written]

    ours, theirs = pty.openpty()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("SHELL", "/bin/bash")
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        with mpl.rc_context({"backend": "agg"}):
            yield prepare
    os.close(ours)


@pytest.mark.long
@pytest.mark.parametrize(
    "line",
    dict.fromkeys(c for p in PAGES if p != BENCHMARK for c in commands(p)),
    ids=lambda c: c[:70].replace("/", "_"),
)
def test_every_command_of_the_pages_runs(line, reader, capsys):
    if is_a_name(line):
        typed(f"{line} --help")
        assert "Usage" in capsys.readouterr().out
        return
    line, written = reader(line)
    typed(line)
    assert capsys.readouterr().out
    assert [path for path in written if not path.exists()] == []


def test_every_command_of_the_pages_is_one():
    """The benchmark's commands are included. They take hours, so that tests/sealed runs them on small cases."""
    lines = [line for page in PAGES for line in commands(page)]
    assert len(lines) > 40
    for line in lines:
        if not is_a_name(line):
            words = [MEANS.get(word, word) for word in shlex.split(line)[1:]]
            app.parse_args([*filter(None, words)], exit_on_error=False, print_error=False)


@pytest.mark.parametrize("module", sorted({m for p in PAGES for m in modules(p)} - {MATRIX}))
def test_every_module_that_the_pages_run_says_how(module, monkeypatch, capsys):
    """Modules are asked for their help alone, since they serve until stopped."""
    monkeypatch.setattr(sys, "argv", [module, "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_module(module, run_name="__main__")
    assert not end.value.code
    assert "usage" in capsys.readouterr().out


# Names ----------------------------------------------------------------------------------------------------------------
FOLDERS = ("jaxfinger", "benchmarks", "datasets", "docs", "notebooks")
CODE = [p for folder in FOLDERS for p in sorted((ROOT / folder).rglob("*.py"))]
TESTS = sorted((ROOT / "tests").rglob("*.py"))
SETTINGS = [ROOT / "pyproject.toml", *(ROOT / "docs").glob("*.toml"), *(ROOT / "fits").glob("*.toml")]
CONTROLLER = sorted((ROOT / "docs").glob("*.st"))
TOLD = [*PAGES, ROOT / "CHANGELOG.md", *CODE]
COMMAND = r"(?:jaxfinger|python|source|apt-get|\.venv/\S+) "  # other tests run those of ours
# Words in backticks that are no names of ours: a reader's, those of other programs and of another laboratory's files.
OTHERS = {"OUT", "TRUTH", "PORT", "NNN", "month", "prox", "m1", "u_c", "stamp_ms", "joint_states", "lint"}
OTHERS |= {"BSpline", "next_fast_len", "wiener", "qm", "qg", "kp", "vir", "gtau", "pulses_N"}
OTHERS |= {
    "angle_MCP",
    "force_T1",
    "motor_id",
    "torque_N_mm",
    "force_kg",
    "candump",
    "motor_current",
    "delta_t",
    "time_step",
}
WRITTEN = {"drag.py", "mine.py", "commands.md", "causes.md", "table.md", "scores/table.md"}  # by a reader or a command


@cache
def parts(file: Path) -> tuple[str, str]:
    """Code of a file without comments and docstrings; and these, or the sentences of a page."""
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".md":
        return "", re.sub(FENCED, "", text, flags=re.DOTALL)
    tokens = tokenize.generate_tokens(StringIO(text).readline)
    tree, told = ast.parse(text), [t.string[1:] for t in tokens if t.type == tokenize.COMMENT]
    for n in ast.walk(tree):
        if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant) and isinstance(n.value.value, str):
            told.append(n.value.value)
            n.value.value = None
    return ast.unparse(tree), "\n".join(told)


def words(text: str) -> list[str]:
    """Names of two letters and more, in plain letters."""
    return [w for w in re.findall(r"[^\W\d]\w+", text) if w.isascii()]


@cache
def names(file: Path) -> frozenset[str]:
    """Words of a file's code."""
    return frozenset(words(parts(file)[0]))


def quoted(file: Path) -> list[str]:
    """What the sentences of a page, or the docstrings and comments of code, write in backticks, commands left out."""
    found = (" ".join(x.split()) for x in re.findall(r"`([^`]+)`", parts(file)[1]))
    return [x for x in found if not re.match(COMMAND, x)]


def shown(found: list) -> list[str]:
    """Each file with what it names, for the message of a test that fails."""
    return [f"{file.relative_to(ROOT)}: {text}" for file, text, *_ in found]


def test_every_name_in_backticks_is_in_the_code():
    files = " ".join(str(p.relative_to(ROOT)) for p in [*CODE, *TESTS, *TOLD, *CONTROLLER, *ROOT.glob("*.cff")])
    known = OTHERS.union(words(files), *map(names, CODE))
    known = known.union(*(words(p.read_text(encoding="utf-8")) for p in [*SETTINGS, *CONTROLLER]))
    tests = "".join(re.findall(r"def (test_\w+)", "".join(p.read_text(encoding="utf-8") for p in TESTS)))
    named = [(file, text, word) for file in TOLD for text in quoted(file) for word in words(text)]
    assert len(named) > 2000
    assert shown([x for x in named if x[2] not in known and x[2] not in tests]) == []


def test_a_dotted_name_is_in_the_module_or_class_that_it_starts_with():
    homes: dict[str, list[Path]] = {}
    for p in CODE:
        classes = re.findall(r"^class (\w+)", p.read_text(encoding="utf-8"), re.MULTILINE)
        for owner in (p.parent.name if p.stem == "__init__" else p.stem, *classes):
            homes.setdefault(owner, []).append(p)
    endings = {"h5", "json", "csv", "py"}
    dotted = r"(?!S\.)(?:\w+\.)*?(\w+)\.(\w+)(?:\(.*\))?"  # S is a structure of MATLAB
    named = [(f, text, *m.groups()) for f in TOLD for text in quoted(f) if (m := re.fullmatch(dotted, text))]
    named = [x for x in named if x[2] in homes and x[3] not in endings]
    assert len(named) > 50
    assert shown([x for x in named if x[3] not in homes and not any(x[3] in names(p) for p in homes[x[2]])]) == []


def test_every_file_that_is_named_is_there():
    alone = {p.name for p in [*CODE, *TESTS, *PAGES]}
    pattern = r"(?<![\w./<>:-])[\w-]+(?:/[\w.-]+)*\.(?:py|md|cff)\b"
    named = [(f, path) for f in TOLD for path in re.findall(pattern, parts(f)[1]) if path not in WRITTEN | alone]
    assert len(named) > 100
    places = (ROOT, ROOT / "jaxfinger")
    assert shown([x for x in named if not any((p / x[1]).exists() for p in (*places, x[0].parent))]) == []


def test_every_option_that_is_named_is_one():
    pattern = r"(?<![\w-])--[a-z][\w-]*"
    known = {"--help", *re.findall(pattern, app.generate_docs(recursive=True, include_hidden=True))}
    known.update(*(re.findall(pattern, parts(p)[0]) for p in CODE))
    named = [(f, text, option) for f in TOLD for text in quoted(f) for option in re.findall(pattern, text)]
    assert len(named) > 30
    assert shown([x for x in named if x[2] not in known]) == []


def test_a_name_in_a_file_is_defined_there():
    """As in `propagate` in `identify/propagate.py`, and for lists of names."""
    pattern = r"((?:`[\w.]+`(?:, | and )?)+)\s+in\s+`([\w/]+\.py)`"
    found = [(f, file, w) for f in PAGES for some, file in re.findall(pattern, parts(f)[1]) for w in words(some)]
    assert len(found) > 10
    for page, file, name in found:
        text = (ROOT / "jaxfinger" / file).read_text(encoding="utf-8")
        assert re.search(rf"^ *(?:(?:def|class) {name}\b|{name} ?[:=])", text, re.MULTILINE), f"{page}: {name}"


def test_every_line_of_code_on_a_page_is_in_its_file():
    """Blocks whose title is a file of the package hold lines of it, in their order."""
    text = "".join(p.read_text(encoding="utf-8") for p in PAGES)
    blocks = re.findall(r'```python title="(.+?)"\n(.*?)```', text, re.DOTALL)
    assert len(blocks) > 10
    for file, block in blocks:
        lines = iter((ROOT / "jaxfinger" / file).read_text(encoding="utf-8").splitlines())
        rest = (line.strip() for line in lines)
        assert [line for line in block.splitlines() if line.strip() not in rest] == [], file


def test_the_site_holds_pages_and_pictures_alone():
    files = get_files(load_config(str(ROOT / "mkdocs.yml")))
    assert {Path(f.src_uri).suffix for f in files if f.inclusion.is_included()} == {".md", ".png"}
