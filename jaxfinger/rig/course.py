"""The course of a run: samples pass and are shown, and whatever must end the run ends it.

`Drives` and `Runner` wait only by way of it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from jaxfinger.errors import UserError
from jaxfinger.rig.backend import Block, CommandRefused, Rig, Status
from jaxfinger.rig.contract import DRIVES_ON, State, Trip
from jaxfinger.rig.operator import Operator
from jaxfinger.rig.reader import Reader, tripped
from jaxfinger.rig.signals import Interrupts
from jaxfinger.rig.trips import FULL_COUNT
from jaxfinger.rig.watch import Watch

# s of samples to wait for after a release or a stop; of a trial they are still recorded. The controller needs 0.7 s of
# them to release all tension.
RELEASE_S = 1.0
TIMEOUT_MARGIN_S = 5.0  # s by which a wait of known length may take longer before the trial ends


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


class Course:
    """Waits in the thread that calls it, and raises TrialEnded where the run must end.

    `watch` is the watch over this run, `place` the trial's name, its number and the count of trials, for the view.
    `drives_off` is true from when the drives were seen off, so that hands may be at the finger: a controller that then
    switches them on without being told ends the run. At first nothing is known of them.
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
        self.place: tuple[str, int, int] = ("", 0, 0)
        self._was_on = False  # whether a sample has shown the drives on since they were switched on
        self.drives_off = False
        self._since = time.monotonic()  # the last Enter, or when the drives were last switched on

    @property
    def drives_on(self) -> bool:
        """Whether the drives were switched on: a controller that lets go without being told ends the run."""
        return self.watch.guards

    def drives_go_on(self) -> None:
        """Take note that the drives are about to be switched on. The watch guards from now on."""
        self.drives_off, self._since = False, time.monotonic()
        self.watch.guard()

    def drives_are_off(self) -> None:
        """Take note that the drives were seen off."""
        self.watch.guards = self._was_on = False
        self.drives_off = True

    def answered(self) -> None:
        """Take note that a prompt has just been answered."""
        self._since = time.monotonic()

    def suspended_s(self) -> float:
        """Time in s for which the program was suspended since the last Enter and since the drives were switched on.

        With the drives on it ends the run. With them off, whoever pressed Enter before does not expect them to go on.
        """
        return self.watch.suspended_s(self._since)

    def show(self, doing: str, block: Block | None) -> None:
        """Hand the state of the run to the live view."""
        reader = self.reader
        self.observe(View(*self.place, doing, block, reader.lost, reader.recording, reader.lag_s))

    def wait(
        self, doing: str, done: Callable[[Block], bool], timeout: float, lacks: Callable[[], str] = lambda: ""
    ) -> None:
        """Wait until a block is `done`. `lacks` says what it lacks, with a leading separator.

        Raises:
            TrialEnded: `timeout` s of samples have come, or the host's limit for them is over, or the run must end.
        """
        self.reader.forget()
        start, latest = self.reader.latest_seq, time.monotonic() + self.host_limit(timeout)
        while True:
            block = self.reader.next()
            self.check(block)
            if block is not None:
                start = start if start >= 0 else int(block.seq[0])  # the first block of all
                self.show(doing, block)
                if done(block):
                    return
            passed = (int(block.seq[-1]) - start) / self.rig.description.rate_hz if block is not None else 0.0
            if passed > timeout or time.monotonic() > latest:
                raise TrialEnded(f"{doing} took longer than {timeout:g} s{lacks()}", Trip.HOST)

    def let_pass(self, seconds: float, done: Callable[[], bool] = lambda: False, since: int | None = None) -> None:
        """Wait for `seconds` of samples, or until `done`, or until the host's limit for that time is over.

        They count from the sample `since`, by default from the next one that is read. A busy host may have to read many
        samples before it comes to those that follow a command.
        """
        reader, rate = self.reader, self.rig.description.rate_hz
        latest = time.monotonic() + self.host_limit(seconds)
        start = since
        while reader.reads and time.monotonic() < latest and not done():
            self.rig.report_alive()
            block = reader.next()
            if block is not None:
                with suppress(Exception):  # A view that fails must not cut off a stop.
                    self.show("waiting for the controller", block)
            start = reader.latest_seq if start is None and reader.latest_seq >= 0 else start
            if start is not None and reader.latest_seq - start >= seconds * rate:
                break

    def host_limit(self, seconds: float) -> float:
        """Time in s on the host's clock after which to give up what may take `seconds` on the controller's.

        0.5 s and the allowed error of the clocks' rates come on top. A simulation may be slower than real time.
        """
        if self.rig.simulated_time:
            return 60.0 + 10.0 * seconds
        return 0.5 + (1.0 + self.rig.description.deadlines.clock_rate) * seconds

    def check(self, block: Block | None) -> None:
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
            self.raise_stopped(self.rig.status())
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

    def astray(self, block: Block | None) -> bool:
        """Whether a block shows the controller stopped, or its drives otherwise than they were switched."""
        return tripped(block) or self._let_go(block) or self._took_hold(block)

    def _took_hold(self, block: Block | None) -> bool:
        """Whether the drives are on at a block's end although hands may be at the finger."""
        return block is not None and self.drives_off and int(block.state[-1]) in DRIVES_ON

    def _let_go(self, block: Block | None) -> bool:
        """Whether the controller, armed before, has the drives off at a block's end, and has not tripped."""
        if block is None or not self.drives_on:
            return False
        self._was_on |= bool(np.isin(block.state, DRIVES_ON).any())
        return self._was_on and int(block.state[-1]) in (State.INIT, State.IDLE, State.RELEASING)

    def seen_off(self, block: Block | None) -> bool:
        """Whether a block's end shows the controller stopped or idle, which has the drives off.

        An idle one from before the drives were switched on says nothing.
        """
        idle = block is not None and int(block.state[-1]) == State.IDLE
        return tripped(block) or (idle and (self._was_on or not self.drives_on))

    def heed_stop_key(self) -> None:
        """Stop the rig and raise TrialEnded where the stop key was pressed or a signal came.

        The watch does so too, but up to PERIOD_S later: the command that follows a prompt would still be sent.
        """
        if (asked := self.watch.stop_request()) is not None:
            self.reader.stop(asked)
            self.check(None)

    def sent(self, send: Callable[[], int]) -> int:
        """Send a command and return its id. Raises TrialEnded where it was refused because the rig has just stopped."""
        try:
            return send()
        except CommandRefused:
            self.check(None)
            if (status := self.rig.status()).state is State.TRIPPED:
                self.raise_stopped(status)
            raise

    def raise_stopped(self, status: Status) -> NoReturn:
        """Raise ControllerStopped with its cause; the trip's FULL_COUNT bad samples are left out of the trial."""
        self.reader.note("trip", status.cause)
        raise ControllerStopped(
            f"the controller stopped: {status.cause}", status.trip, status.trip_seq - FULL_COUNT + 1
        )
