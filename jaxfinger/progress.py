"""What long work says of itself while it goes on."""

from __future__ import annotations


class Step(str):
    """The name of what begins now, with the share of the whole work that is done before it.

    It is a string, so that whoever is told of progress may treat it as one.
    """

    __slots__ = ("done",)
    done: float

    def __new__(cls, text: str, done: float) -> Step:
        """`done` from 0 to 1."""
        step = super().__new__(cls, text)
        step.done = min(max(float(done), 0.0), 1.0)
        return step
