"""Inputs of users, one of each kind of mistake. `cases/<name>/expected.txt` states what the user should get."""

import io
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from jaxfinger.cli import main
from jaxfinger.data import check_file, read_session

CASES = Path(__file__).parent / "cases"
SOUND = CASES / "predictions-with-a-few-nan" / "s.h5"
REFUSED = [
    ("csv-as-other-programs-write-it", "scope.csv", "scope.toml", ["'t'", "q, q.time, tau, tau.time"]),
    ("csv-two-columns-of-one-name", "log.csv", "m.toml", ["q is the name of the columns 2 and 4"]),
    ("import-writes-what-check-refuses", "log.csv", "trial-name.toml", ["a/b", "slash"]),
    ("import-writes-what-check-refuses", "log.csv", "direction.toml", ["joint_direction", "492.73", "-1, 0 or 1"]),
    ("import-writes-what-check-refuses", "log.csv", "hold.toml", ["channels.hold", "0.800013"]),
    ("import-writes-what-check-refuses", "log.csv", "session-start.toml", ["session_start", "'12'"]),
    ("import-writes-what-check-refuses", "log.csv", "motion.toml", ["motion", "not 3"]),
    ("import-writes-what-check-refuses", "log.csv", "source.toml", ["source", "not 3"]),
    ("false-as-text-is-true", "log.csv", "complete.toml", ["complete", "true or false", "'false'"]),
    ("false-as-text-is-true", "log.csv", "active.toml", ["active", "true or false", "'false'"]),
    ("mapping-value-of-the-wrong-kind", "log.csv", "offset-text.toml", ["offset", "'0.3'"]),
    ("mapping-value-of-the-wrong-kind", "log.csv", "scale-list.toml", ["scale", "[1.0, 2.0]"]),
    ("mapping-value-of-the-wrong-kind", "log.csv", "channels-number.toml", ["channels", "not 3"]),
    ("mapping-value-of-the-wrong-kind", "log.csv", "shared-list.toml", ["channels", "[1]"]),
    ("joint-states-of-two-publishers", "log", "m.toml", ["J, K; L, M", "choose by name"]),
    ("matlab-object-read-as-six-numbers", "log.mat", "m.toml", ["MATLAB object (timeseries)", "Data"]),
    ("matlab-object-read-as-six-numbers", "log.mat", "rate.toml", ["MATLAB object (timeseries)", "Data"]),
    ("mcap-in-an-encoding-that-is-not-read", "log.mcap", "m.toml", ["/joint_states is in protobuf", "convert"]),
    ("own-clock-does-not-overlap", "log.mat", "m.toml", ["`t2` runs from 312.5", "1700000000", "do not overlap"]),
    ("own-clock-out-of-order", "log.mat", "m.toml", ["`t2` does not increase at 124 of 600", "first after sample 52"]),
    ("stamps-out-of-order-and-the-advice", "log.csv", "m.toml", ["560 of 1200", "sorted by their time", "sort = true"]),
    ("variable-that-is-there-called-absent", "complex.mat", "complex.toml", ["q is complex"]),
    ("variable-that-is-there-called-absent", "empty.mat", "empty.toml", ["tau is empty"]),
    ("variable-that-is-there-called-absent", "signals.mat", "signals.toml", ["ScopeData.signals is a list of 2"]),
    ("variable-that-is-there-called-absent", "widths", "widths.toml", ["/joint_states.position", "change", "J, K; G"]),
]
IMPORTED = [
    ("csv-as-other-programs-write-it", "quoted.csv", "quoted.toml"),
    ("csv-as-other-programs-write-it", "utf16.csv", "utf16.toml"),
    ("csv-as-other-programs-write-it", "latin1.csv", "latin1.toml"),
    ("csv-as-other-programs-write-it", "decimal-comma.csv", "decimal-comma.toml"),
    ("csv-as-other-programs-write-it", "heads.csv", "heads.toml"),
    ("csv-header-behind-a-hash", "log.csv", "m.toml"),
    ("extension-in-capitals", "LOG.CSV", "m.toml"),
    ("mapping-value-of-the-wrong-kind", "log.csv", "created-date.toml"),
    ("one-topic-of-an-unknown-type", "log", "m.toml"),
    ("simulink-signal-of-two-columns", "log.mat", "m.toml"),
    ("simulink-signal-of-two-columns", "rows.mat", "rows.toml"),
]


def run(*tokens) -> int:
    """Exit code of a command in this process; a traceback fails the test."""
    try:
        main([str(token) for token in tokens])
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def bring_in(case: str, recording: str, mapping: str, out: Path) -> int:
    return run("import", CASES / case / recording, "--mapping", CASES / case / mapping, "-o", out)


@pytest.mark.parametrize(("case", "recording", "mapping", "words"), REFUSED)
def test_what_cannot_be_read_is_refused_in_one_sentence(case, recording, mapping, words, tmp_path, capsys):
    assert bring_in(case, recording, mapping, tmp_path / "s.h5") == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert all(word in said for word in words), said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("case", "recording", "mapping"), IMPORTED)
def test_what_other_programs_write_is_read(case, recording, mapping, tmp_path):
    """All of these files hold the same log of 1200 samples. Its first and last samples are compared."""
    assert bring_in(case, recording, mapping, tmp_path / "s.h5") == 0
    trial = read_session(tmp_path / "s.h5")["01-dyn"]
    assert trial.q.shape == (1200, 1)
    assert trial.time[-1] == pytest.approx(5.995)
    assert trial.q[0, 0] == pytest.approx(0.8, abs=1e-3)
    assert trial.joint_torque[0, 0] == pytest.approx(0.0493, abs=1e-3)


def test_units_that_the_recording_states_are_compared(tmp_path, capsys):
    bring_in("csv-as-other-programs-write-it", "latin1.csv", "latin1.toml", tmp_path / "s.h5")
    assert "states °, and the mapping reads rad" in capsys.readouterr().err


def test_a_joint_of_two_publishers_is_found_by_its_name(tmp_path):
    """The two publishers of the topic send the joints J and L. Messages with L are no samples of this trial."""
    case = CASES / "joint-states-of-two-publishers"
    text = (case / "m.toml").read_text().replace("column = 0", 'column = "J"')
    (tmp_path / "m.toml").write_text(text)
    assert run("import", case / "log", "--mapping", tmp_path / "m.toml", "-o", tmp_path / "s.h5") == 0
    trial = read_session(tmp_path / "s.h5")["01-dyn"]
    assert np.abs(np.diff(trial.q[:, 0])).max() < 0.02
    assert [f for f in check_file(tmp_path / "s.h5") if f.severity != "note"] == []


def test_a_field_that_messages_lack_keeps_its_place(tmp_path, capsys):
    case = CASES / "effort-missing-in-the-first-messages"
    assert run("import", case / "log", "--mapping", case / "m.toml", "-o", tmp_path / "s.h5") == 0
    text = (case / "m.toml").read_text().replace("span = [0.5, 5.0]", "")
    (tmp_path / "m.toml").write_text(text)
    assert run("import", case / "log", "--mapping", tmp_path / "m.toml", "-o", tmp_path / "t.h5") == 2
    assert "NaN in 50 of 1200 samples, first at 0 s; cut these samples out (`span`" in capsys.readouterr().err


def test_a_span_counts_from_the_first_sample(tmp_path):
    assert bring_in("one-message-at-time-zero", "log.mcap", "m.toml", tmp_path / "s.h5") == 0
    assert read_session(tmp_path / "s.h5")["01-dyn"].duration == pytest.approx(4.0, abs=0.01)


def test_a_clock_of_its_own_has_the_units_of_the_time(tmp_path):
    """The trial's clock and the torque's own clock both count ms. The torque must have the log's range."""
    assert bring_in("own-clock-in-ms", "log.mat", "m.toml", tmp_path / "s.h5") == 0
    torque = read_session(tmp_path / "s.h5")["01-dyn"].joint_torque[:, 0]
    assert torque.min() == pytest.approx(-0.06, abs=0.01)
    assert torque.max() == pytest.approx(0.085, abs=0.001)


def test_two_recordings_of_one_name_are_told_apart_by_their_folders(tmp_path, capsys):
    case = CASES / "two-recordings-of-one-name"
    logs = case / "monday" / "log.csv", case / "tuesday" / "log.csv"
    assert run("import", *logs, "--mapping", case / "m.toml", "-o", tmp_path / "s.h5") == 2
    assert "2 of the recordings are called log.csv" in capsys.readouterr().err
    text = (case / "m.toml").read_text()
    (tmp_path / "m.toml").write_text(text.replace("log.csv", "tuesday/log.csv"))
    assert run("import", *logs, "--mapping", tmp_path / "m.toml", "-o", tmp_path / "s.h5") == 0
    (tmp_path / "m.toml").write_text(text)
    assert run("import", logs[1], "--mapping", tmp_path / "m.toml", "-o", tmp_path / "t.h5") == 0
    ours, alone = (read_session(tmp_path / name)["01-dyn"] for name in ("s.h5", "t.h5"))
    np.testing.assert_array_equal(ours.q, alone.q)


def test_an_encoder_that_wraps_is_said_and_unwrapped(tmp_path, capsys):
    case = CASES / "encoder-that-wraps"
    assert bring_in("encoder-that-wraps", "log.csv", "m.toml", tmp_path / "s.h5") == 0
    assert "jumps by a whole turn between two samples at 11 places" in capsys.readouterr().err
    assert any("whole turn" in f.message for f in check_file(tmp_path / "s.h5"))
    text = (case / "m.toml").read_text().replace('units = "deg"', 'units = "deg", unwrap = true')
    (tmp_path / "m.toml").write_text(text)
    assert run("import", case / "log.csv", "--mapping", tmp_path / "m.toml", "-o", tmp_path / "t.h5") == 0
    assert not any("turn" in f.message for f in check_file(tmp_path / "t.h5"))


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("compression-that-is-not-installed/s.h5", ["q: is compressed", "blosc, 32001", "hdf5plugin"]),
        ("empty-dataset/s.h5", ["joint_torque: is empty (it has no shape)", "leave it out"]),
        ("session-open-in-another-program/not-closed.h5", ["was not closed by the program", "h5clear"]),
    ],
)
def test_why_a_session_cannot_be_read(file, words, capsys):
    assert run("check", CASES / file) == 2
    said = capsys.readouterr().out
    assert all(word in said for word in words), said
    assert "damaged" not in said
    assert "truncated" not in said


def test_a_session_that_is_open_elsewhere(tmp_path, capsys):
    shutil.copyfile(SOUND, tmp_path / "s.h5")
    code = "import h5py, sys; f = h5py.File(sys.argv[1], 'r+'); print('open', flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", code, tmp_path / "s.h5"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "open\n"
        assert run("check", tmp_path / "s.h5") == 2
        other.communicate("\n")
    assert "is open in another program; close it there" in capsys.readouterr().out


def test_predictions_with_a_few_nan(tmp_path, capsys):
    predictions = CASES / "predictions-with-a-few-nan" / "p.h5"
    assert run("diagnose", SOUND, "--predictions", predictions, "--quick", "-o", tmp_path / "d") == 2
    assert "/trials/01-dyn/joint_torque: is NaN in 5 of 1200 samples, first at 1 s" in capsys.readouterr().err


def test_a_platform_that_is_not_there(monkeypatch, capsys):
    """Without a device, JAX may raise an exception of any kind. The message is given only where there is no device."""

    def fail(*arguments, **options):
        raise AssertionError("no backend")

    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    monkeypatch.setattr("jaxfinger.cli.app.app", fail)
    monkeypatch.setattr("jax.devices", fail)
    assert run("identify", SOUND, "-o", "f.json") == 2
    said = capsys.readouterr().err
    assert said.startswith("jaxfinger: JAX_PLATFORMS names cuda, which is not there; unset it, or set it to cpu")
    monkeypatch.setattr("jax.devices", lambda: ["cpu"])
    with pytest.raises(AssertionError, match="no backend"):
        run("identify", SOUND, "-o", "f.json")


def test_import_repeats_what_check_warns_of(tmp_path, capsys):
    assert bring_in("time-in-ms-taken-for-s", "log.csv", "m.toml", tmp_path / "s.h5") == 0
    assert "times more slowly than in the protocol; convert ms to s" in capsys.readouterr().err


def test_identify_on_an_output_without_greek_of_torques_that_trade_off_exactly(tmp_path, capsys, monkeypatch):
    """`identify` repeats the checker's warnings, and torques that the trials do not determine have no interval."""
    assert bring_in("unseen-torques-with-an-interval-of-zero", "log.csv", "m.toml", tmp_path / "s.h5") == 0
    with h5py.File(tmp_path / "s.h5", "r+") as file:
        file.attrs["created"] = "on \x1b[31mMonday"
    out = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(out, encoding="cp1252"))
    assert run("identify", tmp_path / "s.h5", "-o", tmp_path / "f.json") == 0
    sys.stdout.flush()
    warned, said = capsys.readouterr().err, out.getvalue().decode("cp1252")
    assert "warning: has `created` 'on " in warned
    assert "\x1b" not in warned
    assert "friction torque J^2" in said
    row = next(line for line in said.splitlines() if line.startswith("J ") and "N mm s/rad" in line)
    assert row.count("± ?") == 2
    assert "ID.3-static of joint J and ID.3-static of joint J" not in said


@pytest.mark.parametrize("kind", ["virtual", "external", "link"])
def test_numbers_that_lie_in_another_file_are_refused(kind, tmp_path):
    """HDF5 reads zeros where the other file is missing."""
    shutil.copyfile(SOUND, tmp_path / "s.h5")
    place = "trials/01-dyn/q"
    with h5py.File(tmp_path / "s.h5", "r+") as file:
        q, units = file[place][()], file[place].attrs["units"]
        del file[place]
        if kind == "virtual":
            layout = h5py.VirtualLayout(q.shape, q.dtype)
            layout[:] = h5py.VirtualSource(str(tmp_path / "gone.h5"), "q", q.shape)
            file.create_virtual_dataset(place, layout)
        elif kind == "external":
            file.create_dataset(place, q.shape, q.dtype, external=[(str(tmp_path / "q.raw"), 0, q.nbytes)])
        else:
            with h5py.File(tmp_path / "other.h5", "w") as other:
                other["q"] = q
                other["q"].attrs["units"] = units
            file[place] = h5py.ExternalLink("other.h5", "q")
        if kind != "link":
            file[place].attrs["units"] = units
    errors = [f for f in check_file(tmp_path / "s.h5") if f.severity == "error"]
    assert any("another file" in f.message and f.place.endswith("/q") for f in errors)
