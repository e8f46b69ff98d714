"""Who stands at the rig: a person at the terminal, or nobody (a simulated rig prepares itself)."""

from __future__ import annotations

import select
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from jaxfinger.errors import UserError


class Operator(Protocol):
    """Answers prompts and may stop the run at any time."""

    def ask(self, text: str, alive: Callable[[], bool]) -> None:
        """Return once it is done; give up when `alive` turns false."""
        ...

    def stop_requested(self) -> bool:
        """Whether the stop key was pressed."""
        ...


class Nobody:
    """For rigs that prepare themselves: a prompt that a person would have to answer is an error."""

    def ask(self, text: str, alive: Callable[[], bool]) -> None:
        """Refuse: nobody is there to do it."""
        raise UserError(f"a person must do this, so run without --yes: {text}")

    def stop_requested(self) -> bool:
        """Never."""
        return False


class AtTerminal:
    """A person at the terminal: Enter answers a prompt, q, space or Escape stops the rig at any time."""

    def __init__(self, say: Callable[[str], None] = print):
        self._say = say
        self._stop = threading.Event()
        self._enter = threading.Event()
        self._closing = threading.Event()
        self._settings: list = []
        self._thread: threading.Thread | None = None

    def __enter__(self) -> AtTerminal:
        import termios
        import tty

        if not sys.stdin.isatty():
            raise UserError("the operator's stop key needs a terminal; run in one, or use --yes on a simulated rig.")
        self._settings = termios.tcgetattr(sys.stdin)
        tty.setcbreak(sys.stdin)
        self._thread = threading.Thread(target=self._listen, name="jaxfinger-keys", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_) -> None:
        import termios

        self._closing.set()
        if self._thread is not None:
            self._thread.join()
        with suppress(termios.error):
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._settings)

    def _listen(self) -> None:
        while not self._closing.is_set():
            if select.select([sys.stdin], [], [], 0.05)[0]:
                self.key(sys.stdin.read(1))

    def key(self, key: str) -> None:
        """A key was pressed."""
        if key in ("q", " ", "\x1b"):
            self._stop.set()
        elif key in ("\n", "\r"):
            self._enter.set()

    def ask(self, text: str, alive: Callable[[], bool]) -> None:
        """Show the prompt and wait for Enter; the rig is watched meanwhile."""
        self._enter.clear()
        self._say(f"{text}\n  Enter when done; q, space or Escape stops the rig.")
        while not self._enter.wait(0.05) and not self._stop.is_set() and alive():
            pass

    def stop_requested(self) -> bool:
        """Whether q, space or Escape was pressed."""
        return self._stop.is_set()
