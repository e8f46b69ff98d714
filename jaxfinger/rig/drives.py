"""What has the drives on, and hands at the finger only while they are off: arming, prompts, release.

A tendon that begins to pull at a prompt with the drives off pulls at a finger in somebody's hands, and the host cannot
switch off what the controller says is off already. It latches a stop at the controller, so that nothing can be armed
from anywhere, says so at once, and takes no Enter until the tendon no longer pulls.
"""

from __future__ import annotations

import time
from typing import NoReturn

from jaxfinger.errors import UserError
from jaxfinger.rig.backend import Setup
from jaxfinger.rig.contract import DRIVES_ON, State, Trip
from jaxfinger.rig.course import RELEASE_S, TIMEOUT_MARGIN_S, Course, TrialEnded
from jaxfinger.rig.reader import tripped
from jaxfinger.rig.waits import AtPose, Pulls, elsewhere, pulled, tensions

# s of samples without a violation before the rig is armed: three times the 0.1 s (clock_offset_s) within which a clock
# that runs wrong shows.
QUIET_S = 0.3
QUIET_TIMEOUT_S = 5.0  # s to wait for these samples. Much longer, since the first samples of a busy host come late.
CLEARS = "See that finger and hands are safe; Enter then clears the stop."  # end of a prompt
# s for which a tendon must pull at a prompt with the drives off before a stop is latched: the hand that fixes a joint
# jerks a tendon for less, and nobody is slower to let go for this delay.
PULL_S = 0.2


class Drives:
    """Switches the drives on and off, and has the operator prepare the finger meanwhile.

    `name` is the operator's, in which a latched stop is cleared.
    """

    def __init__(self, course: Course):
        self.course, self.rig, self.reader = course, course.rig, course.reader
        self.name = "operator"

    def arm(self, name: str) -> None:
        """Bring the controller to IDLE, have the finger fixed straight, and switch the drives on.

        An earlier host may have left the finger loaded: it is released. A latched stop is cleared once the operator has
        agreed.

        Raises:
            UserError: something is wrong; nothing was armed.
        """
        rig, status = self.rig, self.rig.status()
        self.name = name or self.name
        if status.state in DRIVES_ON:
            rig.release()
        if status.state is State.TRIPPED and not rig.prepare(Setup("")):
            self._ask(f"The controller is stopped: {status.cause}. {CLEARS}")
        if status.state is not State.IDLE:
            self.course.let_pass(RELEASE_S, since=rig.status().head)
        if status.state is State.TRIPPED:
            self._clear_stop()
        if (state := rig.status().state) is not State.IDLE:
            raise UserError(f"nothing was armed: the controller is in state {state.name}, not IDLE; see its program.")
        self._await_quiet()
        if still := self._pulled():  # Before a prompt has hands at the finger.
            self._refuse(still)
        self.course.drives_are_off()
        described = rig.description
        which = f"It is '{described.specimen}' on rig '{described.name}'."  # Another rig may have people beside it.
        straight = dict.fromkeys(described.finger.joint_names, 0.0)
        self.prepare(Setup(f"Fix the finger straight: all joints at 0°. {which}", straight))

    def _clear_stop(self) -> None:
        """Clear a latched stop, in the operator's name. The operator has just agreed."""
        self.course.heed_stop_key()  # Not for an operator who has pressed it since.
        self.rig.reset(self.name)
        cleared, reader = self.rig.status().head, self.reader
        self.course.let_pass(RELEASE_S, lambda: reader.latest_seq >= cleared and not tripped(reader.latest))

    def prepare(self, setup: Setup) -> None:
        """Have the finger prepared, by a simulated operator or by a person.

        The drives are off while hands are at the finger, and are switched on afterwards. Only a finger that is to be
        moved by hand stays armed: the runner then sends no command, and the limits of host and controller, the
        heartbeat and the stop key act as always.
        """
        if not setup.hand and self.course.drives_on:
            self.switch_off()
        by_itself = self.rig.prepare(setup)
        if by_itself:
            at_pose, ordered = AtPose(self.rig.description, setup), self.rig.status().head
            self.course.wait("finger being prepared", lambda b: int(b.seq[-1]) >= ordered and at_pose(b), 60.0)
        else:
            self._ask_until_fixed(setup)
        while not setup.hand and not self._switched_on(refuse_pull=by_itself):
            self._stop_pull()
            self._ask_until_fixed(setup)

    def _switched_on(self, refuse_pull: bool) -> bool:
        """Arm the rig once the log has taken a frame and the rig is ready.

        The disk may have failed while nothing was written, as during a prompt. A tendon that has begun to pull since
        Enter arms nothing either: a hand may still be at the finger, or back at it. Return False then, or with
        `refuse_pull` raise.

        Raises:
            UserError: something is wrong; nothing was armed.
        """
        self.reader.note("arm", "the drives are to be switched on")
        if failed := self.reader.recorder.lacks(self.course.host_limit(self.rig.description.deadlines.disk_s)):
            raise TrialEnded(f"nothing was armed: {failed}; make room on the disk, or mend it", Trip.RECORDER)
        self._await_quiet()
        if still := self._pulled():
            if refuse_pull:
                self._refuse(still)
            return False
        self.course.drives_go_on()
        self.course.sent(self.rig.arm)
        return True

    def _await_quiet(self) -> None:
        """Wait for samples from now on, and for QUIET_S of them without a violation. The drives are off.

        Raises:
            UserError: such samples did not come; nothing was armed.
        """
        reader, rig, head = self.reader, self.rig.description, self.rig.status().head

        def quiet() -> bool:
            return reader.latest_seq >= head and reader.quiet(round(QUIET_S * rig.rate_hz))

        self.course.let_pass(QUIET_TIMEOUT_S, lambda: quiet() or reader.violation is not None)
        if away := self.course.suspended_s():
            raise UserError(f"nothing was armed: the program was suspended for {away:.1f} s (Ctrl-Z) meanwhile.")
        self.course.check(reader.latest)
        if not quiet():
            bad = reader.unarmed_violation
            what = bad.sentence if bad is not None else "too few samples came"
            raise UserError(f"nothing was armed: {what}.")

    def _refuse(self, pull: str) -> NoReturn:
        """Raise UserError, since a tendon pulls although the drives are off; `pull` says which."""
        mend = "free the tendon, or see its load cell and its offset"
        raise UserError(f"nothing was armed: with the drives off {pull}; {mend}.")

    def switch_off(self) -> None:
        """Release the finger, and see that the drives are off and no tendon pulls.

        Raises:
            TrialEnded: that was not seen.
        """
        self.rig.release()
        self.course.let_pass(RELEASE_S, self.released, since=self.rig.status().head)
        self.course.check(None)
        if (status := self.rig.status()).state is State.TRIPPED:
            self.course.raise_stopped(status)
        if status.state is not State.IDLE or not self.released():
            still = self._pulled() or f"state {status.state.name}"
            raise TrialEnded(f"the finger was not seen to be released ({still})", Trip.HOST)
        self.course.drives_are_off()

    def released(self) -> bool:
        """Whether the newest sample shows the controller stopped or idle, and no drive's tension."""
        return self.course.seen_off(self.reader.latest) and not self._pulled()

    def _ask_until_fixed(self, setup: Setup) -> None:
        """Ask a person to prepare the finger, again while the encoder of a fixed joint reads another angle."""
        prompt = setup.prompt
        while True:
            while not self._ask(prompt):
                self._stop_pull()
            answered = self.rig.status().head
            self.course.wait("reading the joints", lambda b, at=answered: int(b.seq[-1]) + 1 >= at, TIMEOUT_MARGIN_S)
            if not (wrong := elsewhere(self.reader.latest, self.rig.description, setup.fixed)):
                return
            prompt = f"{wrong}; see the fixture, and unit, scale and offset of the channel. {setup.prompt}"

    def _stop_pull(self) -> None:
        """Latch a stop, since a tendon pulls where hands may be; clear it once it no longer does and somebody agrees.

        The cause is TENSION, after which the controller takes all torque off without a ramp. The view says so before,
        since a controller that does not answer STOP is waited for.
        """
        away, still = "HANDS AWAY FROM THE FINGER", self._pulled() or "a tendon pulled just now"
        self.reader.note("pull", f"with the drives off {still}")
        self.course.show(f"{away}: {still}", self.reader.latest)
        self.course.drives_off = False  # The controller is stopped, as the host told it.
        stopped = "is stopped"
        try:
            self.rig.stop(Trip.TENSION)
        except Exception as error:  # Of any kind: the operator must be told in any case.
            self.reader.note("stop", f"the stop was not acknowledged: {error}")
            stopped = "DOES NOT ANSWER"
        while still:
            said = f"{away}: {still}, and the drives are off. Unless a hand pulls the tendon, switch them off by hand"
            self._ask(f"{said}. The controller {stopped}. Once no tendon pulls: {CLEARS}")
            still = self._pulled()
        self._clear_stop()
        self.course.drives_are_off()

    def _pulled(self) -> str:
        """What a driven tendon reads beyond RELEASED_TENSION in the newest sample, or an empty string."""
        return pulled(tensions(self.reader.latest, self.rig.description))

    def _ask(self, text: str) -> bool:
        """Prompt the operator and wait for the answer; where the drives are on, for `prompt_s` at most.

        The watch sends heartbeats meanwhile, so without this limit an operator who walks away leaves the finger armed.
        Return False, whatever the answer, where a tendon pulls although the drives are off.

        Raises:
            TrialEnded: nobody answered in time, or the run must end.
        """
        armed, patience, asked = self.course.drives_on, self.rig.description.deadlines.prompt_s, time.monotonic()
        off, pulls = self.course.drives_off, Pulls(self.rig.description, PULL_S)
        as_told, lasting = armed or off, False  # Not as told: the controller is still stopped from before.

        def late() -> bool:
            return armed and time.monotonic() - asked > patience

        def keep_waiting() -> bool:
            nonlocal lasting
            self.rig.report_alive()
            if self.rig.synchronous:
                self.reader.next()
            latest, reader = self.reader.latest, self.reader
            lasting = lasting or (off and pulls(latest))
            self.course.show("waiting for Enter", latest)  # Whose hand is at the finger sees the tension it has now.
            strays = as_told and self.course.astray(latest)
            return reader.error is None and reader.violation is None and not (strays or lasting or late())

        if armed:
            on = max(map(abs, tensions(self.reader.latest, self.rig.description).values()), default=0.0)
            text += f" The finger is armed, with {on:.1f} N: without an answer within {patience:g} s it is released."
        self.course.operator.ask(text, keep_waiting)
        self.course.heed_stop_key()
        self.course.check(self.reader.latest if as_told else None)
        # Also where Enter came just then: who answers a prompt that is over does not expect a motor to move.
        if late():
            raise TrialEnded(f"nobody answered the prompt within {patience:g} s (prompt_s of [rig])", Trip.HOST)
        self.course.answered()
        return not (lasting or (off and self._pulled()))
