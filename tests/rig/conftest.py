from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxfinger.data import check_file
from jaxfinger.rig import parse_plan, parse_rig, run
from jaxfinger.rig.backend import Block
from jaxfinger.rig.backends.ads import AdsRig
from jaxfinger.rig.backends.simulated import SimulatedRig
from jaxfinger.rig.channels import RigDescription
from jaxfinger.rig.contract import State
from jaxfinger.rig.simulated import standin
from jaxfinger.rig.simulated.examples import rig_toml

SHORT = """
[plan]
name = "short"
operator = "tester"
[[trial]]
experiment = "ID.2"
joint = "DIP"
passes = 1
[[trial]]
experiment = "ID.4"
tendon = "T3"
joint = "MCP"
levels = [3.0, 6.0]
"""


PATIENT = "[controller]\nheartbeat_s = 5.0\n"


def serious(path):
    """Errors that `check` finds in a session file."""
    return [f for f in check_file(path) if f.severity == "error"]


def slot(rig, kind, of=""):
    """Place of a channel in the controller's record."""
    return rig.description.channels[rig.description.index(kind, of)].slot


@pytest.fixture(scope="session")
def rig() -> RigDescription:
    """The example rig file, read."""
    return parse_rig(rig_toml())


@pytest.fixture
def simulated(rig) -> SimulatedRig:
    return SimulatedRig(rig)


@pytest.fixture(scope="session")
def short(rig):
    """A plan of two short trials."""
    return parse_plan(SHORT, rig)


def ads_rig(where: str, **rig) -> AdsRig:
    """Return an ADS rig for a stand-in at host:port, with deadlines that a loaded machine keeps."""
    address = {"net_id": standin.NET_ID, "ip": where, "port": 851, "reconnect_s": 20}
    return AdsRig(parse_rig(rig_toml("ads", address, **{"stale_s": 5.0, "poll_s": 0.002, **rig}) + PATIENT))


@pytest.fixture
def quiet_block(rig) -> Callable[..., Block]:
    """Return a function that makes blocks of an armed finger at rest: sensor noise, no fault."""

    def make(count: int = 400, first: int = 0, seed: int = 0, state: State = State.ARMED) -> Block:
        rng = np.random.default_rng(seed)
        x = rng.normal(0.0, 1e-3, (count, len(rig.channels)))
        x[:, rig.columns("excursion", rig.finger.tendon_names)] *= 1e-3
        x[:, rig.columns("tension", rig.finger.tendon_names)] += 2.0
        x[:, rig.columns("joint_position", rig.finger.joint_names)] = 0.35
        x[:, rig.columns("tension_setpoint", rig.finger.tendon_names)] = 2.0
        x[:, rig.columns("motor_temperature", rig.finger.tendon_names)] = 30.0
        seq = np.arange(first, first + count, dtype=np.uint64)
        return Block(seq, seq * 1_000_000 + 10**15, x, np.full(count, state, np.uint32), np.zeros(count, np.uint32))

    return make


@pytest.fixture
def record(short, tmp_path) -> Callable:
    """Return a function that records the short plan on a rig, and calls `fault` once a named trial is recorded."""

    def go(rig, fault: Callable | None = None, at: tuple[str, str] = ("02-ID.4-T3-MCP", "waiting"), **options):
        done = []

        def observe(view):
            if fault is not None and not done and view.recording and (view.trial, view.doing) == at:
                done.append(True)
                fault(rig)

        path: Path = options.pop("output", tmp_path / "session.h5")
        return run(options.pop("plan", short), rig, path, observe=observe, **options)

    return go


class Away:
    """A person who answers every prompt at once, until one holds `words`; then in `late` s, or never (None)."""

    def __init__(self, machine, words: str, late: float | None = None):
        self.machine, self.words, self.late = machine, words, late
        self.prompts, self.wanted = [], []
        self.by_itself, machine.prepare = machine.prepare, lambda setup: bool(self.wanted.append(setup))

    def ask(self, text, keep_waiting):
        self.prompts.append(text)
        until = time.monotonic() + (30.0 if self.late is None else self.late)
        while self.words in text and time.monotonic() < until and (keep_waiting() or self.late is not None):
            time.sleep(0.01)
        self.by_itself(self.wanted[-1])
        self.machine._pause(1.0)

    def stop_request(self):
        return ""


def impatient(rig, seconds=0.2):
    """The rig file with a short limit for prompts."""
    return replace(rig, deadlines=replace(rig.deadlines, prompt_s=seconds))
