"""Faults of the stand-in on request: `python -m jaxfinger.rig.standin --fault NAME[:SLOT][=AMOUNT][@SECONDS]`."""

from __future__ import annotations

import re
from dataclasses import dataclass

from jaxfinger.rig import contract


@dataclass(frozen=True)
class FaultKind:
    """One kind of fault: a sentence in which `…` stands for its amount, and the default amount."""

    says: str
    amount: float = 0.0


# Faults that can strike at any time.
CATALOGUE = {
    "nan": FaultKind("the slot is not a number"),
    "flicker": FaultKind("the slot is not a number in two samples of three"),
    "freeze": FaultKind("the slot repeats its value"),
    "spike": FaultKind("the slot reads … too much", 60.0),
    "flag": FaultKind("a terminal flags its samples"),
    "clock-back": FaultKind("the device's time jumps back by … s, again and again", 0.5),
    "clock-frozen": FaultKind("the device's time stands still"),
    "clock-rate": FaultKind("the device's time runs … times as fast", 0.01),
    "clock-jump": FaultKind("the device's time jumps ahead by … s", 3600.0),
    "slow": FaultKind("the task runs … times as fast", 0.01),
    "stall": FaultKind("the task stands still"),
    "restart": FaultKind("the program restarts"),
    "cut": FaultKind("every connection is cut"),
    "delay": FaultKind("every answer comes … s late", 0.04),
    "deaf": FaultKind("STOP and RELEASE are acknowledged and ignored"),
    "state": FaultKind("the state is …", 42.0),
    "mute": FaultKind("reads of the ring are not answered, while all other requests are"),
}
# Faults of the program itself, from its start on.
AT_START = {
    "watchdog": FaultKind("the controller holds tension for … s without a heartbeat", 3600.0),
    "size": FaultKind("ST_Command has … bytes", 168.0),
    "ring": FaultKind("the ring holds … samples", 1.0),
}
assert set(CATALOGUE) == set(contract.FAULTS) - {"none"}


@dataclass(frozen=True)
class InjectedFault:
    """One fault to inject: its name, the slot that it strikes, its amount, and when it begins (s after the start)."""

    name: str
    slot: int
    amount: float
    after_s: float


def parse(text: str) -> InjectedFault:
    """Read a fault from the command line's form. Raises ValueError, with the known names."""
    found = re.fullmatch(r"([a-z-]+)(?::(\d+))?(?:=([-+.\deE]+))?(?:@([.\d]+))?", text)
    known = CATALOGUE | AT_START
    if found is None or found[1] not in known:
        raise ValueError(f"{text!r} is no fault; give NAME[:SLOT][=AMOUNT][@SECONDS] with one of {', '.join(known)}")
    amount = float(found[3]) if found[3] else known[found[1]].amount
    return InjectedFault(found[1], int(found[2] or 0), amount, float(found[4] or 0.0))
