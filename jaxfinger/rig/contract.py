"""The contract with the controller's program: memory layout, commands, states; in words in `docs/plc-contract.md`.

Every structure holds fields of 4 or 8 bytes on their natural boundary, so that TwinCAT's packing and NumPy's agree. The
adapter compares the sizes when it connects.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag

import numpy as np

VERSION = 2  # of the demands on the program (docs/plc-contract.md, Versions), not of the layout alone
VALUES = 60  # LREAL values in one sample
TARGETS = 18  # targets in one command: the rig has 18 actuation modules
RING = 16384  # samples in the ring: 16 s at 1 kHz, 8 MiB. A host that stalls for less loses none.
CYCLE_NS = 1_000_000  # cycle of the stand-in's task; a real controller states its own in stInfo
PREFIX = "GVL_Jaxfinger."

INFO = np.dtype(
    [
        ("version", "<u4"),
        ("sample_size", "<u4"),
        ("ring_length", "<u4"),
        ("values", "<u4"),
        ("cycle_ns", "<u8"),
        ("boot", "<u8"),  # differs after every restart of the program
        ("program", "S80"),
    ]
)
SAMPLE = np.dtype(
    [
        ("seq", "<u8"),
        ("t_ns", "<u8"),  # distributed clock at the start of the task, ns since 2000-01-01
        ("state", "<u4"),
        ("flags", "<u4"),
        ("value", "<f8", VALUES),
        ("seq_end", "<u8"),  # equals seq unless the record was read while being written
    ]
)
STATUS = np.dtype(
    [
        ("head", "<u8"),  # samples written since the start: the next sample's seq
        ("boot", "<u8"),
        ("state", "<u4"),
        ("trip", "<u4"),
        ("trip_seq", "<u8"),
        ("trip_value", "<f8"),
        ("trip_slot", "<i4"),
        ("acknowledged", "<u4"),  # id of the last command processed
        ("refused", "<u4"),  # `Refusal` of that command; 0: accepted
        ("spare", "<u4"),
    ]
)
COMMAND = np.dtype(
    [
        ("id", "<u4"),
        ("kind", "<u4"),
        ("index", "<i4"),  # joint of a JOINT command, trip code of a STOP
        ("spare", "<u4"),
        ("rate", "<f8"),  # N/s or rad/s
        ("acceleration", "<f8"),  # rad/s²
        ("target", "<f8", TARGETS),  # N per tendon (NaN: leave as it is), or rad in target[0]
    ]
)
LIMITS = np.dtype(  # the controller's own limits, above which it stops the rig
    [
        ("tension_max", "<f8"),  # N
        ("tension_rate_max", "<f8"),  # N/s
        ("joint_velocity_max", "<f8"),  # rad/s
        ("joint_torque_max", "<f8"),  # N m
        ("fingertip_force_max", "<f8"),  # N
        ("heartbeat_s", "<f8"),  # s without a heartbeat of the host
    ]
)
FILTER = np.dtype([("enabled", "<u4"), ("setting", "<u4"), ("bandwidth", "<f8")])  # per slot, from CoE; bandwidth in Hz

# Orders to the stand-in's simulated operator, and faults to inject. A real controller has no such symbol.
BENCH = np.dtype(
    [
        ("id", "<u4"),
        ("contact", "<u4"),
        ("fault", "<u4"),
        ("fault_slot", "<i4"),
        ("fault_seq", "<u8"),  # sample from which the fault acts
        ("amount", "<f8"),  # size of the fault; `simulated.faults` gives its unit
        ("lockstep", "<u4"),  # 1: time advances only as the host reads, so the host's clock says nothing about it
        ("spare", "<u4"),
        ("mode", "<i4", TARGETS),  # `Mode` per joint
        ("pose", "<f8", TARGETS),  # rad per joint
    ]
)
FAULTS = (  # faults that the stand-in injects on request; `simulated.faults` describes each
    "none", "nan", "freeze", "spike", "flag", "flicker", "clock-back", "clock-frozen", "clock-rate", "clock-jump",
    "slow", "stall", "restart", "cut", "delay", "deaf", "state", "mute",
)  # fmt: skip

SYMBOLS: dict[str, tuple[np.dtype, int]] = {  # name: (type of one element, number of elements)
    "stInfo": (INFO, 1),
    "stStatus": (STATUS, 1),
    "stLimits": (LIMITS, 1),
    "aFilter": (FILTER, VALUES),
    "stCommand": (COMMAND, 1),
    "nHostBeat": (np.dtype("<u8"), 1),
    "aRing": (SAMPLE, RING),
    "stBench": (BENCH, 1),
}


class State(IntEnum):
    """States of the controller."""

    INIT = 0
    IDLE = 1
    ARMED = 2  # drives are on; tensions and external motor hold their set-points, which begin at 0 N and where it is
    MOVING = 3  # drives are on; a ramp or a move is under way
    RELEASING = 4  # tensions ramp down, then the drives go off
    TRIPPED = 5  # latched: tension is released, and nothing can be armed until RESET


DRIVES_ON = (State.ARMED, State.MOVING)


class Mode(IntEnum):
    """Way in which a joint of the stand-in's finger is held."""

    FREE = 0
    FIXED = 1
    MOTOR = 2
    HAND = 3


class Kind(IntEnum):
    """Commands of the host."""

    NONE = 0
    ARM = 1
    DISARM = 2
    TENSION = 3
    JOINT = 4
    HOLD = 5
    RELEASE = 6
    RESET = 7
    STOP = 8  # release and latch TRIPPED, with the host's cause in `index`


class Trip(IntEnum):
    """Causes of a latched stop. The value is the code on the wire: the controller finds 1 to 9, the host 20 to 29."""

    NONE = 0
    TENSION = 1
    TENSION_RATE = 2
    SLACK = 3
    POSITION = 4
    VELOCITY = 5
    TORQUE = 6
    FORCE = 7
    INVALID = 8  # NaN, infinite, or flagged by the terminal
    HEARTBEAT = 9
    FROZEN = 20
    STALE = 21
    CLOCK = 22
    OPERATOR = 23
    RECORDER = 24
    HOST = 25  # a thread of the host is silent, or the plan cannot go on
    TRACKING = 26
    TEMPERATURE = 27
    LAG = 28
    CONTRACT = 29

    @property
    def sentence(self) -> str:
        """The cause in words, for people."""
        return _SENTENCES[self]

    def said(self, where: str = "") -> str:
        """The cause in words, with `where` (channel and value) and what the operator should look at."""
        return self.sentence + (f" ({where})" if where else "") + (f"; see {_SEE[self]}" if self in _SEE else "")


_SENTENCES = {
    Trip.NONE: "no trip",
    Trip.TENSION: "tendon tension above its limit",
    Trip.TENSION_RATE: "tendon tension changes faster than its limit",
    Trip.SLACK: "a loaded tendon went slack",
    Trip.POSITION: "joint beyond its limits",
    Trip.VELOCITY: "joint velocity above its limit",
    Trip.TORQUE: "external joint torque above its limit",
    Trip.FORCE: "fingertip force above its limit",
    Trip.INVALID: "a channel is not a number or was flagged by its terminal",
    Trip.HEARTBEAT: "the host's heartbeat stopped",
    Trip.FROZEN: "a channel is frozen",
    Trip.STALE: "the controller writes no new samples",
    Trip.CLOCK: "the controller's clock jumps or runs at another rate than it should",
    Trip.OPERATOR: "the operator ended the run, by the stop key, Ctrl-C or a closed terminal",
    Trip.RECORDER: "the recorder can no longer write",
    Trip.HOST: "the host ended the run",
    Trip.TRACKING: "tendon tension does not follow its set-point",
    Trip.TEMPERATURE: "motor temperature above its limit",
    Trip.LAG: "the host is too far behind the rig",
    Trip.CONTRACT: "the controller reports a state that the contract does not define",
}


_SEE = {  # what to look at after a trip
    Trip.TENSION: "the tendon's path, its drive and its load cell",
    Trip.TENSION_RATE: "whether a tendon slips or a cable is loose",
    Trip.SLACK: "whether the emergency stop took the drives' torque, or the tendon is torn or off its pulley",
    Trip.POSITION: "the joint's fixture and its encoder",
    Trip.VELOCITY: "the joint's fixture or coupling, and its encoder",
    Trip.TORQUE: "what blocks the joint",
    Trip.FORCE: "what the fingertip presses on",
    Trip.INVALID: "the channel's cable and terminal",
    Trip.HEARTBEAT: "whether the program was suspended or killed, what else this computer does, and the network",
    Trip.FROZEN: "its cable and terminal",
    Trip.STALE: "whether its task runs",
    Trip.CLOCK: "the controller's task, its distributed clock, and whether this computer slept",
    Trip.RECORDER: "the disk",
    Trip.HOST: "the cause that it gave then",
    Trip.TRACKING: "the tendon's drive and its load cell",
    Trip.TEMPERATURE: "what loads the motor",
    Trip.LAG: "what else this computer does, and the network",
    Trip.CONTRACT: "docs/plc-contract.md",
}


class Refusal(IntEnum):
    """Why the controller refused a command."""

    NONE = 0
    STATE = 1  # not in this state
    RANGE = 2  # a target or rate beyond the hard limits, or not a number
    KIND = 3  # a kind of command that the controller does not know


class Flag(IntFlag):
    """Low half of a sample's flags. The high half is the id of the last command processed, modulo 65536."""

    BUS = 1
    ENCODER = 2
    ANALOG = 4

    @property
    def says(self) -> str:
        """What a terminal reports with this flag, for people."""
        return {
            Flag.BUS: "working counter or device state bad",
            Flag.ENCODER: "parity or magnet error of a joint encoder",
            Flag.ANALOG: "an analog input over or under its range",
        }[self]


FLAGGED = int(Flag.BUS | Flag.ENCODER | Flag.ANALOG)  # bits of a sample's flags, one of which marks it unsound


def layout(ring: int = RING) -> dict[str, tuple[int, int]]:
    """Offset and size in bytes of every symbol in the stand-in's memory: end to end, on 8-byte boundaries."""
    place, offset = {}, 0
    for name, (dtype, count) in SYMBOLS.items():
        size = dtype.itemsize * (ring if name == "aRing" else count)
        place[name] = (offset, size)
        offset += -(-size // 8) * 8
    return place
