"""Findings of the checker about a file, one sentence each."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

from jaxfinger.errors import counted, listed

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """One fault of a file: its place (a path inside the file) and a sentence that ends with the mend.

    An error means that the file breaks the format, or that a number read from it would be wrong. After a warning the
    file can be read, but something will be missing or looks unlikely. A note is worth knowing.
    An error that is `local` leaves the rest of the file usable and does not stop `read_session`. `row` is the index of
    the joint (with its link) or of the tendon that a finding in `/finger` is about.
    """

    severity: Severity
    place: str
    message: str
    local: bool = False
    row: int | None = None

    @property
    def sentence(self) -> str:
        """Place and message; the message alone where it is about the whole file."""
        return self.message if self.place == "/" else f"{self.place}: {self.message}"

    def __str__(self) -> str:
        return f"{self.severity}: {self.sentence}"


class Report(list[Finding]):
    """List of findings, with a method to add each kind."""

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


_ENDINGS = "csv|tsv|txt|log|lvm|dat|asc|sto|mot|mat|jsonl?|ndjson|np[yz]|h5|hdf5|mcap|db3|bag"  # of recordings
# Places that several trials or recordings have alike: what each is, with its name and the rest of the place as groups.
_PLACES = (
    ("trial", re.compile(r"/trials/([^/]+)(.*)")),  # of a session
    ("trial", re.compile(r"trials\.(.+?)(\.(?:channels|time)(?:\..*)?)?")),  # of a mapping; a name may hold dots
    ("recording", re.compile(rf"(?:.*[/\\])?([^/\\]+\.(?:{_ENDINGS}))()", re.IGNORECASE)),
)
_NAMED = 3  # of the others that share a finding: a line holds so many names
_NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d.]*(?:e[-+]?\d+)?%?")


def merged(findings: Iterable[Finding]) -> list[Finding]:
    """Merge findings that several trials or recordings share: the finding of the first one, and the names of the next
    `_NAMED` ones.

    Findings are shared if they differ in nothing but trials, recordings and numbers.
    """
    alike: dict[object, list[tuple[Finding, str, str]]] = {}
    for finding in findings:
        kind, name, rest = _split(finding.place)
        # A finding about the whole has a key of its own.
        key = (finding.severity, finding.local, kind, rest, _NUMBER.sub("", finding.message)) if kind else object()
        alike.setdefault(key, []).append((finding, kind, name))
    out = []
    for (first, kind, own), *others in alike.values():
        names = list(dict.fromkeys(name for *_, name in others if name != own))
        if names:
            also = f" (likewise in {counted(len(names), f'other {kind}')}: {listed(names, _NAMED)})"
            first = replace(first, message=first.message + also)
        out.append(first)
    return out


def _split(place: str) -> tuple[str, str, str]:
    """Kind of a place, the name of its trial or recording, and the rest of the place; empty where it is of neither."""
    found = ((kind, pattern.fullmatch(place)) for kind, pattern in _PLACES)
    return next(((kind, at[1], at[2] or "") for kind, at in found if at), ("", "", ""))
