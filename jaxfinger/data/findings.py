"""What the checker has to say about a file, one sentence a finding."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

from jaxfinger.errors import counted

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """One fault of a file: where it is (a path inside the file) and a sentence that ends with the mend.

    error: the file breaks the format, or a number read from it would be wrong.
    warning: it can be read, but something will be missing or looks unlikely. note: worth knowing.
    An error that is `local` leaves the rest of the file usable, and does not stop `read_session`. What is about one
    joint (with its link) or one tendon of the finger has its `row` among these.
    """

    severity: Severity
    place: str
    message: str
    local: bool = False
    row: int | None = None

    @property
    def sentence(self) -> str:
        """Place and message, of the file as a whole the message alone."""
        return self.message if self.place == "/" else f"{self.place}: {self.message}"

    def __str__(self) -> str:
        return f"{self.severity}: {self.sentence}"


class Report(list[Finding]):
    """The findings so far, with a short way to add one."""

    def error(self, place: str, message: str, local: bool = False, row: int | None = None) -> None:
        self.append(Finding("error", place, message, local, row))

    def warning(self, place: str, message: str) -> None:
        self.append(Finding("warning", place, message))

    def note(self, place: str, message: str) -> None:
        self.append(Finding("note", place, message))

    @property
    def fatal(self) -> Finding | None:
        """The first error that makes the file unusable."""
        return next((f for f in self if f.severity == "error" and not f.local), None)


_TRIAL = re.compile(r"/trials/([^/]+)(.*)")
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d.]*(?:e[-+]?\d+)?%?")


def together(findings: Iterable[Finding], named: int = 3) -> list[Finding]:
    """What is found in several trials alike as one finding: that of the first, and the names of the next ones. Numbers
    in the sentences may differ.
    """
    alike: dict[object, list[tuple[Finding, str]]] = {}
    for finding in findings:
        at = _TRIAL.fullmatch(finding.place)
        key = (finding.severity, finding.local, at[2], _NUMBER.sub("", finding.message)) if at else object()
        alike.setdefault(key, []).append((finding, at[1] if at else ""))
    out = []
    for (first, of), *others in alike.values():
        names = list(dict.fromkeys(name for _, name in others if name != of))
        if names:
            rest = f" and {len(names) - named} more" if len(names) > named else ""
            also = f" (likewise in {counted(len(names), 'other trial')}: {', '.join(names[:named])}{rest})"
            first = replace(first, message=first.message + also)
        out.append(first)
    return out
