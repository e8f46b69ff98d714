"""Runs a plan on a rig: protocols become commands and waits, trials go to the log, the log becomes a session."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import NoReturn

import h5py
import numpy as np

from jaxfinger.errors import UserError
from jaxfinger.rig import convert, wal
from jaxfinger.rig.backend import (
    Block,
    CommandRefused,
    Hold,
    JointMove,
    Rig,
    Setup,
    Status,
    TensionRamp,
)
from jaxfinger.rig.channels import DYNAMIC_BANDWIDTH, Filter, RigDescription
from jaxfinger.rig.contract import State, Trip
from jaxfinger.rig.operator import Nobody, Operator
from jaxfinger.rig.plan import Plan, PlannedTrial
from jaxfinger.rig.protocols import DYNAMIC, Covered, Dwell, Mark, Protocol, Reached, Settled, Start, Tare
from jaxfinger.rig.reader import Reader, tripped
from jaxfinger.rig.recorder import Recorder
from jaxfinger.rig.recover import read_log
from jaxfinger.rig.safety import Supervisor, Violation
from jaxfinger.rig.trips import PERSIST
from jaxfinger.rig.watch import Watch

AFTER_TRIP_S = 1.0  # that is still recorded after a trip, and in which the controller has released all tension
QUIET_S = 0.3  # without a fault before anything is armed: a clock that runs wrong shows within 0.1 s
PATIENCE_S = 5.0  # of the host for that
SLACK_S = 5.0  # that a wait of known length may take longer
HELD = "tension was not seen to fall, so switch the drives off and see that it is off"


@dataclass(frozen=True)
class View:
    """What the live view shows: the trial, its place in the plan, what is waited for, and the newest samples."""

    trial: str
    number: int
    count: int
    doing: str
    block: Block | None
    lost: int
    recording: bool
    lag_s: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """A run: trials that are complete, why it ended early (empty: it did not), and the log to resume from."""

    session: Path
    complete: tuple[str, ...]
    cause: str
    log: Path | None


class TrialEnded(UserError):
    """The trial under way cannot go on; `trip` and `seq` say why and where its good samples end."""

    def __init__(self, message: str, trip: Trip, seq: int | None = None):
        super().__init__(message)
        self.trip, self.seq = trip, seq


def log_path(output: Path) -> Path:
    """Where the log of a session lies."""
    return output.with_name(output.name + ".wal")


def refuse_filtered(plan: Plan, rig: RigDescription, filters: dict[str, Filter]) -> None:
    """Refuse dynamic experiments on terminals whose filter spoils them: 1 kHz of samples are not 1 kHz of signal."""
    slow = [
        name for name, f in filters.items() if f.enabled and (f.bandwidth is None or f.bandwidth < DYNAMIC_BANDWIDTH)
    ]
    dynamic = [t.name for t in plan.trials if t.experiment in DYNAMIC]
    if slow and dynamic and not rig.allow_filtered:
        width = filters[slow[0]].bandwidth
        raise UserError(
            f"the terminal of '{slow[0]}' filters at {'an unknown bandwidth' if width is None else f'{width:g} Hz'} "
            f"({len(slow)} channels do), which spoils {dynamic[0]}; switch the filter off (CoE 0x8000:06) or set "
            f"allow_filtered = true in [rig]."
        )


class Runner:
    """Carries out protocols on an open rig."""

    def __init__(self, rig: Rig, reader: Reader, operator: Operator, observe: Callable[[View], None] | None = None):
        self.rig, self.reader, self.operator = rig, reader, operator
        self.watch = Watch(rig, reader, operator)
        self.observe = observe or (lambda view: None)
        self.tare: dict[str, float] = {}
        self.t0: int | None = None
        self._place = ("", 0, 0)
        self._id = 0
        self._setup = Setup("")
        self._start: dict = {}

    # one trial --------------------------------------------------------------------------------------------------
    def trial(self, trial: PlannedTrial, name: str, number: int, count: int, begun_s: float) -> str:
        """Run one trial; returns why it ended early, or an empty string."""
        self._place = (name, number, count)
        self._start = {
            "name": name,
            "planned": trial.name,
            "experiment": trial.experiment,
            "joint": trial.joint,
            "tendon": trial.tendon,
            "motion": trial.motion,
            "parameters": asdict(trial.parameters),
            "begun_s": begun_s,
        }
        try:
            self.carry_out(trial.protocol(self.rig.description))
            self.reader.end({"complete": True})
            return ""
        except UserError as error:
            return self.ended(error)
        except KeyboardInterrupt:
            return self.interrupted()

    def interrupted(self) -> str:
        """Stop the rig after Ctrl-C; returns why the run ended."""
        self.reader.stop(Violation(Trip.OPERATOR, "interrupt", self.reader.latest_seq, float("nan")))
        return self.ended(TrialEnded("the run was interrupted", Trip.OPERATOR))

    def ended(self, error: UserError) -> str:
        """Let go, record what follows, close the trial; returns why it ended."""
        reader = self.reader
        trip, seq = (error.trip, error.seq) if isinstance(error, TrialEnded) else (Trip.HOST, None)
        if not tripped(reader.latest):
            reader.stop(Violation(trip, "host", reader.latest_seq, float("nan")))
        self._pass(AFTER_TRIP_S)
        cause = str(error).rstrip(".")
        if reader.latest is not None and not (tripped(reader.latest) or int(reader.latest.state[-1]) == State.IDLE):
            cause = f"{cause}; {HELD}"
        if reader.recording:
            place = {} if seq is None else {"seq": seq}
            reader.end({"complete": False, "cause": cause, "trip": int(trip), **place})
        return cause

    def ready(self, name: str) -> None:
        """Let go what an earlier host left loaded, clear a latched stop with the operator's consent, and arm.

        Raises UserError where anything is wrong before that; then nothing was armed.
        """
        rig, status = self.rig, self.rig.status()
        if status.state in (State.ARMED, State.MOVING):
            rig.release()
        if status.state is State.TRIPPED and not rig.prepare(Setup("")):
            self._ask(f"The controller is stopped: {status.cause}. See that finger and hands are safe.")
        if status.state is not State.IDLE:
            self._pass(AFTER_TRIP_S)
        if status.state is State.TRIPPED:
            rig.reset(name or "operator")
        if not rig.prepare(Setup("", fixed=dict.fromkeys(rig.description.finger.joint_names, 0.0))):
            self._ask("Hands off: the drives are about to be switched on.")
        latest = time.monotonic() + PATIENCE_S
        while not self.reader.quiet(round(QUIET_S * rig.description.rate_hz)):
            self.reader.next()
            self._look(None)
            if time.monotonic() > latest:
                trouble = self.reader.trouble
                what = trouble.sentence if trouble is not None else "too few samples came"
                raise UserError(f"nothing was armed: {what}.")
        self.watch.guard()
        rig.arm()

    def let_go(self) -> str:
        """Release the finger after the last trial; returns what went wrong."""
        try:
            self.rig.release()
            self._pass(AFTER_TRIP_S, lambda: self.rig.status().state in (State.IDLE, State.TRIPPED))
            if self.rig.status().state is not State.IDLE:
                raise TrialEnded("the controller did not release the finger after the last trial", Trip.HOST)
        except UserError as error:
            return self.ended(error)
        return ""

    def _pass(self, seconds: float, done: Callable[[], bool] = lambda: False) -> None:
        """Let so much time pass, by samples and by the host's clock, or less where it is done."""
        reader, rate = self.reader, self.rig.description.rate_hz
        latest = time.monotonic() + self._longest(seconds)
        start: int | None = None
        while reader.error is None and time.monotonic() < latest and not done():
            self.rig.alive()
            reader.next()
            start = reader.latest_seq if start is None and reader.latest_seq >= 0 else start
            if start is not None and reader.latest_seq - start >= seconds * rate:
                break

    def _longest(self, seconds: float) -> float:
        """On the host's clock, for something that may take so long on the controller's."""
        if self.rig.simulated_time:  # a simulation may be slow
            return 60.0 + 10.0 * seconds
        return 0.5 + (1.0 + self.rig.description.deadlines.clock_rate) * seconds

    def _ask(self, text: str) -> None:
        def alive() -> bool:
            self.rig.alive()
            return self.reader.error is None and self.reader.violation is None

        self.operator.ask(text, alive)
        self._look(None)

    def carry_out(self, protocol: Protocol) -> None:
        """Carry out the steps of a protocol."""
        for step in protocol:
            if isinstance(step, TensionRamp | JointMove | Hold):
                self.reader.supervisor.commanded(step)
                self._command(step)
            elif isinstance(step, Setup):
                self._prepare(step)
            elif isinstance(step, Tare):
                self._tare(step)
            elif isinstance(step, Start):
                self._begin(step)
            elif isinstance(step, Mark):
                self.reader.mark(asdict(step))
            elif isinstance(step, Reached):
                self._wait("moving", lambda b: _reached(b, self._id), step.timeout)
            elif isinstance(step, Dwell):
                self._wait("waiting", _Elapsed(self.reader, step.seconds), step.seconds + SLACK_S)
            elif isinstance(step, Settled):
                self._wait("tensions settling", _Steady(self.rig.description, step), step.timeout)
            else:
                assert isinstance(step, Covered)
                self._wait("moved by hand", _Passes(self.rig.description, step), step.timeout)

    def _command(self, step: TensionRamp | JointMove | Hold) -> None:
        try:
            self._id = self.rig.command(step)
        except CommandRefused:  # where the rig has just been stopped, that is the cause
            self._look(None)
            if (status := self.rig.status()).state is State.TRIPPED:
                self._stopped(status)
            raise

    def _begin(self, step: Start) -> None:
        if self.t0 is None:
            self.t0 = self.reader.latest_t
        self.reader.begin(
            {
                **self._start,
                "session_start": self._start["begun_s"] + max(self.reader.latest_t - self.t0, 0) * 1e-9,
                "loaded": list(step.loaded),
                "motor": self._setup.motor,
                "contact": self._setup.contact,
                "tare": dict(self.tare),
            }
        )

    def _prepare(self, setup: Setup) -> None:
        self._setup = setup
        if not self.rig.prepare(setup):
            self._ask(setup.text)
            return
        self._wait("finger being prepared", _AtPose(self.rig.description, setup), 60.0)

    def _tare(self, step: Tare) -> None:
        rig = self.rig.description
        columns = [i for i, c in enumerate(rig.channels) if c.kind in step.kinds]
        rows: list[np.ndarray] = []
        elapsed = _Elapsed(self.reader, step.seconds)

        def enough(block: Block) -> bool:
            rows.append(block.x[:, columns])
            return elapsed(block)

        self._wait("taring", enough, step.seconds + SLACK_S)
        values = np.concatenate(rows)
        tops = {"external_torque": rig.limits.joint_torque_max, "fingertip_force": rig.limits.fingertip_force_max}
        for i, mean, spread in zip(columns, values.mean(0), values.std(0), strict=True):
            top = tops.get(rig.channels[i].kind)
            if not np.isfinite(mean) or (top is not None and (abs(mean) > 0.2 * top or spread > 0.02 * top)):
                raise UserError(
                    f"'{rig.channels[i].name}' cannot be tared: it reads {mean:.3g} ± {spread:.2g}; "
                    "unload it and see its cable."
                )
            self.tare[rig.channels[i].name] = float(mean)

    # waiting ----------------------------------------------------------------------------------------------------
    def _wait(self, doing: str, done: Callable[[Block], bool], timeout: float) -> None:
        """Wait for blocks until it is done; ends on the device's clock and on the host's, and at the stop key."""
        self.reader.forget()
        start, latest = self.reader.latest_t, time.monotonic() + self._longest(timeout)
        while True:
            block = self.reader.next()
            self._look(block)
            if block is not None:
                self.observe(
                    View(*self._place, doing, block, self.reader.lost, self.reader.recording, self.reader.lag_s)
                )
                if done(block):
                    return
            if time.monotonic() > latest or (block is not None and (int(block.t_ns[-1]) - start) * 1e-9 > timeout):
                raise TrialEnded(f"{doing} took longer than {timeout:g} s", Trip.HOST)

    def _look(self, block: Block | None) -> None:
        """A sign of life; raises TrialEnded where the run must end."""
        reader = self.reader
        self.rig.alive()
        if self.rig.synchronous:
            self.watch.look()
        if reader.violation is not None:
            trip, since = reader.violation.trip, reader.violation.since
            cause = reader.recorder.failure if trip is Trip.RECORDER else None
            raise TrialEnded(cause or reader.violation.sentence, trip, since)
        if tripped(block):
            self._stopped(self.rig.status())
        if reader.error is not None:
            raise TrialEnded(str(reader.error), Trip.STALE)

    def _stopped(self, status: Status) -> NoReturn:
        """Raise TrialEnded with the controller's own cause."""
        self.reader.note("trip", status.cause)
        raise TrialEnded(f"the controller stopped: {status.cause}", status.trip, status.trip_seq - PERSIST + 1)


class _Elapsed:
    """So many seconds of device time from now on."""

    def __init__(self, reader: Reader, seconds: float):
        self._until = reader.latest_t + int(seconds * 1e9)

    def __call__(self, block: Block) -> bool:
        return int(block.t_ns[-1]) >= self._until


def _reached(block: Block, number: int) -> bool:
    return bool(np.any((block.acknowledged == number & 0xFFFF) & (block.state == State.ARMED)))


class _Steady:
    """Every tension within its band for long enough."""

    def __init__(self, rig: RigDescription, step: Settled):
        self._columns = rig.columns("tension", step.tensions)
        self._targets = np.array(list(step.tensions.values()))
        self._within, self._need = step.within, round(step.seconds * rig.rate_hz)
        self._good = 0

    def __call__(self, block: Block) -> bool:
        good = (np.abs(block.x[:, self._columns] - self._targets) < self._within).all(1)
        bad = np.flatnonzero(~good)
        self._good = self._good + len(block) if not len(bad) else len(block) - 1 - int(bad[-1])
        return self._good >= self._need


class _Passes:
    """Every joint through its range, to and fro, often enough."""

    def __init__(self, rig: RigDescription, step: Covered):
        self._columns = rig.columns("joint_position", step.joints)
        limits = rig.finger.limits[[rig.finger.joint_names.index(name) for name in step.joints]]
        slack = (1 - step.share) / 2 * (limits[:, 1] - limits[:, 0])
        self._low, self._high = limits[:, 0] + slack, limits[:, 1] - slack
        self._side, self._turns, self._need = [0] * len(limits), [0] * len(limits), 2 * step.passes

    def __call__(self, block: Block) -> bool:
        for j, column in enumerate(self._columns):
            for side, hit in ((1, block.x[:, column] >= self._high[j]), (-1, block.x[:, column] <= self._low[j])):
                if self._side[j] != side and hit.any():
                    self._turns[j] += self._side[j] != 0
                    self._side[j] = side
        return min(self._turns) >= self._need


class _AtPose:
    """Fixed joints where their fixtures hold them."""

    def __init__(self, rig: RigDescription, setup: Setup):
        self._columns = rig.columns("joint_position", setup.fixed)
        self._pose = np.array(list(setup.fixed.values()))

    def __call__(self, block: Block) -> bool:
        return not self._columns or bool((np.abs(block.x[-1, self._columns] - self._pose) < 0.02).all())


# a whole session ------------------------------------------------------------------------------------------------
def run(
    plan: Plan,
    rig: Rig,
    output: str | Path,
    resume: bool = False,
    operator: Operator | None = None,
    observe: Callable[[View], None] | None = None,
) -> Outcome:
    """Record a session: every trial of the plan that the log does not hold yet.

    Publishes what there is, also when cut short. Raises UserError before anything moves where plan, rig and files do
    not fit together.
    """
    output, operator = Path(output), operator or Nobody()
    path = log_path(output)
    log = _earlier(plan, path, output, resume)
    with rig:
        filters = rig.filters()
        refuse_filtered(plan, rig.description, filters)
        head = convert.header(rig.description, plan.text, filters, rig.fingerprint())
        head["created"] = log.header["created"] if log else datetime.now(UTC).isoformat(timespec="milliseconds")
        recorder = Recorder(path, head, resume=log is not None)
        try:
            if log is not None:
                _backlog(log, rig, recorder)
            cause = _trials(plan, rig, recorder, operator, observe, log)
        except UserError:
            recorder.close()
            if log is None:  # nothing moved, so there is nothing to resume
                path.unlink(missing_ok=True)
            raise
        except BaseException:
            recorder.close()
            raise
    recorder.close()
    if recorder.hangs:
        return Outcome(output, (), cause or recorder.failure or "", path)
    cause = cause or recorder.failure or ""
    log = read_log(path)
    for tag, value in recorder.unwritten:
        if tag == wal.END and log.recordings and log.recordings[-1].end is None:
            log.recordings[-1].end = value
    try:
        convert.publish(log, output, overwrite=resume)
    except UserError as error:
        ended = f"{cause}; " if cause else ""
        raise UserError(
            f"{ended}{str(error).rstrip('.')}; jaxfinger recover {path} makes it once there is room."
        ) from error
    if not cause:
        path.unlink()
    done = tuple(r.name for r in log.recordings if r.complete)
    return Outcome(output, done, cause, path if cause else None)


def _earlier(plan: Plan, path: Path, output: Path, resume: bool) -> convert.Log | None:
    """The log to go on with, or None; refuses to mix sessions or to overwrite one."""
    if not resume:
        if output.exists():
            raise UserError(f"{output}: exists already and is not overwritten; choose another name.")
        if path.exists():
            raise UserError(
                f"{path}: a recording was interrupted here; go on with --resume, or rescue it with jaxfinger recover."
            )
        return None
    if not path.exists():
        raise UserError(f"{path}: there is no interrupted recording to resume; leave --resume out.")
    log = read_log(path)
    if log.header["plan"] != plan.text:
        raise UserError(
            f"{path}: was recorded with another plan than {plan.path}; resume with the plan it was begun with."
        )
    if output.exists():
        with h5py.File(output, "r") as file:
            if file.attrs.get("created") != log.header["created"]:
                raise UserError(f"{output}: is not the session that {path.name} belongs to; choose another name.")
    return log


def _backlog(log: convert.Log, rig: Rig, recorder: Recorder) -> None:
    """Close the trial in which the recorder died, with what the controller's ring still holds of it."""
    if not log.recordings or log.recordings[-1].end is not None:
        return
    end = {"complete": False, "cause": "the recorder was killed", "trip": int(Trip.HOST)}
    last = log.last_seq
    if last is not None and rig.fingerprint() == log.header["fingerprint"]:
        status = rig.status()
        until = status.trip_seq if status.state is State.TRIPPED else status.head
        rig.rewind(last + 1)
        while last < until - 1:
            block = rig.read_block(rig.description.deadlines.stale_s)
            recorder.block(block)
            last = int(block.seq[-1])
        end["seq"] = max(until, log.last_seq + 1) if log.last_seq is not None else until
    else:
        end["seq"] = 0 if last is None else last + 1
    recorder.put(wal.END, end)


def _reference(rig: RigDescription) -> Protocol:
    """Tendon encoders read zero with the finger straight and its tendons under 2 N."""
    straight = dict.fromkeys(rig.finger.joint_names, 0.0)
    pretension = {n: 2.0 for n, active in zip(rig.finger.tendon_names, rig.finger.active, strict=True) if active}
    yield Setup("Fix the finger straight: all joints at 0°.", fixed=straight)
    yield TensionRamp(pretension, min(10.0, rig.limits.tension_rate))
    yield Reached()
    yield Settled(pretension)
    yield Tare(("excursion",))


def _trials(plan, rig: Rig, recorder: Recorder, operator: Operator, observe, log: convert.Log | None) -> str:
    earlier = log.recordings if log else []
    done = {r.start["planned"] for r in earlier if r.complete}
    names = {r.name for r in earlier}
    ends = [r.start["session_start"] + sum(map(len, r.blocks)) / rig.description.rate_hz for r in earlier]
    begun = max(ends, default=0.0)
    left = [t for t in plan.trials if t.name not in done]
    reader = Reader(rig, recorder, Supervisor(rig.description))
    runner = Runner(rig, reader, operator, observe)
    try:
        runner.watch.start()
        reader.start(lambda: runner.watch.join("reader"))
        try:
            runner.ready(plan.operator)
            runner._place = ("reference", 0, len(plan.trials))
            runner.carry_out(_reference(rig.description))
        except UserError as error:
            if not runner.watch.guards and reader.violation is None:  # nothing was armed
                raise UserError(str(error)) from error
            return runner.ended(error)
        for trial in left:
            name, again = trial.name, 1
            while name in names:
                again += 1
                name = f"{trial.name}-{again}"
            if cause := runner.trial(trial, name, plan.trials.index(trial) + 1, len(plan.trials), begun):
                return f"{name}: {cause}"
        return runner.let_go()
    except KeyboardInterrupt:
        return runner.interrupted()
    finally:
        runner.watch.close()
        reader.close()
