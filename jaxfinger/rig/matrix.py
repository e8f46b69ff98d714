"""The fault matrix: which faults stop the rig, who finds them, and how soon tension must be off.

    python -m jaxfinger.rig.matrix      prints the table of docs/recording.md

Each fault is tried in several phases of a recording and sizes of blocks. A cell of the supervisor alone is a stream of
samples in which the fault begins; no time passes. A cell over the wire records from the stand-in in real time
(`tests/rig/test_matrix.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from jaxfinger.rig.backend import Block
from jaxfinger.rig.channels import RigDescription
from jaxfinger.rig.contract import Flag, State, Trip
from jaxfinger.rig.safety import Supervisor, Violation
from jaxfinger.rig.watch import PERIOD_S

# Samples of a block: one alone, as many as fill a count (`trips.FULL_COUNT`), and up to what a poll of a 1 kHz
# controller every 50 ms brings.
BLOCK_SIZES = (1, 3, 10, 50)
PHASES = ("arming", "ramp", "hold", "letting go")
# s allowed from where a fault shows to the stop. The slowest way is the controller's heartbeat watchdog, 0.25 s, and
# one period of the watch.
STOP_S = 0.3
LETTING_GO_S = 0.7  # s from the stop to no tension: the controller ramps to 2 N in 0.2 s and to 0.5 N in 0.5 s
OFF_S = STOP_S + LETTING_GO_S
LOST_S = 0.2  # s of samples before the fault that may be missing from the file
END_S = 10.0  # s from the fault until `record` has ended by itself

BEGIN = 200  # number of the sample at which a fault begins: later than any check looks back (`safety.VELOCITY_SPAN`)
LENGTH = BEGIN + 1200  # samples of a stream; the last fault to show, a frozen channel, does after 1000
ARMED_BEFORE = 5  # samples from arming to the fault, in the phase "arming"

Spoil = Callable[[Block, np.ndarray, RigDescription], None]


@dataclass(frozen=True)
class Row:
    """One fault, with the description `says` for people.

    `by` names who stops the rig, `causes` the trip codes that may be given for it. For `shows` s the fault cannot be
    told from a sound rig. `spoil` puts it into a stream at a mask of samples, `wire` is the fault of the stand-in
    (`simulated.faults`) or of the host's threads and disk. It is tried in `phases`. With `at_once` the stop takes
    tension off without a ramp. Where `off` is false no software can take tension off: the drives' own watchdog does.
    """

    name: str
    says: str
    by: str
    causes: tuple[Trip, ...]
    spoil: Spoil | None = None
    wire: str = ""
    shows: Callable[[RigDescription], float] = lambda rig: 0.0
    phases: tuple[str, ...] = PHASES
    at_once: bool = False
    off: bool = True


def _set(kind: str, of: str, value: float) -> Spoil:
    """The channel reads `value` at the masked samples."""

    def spoil(block: Block, at: np.ndarray, rig: RigDescription) -> None:
        block.x[at, rig.index(kind, of)] = value

    return spoil


def _run(kind: str, of: str, step: float) -> Spoil:
    """The channel changes by `step` per masked sample, for forty samples."""

    def spoil(block: Block, at: np.ndarray, rig: RigDescription) -> None:
        block.x[:, rig.index(kind, of)] += np.minimum(np.cumsum(at), 40) * step

    return spoil


def _still(block: Block, at: np.ndarray, rig: RigDescription) -> None:
    """The MCP turns by 3 rad/s for 0.2 s, and the encoder of T3 repeats its value."""
    block.x[:, rig.index("joint_position", "MCP")] += np.minimum(np.cumsum(at), 200) * 3.0 / rig.rate_hz
    column = rig.index("excursion", "T3")
    block.x[at, column] = block.x[int(np.argmax(at)), column]


def _time(rate: float = 1.0, jump: float = 0.0) -> Spoil:
    """The device's clock jumps by `jump` s and then runs at `rate`."""

    def spoil(block: Block, at: np.ndarray, rig: RigDescription) -> None:
        since = np.cumsum(at) * at  # samples since the fault began
        wrong = since * (rate - 1.0) * 1e9 / rig.rate_hz + at * jump * 1e9
        block.t_ns[:] = (block.t_ns.astype(np.int64) + wrong.astype(np.int64)).astype(np.uint64)

    return spoil


def _flicker(block: Block, at: np.ndarray, rig: RigDescription) -> None:
    block.x[np.cumsum(at) % 3 > 0, rig.index("external_torque")] = np.nan


def _flag(block: Block, at: np.ndarray, rig: RigDescription) -> None:
    block.flags[at] |= int(Flag.ANALOG)


def _freeze(block: Block, at: np.ndarray, rig: RigDescription) -> None:
    column = rig.index("tension", "T3")
    block.x[at, column] = block.x[int(np.argmax(at)), column]


def _state(block: Block, at: np.ndarray, rig: RigDescription) -> None:
    block.state[at] = 42


def _deadline(name: str) -> Callable[[RigDescription], float]:
    """Value in s of a deadline of the rig file: the fault shows once it has passed."""
    return lambda rig: getattr(rig.deadlines, name)


BOTH, HOST, CONTROLLER = "controller and host", "host", "controller"
MATRIX = (
    Row("nan", "a channel is not a number", BOTH, (Trip.INVALID,), _set("external_torque", "", np.nan), "nan:11"),
    Row("flicker", "not a number in two samples of three", BOTH, (Trip.INVALID,), _flicker, "flicker:11"),
    Row("flag", "a terminal flags its samples", BOTH, (Trip.INVALID,), _flag, "flag"),
    Row("tension", "tension above its limit", BOTH, (Trip.TENSION,), _set("tension", "T3", 30.0), "spike:2=60",
        at_once=True),
    Row("position", "joint beyond its stops", BOTH, (Trip.POSITION,), _set("joint_position", "DIP", 1.7),
        "spike:10=1.4"),
    Row("velocity", "joint too fast", BOTH, (Trip.VELOCITY,), _run("joint_position", "PIP", 0.02)),
    Row("steep", "tension changes too fast", BOTH, (Trip.TENSION_RATE,), _run("tension", "T1", -0.7)),
    Row("temperature", "motor too warm", HOST, (Trip.TEMPERATURE,), _set("motor_temperature", "T2", 75.0),
        "spike:20=45"),
    Row("tracking", "tension away from its set-point", HOST, (Trip.TRACKING,), _run("tension_setpoint", "T1", 0.25),
        "spike:0=4", shows=lambda rig: rig.limits.tension_error_s, phases=("arming", "ramp", "hold")),
    Row("frozen", "analog channel frozen", HOST, (Trip.FROZEN, Trip.TRACKING), _freeze, "freeze:0",
        shows=lambda rig: max(c.frozen for c in rig.channels)),
    Row("encoder", "joint encoder frozen while a tendon runs by 1.5 mm", HOST, (Trip.FROZEN,),
        _run("excursion", "T2", 1e-4), shows=lambda rig: 0.015, phases=("ramp", "hold")),
    Row("excursion", "tendon encoder frozen while its joint turns by a quarter of its range", HOST, (Trip.FROZEN,),
        _still, shows=lambda rig: 0.15, phases=("ramp", "hold")),
    Row("clock back", "the controller's clock runs back", HOST, (Trip.CLOCK,), _time(jump=-0.5), "clock-back"),
    Row("clock frozen", "the controller's clock stands still", HOST, (Trip.CLOCK,), _time(rate=0.0), "clock-frozen"),
    Row("clock slow", "the controller's clock a hundred times too slow", HOST, (Trip.CLOCK,), _time(rate=0.01),
        "clock-rate=0.01", shows=_deadline("clock_offset_s")),
    Row("clock fast", "the controller's clock a thousand times too fast", HOST, (Trip.CLOCK,), _time(rate=1000.0),
        "clock-rate=1000"),
    Row("clock jump", "the controller's clock jumps by an hour", HOST, (Trip.CLOCK,), _time(jump=3600.0),
        "clock-jump"),
    Row("state", "the controller reports a state that the contract does not define", HOST, (Trip.CONTRACT,), _state,
        "state"),
    Row("slow", "the whole controller a hundred times too slow", HOST, (Trip.CLOCK, Trip.STALE), wire="slow",
        shows=_deadline("clock_offset_s"), off=False),
    Row("stall", "the controller's task stands still", HOST, (Trip.STALE,), wire="stall", shows=_deadline("stale_s"),
        off=False),
    Row("restart", "the controller's program restarts", HOST, (Trip.STALE,), wire="restart", at_once=True),
    Row("cut", "the connection is cut", CONTROLLER, (Trip.HEARTBEAT,), wire="cut"),
    Row("lag", "samples reach the host too late", HOST, (Trip.LAG, Trip.HEARTBEAT), wire="delay=0.2",
        shows=_deadline("lag_s")),
    Row("key", "stop key, also while the terminal takes no output", HOST, (Trip.OPERATOR,), wire="key"),
    Row("mute", "stop key while a call to the controller waits for its answer", HOST, (Trip.OPERATOR,), wire="mute"),
    Row("deaf", "stop key, and the controller ignores STOP", CONTROLLER, (Trip.HEARTBEAT,), wire="deaf"),
    Row("reader", "the thread that reads and supervises hangs", HOST, (Trip.HOST, Trip.HEARTBEAT), wire="reader",
        shows=_deadline("thread_s")),
    Row("call", "that thread hangs in a call to the controller", CONTROLLER, (Trip.HOST, Trip.HEARTBEAT), wire="call"),
    Row("beat", "the heartbeat hangs in its call to the controller", CONTROLLER, (Trip.HOST, Trip.HEARTBEAT),
        wire="beat"),
    Row("runner", "the thread that carries out the plan hangs", HOST, (Trip.HOST,), wire="runner",
        shows=_deadline("thread_s")),
    Row("watch", "the thread of the stop key hangs, which allows heartbeats", CONTROLLER, (Trip.HEARTBEAT,),
        wire="watch"),
    Row("host", "the host's process is stopped or killed", CONTROLLER, (Trip.HEARTBEAT,), wire="host"),
    Row("disk", "the disk does not answer", HOST, (Trip.RECORDER,), wire="disk", shows=_deadline("disk_s")),
    Row("full", "the disk is full", HOST, (Trip.RECORDER,), wire="full"),
)  # fmt: skip


def stream(rig: RigDescription, phase: str) -> Block:
    """Return LENGTH samples of a sound finger in a phase; sample BEGIN lies within it."""
    rng, finger, k = np.random.default_rng(0), rig.finger, np.arange(LENGTH)
    seconds = np.maximum(k - BEGIN, 0) / rig.rate_hz
    state, wanted = {
        "arming": (np.where(k < BEGIN - ARMED_BEFORE, State.IDLE, State.ARMED), 0.0 * k),
        "ramp": (np.full(LENGTH, State.MOVING), 3.0 + 5.0 * k / rig.rate_hz),
        "hold": (np.full(LENGTH, State.ARMED), np.full(LENGTH, 8.0)),
        "letting go": (
            np.where(seconds < LETTING_GO_S, np.where(k < BEGIN - 50, State.ARMED, State.RELEASING), State.IDLE),
            np.maximum(8.0 - 30.0 * np.maximum(k - BEGIN + 50, 0) / rig.rate_hz, 0.0),
        ),
    }[phase]
    x = rng.normal(0.0, 1e-3, (LENGTH, len(rig.channels)))
    x[:, rig.columns("excursion", finger.tendon_names)] *= 1e-3
    x[:, rig.columns("tension", finger.tendon_names)] += wanted[:, None]
    x[:, rig.columns("joint_position", finger.joint_names)] = 0.35
    x[:, rig.columns("tension_setpoint", finger.tendon_names)] = wanted[:, None]
    x[:, rig.columns("motor_temperature", finger.tendon_names)] = 30.0
    seq = np.arange(LENGTH, dtype=np.uint64)
    t_ns = (seq * (1e9 / rig.rate_hz) + 10**15).astype(np.uint64)
    return Block(seq, t_ns, x, state.astype(np.uint32), np.zeros(LENGTH, np.uint32))


def blocks(whole: Block, size: int) -> Iterator[Block]:
    """Cut a stream into blocks of `size` samples."""
    for start in range(0, len(whole), size):
        cut = slice(start, start + size)
        yield Block(whole.seq[cut], whole.t_ns[cut], whole.x[cut], whole.state[cut], whole.flags[cut])


def supervise(rig: RigDescription, row: Row, phase: str, size: int) -> tuple[Violation, int] | None:
    """Run one cell of the supervisor alone.

    Return the first violation, and the last sample of the block that brought it to the host, or None.
    """
    assert row.spoil is not None
    whole = stream(rig, phase)
    row.spoil(whole, np.arange(LENGTH) >= BEGIN, rig)
    supervisor = Supervisor(rig)
    for block in blocks(whole, size):
        if found := supervisor.check(block):
            return found[0], int(block.seq[-1])
    return None


def cells() -> Iterator[tuple[Row, str, int]]:
    """Yield every cell of the supervisor alone: row, phase, block size."""
    return (
        (row, phase, size) for row in MATRIX if row.spoil is not None for phase in row.phases for size in BLOCK_SIZES
    )


Results = dict[tuple[str, str, int], "tuple[Violation, int] | None"]


def run(rig: RigDescription) -> Results:
    """Run every cell of the supervisor alone. The result is by name of the row, phase and block size."""
    return {(row.name, phase, size): supervise(rig, row, phase, size) for row, phase, size in cells()}


def stopped_s(rig: RigDescription, row: Row, results: Results) -> float:
    """Longest time in s from where a fault shows to the stop.

    A fault that the host finds takes the samples of the worst cell, a pause of the reader and a period of the watch.
    One that only the controller finds takes its heartbeat time.
    """
    if row.by == CONTROLLER:
        return rig.loosest_limits.heartbeat_s + (PERIOD_S if row.name == "deaf" else 0.0)
    hits = [hit for (name, _, _), hit in results.items() if name == row.name]
    samples = max((hit[0].seq - BEGIN + 1 if hit else LENGTH for hit in hits), default=0)
    return max(samples / rig.rate_hz - row.shows(rig), 0.0) + rig.poll_s + PERIOD_S


def table(rig: RigDescription, results: Results) -> str:
    """Return the matrix as the table of docs/recording.md."""
    lines = [
        "| fault | shows after | then stopped within | tension off within | by |",
        "| --- | --- | --- | --- | --- |",
    ]
    for row in MATRIX:
        stop = stopped_s(rig, row, results)
        off = f"{stop + (0.0 if row.at_once else LETTING_GO_S):.2f} s" if row.off else "the drives' own watchdog"
        shows = f"{row.shows(rig):g} s" if row.shows(rig) else "at once"
        lines.append(f"| {row.says} | {shows} | {stop:.2f} s | {off} | {row.by} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the table for the example rig file."""
    from jaxfinger.rig.rig_file import parse_rig
    from jaxfinger.rig.simulated.examples import rig_toml

    rig = parse_rig(rig_toml())
    print(table(rig, run(rig)), end="")


if __name__ == "__main__":
    main()
