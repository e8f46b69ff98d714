"""The live view in the terminal: tensions, angles, what is waited for, progress."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from jaxfinger.rig.channels import RigDescription
from jaxfinger.rig.runner import View

REFRESH_S = 0.1


class LiveView(AbstractContextManager):
    """Call it with every View; it draws ten times a second. Outside a terminal it prints one line a trial."""

    def __init__(self, rig: RigDescription, console: Console | None = None):
        self._rig = rig
        self._console = console or Console()
        self._live = Live(console=self._console, auto_refresh=False) if self._console.is_terminal else None
        self._drawn, self._trial = 0.0, ""

    def __enter__(self) -> LiveView:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, text: str) -> None:
        """Print above the view."""
        self._console.print(text, markup=False)

    def __call__(self, view: View) -> None:
        """Show a View."""
        if self._live is None:
            if view.trial != self._trial:
                self._trial = view.trial
                self._console.print(f"{view.number}/{view.count} {view.trial}", markup=False)
        elif time.monotonic() - self._drawn > REFRESH_S:
            self._drawn = time.monotonic()
            self._live.update(self.draw(view), refresh=True)

    def draw(self, view: View) -> Group:
        """The view as something rich can print."""
        table = Table(box=None, padding=(0, 1), show_header=False)
        table.add_column(justify="left")
        table.add_column(justify="right")
        table.add_column(width=30)
        if view.block is not None:
            mean = np.nanmean(view.block.x, axis=0)
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
        dot = "● " if view.recording else "  "
        head = Text(f"{dot}{view.number}/{view.count} {view.trial}: {view.doing}{lost}   (q, space or Esc stops)")
        return Group(head, table)
