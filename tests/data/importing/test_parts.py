"""Logs of several trials, told apart by words, and recordings of one name, told apart by their folders."""

from pathlib import Path

import numpy as np
import pytest

from jaxfinger.cli import main
from jaxfinger.data import read_session
from jaxfinger.data.finger_file import finger_from
from jaxfinger.data.importing.by_mapping import import_session
from jaxfinger.data.importing.proposal import proposal
from jaxfinger.data.importing.sources import load_recording
from jaxfinger.data.toml import Place
from tests.data.conftest import ONE_JOINT

TIME = np.arange(400) / 100.0
SWEEP = 0.5 + 0.4 * np.sin(TIME)


def of_a_day(path: Path, words: list[str], starts: list[float]) -> Path:
    """A log of 3 s for each of the words, which begin at these times."""
    trials = enumerate(zip(words, starts, strict=True))
    rows = [
        f"{word},{start + t:.2f},{(80.0 - 9.0 * k) * np.sin(t):.4f},{np.cos(t):.4f}"
        for k, (word, start) in trials
        for t in np.arange(300) / 100
    ]
    path.write_text("\n".join(["the trial,t,angle_deg,torque_mNm", *rows, ""]))
    return path


@pytest.mark.parametrize("starts", [[0.0, 20.0, 50.0], [0.0, 0.0, 0.0]])
def test_words_of_a_log_that_tell_trials_apart_make_a_trial_of_each(tmp_path, starts):
    path = of_a_day(tmp_path / "log.csv", ["first", "it's", "third"], starts)
    (tmp_path / "finger.toml").write_text(ONE_JOINT[ONE_JOINT.index("[finger]") :])
    finger = finger_from(str(tmp_path / "finger.toml"), Place(""))
    (tmp_path / "map.toml").write_text(proposal([load_recording(path)], finger))
    session = import_session([path], tmp_path / "map.toml")
    assert list(session.trials) == ["01-log-first", "02-log-it-s", "03-log-third"]
    for trial in session:
        np.testing.assert_allclose(trial.time, np.arange(300) / 100, atol=1e-6)


def test_idle_samples_without_a_word_lie_between_trials(tmp_path):
    path = of_a_day(tmp_path / "log.csv", ["first", "", "second"], [0.0, 3.0, 6.0])
    said = proposal([load_recording(path)])
    assert "where = \"'the trial' == 'first'\"" in said
    assert "where = \"'the trial' == 'second'\"" in said
    assert said.count("[trials.") == 2


@pytest.mark.parametrize(
    ("words", "starts"),
    [
        (["up", "down"], [0.0, 3.0]),  # phases of one trial, without a pause
        (["up", "down", "up"], [0.0, 20.0, 50.0]),  # a state that comes again
    ],
)
def test_words_that_tell_no_trials_apart_are_named_in_the_proposal(tmp_path, words, starts):
    said = proposal([load_recording(of_a_day(tmp_path / "log.csv", words, starts))])
    assert "# \"the trial\" holds the words 'up', 'down'; a trial's `where` can test it" in said
    assert said.count("[trials.") == 1


def test_recordings_of_one_name_in_folders_of_their_own_are_told_apart(tmp_path, capsys):
    """A folder a trial is a usual order. What is proposed imports as it stands, and names trials by their folders."""
    runs = {"bend": 1.0, "stretch": 0.5}
    for name, size in runs.items():
        (tmp_path / name).mkdir()
        table = np.column_stack([TIME, size * SWEEP, 0.01 * SWEEP])
        np.savetxt(tmp_path / name / "log.csv", table, "%.6f", ",", header="t [s],q [rad],tau [N m]", comments="")
    files = [str(tmp_path / name / "log.csv") for name in runs]
    (tmp_path / "finger.toml").write_text(ONE_JOINT[ONE_JOINT.index("[finger]") :])
    main(["look", *files, "--finger", str(tmp_path / "finger.toml")])
    said, mapping = capsys.readouterr().out, tmp_path / "map.toml"
    mapping.write_text(said[said.index("# a mapping") :])
    main(["import", *files, "--mapping", str(mapping), "--output", str(tmp_path / "s.h5")])
    assert "import: bend/log.csv, stretch/log.csv" in capsys.readouterr().err
    session = read_session(tmp_path / "s.h5")
    for trial, (name, size) in zip(session, runs.items(), strict=True):
        assert name in trial.name
        assert np.ptp(trial.q) == pytest.approx(size * np.ptp(SWEEP), rel=0.01)
