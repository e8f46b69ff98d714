"""Command line, run in this process: its output, its files, and its refusals."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from jaxfinger import cli
from jaxfinger.cli import main, tables
from jaxfinger.cli.app import COMMANDS, SEALED, STAGES
from jaxfinger.data import read_session
from jaxfinger.effects import CATALOGUE
from jaxfinger.errors import UserError
from jaxfinger.identify import Fit, Recipe, load_fit, refine, save_fit
from jaxfinger.identify.nominal import nominal_model
from jaxfinger.report.numbers import number

ROOT = Path(__file__).parents[2]
EMPS = ROOT / "datasets" / "emps"
DEMO = ROOT / "datasets" / "demo-finger" / "session.h5"


def run(*tokens) -> int:
    """Exit code of a command."""
    try:
        main([str(t) for t in tokens])
    except SystemExit as end:
        return end.code or 0
    return 0


def test_ctrl_c_while_modules_are_imported_ends_without_a_traceback(monkeypatch, capsys):
    def pressed() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "_streams", pressed)  # the last step before the command's modules are imported
    assert run("show", "fit.json") == 130
    assert capsys.readouterr() == ("", "")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Folder with both recordings of the servo axis as sessions, and a fit of the first."""
    folder = tmp_path_factory.mktemp("emps")
    for name, recording in (("emps", "DATA_EMPS"), ("emps-pulses", "DATA_EMPS_PULSES")):
        mapping = EMPS / f"{name}.toml"
        assert run("import", EMPS / f"{recording}.mat", "--mapping", mapping, "-o", folder / f"{name}.h5") == 0
    assert run("identify", folder / "emps.h5", "-o", folder / "fit.json", "--recipe", "emps") == 0
    return folder


def test_help_needs_neither_jax_nor_numpy():
    code = (
        "import sys; from jaxfinger.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "print('loaded', [m for m in ('jax', 'numpy', 'h5py') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "loaded []" in out
    assert all(name in out for name in COMMANDS)


@pytest.mark.parametrize(("command", "file"), [("show", "fit.json"), ("show", "emps.h5"), ("check", "emps.h5")])
def test_what_needs_no_computing_needs_no_jax(folder, command, file):
    code = (
        "import sys; from jaxfinger.cli import main\n"
        f"try: main([{command!r}, {str(folder / file)!r}])\n"
        "except SystemExit: pass\n"
        "print('loaded', [m for m in ('jax', 'scipy', 'jaxtyping') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "loaded []" in out


@pytest.mark.parametrize(("content", "says"), [('"seen": {}', "'stages' is missing"), ('"seen": 3', "is damaged")])
def test_show_says_what_a_damaged_fit_lacks(tmp_path, capsys, content, says):
    file = tmp_path / "fit.json"
    file.write_text(f'{{"schema": "jaxfinger-fit/2", {content}}}', encoding="utf-8")
    assert run("show", file) == 2
    said = capsys.readouterr().err
    assert says in said
    assert "Error" not in said


@pytest.mark.parametrize(
    "tokens", [*([c] for c in COMMANDS), *(["fit", s] for s in STAGES), *(["sealed", s] for s in SEALED)]
)
def test_every_command_explains_itself(tokens, capsys):
    assert run(*tokens, "--help") == 0
    assert "Usage" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(190.4, 2, "190"), (0.01234, 3, "0.0123"), (99.6, 2, "100"), (2.5e7, 3, "2.5e+07"), (None, 3, "–")],
)
def test_a_number_for_people(value, digits, text):
    assert number(value, digits) == text


def test_check_of_a_sound_file(folder, capsys):
    assert run("check", folder / "emps.h5", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["ok"]
    assert not [f for f in found["findings"] if f["severity"] == "error"]


def test_import_and_check_say_how_the_finger_is_mounted_and_how_fast_it_moves(tmp_path, capsys):
    file = tmp_path / "emps.h5"
    mounting = "mounting: gravity acts on no joint: the finger moves in a horizontal plane"
    motion = "motion: 1 trial of 24.8 s; axis slides fastest, at 125 mm/s in 01-ID3-dynamic-axis"
    for tokens in (("import", EMPS / "DATA_EMPS.mat", "--mapping", EMPS / "emps.toml", "-o", file), ("check", file)):
        assert run(*tokens) == 0
        said = capsys.readouterr().out.splitlines()
        assert mounting in said
        assert motion in said
    assert run("check", file, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert [f"{what}: {found[what]}" for what in ("mounting", "motion")] == [mounting, motion]


def test_import_of_an_experiment_without_its_torque_says_so_and_exits_as_check_does(tmp_path, capsys):
    mapping, file = tmp_path / "m.toml", tmp_path / "s.h5"
    shutil.copy(EMPS / "axis.toml", tmp_path)
    lines = (EMPS / "emps.toml").read_text().splitlines()
    mapping.write_text("\n".join(line for line in lines if not line.startswith("channels.joint_torque")))
    assert run("import", EMPS / "DATA_EMPS.mat", "--mapping", mapping, "-o", file) == 2
    assert re.search(r"error: .*/joint_torque: is missing", capsys.readouterr().err)
    assert run("check", file) == 2


def test_check_names_what_is_wrong(folder, tmp_path, capsys):
    bad = tmp_path / "bad.h5"
    bad.write_bytes((folder / "emps.h5").read_bytes())
    with h5py.File(bad, "r+") as file:
        del next(iter(file["trials"].values()))["q"]
        file.attrs["created"] = "Monday"
    assert run("check", bad) == 2
    *found, count = capsys.readouterr().out.splitlines()
    assert any("/q: is missing" in line for line in found)
    assert count == f"{bad}: 1 error, 1 warning"
    assert sorted(line.split(":")[0] for line in found) == ["error", "warning"]


def test_the_published_axis_comes_back(folder, capsys):
    """Janot, Gautier, Brunot 2019: M 95.11 kg, Fv 203.5 N s/m, Fc 20.39 N, offset −3.16 N."""
    assert run("show", folder / "fit.json", "--json") == 0
    values = {p["name"]: p for p in json.loads(capsys.readouterr().out)["parameters"]}
    for name, published, tolerance, units in (
        ("mass axis", 95.11, 0.01, "kg"),
        ("damping axis", 203.5, 0.08, "N s/m"),
        ("friction torque axis^0", 20.39, 0.08, "N"),
        ("elastic torque axis^0", -3.16, 0.12, "N"),
    ):
        assert values[name]["value"] == pytest.approx(published, rel=tolerance)
        assert abs(values[name]["value"] - published) < 1.96 * values[name]["std"]
        assert values[name]["units"] == units


def test_a_term_that_the_recipe_left_out_is_fitted_as_an_effect_that_is_known(folder, tmp_path, capsys):
    recipe, fit = ROOT / "fits" / "emps-no-coulomb.toml", tmp_path / "fit.json"
    named = ("--effect", "joint_coulomb:axis", "--recipe", recipe, "-o", fit, "--json")
    assert run("fit", "effects", folder / "emps.h5", *named) == 0
    values = {p["name"]: p for p in json.loads(capsys.readouterr().out)["parameters"]}
    c0 = values["joint_coulomb axis c0"]
    assert c0["units"] == "N"
    assert abs(c0["value"] - 20.39) < 1.96 * c0["std"]
    assert c0["std"] < 2.0
    assert run("validate", fit, folder / "emps-pulses.h5", "--json") == 0
    (score,) = json.loads(capsys.readouterr().out)["scores"]
    assert score["rms"] < 6.0  # N. Without Coulomb friction it is 10.7.
    assert run("fit", "effects", folder / "emps.h5", "--effect", "joint_coulomb", "-o", tmp_path / "other.json") == 2
    assert "for example tendon_stretch:T3" in capsys.readouterr().err


@pytest.mark.long
def test_a_first_look_at_the_axis_names_the_friction_that_its_recipe_leaves_out(folder, tmp_path, capsys):
    recipe = ROOT / "fits" / "emps-no-coulomb.toml"
    assert run("diagnose", folder / "emps.h5", "--recipe", recipe, "--quick", "--json", "-o", tmp_path) == 0
    gap = json.loads(capsys.readouterr().out)  # Stdout holds nothing else.
    assert gap == json.loads((tmp_path / "gap.json").read_text(encoding="utf-8"))
    verdict = gap["verdict"]
    assert verdict["status"] == "explained"
    assert verdict["effects"] == [{"effect": "joint_coulomb", "site": ["axis"]}]
    assert "a first look" in verdict["summary"]


@pytest.mark.long
def test_several_sessions_have_a_diagnosis_each_and_a_table_of_their_causes(folder, tmp_path, capsys):
    again = tmp_path / "again.h5"
    shutil.copy(folder / "emps.h5", again)
    recipe, out = ROOT / "fits" / "emps-no-coulomb.toml", tmp_path / "out"
    assert run("diagnose", folder / "emps.h5", again, "--recipe", recipe, "--quick", "-o", out) == 0
    header, row = [line for line in capsys.readouterr().out.splitlines() if line.startswith(("cause", "joint coulomb"))]
    assert header.split() == ["cause", "emps.h5", "again.h5"]
    assert row.count("over 99 %, c0 ") == 2
    one, other = (json.loads((out / name / "gap.json").read_text(encoding="utf-8")) for name in ("emps", "again"))
    assert one | {"data": "again.h5"} == other


def test_show_prints_tables_and_what_to_do_about_a_misfit(folder, capsys):
    assert run("show", folder / "fit.json") == 0
    out = capsys.readouterr().out
    assert "mass axis" in out
    assert "jaxfinger diagnose" in out


@pytest.mark.parametrize(
    ("size", "unit", "elastic", "damping"),
    [
        (1.0, " N mm ", "66.3; -13.0 ± 2.0", "1.20 ± 0.20  N mm s/rad"),
        (1e4, " N m ", "663; -130 ± 20", "12.0 ± 2.0  N m s/rad"),
    ],
)
def test_torques_are_in_a_unit_that_suits_the_machine(capsys, size, unit, elastic, damping):
    std = size / 1.96
    tables._joints(
        [
            {
                "joint": "J",
                "prismatic": False,
                "range": [-10.0, 90.0],
                "gravity": [1.0 * size, -12.0 * size],
                "elastic": [66.3 * size, -13.0 * size, 2.0 * std],
                "friction": [6.0 * size, 6.0 * size, None],
                "damping": [1.2 * size, 0.2 * std],
            }
        ]
    )
    out = capsys.readouterr().out
    assert unit in out
    assert elastic in out
    assert damping in out


def test_validation_on_the_other_recording(folder, capsys):
    assert run("validate", folder / "fit.json", folder / "emps-pulses.h5", "--json") == 0
    (score,) = json.loads(capsys.readouterr().out)["scores"]
    assert (score["experiment"], score["column"], score["units"]) == ("ID.3-dynamic", "axis", "N")
    assert 0 < score["noise"] < score["rms"] < 12  # N, where forces reach 150 N


def test_prediction_is_a_file_of_the_same_layout(folder, tmp_path):
    out = tmp_path / "p.h5"
    assert run("predict", folder / "fit.json", folder / "emps-pulses.h5", "-o", out) == 0
    with h5py.File(out) as predicted, h5py.File(folder / "emps-pulses.h5") as measured:
        (name,) = predicted["trials"]
        force, truth = (f["trials"][name]["joint_torque"][:] for f in (predicted, measured))
    assert force.shape == truth.shape
    assert 1 - np.var(truth - force) / np.var(truth) > 0.95


def test_a_stage_at_a_time(folder, tmp_path, capsys):
    assert run("fit", "id3", folder / "emps.h5", "-o", tmp_path / "f.json", "--recipe", "emps", "--json") == 0
    one = json.loads(capsys.readouterr().out)["parameters"]
    assert run("show", folder / "fit.json", "--json") == 0
    all_at_once = json.loads(capsys.readouterr().out)["parameters"]
    assert [p["value"] for p in one] == pytest.approx([p["value"] for p in all_at_once])


@pytest.mark.parametrize(
    ("tokens", "sentence"),
    [
        (("check", "{f}/none.h5"), None),
        (("identify", "{f}/none.h5", "-o", "{t}/x.json"), "none.h5"),
        (("identify", "{f}/fit.json", "-o", "{t}/x.json"), "HDF5"),
        (("identify", "{f}/emps.h5", "-o", "{t}/x.json", "--recipe", "none.toml"), "none.toml"),
        (("identify", "{f}/emps.h5", "-o", "{f}/fit.json"), "--overwrite"),
        (("identify", "{f}/emps.h5", "-o", "{t}/no/x.json"), "is no folder"),
        (("show", "{f}/emps.h5"), "no fit"),
        (("validate", "{f}/fit.json", "{f}/emps.h5", "-e", "VD.1"), "has no trial of VD.1"),
        (("predict", "{f}/fit.json", "{f}/emps.h5", "-o", "{f}/emps.h5"), "is read by this command"),
        (("predict", "{f}/fit.json", "{f}/emps.h5", "-o", "{f}/emps.h5", "--overwrite"), "is read by this command"),
        (("identify", "{f}/emps.h5", "-o", "{f}/emps.h5", "--overwrite"), "is read by this command"),
        (("identify", "{f}/emps.h5", "-o", "{f}/fit.json", "--recipe", "{f}/fit.json", "--overwrite"), "is read by"),
        (("import", "{f}/emps.h5", "--mapping", "m.toml", "-o", "{f}/emps.h5", "--overwrite"), "is read by this"),
        (("fit", "id3", "{f}/emps.h5", "-o", "{t}/x.json", "--start", "{f}/fit.json", "--recipe", "emps"), "--start"),
        (("simulate", "{f}/none.toml", "-o", "{t}/x.h5"), "none.toml"),
        (("import", "--mapping", "{f}/m.toml", "-o", "{t}/x.h5"), "no recording was given"),
        (("identify", "{f}/emps.h5"), None),
        (("identfy",), None),
        (("identify", "{f}", "-o", "{t}/x.json"), "is a folder"),
        (("identify", "{f}/emps.h5", "-o", "/dev/null", "--overwrite"), "is a device"),
        (("identify", "{f}/emps.h5", "-o", "{t}/x.json", "--recipe", "papper"), "did you mean 'paper'?"),
        (("identify", "{f}/emps.h5", "-o", "{t}/x.json", "--recipe", "{f}"), "Is a directory"),
        (("identify", "{f}/emps.h5", "-o", "{t}/x.json", "--figures", "{f}/fit.json"), "choose another folder"),
        (("fit", "id2", "{f}/emps.h5", "-o", "{t}/x.json", "--recipe", "emps"), "no ID.2 trial"),
        (("fit", "effects", "{f}/emps.h5", "-o", "{t}/x.json", "--effect", "joint_stribek:axis"), "'joint_stribeck'"),
        (("fit", "effects", "{f}/emps.h5", "-o", "{t}/x.json", "--effect", "joint_stribeck:Axis"), "mean 'axis'"),
        (("validate", "{f}/fit.json", "{f}/emps.h5", "--figures", "{f}/fit.json"), "is a file"),
        (("validate", "{f}/emps.h5", "{f}/fit.json"), "is an HDF5 file and no fit"),
        (("influence", "{f}/fit.json", DEMO), "where the fit has axis"),
        (("influence", "{f}/fit.json", "{f}/emps.h5", "--figure", "{t}/x.jpg"), "ends in .svg or .png"),
        (("diagnose", "{f}/fit.json", "-o", "{t}"), "is not an HDF5 file"),
        (("diagnose", "{f}/emps.h5", "-o", "{f}/fit.json"), "name a folder"),
        (("diagnose", "{f}/emps.h5", "-o", "{t}", "--tolerance", "abc"), "say a share such as 2%"),
        (("diagnose", "{f}/emps.h5", "-o", "{t}", "--predictions", "{f}/emps.h5"), "is the session itself"),
        (("diagnose", "{f}/emps.h5", "-o", "{t}", "--effects", "{f}"), "is not a Python file with effects"),
        (("diagnose", "{f}/emps.h5", "-o", "{t}", "--against", "{f}/emps.h5"), "is an HDF5 file and no fit"),
        (("diagnose", "{f}/emps.h5", "-o", "{t}", "--quik"), None),
        (("diagnose", "-o", "{t}"), "needs a session"),
        (("diagnose", "{f}/emps.h5", "{f}/emps.h5", "-o", "{t}"), "in files of different names"),
        (("demo", "-o", "{f}/fit.json"), "is a file"),
        (("look", "{f}/none.csv"), "does not exist"),
        (("simulate", "{f}/emps.h5", "-o", "{t}/x.h5"), "is not text"),
        (("record", "{f}/none.toml", "--rig", "{f}/none.toml", "-o", "{t}/x.h5"), "none.toml"),
        (("recover", "{f}/emps.h5", "-o", "{t}/x.h5"), "not a recording log"),
        (("sealed", "make", "{f}/fit.json", "--count", "1"), "is a file"),
        (("sealed", "close", "{f}/none"), "run them first"),
        (("--show-completion", "tcsh"), None),
    ],
)
def test_a_mistake_is_one_sentence_and_exit_code_2(folder, tmp_path, capsys, tokens, sentence):
    before = {p: p.read_bytes() for p in folder.iterdir()}
    assert run(*(str(t).format(f=folder, t=tmp_path) for t in tokens)) == 2
    said = capsys.readouterr()
    assert "Traceback" not in said.err + said.out
    if sentence is not None:
        (line,) = [line for line in said.err.splitlines() if line.startswith("jaxfinger: ")]
        assert sentence in line
    assert {p: p.read_bytes() for p in folder.iterdir()} == before
    assert not list(tmp_path.iterdir())


def test_a_fit_without_a_single_stage_is_refused(folder, tmp_path, capsys):
    """Its numbers would be those of the finger's description, and zeros."""
    recipe = tmp_path / "arms.toml"
    recipe.write_text('name = "arms"\n[fit]\nstages = ["ID.2"]\n')
    assert run("identify", folder / "emps.h5", "-o", tmp_path / "x.json", "--recipe", recipe) == 2
    assert "no ID.2 trial; nothing is fitted, so nothing written" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "x.json").exists()


def test_overwriting_when_asked(folder, tmp_path):
    out = tmp_path / "p.h5"
    out.write_text("old")
    assert run("predict", folder / "fit.json", folder / "emps.h5", "-o", out, "--overwrite") == 0
    assert h5py.is_hdf5(out)


def test_long_work_says_how_much_is_done_and_about_how_long_the_rest_takes(capsys, monkeypatch):
    from jaxfinger.cli import output
    from jaxfinger.progress import Step

    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    _clock(monkeypatch, 0.0, 1.0, 5.0, 30.0, 400.0, 401.0, 402.0)
    with output.progress("diagnose") as say:
        say("reading the file")
        say(Step("identifying", 0.05))
        say(Step("searching", 0.5))
        say(Step("refitting", 0.6))
        say(Step("writing", 1.0))
    assert capsys.readouterr().err.splitlines() == [
        "diagnose: reading the file",
        "diagnose: identifying (5 %)",
        "diagnose: searching (50 %, about 30 s left)",
        "diagnose: refitting (60 %, about 4 min left)",
        "diagnose: writing (100 %)",
    ]


def _clock(monkeypatch, *seconds):
    from jaxfinger.cli import output

    ticks = iter(seconds)
    monkeypatch.setattr(output.time, "monotonic", lambda: next(ticks))


def test_the_time_left_is_learned_from_the_last_run(capsys, monkeypatch, tmp_path):
    """Only a run that came to its end counts."""
    from jaxfinger.cli import output

    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))

    def run_once(*seconds, title="diagnose", fails=False):
        _clock(monkeypatch, *seconds)
        try:
            with output.progress(title) as say:
                say("searching")
                say("refitting")
                if fails:
                    raise ValueError
        except ValueError:
            pass
        return capsys.readouterr().err.splitlines()

    assert run_once(0.0, 10.0, 80.0, 90.0, fails=True) == ["diagnose: searching", "diagnose: refitting"]
    assert run_once(0.0, 25.0, 50.0, 100.0) == ["diagnose: searching", "diagnose: refitting"]
    assert run_once(0.0, 20.0, 40.0, 80.0) == [
        "diagnose: searching (25 %, about 60 s left)",
        "diagnose: refitting (50 %, about 40 s left)",
    ]
    assert run_once(0.0, 1.0, 2.0, 3.0, title="another") == ["another: searching", "another: refitting"]
    (tmp_path / "progress.json").write_text("[1, 2")
    assert run_once(0.0, 20.0, 40.0, 80.0)[0] == "diagnose: searching"


def test_a_terminal_of_ascii_and_a_library_that_warns():
    """Greek letters are replaced, and no warning of a library reaches stderr."""
    code = (
        "import warnings, logging, sys; from jaxfinger.cli import main\n"
        "try: main(['show', '--help'])\n"
        "except SystemExit: pass\n"
        "warnings.warn('a library says'); logging.getLogger('matplotlib').warning('a font'); print('τ = 1 µN')"
    )
    run_it = [sys.executable, "-c", code]
    done = subprocess.run(run_it, capture_output=True, env=os.environ | {"PYTHONIOENCODING": "ascii"}, check=True)
    assert done.stdout.rstrip().endswith(b"? = 1 ?N")
    assert done.stderr == b""


def test_effects_lists_the_catalogue_and_prints_one_in_full(capsys):
    assert run("effects") == 0
    assert "joint_backlash" in capsys.readouterr().out
    assert run("effects", "joint_backlash") == 0
    said = capsys.readouterr().out
    assert "dead zone" in said
    assert "width" in said
    assert run("effects", "elastic_hardening") == 0
    said = capsys.readouterr().out
    assert "0.4 × torque" in said
    assert "towards both limits" in said
    assert run("effects", "joint_backlas") == 2
    assert "did you mean 'joint_backlash'" in capsys.readouterr().err


def test_a_disk_that_is_full_is_one_sentence(folder):
    """A command whose output does not fit on the disk ends without a traceback, and not with exit code 0."""
    command = [sys.executable, "-m", "jaxfinger", "show", str(folder / "fit.json")]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    (sentence,) = done.stderr.splitlines()
    assert sentence.startswith("jaxfinger: the disk takes no more")


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_can_complete_commands_and_options(shell, capsys, tmp_path, monkeypatch):
    assert run("--show-completion", shell) == 0
    script = capsys.readouterr().out
    assert all(word in script for word in ("diagnose", "identify", "tolerance"))
    monkeypatch.setenv("HOME", str(tmp_path))
    assert run("--install-completion", shell) == 0
    (path,) = capsys.readouterr().out.split(": written")[:1]
    assert Path(path).read_text(encoding="utf-8").strip() == script.strip()


def test_bash_completes_what_was_begun(capsys):
    assert run("--show-completion", "bash") == 0
    ask = "COMP_WORDS=(jaxfinger iden); COMP_CWORD=1; _jaxfinger; echo ${COMPREPLY[@]}"
    script = f"{capsys.readouterr().out}\n{ask}"
    assert subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True).stdout == "identify\n"


@pytest.mark.parametrize(
    ("tokens", "says"),
    [
        (["validate", "fit.json"], "validate needs FILE: Session (HDF5), best of trials that the fit has not seen."),
        (["fit", "id2"], "fit id2 needs FILE: Session (HDF5)."),
        (["predict", "fit.json", "s.h5"], "predict needs --output: Predictions to write (HDF5)."),
    ],
)
def test_what_a_command_needs_is_said_in_a_sentence(tokens, says, capsys):
    with pytest.raises(SystemExit) as end:
        main(tokens)
    assert end.value.code == 2
    assert " ".join(capsys.readouterr().err.split()) == f"jaxfinger: {says}"


def test_a_fit_with_effects_is_refused_before_any_work_where_it_is_of_no_use(tmp_path, capsys):
    session = read_session(DEMO)
    fit = Fit.before(session, Recipe(), nominal_model(session, Recipe()))
    stretch = CATALOGUE["tendon_stretch"].at(fit.model.finger, ("T3",))
    save_fit(fit.with_effect(stretch, ("compliance",)), tmp_path / "fit.json")
    for command in (
        ("influence", tmp_path / "fit.json", DEMO),
        ("fit", "joint", DEMO, "--start", tmp_path / "fit.json"),
    ):
        more = ("-o", tmp_path / "out.json") if command[0] == "fit" else ()
        assert run(*command, *more) != 0
        assert f"{tmp_path / 'fit.json'}: its model has effects; give a fit of the nominal" in capsys.readouterr().err
    with pytest.raises(UserError, match="a fit with effects cannot be refined"):
        refine(session, load_fit(tmp_path / "fit.json"))
    # One that neither the catalogue nor a file has is named with the fit's file.
    text = (tmp_path / "fit.json").read_text()
    (tmp_path / "own.json").write_text(text.replace("tendon_stretch", "my_stretch"))
    assert run("fit", "id4", DEMO, "--start", tmp_path / "own.json", "-o", tmp_path / "out.json") != 0
    assert f"{tmp_path / 'own.json'}: the effect 'my_stretch' is not in the catalogue" in capsys.readouterr().err
