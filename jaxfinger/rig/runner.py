"""The runner carries out a plan's protocols on an open rig: it arms, sends commands, waits, and ends each trial."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
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
from jaxfinger.rig.protocols import Covered, Dwell, Mark, Protocol, Reached, Settled, Start, Tare, slackened
from jaxfinger.rig.reader import Reader, tripped
from jaxfinger.rig.safety import Violation
from jaxfinger.rig.signals import INTERRUPTED, Interrupts
from jaxfinger.rig.trips import FULL_COUNT
from jaxfinger.rig.waits import AtPose, Elapsed, Passes, Steady, elsewhere, pulled, reached, tensions
from jaxfinger.rig.watch import Watch

DRIVES_ON = (State.ARMED, State.MOVING)
# s of samples that are still recorded after a stop. The controller needs 0.7 s of them to release all tension.
AFTER_TRIP_S = 1.0
# s of samples without a violation before the rig is armed: three times the 0.1 s (clock_offset_s) within which a clock
# that runs wrong shows.
QUIET_S = 0.3
QUIET_TIMEOUT_S = 5.0  # s to wait for these samples. Much longer, since the first samples of a busy host come late.
TIMEOUT_MARGIN_S = 5.0  # s by which a wait of known length may take longer before the trial ends
RELEASED = "the finger is released, and its drives are off"
TENSION_NOT_SEEN_TO_FALL = "tension was not seen to fall, so switch the drives off and see that it is off"


@dataclass(frozen=True)
class View:
    """State of the run for the live view.

    `trial` is number `number` of `count`, `doing` says what is waited for, `block` holds the newest samples, `lost`
    counts lost samples, `lag_s` is how far the host is behind the rig.
    """

    trial: str
    number: int
    count: int
    doing: str
    block: Block | None
    lost: int
    recording: bool
    lag_s: float = 0.0


class TrialEnded(UserError):
    """The trial under way cannot go on. Its samples before number `seq` are good (None: all so far)."""

    def __init__(self, message: str, trip: Trip, seq: int | None = None):
        super().__init__(message)
        self.trip, self.seq = trip, seq


class ControllerStopped(TrialEnded):
    """The controller stopped the rig and released the finger for a cause of its own."""


class Runner:
    """Carries out protocols on an open rig, in the thread that calls it.

    `watch` is the watch over this run, `tare` holds the zeros of the tared channels (SI), `t0` the device time (ns) at
    which the first trial began.
    """

    def __init__(
        self,
        rig: Rig,
        reader: Reader,
        operator: Operator,
        interrupts: Interrupts,
        observe: Callable[[View], None] | None = None,
    ):
        self.rig, self.reader, self.operator = rig, reader, operator
        self.watch = Watch(rig, reader, operator, interrupts)
        self.observe = observe or (lambda view: None)
        self.tare: dict[str, float] = {}
        self.t0: int | None = None
        self._place = ("", 0, 0)
        self._id = 0
        self._was_on = False  # whether a sample has shown the drives on since they were switched on
        self._off = False  # the drives were seen off, so that hands may be at the finger
        self._setup = Setup("")
        self._start: dict = {}
        self._ended: int | None = None  # number of the sample at which the trial ended whose faults may still show

    # one trial --------------------------------------------------------------------------------------------------
    def trial(self, trial: PlannedTrial, name: str, number: int, count: int, begun_s: float) -> str:
        """Run one trial. Return why it ended early, or an empty string.

        `name` is the trial's name in the file, `number` its place among the plan's `count` trials. A session that is
        resumed has lasted `begun_s` s before.
        """
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
            place, finger = (name, number, count), self.rig.description.finger
            self.carry_out(trial.protocol(self.rig.description), place)
            self._check(None)
            self._ended = self.reader.end({"complete": True})
            self.carry_out(slackened(finger, trial.parameters.tension_rate), place)
            self.carry_out(iter([Dwell(self.rig.description.hindsight_s)]), place)
            self._ended = None
            return ""
        except Exception as error:  # Of any kind: the finger is armed.
            return self.abort(error)
        except KeyboardInterrupt:
            return self.abort_interrupted()

    def abort_interrupted(self) -> str:
        """Stop the rig after a KeyboardInterrupt. Return why the run ended."""
        return self.abort(TrialEnded(INTERRUPTED, Trip.OPERATOR))

    def abort(self, error: Exception) -> str:
        """Stop the rig unless it is stopped, record AFTER_TRIP_S more, end the trial.

        Return why it ended and in which state the rig is: where no sample shows the controller stopped and no drive's
        tension, the operator is to switch the drives off.
        """
        self.watch.interrupts.stopping = True
        reader = self.reader
        trip, seq = (error.trip, error.seq) if isinstance(error, TrialEnded) else (Trip.HOST, None)
        said = str(error) if isinstance(error, UserError) else f"the recorder failed ({type(error).__name__}: {error})"
        cause = said.rstrip(".")
        if seq is None:  # What is read from here on shows the release.
            seq = reader.violation.since if reader.violation is not None else reader.latest_seq + 1
        if not (tripped(reader.latest) or isinstance(error, ControllerStopped)):
            reader.stop(Violation.of_host(trip, reader.latest_seq, cause))
        heard = reader.latest_seq
        self._let_pass(AFTER_TRIP_S, self._released)  # A busy host first has to read the samples before the stop.
        if self._released() or reader.latest_seq > heard:  # Of a silent reader nothing more is to be expected.
            self._let_pass(AFTER_TRIP_S)
        end = {"complete": False, "cause": cause, "trip": int(trip), "seq": seq}
        if reader.recording:
            reader.end(end)
        elif self._ended is not None and seq < self._ended:
            reader.amend(self._start["name"], end)
        if reader.latest is None:
            return cause
        return f"{cause}; {RELEASED if self._released() else TENSION_NOT_SEEN_TO_FALL}"

    def _released(self) -> bool:
        """Whether the newest sample shows the controller stopped or idle, and no drive's tension."""
        block = self.reader.latest
        idle = block is not None and (tripped(block) or int(block.state[-1]) == State.IDLE)
        return idle and not pulled(tensions(block, self.rig.description))

    def arm(self, name: str) -> None:
        """Bring the controller to IDLE, have the finger fixed straight, and switch the drives on.

        An earlier host may have left the finger loaded: it is released. A latched stop is cleared once the operator has
        agreed.

        Raises:
            UserError: something is wrong; nothing was armed.
        """
        rig, status = self.rig, self.rig.status()
        if status.state in DRIVES_ON:
            rig.release()
        if status.state is State.TRIPPED and not rig.prepare(Setup("")):
            safe = "See that finger and hands are safe; Enter then clears the stop."
            self._ask(f"The controller is stopped: {status.cause}. {safe}")
        if status.state is not State.IDLE:
            self._let_pass(AFTER_TRIP_S, since=rig.status().head)
        if status.state is State.TRIPPED:
            self._heed_stop_key()  # A latch is not cleared for an operator who has pressed it since.
            rig.reset(name or "operator")
            self._let_pass(AFTER_TRIP_S, lambda: not tripped(self.reader.latest))
        if (state := rig.status().state) is not State.IDLE:
            raise UserError(f"nothing was armed: the controller is in state {state.name}, not IDLE; see its program.")
        self._refuse_unready()  # Before a prompt has hands at the finger.
        self._off = True
        straight = dict.fromkeys(rig.description.finger.joint_names, 0.0)
        self._prepare(Setup("Fix the finger straight: all joints at 0°.", straight))

    def _switch_on(self) -> None:
        """Arm the rig once the log has taken a frame and the rig is ready.

        The disk may have failed while nothing was written, as during a prompt.

        Raises:
            UserError: something is wrong; nothing was armed.
        """
        self.reader.note("arm", "the drives are to be switched on")
        if failed := self.reader.recorder.lacks(self._host_limit(self.rig.description.deadlines.disk_s)):
            raise TrialEnded(f"nothing was armed: {failed}; make room on the disk, or mend it", Trip.RECORDER)
        self._refuse_unready()
        self._off = False
        self.watch.guard()
        self._sent(self.rig.arm)

    def _refuse_unready(self) -> None:
        """Wait for samples from now on, and for QUIET_S of them without a violation; see that no tendon pulls.

        The drives are off.

        Raises:
            UserError: such samples did not come, or a tendon pulls; nothing was armed.
        """
        reader, rig, head = self.reader, self.rig.description, self.rig.status().head

        def quiet() -> bool:
            return reader.latest_seq >= head and reader.quiet(round(QUIET_S * rig.rate_hz))

        self._let_pass(QUIET_TIMEOUT_S, lambda: quiet() or reader.violation is not None)
        self._check(reader.latest)
        if not quiet():
            bad = reader.unarmed_violation
            what = bad.sentence if bad is not None else "too few samples came"
            raise UserError(f"nothing was armed: {what}.")
        if still := pulled(tensions(reader.latest, rig)):
            mend = "free the tendon, or see its load cell and its offset"
            raise UserError(f"nothing was armed: with the drives off {still}; {mend}.")

    def _switch_off(self) -> None:
        """Release the finger, and see that the drives are off and no tendon pulls.

        Raises:
            TrialEnded: that was not seen.
        """
        self.rig.release()
        self._let_pass(AFTER_TRIP_S, self._released, since=self.rig.status().head)
        self._check(None)
        if (status := self.rig.status()).state is State.TRIPPED:
            self._raise_stopped(status)
        if status.state is not State.IDLE or not self._released():
            still = pulled(tensions(self.reader.latest, self.rig.description)) or f"state {status.state.name}"
            raise TrialEnded(f"the finger was not seen to be released ({still})", Trip.HOST)
        self.watch.guards = self._was_on = False
        self._off = True

    def release(self) -> str:
        """Release the finger after the last trial. Return what went wrong, or an empty string."""
        try:
            self._switch_off()
        except Exception as error:  # Of any kind, as in `trial`.
            return f"after the last trial: {self.abort(error)}"
        return ""

    def _let_pass(self, seconds: float, done: Callable[[], bool] = lambda: False, since: int | None = None) -> None:
        """Wait for `seconds` of samples, or until `done`, or until the host's limit for that time is over.

        They count from the sample `since`, by default from the next one that is read. A busy host may have to read many
        samples before it comes to those that follow a command.
        """
        reader, rate = self.reader, self.rig.description.rate_hz
        latest = time.monotonic() + self._host_limit(seconds)
        start = since
        while reader.reads and time.monotonic() < latest and not done():
            self.rig.report_alive()
            block = reader.next()
            if block is not None:
                with suppress(Exception):  # A view that fails must not cut off a stop.
                    self._show("waiting for the controller", block)
            start = reader.latest_seq if start is None and reader.latest_seq >= 0 else start
            if start is not None and reader.latest_seq - start >= seconds * rate:
                break

    def _host_limit(self, seconds: float) -> float:
        """Time in s on the host's clock after which to give up what may take `seconds` on the controller's.

        0.5 s and the allowed error of the clocks' rates come on top. A simulation may be slower than real time.
        """
        if self.rig.simulated_time:
            return 60.0 + 10.0 * seconds
        return 0.5 + (1.0 + self.rig.description.deadlines.clock_rate) * seconds

    def _ask(self, text: str) -> None:
        """Prompt the operator and wait for the answer; where the drives are on, for `prompt_s` at most.

        The watch sends heartbeats meanwhile, so without this limit an operator who walks away leaves the finger armed.

        Raises:
            TrialEnded: nobody answered in time, or the run must end.
        """
        armed, patience, asked = self.watch.guards, self.rig.description.deadlines.prompt_s, time.monotonic()
        as_told = armed or self._off  # Otherwise the controller is still stopped from before.

        def late() -> bool:
            return armed and time.monotonic() - asked > patience

        def keep_waiting() -> bool:
            self.rig.report_alive()
            latest, reader = self.reader.latest, self.reader
            self._show("waiting for Enter", latest)  # Who has a hand at the finger sees the tension that it has now.
            strays = as_told and (tripped(latest) or self._let_go(latest) or self._took_hold(latest))
            return reader.error is None and reader.violation is None and not strays and not late()

        if armed:
            on = max(map(abs, tensions(self.reader.latest, self.rig.description).values()), default=0.0)
            text += f" The finger is armed, with {on:.1f} N: without an answer within {patience:g} s it is released."
        self.operator.ask(text, keep_waiting)
        self._heed_stop_key()
        self._check(self.reader.latest if as_told else None)
        # Also where Enter came just then: who answers a prompt that is over does not expect a motor to move.
        if late():
            raise TrialEnded(f"nobody answered the prompt within {patience:g} s (prompt_s of [rig])", Trip.HOST)

    def _heed_stop_key(self) -> None:
        """Stop the rig and raise TrialEnded where the stop key was pressed or a signal came.

        The watch does so too, but up to PERIOD_S later: the command that follows a prompt would still be sent.
        """
        if (asked := self.watch.stop_request()) is not None:
            self.reader.stop(asked)
            self._check(None)

    def carry_out(self, protocol: Protocol, place: tuple[str, int, int]) -> None:
        """Carry out the steps of a protocol; `place` is the trial's name, its number and the count of trials.

        Raises:
            TrialEnded: the rig was stopped, cannot be read, or a wait took too long.
            CommandRefused: host or controller refused a command.
        """
        self._place = place
        moved_to: dict[str, float] = {}  # target (rad) of the last command, by joint
        for step in protocol:
            if isinstance(step, TensionRamp | JointMove | Hold):
                moved_to = {step.joint: step.target} if isinstance(step, JointMove) else {}
                self.reader.supervisor.commanded(step)
                self._id = self._sent(lambda command=step: self.rig.command(command))
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
                if wrong := elsewhere(self.reader.latest, self.rig.description, moved_to):
                    said = f"after its move {wrong}; see the coupling, and unit, scale and offset of the channel"
                    raise TrialEnded(said, Trip.HOST)
            elif isinstance(step, Dwell):
                self._wait("waiting", Elapsed(self.reader, step.seconds), step.seconds + TIMEOUT_MARGIN_S)
            elif isinstance(step, Settled):
                steady = Steady(self.rig.description, step)
                self._wait("tensions settling", steady, step.timeout, lambda steady=steady: steady.lacks)
            else:
                assert isinstance(step, Covered)
                passes = Passes(self.rig.description, step)
                self._wait("moving by hand", passes, step.timeout, lambda passes=passes: passes.lacks)

    def _sent(self, send: Callable[[], int]) -> int:
        """Send a command and return its id. Raises TrialEnded where it was refused because the rig has just stopped."""
        try:
            return send()
        except CommandRefused:
            self._check(None)
            if (status := self.rig.status()).state is State.TRIPPED:
                self._raise_stopped(status)
            raise

    def _begin(self, step: Start) -> None:
        """Begin to record the trial. Its time in the session is the device's time since the first trial began."""
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
        """Have the finger prepared, by a simulated operator or by a person.

        The drives are off while hands are at the finger, and are switched on afterwards. Only a finger that is to be
        moved by hand stays armed: the runner then sends no command, and the limits of host and controller, the
        heartbeat and the stop key act as always.
        """
        self._setup = setup
        if not setup.hand and self.watch.guards:
            self._switch_off()
        if self.rig.prepare(setup):
            at_pose, ordered = AtPose(self.rig.description, setup), self.rig.status().head
            self._wait("finger being prepared", lambda b: int(b.seq[-1]) >= ordered and at_pose(b), 60.0)
        else:
            self._ask_until_fixed(setup)
        if not setup.hand:
            self._switch_on()

    def _ask_until_fixed(self, setup: Setup) -> None:
        """Ask a person to prepare the finger, again while the encoder of a fixed joint reads another angle."""
        prompt = setup.prompt
        while True:
            self._ask(prompt)
            answered = self.rig.status().head
            self._wait("reading the joints", lambda b, at=answered: int(b.seq[-1]) + 1 >= at, TIMEOUT_MARGIN_S)
            if not (wrong := elsewhere(self.reader.latest, self.rig.description, setup.fixed)):
                return
            prompt = f"{wrong}; see the fixture, and unit, scale and offset of the channel. {setup.prompt}"

    def _tare(self, step: Tare) -> None:
        """Take the mean of the channels as their zero; refuse a torque or force sensor that is loaded or noisy.

        At most 20 % of the channel's limit in the mean and 2 % in the standard deviation pass: an unloaded sensor has
        only its offset and its noise.
        """
        rig = self.rig.description
        columns = [i for i, c in enumerate(rig.channels) if c.kind in step.kinds]
        rows: list[np.ndarray] = []
        elapsed = Elapsed(self.reader, step.seconds)

        def enough(block: Block) -> bool:
            rows.append(block.x[:, columns])
            return elapsed(block)

        self._wait("taring", enough, step.seconds + TIMEOUT_MARGIN_S)
        values = np.concatenate(rows)
        limits = {"external_torque": rig.limits.joint_torque_max, "fingertip_force": rig.limits.fingertip_force_max}
        for i, mean, spread in zip(columns, values.mean(0), values.std(0), strict=True):
            limit = limits.get(rig.channels[i].kind)
            if not np.isfinite(mean) or (limit is not None and (abs(mean) > 0.2 * limit or spread > 0.02 * limit)):
                raise UserError(
                    f"'{rig.channels[i].name}' cannot be tared: it reads {mean:.3g} ± {spread:.2g}; "
                    "unload it and see its cable."
                )
            self.tare[rig.channels[i].name] = float(mean)

    # waiting ----------------------------------------------------------------------------------------------------
    def _show(self, doing: str, block: Block | None) -> None:
        """Hand the state of the run to the live view."""
        reader = self.reader
        self.observe(View(*self._place, doing, block, reader.lost, reader.recording, reader.lag_s))

    def _wait(
        self, doing: str, done: Callable[[Block], bool], timeout: float, lacks: Callable[[], str] = lambda: ""
    ) -> None:
        """Wait until a block is `done`. `lacks` says what it lacks, with a leading separator.

        Raises:
            TrialEnded: `timeout` s of samples have come, or the host's limit for them is over, or the run must end.
        """
        self.reader.forget()
        start, latest = self.reader.latest_seq, time.monotonic() + self._host_limit(timeout)
        while True:
            block = self.reader.next()
            self._check(block)
            if block is not None:
                start = start if start >= 0 else int(block.seq[0])  # the first block of all
                self._show(doing, block)
                if done(block):
                    return
            passed = (int(block.seq[-1]) - start) / self.rig.description.rate_hz if block is not None else 0.0
            if passed > timeout or time.monotonic() > latest:
                raise TrialEnded(f"{doing} took longer than {timeout:g} s{lacks()}", Trip.HOST)

    def _check(self, block: Block | None) -> None:
        """Report a sign of life to the watch. Raise TrialEnded where the run must end.

        A synchronous rig has no watch thread, so its watch checks here.
        """
        reader = self.reader
        self.rig.report_alive()
        if self.rig.synchronous:
            self.watch.check()
        if reader.violation is not None:
            raise TrialEnded(reader.violation.sentence, reader.violation.trip, reader.violation.since)
        if tripped(block):
            self._raise_stopped(self.rig.status())
        if reader.error is not None:
            raise TrialEnded(str(reader.error), Trip.STALE)
        if block is not None and self._let_go(block):
            on = np.flatnonzero(np.isin(block.state, DRIVES_ON))
            first = int(on[-1]) + 1 if len(on) else 0
            name = State(int(block.state[-1])).name
            cause = f"the controller let go of the finger without being told to (state {name}); see who commands it"
            raise TrialEnded(cause, Trip.HOST, int(block.seq[first]))
        if self._took_hold(block):
            cause = "the controller switched the drives on without being told to; see who commands it"
            raise TrialEnded(cause, Trip.HOST)

    def _took_hold(self, block: Block | None) -> bool:
        """Whether the drives are on at a block's end although hands may be at the finger."""
        return block is not None and self._off and int(block.state[-1]) in DRIVES_ON

    def _let_go(self, block: Block | None) -> bool:
        """Whether the controller, armed before, has the drives off at a block's end, and has not tripped."""
        if block is None or not self.watch.guards:
            return False
        self._was_on |= bool(np.isin(block.state, DRIVES_ON).any())
        return self._was_on and int(block.state[-1]) in (State.INIT, State.IDLE, State.RELEASING)

    def _raise_stopped(self, status: Status) -> NoReturn:
        """Raise ControllerStopped with its cause; the trip's FULL_COUNT bad samples are left out of the trial."""
        self.reader.note("trip", status.cause)
        raise ControllerStopped(
            f"the controller stopped: {status.cause}", status.trip, status.trip_seq - FULL_COUNT + 1
        )
