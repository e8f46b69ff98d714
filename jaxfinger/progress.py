"""Progress messages of long work."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str], None]  # takes the name of the step that begins, which may be a `Step`


class Step(str):
    """Name of a step that begins, with the share of the whole work done before it.

    It is a string, so that a progress callback may treat it as one.
    """

    __slots__ = ("done",)
    done: float

    def __new__(cls, text: str, done: float) -> Step:
        """Step named `text`; `done` is clipped to 0 … 1."""
        step = super().__new__(cls, text)
        step.done = min(max(float(done), 0.0), 1.0)
        return step
