"""`jaxfinger diagnose` refuses mistakes before it starts to work."""

from pathlib import Path

import pytest

from jaxfinger.cli import main
from jaxfinger.data import read_session, write_predictions
from jaxfinger.errors import UserError
from jaxfinger.identify import Fit, Recipe
from jaxfinger.identify.fit_file import save_fit
from jaxfinger.identify.nominal import nominal_model


@pytest.mark.parametrize("name", ["gap.json", "nominal.json", "augmented.json", "report.html"])
def test_an_earlier_diagnosis_is_kept(tmp_path, capsys, name):
    (tmp_path / name).write_text("kept")
    with pytest.raises(SystemExit) as stop:
        main(["diagnose", str(tmp_path / "none.h5"), "-o", str(tmp_path)])
    assert stop.value.code == 2
    assert f"{name}: exists already" in capsys.readouterr().err
    assert (tmp_path / name).read_text() == "kept"


def test_a_file_is_no_folder(tmp_path, capsys):
    (tmp_path / "out").write_text("")
    with pytest.raises(SystemExit):
        main(["diagnose", str(tmp_path / "none.h5"), "-o", str(tmp_path / "out")])
    assert "name a folder" in capsys.readouterr().err


def test_a_missing_session_is_said(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["diagnose", str(tmp_path / "none.h5"), "-o", str(tmp_path / "out")])
    assert stop.value.code == 2
    assert "none.h5" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_file_of_effects_is_loaded_before_the_session(tmp_path, capsys):
    (tmp_path / "mine.py").write_text("x = 1\n")
    with pytest.raises(SystemExit):
        main(
            ["diagnose", str(tmp_path / "none.h5"), "-o", str(tmp_path / "out"), "--effects", str(tmp_path / "mine.py")]
        )
    assert "defines no effect" in capsys.readouterr().err


@pytest.mark.parametrize("sessions", [["fresh"], ["fresh", "session"]])
def test_ctrl_c_leaves_no_empty_folder(tmp_path, monkeypatch, sessions):
    def pressed(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxfinger.gap.diagnose", pressed)
    demo = Path(__file__).parents[2] / "datasets" / "demo-finger"
    with pytest.raises((SystemExit, KeyboardInterrupt)):
        main(["diagnose", *(f"{demo / name}.h5" for name in sessions), "-o", f"{tmp_path}/new/out"])
    assert list(tmp_path.iterdir()) == []


def test_a_fit_of_the_session_itself_is_said_to_count_twice(tmp_path, capsys, monkeypatch):
    path = Path(__file__).parents[2] / "datasets" / "demo-finger" / "fresh.h5"
    session = read_session(path)
    save_fit(Fit.before(session, Recipe(), nominal_model(session, Recipe())), tmp_path / "fit.json")

    def ends(*args):
        raise UserError("ends here")

    monkeypatch.setattr("jaxfinger.gap.diagnose", ends)
    with pytest.raises(SystemExit):
        main(["diagnose", str(path), "--against", str(tmp_path / "fit.json"), "-o", str(tmp_path / "out")])
    assert f"fit.json: is a fit of {path} itself, whose data then count twice" in capsys.readouterr().err


def test_predictions_are_checked_before_the_work_begins(tmp_path, capsys, monkeypatch):
    """What can only be a mistake is refused with the file's name; what is doubtful goes to stderr."""
    path, file = Path(__file__).parents[2] / "datasets" / "demo-finger" / "fresh.h5", tmp_path / "simulator.h5"
    session = read_session(path)
    names = [t.name for t in session.select("ID.3-dynamic")]

    def ends(*args):
        raise UserError("ends here")

    monkeypatch.setattr("jaxfinger.gap.diagnose", ends)
    for factor, says in (
        (-0.9, f"jaxfinger: {file}: /trials/{names[0]}/joint_torque: predictions of"),
        (0.9, f"{file}: note: {len(names)} of {len(session)} trials are predicted"),
    ):
        told = {name: {"joint_torque": factor * session[name].joint_torque} for name in names}
        write_predictions(file, session, told, overwrite=True)
        with pytest.raises(SystemExit):
            main(["diagnose", str(path), "--predictions", str(file), "-o", str(tmp_path / "out")])
        assert says in capsys.readouterr().err
