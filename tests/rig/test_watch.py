"""The watch acts within its own time, whatever call to the controller hangs."""

import signal
import threading
import time
from types import SimpleNamespace

import pytest

from jaxfinger.rig.contract import Trip
from jaxfinger.rig.operator import STOP_KEY, TERMINAL_GONE, Nobody
from jaxfinger.rig.reader import Reader
from jaxfinger.rig.recorder import Recorder
from jaxfinger.rig.safety import Supervisor
from jaxfinger.rig.signals import Interrupts
from jaxfinger.rig.watch import Watch

PATIENCE_S = 10.0  # s for a loaded machine; what is tested happens within a few periods of the watch, or never


def until(condition) -> bool:
    deadline = time.monotonic() + PATIENCE_S
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.005)
    return condition()


class Pressing(Nobody):
    """An operator who can ask for a stop."""

    asked = ""

    def stop_request(self) -> str:
        return self.asked


@pytest.fixture
def watched(simulated, tmp_path):
    """A watch over a rig that runs in real time, whose heartbeats are counted and hang once `hang` is set."""
    simulated.synchronous = simulated.simulated_time = False
    beats, hang, go = [], threading.Event(), threading.Event()

    def beat():
        beats.append(time.monotonic())
        if hang.is_set():
            go.wait(60.0)

    simulated.beat = beat
    recorder = Recorder(tmp_path / "a.wal", {})
    reader = Reader(simulated, recorder, Supervisor(simulated.description))
    operator = Pressing()
    watch = Watch(simulated, reader, operator, Interrupts())
    watch.start()
    yield SimpleNamespace(watch=watch, reader=reader, operator=operator, beats=beats, hang=hang)
    go.set()
    watch.close()
    recorder.close()


def test_the_stop_key_is_heard_while_a_heartbeat_hangs_in_its_call(watched):
    watched.hang.set()
    sent = len(watched.beats)
    assert until(lambda: len(watched.beats) > sent)  # This one hangs.
    watched.operator.asked = STOP_KEY
    assert until(lambda: watched.reader.violation is not None)
    assert watched.reader.violation.trip is Trip.OPERATOR


def test_a_heartbeat_that_hangs_in_its_call_is_a_silent_thread(watched):
    watched.watch.guards = True
    assert until(lambda: len(watched.beats) > 2)
    assert watched.reader.violation is None
    watched.hang.set()
    assert until(lambda: watched.reader.violation is not None)
    assert watched.reader.violation.trip is Trip.HOST
    assert "heartbeat" in watched.reader.violation.sentence


def test_a_terminal_that_is_gone_is_no_stop_key(watched):
    watched.operator.asked = TERMINAL_GONE
    assert until(lambda: watched.reader.violation is not None)
    assert watched.reader.violation.sentence == TERMINAL_GONE


def test_no_heartbeat_follows_a_stop(watched):
    assert until(lambda: len(watched.beats) > 2)
    watched.operator.asked = STOP_KEY
    assert until(lambda: watched.reader.violation is not None)
    time.sleep(0.05)  # for one that was on its way
    sent = len(watched.beats)
    time.sleep(0.3)  # six times BEAT_S
    assert len(watched.beats) == sent


def test_only_a_pause_that_ends_with_sigcont_is_a_suspension(simulated, tmp_path):
    """A busy computer makes pauses too, and one from before the last Enter matters no more."""
    simulated.synchronous = simulated.simulated_time = False
    recorder, begun = Recorder(tmp_path / "a.wal", {}), time.monotonic()
    with Interrupts() as interrupts:
        watch = Watch(simulated, Reader(simulated, recorder, Supervisor(simulated.description)), Nobody(), interrupts)
        watch._checked -= 5.0
        assert watch.suspended_s(begun) == 0.0
        signal.raise_signal(signal.SIGCONT)
        for _ in range(2):  # before the watch has checked again, and after
            assert watch.suspended_s(begun) == pytest.approx(5.0, abs=1.0)
            watch.check()
        assert watch.suspended_s(time.monotonic()) == 0.0
        interrupts.continued = begun - 10.0
        assert watch.suspended_s(begun) == 0.0
    recorder.close()
