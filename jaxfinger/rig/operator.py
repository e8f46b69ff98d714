"""Who stands at the rig: a person at the terminal, or nobody (a simulated rig prepares itself)."""

from __future__ import annotations

import os
import select
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol, runtime_checkable

from jaxfinger.errors import UserError


@runtime_checkable
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
    """A person at the terminal: Enter answers a prompt, q, space or Escape stops the rig at any time.

    Keys are read by whoever asks for them, and nothing is printed: a terminal that takes no output still gives keys.
    """

    def __init__(self, say: Callable[[str], None] = print):
        self._say = say
        self._stop = threading.Event()
        self._enter = threading.Event()
        self._reading = threading.Lock()
        self._settings: list = []
        self._keys: int | None = None  # file descriptor

    def __enter__(self) -> AtTerminal:
        import termios
        import tty

        if not sys.stdin.isatty():
            raise UserError("the operator's stop key needs a terminal; run in one, or use --yes on a simulated rig.")
        keys = self._keys = sys.stdin.fileno()
        self._settings = termios.tcgetattr(keys)
        tty.setcbreak(keys, termios.TCSANOW)  # any other waits for output that nobody may be reading
        return self

    def __exit__(self, *_) -> None:
        import termios

        with suppress(termios.error):
            termios.tcsetattr(sys.stdin, termios.TCSANOW, self._settings)
        self._keys = None

    def _poll(self) -> None:
        """Take the keys that were pressed; never waits."""
        if self._keys is None or not self._reading.acquire(blocking=False):
            return
        try:
            while select.select([self._keys], [], [], 0)[0]:
                pressed = os.read(self._keys, 64)
                if not pressed:  # the terminal is gone, and the stop key with it
                    self._stop.set()
                    return
                for key in pressed.decode(errors="replace"):
                    self.key(key)
        except OSError:
            self._stop.set()
        finally:
            self._reading.release()

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
        while not self._enter.wait(0.05) and not self.stop_requested() and alive():
            pass

    def stop_requested(self) -> bool:
        """Whether q, space or Escape was pressed."""
        self._poll()
        return self._stop.is_set()
