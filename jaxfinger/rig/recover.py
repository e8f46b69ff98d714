"""Make a session from the log of a recording that was killed, without the rig."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jaxfinger.rig import wal
from jaxfinger.rig.convert import Log, publish, read_frames


@dataclass(frozen=True)
class Recovered:
    """Names of the trials written, names of those that were cut short or damaged, and how much of the log was lost.

    `damage` has a sentence without a full stop for each place before the log's end, `torn_bytes` counts those at it.
    """

    trials: tuple[str, ...]
    incomplete: tuple[str, ...]
    damage: tuple[str, ...]
    torn_bytes: int


def read_log(path: str | Path) -> Log:
    """Read the sound part of a log. Raises UserError where there is none."""
    return read_frames(wal.read_log(path), str(path))


def recover(path: str | Path, output: str | Path, overwrite: bool = False) -> Recovered:
    """Write the session that a log holds. The log is not changed.

    Raises:
        UserError: a recorder still writes to the log, it cannot be read, or the session cannot be written.
    """
    wal.refuse_live(path)
    log = read_log(path)
    session = publish(log, output, overwrite)
    incomplete = tuple(t.name for t in session if not t.complete)
    torn = Path(path).stat().st_size - wal.sound_length(path)
    return Recovered(tuple(session.trials), incomplete, tuple(map(str, log.damage)), torn)
