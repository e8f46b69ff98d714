"""Operators: a person at the terminal, or nobody (a simulated rig prepares itself)."""

from __future__ import annotations

import os
import select
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol, runtime_checkable

from jaxfinger.errors import UserError

# s that a prompt must have been on the screen, without an Enter, before Enter answers it: two presses in a row are one,
# and a key that is held down, which repeats every 30 ms, answers nothing.
READ_S = 0.5
# s between two looks at a prompt, from which on the program was suspended meanwhile. A look takes 0.05 s, and tenths of
# a second on a busy machine; Ctrl-Z and the fg after it, typed by hand, are farther apart.
SUSPENDED_S = 1.0
# Why an operator wants the rig stopped.
STOP_KEY, TERMINAL_GONE = "the operator pressed the stop key", "the operator's terminal is gone"


@runtime_checkable
class Operator(Protocol):
    """Answers prompts, and can stop the run at any time. The watch asks for the `stop_request` every 20 ms."""

    def ask(self, text: str, keep_waiting: Callable[[], bool]) -> None:
        """Show a prompt. Return when the operator has done it, or when `keep_waiting()` is false."""
        ...

    def stop_request(self) -> str:
        """Say why the operator wants the rig stopped, in a sentence; empty while it may run.

        Must not wait: the same thread allows the heartbeats.
        """
        ...


class Nobody:
    """No operator, for rigs that prepare themselves. A prompt that needs a person is an error."""

    def ask(self, text: str, keep_waiting: Callable[[], bool]) -> None:
        """Raise UserError: nobody is there to do it."""
        raise UserError(f"a person must do this, so run without --yes: {text}")

    def stop_request(self) -> str:
        """Return an empty string: nobody stops the run."""
        return ""


class AtTerminal:
    """A person at the terminal. Enter answers a prompt; q, space or Escape stops the rig at any time.

    The thread that asks for keys reads them itself and prints nothing, so keys also arrive from a terminal that takes
    no output. A terminal that is gone counts as a stop, since its stop key is gone with it. `say` prints a prompt, or
    returns an event that is set once the prompt is printed. After the program was suspended, as by Ctrl-Z, the prompt
    is printed again: it may have left the screen, and an Enter may have been meant for the shell.
    """

    def __init__(self, say: Callable[[str], threading.Event | None] = print):
        self._say = say
        self._request = ""  # why the rig is to be stopped
        self._enter = threading.Event()
        self._resumed = threading.Event()  # after the shell had the terminal
        self._reading = threading.Lock()
        self._settings: list = []
        self._keys: int | None = None  # file descriptor

    def __enter__(self) -> AtTerminal:
        import termios

        if not sys.stdin.isatty():
            raise UserError("the operator's stop key needs a terminal; run in one, or use --yes on a simulated rig.")
        keys = self._keys = sys.stdin.fileno()
        self._settings = termios.tcgetattr(keys)
        _take_keys_at_once(keys)
        return self

    def __exit__(self, *_) -> None:
        import termios

        with suppress(termios.error):
            termios.tcsetattr(sys.stdin, termios.TCSANOW, self._settings)
        self._keys = None

    def _poll(self, wait: bool = False) -> None:
        """Read the keys that were pressed. Where another thread is reading them, `wait` for it or leave it to that."""
        import termios

        if self._keys is None or not self._reading.acquire(blocking=wait):
            return
        try:
            if _take_keys_at_once(self._keys):
                self._resumed.set()  # Before any key is read.
            while select.select([self._keys], [], [], 0)[0]:
                pressed = os.read(self._keys, 64)
                if not pressed:
                    self._request = self._request or TERMINAL_GONE
                    return
                for key in pressed.decode(errors="replace"):
                    self.key(key)
        except (OSError, termios.error):
            self._request = self._request or TERMINAL_GONE
        finally:
            self._reading.release()

    def key(self, key: str) -> None:
        """Act on one key."""
        if key in ("q", "Q", " ", "\x1b"):
            self._request = STOP_KEY
        elif key in ("\n", "\r"):
            self._enter.set()

    def ask(self, text: str, keep_waiting: Callable[[], bool]) -> None:
        """Show the prompt and wait for Enter. A stop key or a false `keep_waiting()` ends the wait too.

        An Enter from before the prompt answers nothing: who pressed it has not read the prompt. Nor does one from
        before it is printed again.
        """
        prompt = f"{text}\n  Enter when done; q, space or Escape stops the rig."
        self._poll(wait=True)
        self._resumed.clear()
        self._enter.clear()
        printed, shown, looked = self._say(prompt), None, time.monotonic()
        while not self.stop_request() and keep_waiting():
            passed, looked = time.monotonic() - looked, time.monotonic()
            if self._resumed.is_set() or passed > SUSPENDED_S:
                self._resumed.clear()
                self._enter.clear()
                printed, shown = self._say(prompt), None
            if shown is None and (printed is None or printed.is_set()):
                shown = looked
            if self._enter.wait(0.05) and not self._resumed.is_set():
                if shown is not None and time.monotonic() - shown >= READ_S:
                    return
                self._enter.clear()  # Nobody can have read the prompt yet, or the key is held down.
                shown = None if shown is None else time.monotonic()

    def stop_request(self) -> str:
        """STOP_KEY once q, space or Escape was pressed, TERMINAL_GONE once the terminal is gone."""
        self._poll()
        return self._request


def _take_keys_at_once(keys: int) -> bool:
    """Have keys arrive without Enter; after Ctrl-Z and fg the terminal is in the shell's mode, where they do not.

    Return whether it was in that mode.
    """
    import termios
    import tty

    if not os.isatty(keys) or not termios.tcgetattr(keys)[3] & termios.ICANON:
        return False
    tty.setcbreak(keys, termios.TCSANOW)  # Other ways wait until the terminal has taken all output: maybe never.
    return True
