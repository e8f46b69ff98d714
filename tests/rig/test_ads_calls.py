"""Calls of the ADS backend that hang or are cut, without a controller."""

import contextlib
import threading
import time
from types import SimpleNamespace

import pyads
import pytest

from jaxfinger.rig.backend import ConnectionLost
from jaxfinger.rig.contract import State
from jaxfinger.rig.simulated.ams import AmsServer
from jaxfinger.rig.simulated.controller import Controller
from tests.rig.conftest import ads_rig


@pytest.mark.parametrize("calls", [1, 8])
def test_one_call_that_never_ends_hangs_and_many_slow_ones_do_not(calls):
    """The calls are another thread's; this thread waits for the connection."""
    rig, begun = ads_rig("127.0.0.1:1"), threading.Event()

    def work(port):
        begun.set()
        time.sleep(1.6 / calls)
        return b""

    other = threading.Thread(target=lambda: [rig._call(work) for _ in range(calls)])
    other.start()
    begun.wait()
    try:
        if calls == 1:
            with pytest.raises(ConnectionLost, match="hangs"):
                rig._call(lambda port: b"")
        else:
            assert rig._call(lambda port: b"mine") == b"mine"
    finally:
        other.join()


@pytest.mark.parametrize("hangs", ["call", "connecting again"])
def test_a_call_that_hangs_is_waited_for_once(monkeypatch, hangs):
    """A stop, the look whether tension falls, and the end of the run would each wait for it again."""
    rig, begun, go = ads_rig("127.0.0.1:1"), threading.Event(), threading.Event()

    def hang(port=0):
        begun.set()
        go.wait(60.0)
        return b""

    def cut(port):
        raise pyads.ADSError(text="cut")

    monkeypatch.setattr(rig, "_attach", hang)

    def call():
        with contextlib.suppress(ConnectionLost):
            rig._call(hang if hangs == "call" else cut)

    other = threading.Thread(target=call)
    other.start()
    try:
        begun.wait()
        with pytest.raises(ConnectionLost, match="hangs"):
            rig._call(lambda port: b"")
        attempts = []
        wait = rig._lock.acquire
        rig._lock = SimpleNamespace(
            acquire=lambda timeout: attempts.append(timeout) or wait(timeout=timeout), release=rig._lock.release
        )
        with pytest.raises(ConnectionLost, match="hangs"):
            rig._call(lambda port: b"")
        rig.close()
        assert len(attempts) == 2
    finally:
        go.set()
        other.join()


def test_a_connection_that_is_closed_while_it_opens_is_opened_again(monkeypatch):
    """A router does so while it still hangs up on a program that was killed a moment ago."""
    controller, lock, serve, hung_up = Controller(), threading.Lock(), AmsServer._serve, []

    def hang_up(self, client):
        if len(hung_up) < 2:
            hung_up.append(client)
            client.recv(1)
            client.close()
        else:
            serve(self, client)

    monkeypatch.setattr(AmsServer, "_serve", hang_up)
    places = {f"GVL_Jaxfinger.{name}": place for name, place in controller.place.items()}
    server = AmsServer(controller.memory, places, lock)
    try:
        with ads_rig(f"127.0.0.1:{server.port}") as rig:
            assert rig.status().state is State.IDLE
        assert len(hung_up) == 2
    finally:
        server.close()
