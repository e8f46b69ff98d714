"""Carries out protocols on an open rig: their steps become commands and waits."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import NoReturn

import numpy as np

from jaxfinger.errors import UserError
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
from jaxfinger.rig.contract import State, Trip
from jaxfinger.rig.operator import Operator
from jaxfinger.rig.plan import PlannedTrial
from jaxfinger.rig.protocols import Covered, Dwell, Mark, Protocol, Reached, Settled, Start, Tare
from jaxfinger.rig.reader import Reader, tripped
from jaxfinger.rig.safety import Violation
from jaxfinger.rig.trips import FULL_COUNT
from jaxfinger.rig.waits import AtPose, Elapsed, Passes, Steady, reached
from jaxfinger.rig.watch import Watch

AFTER_TRIP_S = 1.0  # that is still recorded after a trip, and in which the controller has released all tension
QUIET_S = 0.3  # without a fault before anything is armed: a clock that runs wrong shows within 0.1 s
PATIENCE_S = 5.0  # for that quiet: many times as long, since the first samples of a busy host come late
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


class TrialEnded(UserError):
    """The trial under way cannot go on; `trip` and `seq` say why and where its good samples end."""

    def __init__(self, message: str, trip: Trip, seq: int | None = None):
        super().__init__(message)
        self.trip, self.seq = trip, seq


class ControllerStopped(TrialEnded):
    """The controller has stopped the rig, and let go, for a cause of its own."""


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
            self.carry_out(trial.protocol(self.rig.description), (name, number, count))
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
        if not (tripped(reader.latest) or isinstance(error, ControllerStopped)):
            reader.stop(Violation(trip, "host", reader.latest_seq, float("nan")))

        def lets_go() -> bool:
            block = reader.latest
            return block is not None and (tripped(block) or int(block.state[-1]) == State.IDLE)

        self._pass(AFTER_TRIP_S, lets_go)  # samples of a busy host come late: those before the stop first
        self._pass(AFTER_TRIP_S)
        cause = str(error).rstrip(".")
        if reader.latest is not None and not lets_go():
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

        def quiet() -> bool:
            return self.reader.quiet(round(QUIET_S * rig.description.rate_hz))

        self._pass(PATIENCE_S, quiet)
        self._look(None)
        if not quiet():
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

    def carry_out(self, protocol: Protocol, place: tuple[str, int, int]) -> None:
        """Carry out the steps of a protocol; `place` is a trial's name, its number and how many there are."""
        self._place = place
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
                self._wait("moving", lambda b: reached(b, self._id), step.timeout)
            elif isinstance(step, Dwell):
                self._wait("waiting", Elapsed(self.reader, step.seconds), step.seconds + SLACK_S)
            elif isinstance(step, Settled):
                self._wait("tensions settling", Steady(self.rig.description, step), step.timeout)
            else:
                assert isinstance(step, Covered)
                self._wait("moved by hand", Passes(self.rig.description, step), step.timeout)

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
        self._wait("finger being prepared", AtPose(self.rig.description, setup), 60.0)

    def _tare(self, step: Tare) -> None:
        rig = self.rig.description
        columns = [i for i, c in enumerate(rig.channels) if c.kind in step.kinds]
        rows: list[np.ndarray] = []
        elapsed = Elapsed(self.reader, step.seconds)

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
        """Raise ControllerStopped with its cause."""
        self.reader.note("trip", status.cause)
        raise ControllerStopped(
            f"the controller stopped: {status.cause}", status.trip, status.trip_seq - FULL_COUNT + 1
        )
