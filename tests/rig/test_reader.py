"""The reader logs by how much the host's clock leads the controller's, and turns every exception into an error."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

from jaxfinger.rig import reader as module
from jaxfinger.rig import wal
from jaxfinger.rig.contract import Trip
from jaxfinger.rig.reader import EPOCH_NS, Reader
from jaxfinger.rig.recorder import Recorder
from jaxfinger.rig.safety import Supervisor


@pytest.mark.parametrize(("lead_s", "drift"), [(3.0, 5e-3), (-0.5, -1e-3)])
def test_the_drift_between_two_clocks_shows_from_trial_to_trial(simulated, tmp_path, monkeypatch, lead_s, drift):
    """Blocks take up to 40 ms to arrive; 10 s lie between the trials."""
    rng, born = np.random.default_rng(5), simulated.controller
    start = None

    def host() -> int:
        nonlocal start
        device = 820_000_000 * 10**9 + (born.seq - 1) * 10**6
        start = device if start is None else start
        on_its_way = rng.exponential(4e6) if rng.random() < 0.9 else 40e6
        return EPOCH_NS + device + int(lead_s * 1e9 + drift * (device - start) + on_its_way)

    monkeypatch.setattr(module, "time", SimpleNamespace(time_ns=host, monotonic=time.monotonic))
    simulated.synchronous = False  # as a rig with a clock of its own; its samples are still made when they are read
    recorder = Recorder(tmp_path / "a.wal", {})
    with simulated:
        reader = Reader(simulated, recorder, Supervisor(simulated.description))
        for _ in range(2):
            reader.begin({})
            for _ in range(50):
                assert reader._step(0.0), reader.error
            reader.end({"complete": True})
            simulated._pause(10.0)
            simulated.rewind(born.seq)
    recorder.close()
    first, second = (f.json["clocks"] for f in wal.read_log(recorder.path) if f.tag == wal.END)
    for ahead, at in (first, second):
        assert ahead * 1e-9 == pytest.approx(lead_s + drift * (at - start) * 1e-9, abs=1e-3)
    assert (second[0] - first[0]) / (second[1] - first[1]) == pytest.approx(drift, abs=2e-4)


def test_a_computer_that_has_slept_is_not_taken_for_a_wrong_clock_alone(simulated, tmp_path):
    """Its own clock stood still, while the controller's samples went on; the drives are off."""
    recorder, controller = Recorder(tmp_path / "a.wal", {}), simulated.controller
    with simulated:
        reader = Reader(simulated, recorder, Supervisor(simulated.description))
        simulated.synchronous = simulated.simulated_time = False
        for samples in (20, 20, 10_000):
            for _ in range(samples):
                controller.cycle()
            assert reader._step(time.monotonic())
            assert (reader.unarmed_violation is None) == (samples == 20)
    recorder.close()
    assert reader.unarmed_violation is not None
    assert reader.unarmed_violation.trip is Trip.CLOCK
    assert "whether this computer slept" in reader.unarmed_violation.sentence


def test_whatever_goes_wrong_in_a_read_is_an_error_that_ends_the_trial(simulated, tmp_path, monkeypatch):
    """An exception that nobody expected must not leave a run waiting for samples that never come."""

    def broken(timeout):
        raise ValueError("half a header")

    recorder = Recorder(tmp_path / "a.wal", {})
    with simulated:
        reader = Reader(simulated, recorder, Supervisor(simulated.description))
        monkeypatch.setattr(simulated, "read_block", broken)
        assert reader.next() is None
    recorder.close()
    assert str(reader.error) == "the rig cannot be read: ValueError: half a header"
