"""The live view in the terminal: tensions, angles, progress, what the run waits for."""

from __future__ import annotations

import sys
import threading
from collections import deque
from contextlib import AbstractContextManager, nullcontext, suppress

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from jaxfinger.rig.channels import RigDescription
from jaxfinger.rig.course import View

REFRESH_S = 0.1  # s between two drawings
STALLED_S = 2.0  # s that closing waits for a terminal that takes no output


class LiveView(AbstractContextManager):
    """Shows every View that it is called with. A thread of its own draws the newest one and prints messages.

    The caller never waits: a terminal that takes no output stalls only that thread. `stalled` is then true at the end.
    Without a terminal, one line for each trial is printed. Where drawing fails, the view says so and prints messages
    and these lines to stderr from then on, since the operator needs the prompts. `failure` says why.
    """

    def __init__(self, rig: RigDescription, console: Console | None = None):
        self._rig = rig
        self._console = console or Console()
        self._live: Live | None = None
        if self._console.is_terminal:  # Output of others must not pass through the view and wait for the terminal.
            self._live = Live(console=self._console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False)
        self._trial = ""
        self._view: View | None = None
        self._said: deque[tuple[str, threading.Event]] = deque()  # messages to print, with the events to set then
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name="jaxfinger-view", daemon=True)
        self.stalled = False
        self.failure = ""

    def __enter__(self) -> LiveView:
        self._thread.start()
        return self

    def __exit__(self, *_) -> None:
        self._closing.set()
        self._thread.join(STALLED_S)
        self.stalled = self._thread.is_alive()

    def say(self, text: str) -> threading.Event:
        """Print a line above the view, without waiting for it. The event is set once it is printed."""
        printed = threading.Event()
        self._said.append((text, printed))
        return printed

    def __call__(self, view: View) -> None:
        """Show a View, without waiting for it."""
        if self._live is not None:
            self._view = view
        elif view.trial != self._trial:
            self._trial = view.trial
            self.say(f"{view.number}/{view.count} {view.trial}")

    def _work(self) -> None:
        try:
            with self._live if self._live is not None else nullcontext():
                self._print_until_closed()
        except Exception as error:  # Of any kind: the view is no safety function, and nothing else may end with it.
            self.failure = f"the live view has failed ({type(error).__name__}: {error})"
            self._live, self._console = None, Console(file=sys.stderr, soft_wrap=True)
            self._said.appendleft((f"{self.failure}; recording and stop key do not depend on it.", threading.Event()))
            with suppress(Exception):  # Nobody can be told. A prompt that is not printed is answered by nobody.
                self._print_until_closed()

    def _print_until_closed(self) -> None:
        while not self._closing.wait(REFRESH_S):
            self._print()
        self._print()

    def _print(self) -> None:
        while self._said:
            text, printed = self._said[0]
            self._console.print(text, markup=False)
            self._said.popleft()  # Only now: what could not be printed is printed again elsewhere.
            printed.set()
        view, self._view = self._view, None
        if view is not None and self._live is not None:
            self._live.update(self.draw(view), refresh=True)

    def draw(self, view: View) -> Group:
        """Render a View for rich."""
        table = Table(box=None, padding=(0, 1), show_header=False)
        table.add_column(justify="left")
        table.add_column(justify="right")
        table.add_column(width=30)
        if view.block is not None:
            mean = view.block.x.mean(axis=0)  # nan where any sample of the block is no number
            finger, limits = self._rig.finger, self._rig.limits
            for channel, value in zip(self._rig.channels, mean, strict=True):
                if channel.kind == "tension":
                    bar = ProgressBar(total=limits.tension_max, completed=max(float(value), 0.0), width=30)
                    table.add_row(channel.of, f"{value:6.2f} N", bar)
                elif channel.kind == "joint_position":
                    low, high = finger.limits[finger.joint_names.index(channel.of)]
                    bar = ProgressBar(total=float(high - low), completed=max(float(value - low), 0.0), width=30)
                    table.add_row(channel.of, f"{np.degrees(value):6.1f} °", bar)
                elif channel.kind == "external_torque":
                    table.add_row("motor", f"{value * 1e3:6.1f} N mm", "")
        lost = f", {view.lost} samples lost" if view.lost else ""
        lag = f", {view.lag_s * 1e3:.0f} ms behind the rig" if view.lag_s else ""
        dot = "● " if view.recording else "  "
        head = Text(f"{dot}{view.number}/{view.count} {view.trial}: {view.doing}{lost}{lag}   (q, space or Esc stops)")
        return Group(head, table)
