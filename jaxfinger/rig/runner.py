"""The runner carries out a plan's protocols on an open rig: it sends commands, waits, and ends each trial."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict

import numpy as np

from jaxfinger.errors import UserError
from jaxfinger.rig.backend import Block, Hold, JointMove, Setup, TensionRamp
from jaxfinger.rig.contract import Trip
from jaxfinger.rig.course import RELEASE_S, TIMEOUT_MARGIN_S, ControllerStopped, Course, TrialEnded
from jaxfinger.rig.drives import Drives
from jaxfinger.rig.plan import PlannedTrial
from jaxfinger.rig.protocols import Covered, Dwell, Mark, Protocol, Reached, Settled, Start, Tare, slackened
from jaxfinger.rig.reader import tripped
from jaxfinger.rig.safety import Violation
from jaxfinger.rig.signals import INTERRUPTED
from jaxfinger.rig.waits import Elapsed, Passes, Steady, elsewhere, reached

RELEASED = "the finger is released, and its drives are off"
# Cause in the log until the hindsight is over: a recorder that is killed before has not seen whether a sensor froze.
NO_HINDSIGHT = "the recorder was killed before a sensor that froze at the end would have shown"
WHOLE = {"complete": True, "cause": "", "trip": int(Trip.NONE)}
TENSION_NOT_SEEN_TO_FALL = "tension was not seen to fall, so switch the drives off and see that it is off"


class Runner:
    """Carries out protocols on an open rig, in the thread that calls it.

    `course` waits and heeds what ends the run, `drives` arms and releases. `tare` holds the zeros of the tared channels
    (SI), `t0` the device time (ns) at which the first trial began.
    """

    def __init__(self, course: Course):
        self.course, self.rig, self.reader = course, course.rig, course.reader
        self.drives = Drives(course)
        self.tare: dict[str, float] = {}
        self.t0: int | None = None
        self._id = 0
        self._setup = Setup("")
        self._start: dict = {}
        self._ended: int | None = None  # number of the sample at which the trial ended whose faults may still show

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
            self.course.check(None)
            self._ended = self.reader.end({"complete": False, "cause": NO_HINDSIGHT, "trip": int(Trip.HOST)})
            self.carry_out(slackened(finger, trial.parameters.tension_rate), place)
            self.carry_out(iter([Dwell(self.rig.description.hindsight_s)]), place)
            self.reader.amend(name, {**WHOLE, "seq": self._ended})
            self._ended = None
            return ""
        except Exception as error:  # Of any kind: the finger is armed.
            return self.abort(error)
        except KeyboardInterrupt:
            return self.abort_interrupted()

    def release(self) -> str:
        """Release the finger after the last trial. Return what went wrong, or an empty string."""
        try:
            self.drives.switch_off()
        except Exception as error:  # Of any kind, as in `trial`.
            return f"after the last trial: {self.abort(error)}"
        return ""

    def abort_interrupted(self) -> str:
        """Stop the rig after a KeyboardInterrupt. Return why the run ended."""
        return self.abort(TrialEnded(INTERRUPTED, Trip.OPERATOR))

    def abort(self, error: Exception) -> str:
        """Stop the rig unless it is stopped, record RELEASE_S more, end the trial.

        Return why it ended and in which state the rig is: where no sample shows the controller stopped and no drive's
        tension, the operator is to switch the drives off.
        """
        self.course.watch.interrupts.stopping = True
        reader, away = self.reader, self.course.suspended_s() if self.course.drives_on else 0.0
        trip, seq = (error.trip, error.seq) if isinstance(error, TrialEnded) else (Trip.HOST, None)
        said = str(error) if isinstance(error, UserError) else f"the recorder failed ({type(error).__name__}: {error})"
        cause = said.rstrip(".")
        if seq is None:  # What is read from here on shows the release.
            seq = reader.violation.since if reader.violation is not None else reader.latest_seq + 1
        if not (tripped(reader.latest) or isinstance(error, ControllerStopped)):
            reader.stop(Violation.of_host(trip, reader.latest_seq, cause))
        heard = reader.latest_seq
        # A busy host first has to read the samples before the stop.
        self.course.let_pass(RELEASE_S, self.drives.released)
        if self.drives.released() or reader.latest_seq > heard:  # Of a silent reader nothing more is to be expected.
            self.course.let_pass(RELEASE_S)
        if away:  # What was found when the program went on only follows from it.
            trip, cause = self._stopped_meanwhile(trip, away)
        end = {"complete": False, "cause": cause, "trip": int(trip), "seq": seq}
        if reader.recording:
            reader.end(end)
        elif self._ended is not None:
            hindsight = self.rig.description.hindsight_s * self.rig.description.rate_hz
            whole = seq >= self._ended and heard >= self._ended + hindsight
            reader.amend(self._start["name"], {**(WHOLE if whole else end), "seq": min(seq, self._ended)})
        if reader.latest is None:
            return cause
        return f"{cause}; {RELEASED if self.drives.released() else TENSION_NOT_SEEN_TO_FALL}"

    def _stopped_meanwhile(self, trip: Trip, away: float) -> tuple[Trip, str]:
        """Trip code and cause where the program was suspended for `away` s with the drives on.

        `trip` is what the host found afterwards. The controller knows what stopped the drives.
        """
        stopped = "without a heartbeat the controller's watchdog stops them by itself"
        with suppress(Exception):  # Of any kind: a controller that does not answer must not cut off the end.
            if self.reader.reads and 0 < (status := self.rig.status()).trip <= Trip.HEARTBEAT:
                trip, stopped = status.trip, f"meanwhile the controller stopped them: {status.cause}"
        if trip is Trip.HEARTBEAT:
            stopped = "the controller's watchdog stopped them, since it got no heartbeat"
        return trip, f"the program was suspended for {away:.1f} s (Ctrl-Z) with the drives on; {stopped}"

    def carry_out(self, protocol: Protocol, place: tuple[str, int, int]) -> None:
        """Carry out the steps of a protocol; `place` is the trial's name, its number and the count of trials.

        Raises:
            TrialEnded: the rig was stopped, cannot be read, or a wait took too long.
            CommandRefused: host or controller refused a command.
        """
        self.course.place = place
        moved_to: dict[str, float] = {}  # target (rad) of the last command, by joint
        for step in protocol:
            if isinstance(step, TensionRamp | JointMove | Hold):
                moved_to = {step.joint: step.target} if isinstance(step, JointMove) else {}
                self.reader.supervisor.commanded(step)
                self._id = self.course.sent(lambda command=step: self.rig.command(command))
            elif isinstance(step, Setup):
                self._setup = step
                self.drives.prepare(step)
            elif isinstance(step, Tare):
                self._tare(step)
            elif isinstance(step, Start):
                self._begin(step)
            elif isinstance(step, Mark):
                self.reader.mark(asdict(step))
            elif isinstance(step, Reached):
                self.course.wait("moving", lambda b: reached(b, self._id), step.timeout)
                if wrong := elsewhere(self.reader.latest, self.rig.description, moved_to):
                    said = f"after its move {wrong}; see the coupling, and unit, scale and offset of the channel"
                    raise TrialEnded(said, Trip.HOST)
            elif isinstance(step, Dwell):
                self.course.wait("waiting", Elapsed(self.reader, step.seconds), step.seconds + TIMEOUT_MARGIN_S)
            elif isinstance(step, Settled):
                steady = Steady(self.rig.description, step)
                self.course.wait("tensions settling", steady, step.timeout, lambda steady=steady: steady.lacks)
            else:
                assert isinstance(step, Covered)
                passes = Passes(self.rig.description, step)
                self.course.wait("moving by hand", passes, step.timeout, lambda passes=passes: passes.lacks)

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

        self.course.wait("taring", enough, step.seconds + TIMEOUT_MARGIN_S)
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
