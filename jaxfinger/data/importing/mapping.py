"""Mapping files as records. docs/your-own-data.md explains them in words.

specimen = "finger 3"
finger = "finger.toml"              # or a session, or a table [finger] as in `finger_file`
[trials.01-ID.2-MCP]
file = "log1.mat"
experiment = "ID.2"
joint = "MCP"
time = "t"                          # or rate_hz = 1000
[trials.01-ID.2-MCP.channels]       # or [channels], shared by all trials
q.MCP = { from = "enc", column = 0, units = "deg" }
tendon_force.T1 = { from = "u", scale = 12.5, offset = -0.3, units = "N" }
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from datetime import date, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from jaxfinger.data.finger_file import Finger
from jaxfinger.data.session import EXPERIMENT_NAMES
from jaxfinger.data.toml import Fault, NotEmpty, OneOf, Place, Positive, Within, read_toml

_ColumnKey = Annotated[int, Within(0)] | str  # number of a column, from 0, or its name


class _Numbers:
    """Annotation of a value that must be a number, a list or a matrix of numbers."""

    def check(self, value: Any) -> None:
        """Raise Fault where the value is anything else."""
        try:
            numbers = np.asarray(value)
        except ValueError:  # Rows have different lengths.
            numbers = np.asarray("")
        if numbers.dtype.kind not in "iuf" or not np.isfinite(numbers).all() or numbers.size == 0:
            raise Fault("must be a number, a list or a matrix of numbers")


@dataclass(frozen=True)
class Reading:
    """Reading of a recording's variable: (variable · scale + offset) in `units`."""

    from_: str
    column: _ColumnKey | None = None
    scale: float | str = 1.0  # a number, or the name of a variable that holds one number
    offset: float = 0.0
    units: str | None = None
    unwrap: bool | Positive = False  # true: whole turns are unwrapped; a number: the variable's period


@dataclass(frozen=True)
class Column(Reading):
    """Term of a column of a channel: a reading, with its own clock or file where these are not the trial's."""

    time: str | Reading | None = None  # the variable's own clock
    file: str | None = None  # the recording that holds it, where it is not the trial's


ColumnSpec = str | Column | Annotated[tuple[str | Column, ...], NotEmpty()]  # A list means the sum of its terms.
Columns = Mapping[str, ColumnSpec]

Files = str | Annotated[tuple[str, ...], NotEmpty()]  # Files of a list lie side by side, sample by sample.


def terms(spec: ColumnSpec) -> tuple[Column, ...]:
    """Terms whose sum is the column."""
    each = spec if isinstance(spec, tuple) else (spec,)
    return tuple(Column(term) if isinstance(term, str) else term for term in each)


@dataclass(frozen=True)
class Channels:
    """`[channels]`: the measured columns of each channel, by the name of their joint, tendon, axis or sensor."""

    q: Columns = field(default_factory=dict)
    tendon_force: Columns = field(default_factory=dict)
    tendon_excursion: Columns = field(default_factory=dict)
    joint_torque: Columns = field(default_factory=dict)
    fingertip_force: Columns = field(default_factory=dict)
    joint_direction: Columns = field(default_factory=dict)
    tendon_direction: Columns = field(default_factory=dict)
    temperature: Columns = field(default_factory=dict)
    hold: ColumnSpec | None = None

    def over(self, shared: Channels) -> Channels:
        """Channels of a trial: these ones, and the shared ones that these leave out."""
        own = {f.name: value for f in fields(self) if (value := getattr(self, f.name))}
        return replace(shared, **own)

    def mapped(self) -> dict[str, Any]:
        """Mapped channels by name."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name))}


@dataclass(frozen=True)
class MappedTrial:
    """`[trials.<name>]`: the part of a recording that is a trial."""

    experiment: Annotated[str, OneOf(EXPERIMENT_NAMES)]
    file: Files | None = None  # optional where only one recording is given
    joint: str | None = None
    tendon: str | None = None
    complete: bool = True
    motion: str | None = None
    session_start: float | None = None  # s
    time: str | Reading | None = None
    rate_hz: Positive | None = None
    span: tuple[float, float] | None = None  # s from the recording's start
    where: str | None = None  # a condition on the recording's rows
    sort: bool = False
    channels: Channels = field(default_factory=Channels)
    derived: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self):
        if (self.time is None) == (self.rate_hz is None):
            raise Fault("has both `time` and `rate_hz`" if self.time else "has neither `time` nor `rate_hz`; name the "
                        "variable that holds the time, or the sampling rate")  # fmt: skip
        if self.span is not None and self.span[0] >= self.span[1]:
            raise Fault("must be [begin, end] in s, the earlier first", "span")


@dataclass(frozen=True)
class MappingFile:
    """Content of a mapping file. `derived` are expressions of variables by name, `constants` the numbers in them."""

    specimen: str
    finger: str | Finger
    trials: Mapping[str, MappedTrial]
    source: str | None = None
    created: str | datetime | date | None = None
    channels: Channels = field(default_factory=Channels)
    constants: Mapping[str, Annotated[Any, _Numbers()]] = field(default_factory=dict)
    derived: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self):
        for name in self.trials:
            if "/" in name or name.strip() in ("", ".", ".."):
                raise Fault("is no name for a trial; leave out slashes, which make groups of a file", "trials", name)
        if isinstance(self.created, str):
            try:
                datetime.fromisoformat(self.created)
            except ValueError:
                raise Fault(f"is {self.created!r}; write a date and time as 2026-01-31T12:00:00Z", "created") from None

    @property
    def created_text(self) -> str | None:
        """Date and time of the recordings in ISO 8601, as the dataset format has it."""
        return self.created if self.created is None or isinstance(self.created, str) else self.created.isoformat()


def read_mapping(path: str | Path) -> tuple[MappingFile, Place]:
    """Read a mapping file; also returns the place of its keys, for faults that are found later.

    Raises:
        UserError: the file cannot be read, or a key is unknown, of the wrong type or missing.
    """
    document = read_toml(path, "name a mapping file")
    return document.read(MappingFile), document.place
