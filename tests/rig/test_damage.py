"""Damage in the middle of a log costs what it touches, is said, and never mixes two trials."""

import io

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxfinger.cli.record import recover as recover_command
from jaxfinger.data import read_session
from jaxfinger.errors import UserError
from jaxfinger.rig import parse_plan, recover, wal
from jaxfinger.rig.backends.simulated import SimulatedRig
from jaxfinger.rig.convert import read_frames
from jaxfinger.rig.recover import read_log
from jaxfinger.rig.session import log_path, run
from tests.rig.conftest import SHORT, serious, slot

FIRST, SECOND, THIRD = "01-ID.2-DIP", "02-ID.4-T3-MCP", "03-ID.4-T3-MCP"


@pytest.fixture(scope="module")
def image(rig, tmp_path_factory) -> bytes:
    """A log of two complete trials and one that a fault cut short."""
    plan = parse_plan(SHORT + SHORT[SHORT.rindex("[[trial]]") :], rig)
    machine, path = SimulatedRig(rig), tmp_path_factory.mktemp("log") / "session.h5"

    def observe(view):
        if view.recording and view.trial == THIRD and not machine.controller.faults:
            machine.inject("nan", slot(machine, "external_torque"))

    outcome = run(plan, machine, path, observe=observe)
    assert outcome.complete == (FIRST, SECOND)
    return log_path(path).read_bytes()


def in_memory(image: bytes) -> list[wal.Frame]:
    return list(wal.frames(io.BytesIO(image)))


def span(image: bytes, trial: str, tag: bytes, number: int = 0) -> tuple[int, int]:
    """Bytes of a trial's frame: the one of this tag with this number."""
    found = in_memory(image)
    begin = next(i for i, f in enumerate(found) if f.tag == wal.TRIAL and f.json["name"] == trial)
    frame = [f for f in found[begin:] if f.tag == tag][number]
    return frame.start, frame.end


def spoiled(image: bytes, start: int, end: int) -> bytes:
    """The log with zeros in place of these bytes, as after a power cut."""
    return image[:start] + bytes(end - start) + image[end:]


def numbers(log) -> dict[str, np.ndarray]:
    """Numbers of each trial's samples."""
    return {t.name: np.concatenate([b.seq.astype(np.int64) for b in t.blocks] or [[]]) for t in log.trials}


def test_what_lies_on_either_side_of_the_damage_is_kept(rig, image, tmp_path, capsys):
    held = span(image, SECOND, wal.MARK, 1)[1]  # within the first hold
    start, end = next((f.start, f.end) for f in in_memory(image) if f.tag == wal.DATA and f.start > held + 10_000)
    samples = (end - start) // wal.sample_bytes(len(rig.channels))
    (tmp_path / "whole.wal").write_bytes(image)
    (tmp_path / "hurt.wal").write_bytes(spoiled(image, start + 40, start + 60))
    recover(tmp_path / "whole.wal", tmp_path / "whole.h5")
    recover_command(tmp_path / "hurt.wal", output=tmp_path / "hurt.h5")
    said = f"the log is damaged for {end - start} bytes from byte {start} on, within {SECOND}, "
    said += f"which lacks {samples} samples there"
    assert capsys.readouterr().out == f"{tmp_path / 'hurt.h5'}: 3 trials, cut short: {SECOND}, {THIRD}; {said}\n"
    whole, hurt = read_session(tmp_path / "whole.h5"), read_session(tmp_path / "hurt.h5")
    assert serious(tmp_path / "hurt.h5") == []
    assert [t.complete for t in whole] == [True, True, False]
    assert [t.complete for t in hurt] == [True, False, False]
    np.testing.assert_array_equal(hurt[FIRST].q, whole[FIRST].q)
    kept = np.isin(np.round(whole[SECOND].time, 6), np.round(hurt[SECOND].time, 6))
    assert (~kept).sum() == samples
    np.testing.assert_array_equal(hurt[SECOND].q, whole[SECOND].q[kept])
    unknown = hurt[SECOND].hold != whole[SECOND].hold[kept]
    assert unknown.any()  # A mark may have been among the damaged bytes: no hold is known until the next one.
    assert np.all(hurt[SECOND].hold[unknown] == -1)
    assert np.all(hurt[SECOND].hold[hurt[SECOND].hold >= 0] == whole[SECOND].hold[kept][hurt[SECOND].hold >= 0])
    with h5py.File(tmp_path / "hurt.h5") as file:
        assert said in file[f"trials/{SECOND}"].attrs["cause"]
        assert file[f"trials/{SECOND}"].attrs["lost_samples"] == samples
        table = file["rig/damage"]
        assert table["trial"].asstr()[()].tolist() == [SECOND]
        assert [table[k][()].tolist() for k in ("at", "size", "lost")] == [[start], [end - start], [samples]]
    with h5py.File(tmp_path / "whole.h5") as file:
        assert "damage" not in file["rig"]


def test_a_trial_whose_beginning_is_lost_is_not_added_to_the_one_before(image):
    start, end = span(image, FIRST, wal.END)[0], span(image, SECOND, wal.DATA, 2)[1]
    log = read_frames(in_memory(spoiled(image, start, end)))
    whole = numbers(read_frames(in_memory(image)))
    assert {t.name: t.complete for t in log.trials} == {FIRST: False, THIRD: False}
    np.testing.assert_array_equal(numbers(log)[FIRST], whole[FIRST])
    (damage,) = log.damage
    assert 0 < damage.left_out < len(whole[SECOND])
    assert str(damage).endswith(f"; {damage.left_out} samples of the trial that begins there are left out")


def test_damage_between_trials_is_said_and_costs_no_other_trial(image):
    start, end = span(image, SECOND, wal.TRIAL)[0], span(image, SECOND, wal.END)[1]
    log = read_frames(in_memory(spoiled(image, start, end)))
    assert {t.name: t.complete for t in log.trials} == {FIRST: True, THIRD: False}
    assert "between two trials" in str(log.damage[0])


def test_a_log_without_its_header_is_refused_with_the_reason(image, tmp_path):
    (tmp_path / "hurt.wal").write_bytes(spoiled(image, 12, 16))
    with pytest.raises(UserError, match="first frame is damaged"):
        read_log(tmp_path / "hurt.wal")


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_lost_blocks_of_the_disk_give_no_trial_a_sample_of_another_one(image, data):
    whole, hurt = read_frames(in_memory(image)), image
    head = in_memory(image)[0].end
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(head, len(image) - 1))
        hurt = spoiled(hurt, at, min(at + data.draw(st.sampled_from([1, 4096, 65536])), len(image)))
    log, before = read_frames(in_memory(hurt)), numbers(whole)
    for trial in log.trials:
        assert set(numbers(log)[trial.name].tolist()) <= set(before[trial.name].tolist())
        if trial.complete:
            np.testing.assert_array_equal(numbers(log)[trial.name], before[trial.name])
    hit = {t.name for t in log.trials if t.damage}
    assert hurt == image or log.damage or len(in_memory(hurt)) < len(in_memory(image))
    assert not any(t.complete for t in log.trials if t.name in hit)


def test_a_disk_that_keeps_a_trial_badly_is_said_and_the_trial_is_repeated(rig, record, monkeypatch):
    write, data = wal.LogWriter._write, []

    def flips(log, payload):
        data.extend([payload] if payload[:4] == wal.DATA else [])
        write(log, payload[:50] + b"?" + payload[51:] if len(data) == 3 and payload is data[-1] else payload)

    monkeypatch.setattr(wal.LogWriter, "_write", flips)
    outcome = record(SimulatedRig(rig))
    assert outcome.cause.startswith(f"the disk did not keep {FIRST} whole; the log is damaged for ")
    assert outcome.complete == (SECOND,)
    monkeypatch.undo()
    again = record(SimulatedRig(rig), resume=True)
    assert again.cause == ""
    assert again.complete == (SECOND, f"{FIRST}-2")
    assert list(read_session(again.session).trials) == [FIRST, SECOND, f"{FIRST}-2"]


def test_what_a_resumed_recording_cuts_off_is_noted(rig, record, tmp_path):
    record(SimulatedRig(rig), lambda m: m.inject("nan", slot(m, "external_torque")))
    path = log_path(tmp_path / "session.h5")
    path.write_bytes(path.read_bytes() + b"half a frame")
    outcome = record(SimulatedRig(rig), resume=True)
    with h5py.File(outcome.session) as file:
        assert any("12 bytes at the log's end were not whole" in e for e in file["rig/events"].asstr()[()])
