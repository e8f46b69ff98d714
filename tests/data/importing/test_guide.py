"""The guide docs/your-own-data.md works from start to end, and names every key and unit."""

import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from jaxfinger.cli import main
from jaxfinger.data import check_file, read_predictions, read_session
from jaxfinger.data.importing.mapping import Column, MappedTrial, MappingFile
from jaxfinger.data.units import TO_SI

ROOT = Path(__file__).parents[3]
GUIDE = (ROOT / "docs" / "your-own-data.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)([^\n]*)\n(.*?)^```", GUIDE, re.M | re.S)


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    """Folder after all commands of the guide were run in it, with all of its files."""
    folder = tmp_path_factory.mktemp("reader")
    patch = pytest.MonkeyPatch()
    patch.chdir(folder)
    shutil.copytree(
        ROOT / "docs", folder / "docs", ignore=lambda _, names: [n for n in names if n != "own_data_logs.py"]
    )
    try:
        for kind, name, text in BLOCKS:
            if kind == "toml":
                Path(name.strip()).write_text(text, encoding="utf-8")
            for line in text.splitlines() if kind == "bash" else ():
                run(shlex.split(line))
    finally:
        patch.undo()
    return folder


def run(words: list[str]) -> None:
    match words:
        case ["mkdir", folder]:
            Path(folder).mkdir()
        case ["python", *rest]:
            subprocess.run([sys.executable, *rest], check=True)
        case ["jaxfinger", *rest]:
            main([str(path) for word in rest for path in (sorted(Path().glob(word)) if "*" in word else [word])])
        case _:
            raise AssertionError(words)


def test_the_guide_leads_to_the_truth(followed):
    """The logs' own constants come back: stiffness, friction, damping, moment arms and the tendons' loss."""
    from docs import own_data_logs as truth
    from jaxfinger.identify import load_fit

    assert [f for f in check_file(followed / "session.h5") if f.severity != "note"] == []
    assert [s.status for s in load_fit(followed / "fit.json").stages] == ["fitted"] * 4
    found = {row["name"]: row["value"] for row in load_fit(followed / "fit.json").table()}
    assert found["friction torque MCP^0"] == pytest.approx(truth.FRICTION, rel=0.1)
    assert found["elastic torque MCP^1"] == pytest.approx(truth.STIFFNESS, rel=0.05)
    assert found["damping MCP"] == pytest.approx(truth.DAMPING, rel=0.25)
    for tendon, arm in truth.ARMS.items():
        assert found[f"excursion {tendon} MCP^1"] == pytest.approx(arm, rel=0.05)


def test_two_loggers_make_one_trial(followed):
    session = read_session(followed / "session.h5")
    static, dynamic = session["02-ID3-static-MCP"], session["03-ID3-dynamic-MCP"]
    assert static.duration == pytest.approx(8 * 2.5 + 1.5, abs=0.1)
    assert np.isfinite(static.joint_torque).all()
    assert dynamic.q[:, 0].max() == pytest.approx(1.3, abs=0.01)


def test_the_format_is_described_as_it_is_read():
    from jaxfinger.data import schema

    text = (ROOT / "docs" / "dataset-format.md").read_text(encoding="utf-8")
    tables = {"joints/": schema.JOINTS, "links/": schema.LINKS, "tendons/": schema.TENDONS}
    entries = [(table + entry.name, entry) for table, rows in tables.items() for entry in rows]
    entries += [(e.name, e) for e in (schema.FINGERTIP, schema.TIME, *schema.CHANNELS.values(), schema.TEMPERATURE)]
    for name, entry in entries:
        row = next(
            (line for line in text.splitlines() if line.startswith("| `") and f"`{name}`" in line.split("|")[1]), ""
        )
        shape = ", ".join(map(str, entry.shape)) + ("," if len(entry.shape) == 1 else "")
        assert f"({shape})" in row, name
        assert entry.units is None or f"| {entry.units} |" in row, name
    assert schema.VERSION in text


def test_the_guide_names_every_key_and_unit():
    keys = {f.name.rstrip("_") for kind in (MappingFile, MappedTrial, Column) for f in fields(kind)} - {"trials"}
    assert [key for key in keys if f"`{key}`" not in GUIDE and f"`[{key}]`" not in GUIDE] == []
    units = GUIDE[GUIDE.index("Units: ") :].split("\n")[0]
    assert [unit for unit in TO_SI if unit != "1" and unit not in units] == []


def test_the_page_writes_predictions_of_another_simulator(followed, monkeypatch):
    """The page's script predicts the torque of the joint that is moved, and of no other."""
    monkeypatch.chdir(followed)
    (script,) = (text for kind, _, text in BLOCKS if kind == "python")
    exec(compile(script, "page", "exec"), {})
    found = read_predictions("simulator.h5")
    session = read_session("session.h5")
    assert set(found) == {trial.name for trial in session if trial.experiment.startswith("ID.3")}
    assert all(np.isfinite(channels["joint_torque"]).all() for channels in found.values())
