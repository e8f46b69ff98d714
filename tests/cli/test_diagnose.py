"""`jaxfinger diagnose` refuses mistakes before it starts to work."""

import pytest

from jaxfinger.cli import main


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
