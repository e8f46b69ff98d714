"""What the checker has to say about a file, one sentence a finding."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """One fault of a file: where it is (a path inside the file) and a sentence that ends with the mend.

    error: the file breaks the format, or a number read from it would be wrong.
    warning: it can be read, but something will be missing or looks unlikely. note: worth knowing.
    An error that is `local` leaves the rest of the file usable, and does not stop `read_session`.
    """

    severity: Severity
    place: str
    message: str
    local: bool = False

    @property
    def sentence(self) -> str:
        """Place and message, of the file as a whole the message alone."""
        return self.message if self.place == "/" else f"{self.place}: {self.message}"

    def __str__(self) -> str:
        return f"{self.severity}: {self.sentence}"


class Report(list[Finding]):
    """The findings so far, with a short way to add one."""

    def error(self, place: str, message: str, local: bool = False) -> None:
        self.append(Finding("error", place, message, local))

    def warning(self, place: str, message: str) -> None:
        self.append(Finding("warning", place, message))

    def note(self, place: str, message: str) -> None:
        self.append(Finding("note", place, message))

    @property
    def fatal(self) -> Finding | None:
        """The first error that makes the file unusable."""
        return next((f for f in self if f.severity == "error" and not f.local), None)
