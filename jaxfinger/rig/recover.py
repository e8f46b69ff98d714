"""A readable session from the log of a recording that was killed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jaxfinger.rig import wal
from jaxfinger.rig.convert import Log, publish, read_frames


@dataclass(frozen=True)
class Recovered:
    """What came out: trials written, those that were cut short, and bytes at the log's end that were not sound."""

    trials: tuple[str, ...]
    incomplete: tuple[str, ...]
    torn_bytes: int


def read_log(path: str | Path) -> Log:
    """The sound part of a log."""
    return read_frames(wal.read_log(path), str(path))


def recover(path: str | Path, output: str | Path, overwrite: bool = False) -> Recovered:
    """Write the session that the log holds; the log stays as it is."""
    session = publish(read_log(path), output, overwrite)
    incomplete = tuple(t.name for t in session if not t.complete)
    return Recovered(tuple(session.trials), incomplete, Path(path).stat().st_size - wal.sound_length(path))
