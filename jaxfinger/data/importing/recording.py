"""Recordings of other tools: their variables by name, each with its clock, and why some cannot be used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


@dataclass(frozen=True)
class Variable:
    """Variable of a recording: an array (N,) or (N, k), samples first, in the units of the recording.

    `columns` are the recording's names of the k columns, empty where it gives none. `clock` is the name of the variable
    with the times of the samples, empty where the format states none. `units` are those that the recording states.
    `present` (N, k) is false where a sample lacks a column, as in messages of several publishers on one topic.
    """

    values: Float[np.ndarray, "N *k"]
    columns: tuple[str, ...] = ()
    clock: str = ""
    units: str = ""
    present: Bool[np.ndarray, "N k"] | None = None

    @cached_property
    def sizes(self) -> tuple[float, ...]:
        """99th percentile of the absolute values of every column, NaN where none is finite."""
        columns = np.abs(self.values.reshape(len(self.values), -1)).T
        return tuple(float(np.nanpercentile(x, 99.0)) if np.isfinite(x).any() else np.nan for x in columns)


@dataclass(frozen=True)
class Recording:
    """Variables of one file.

    `unusable` holds the variables that give no numbers, each with the reason: the end of a sentence that begins with
    the name. `words` holds those of them that are text, (N,), which conditions can test. `remarks` are sentences about
    the file as a whole. `angles` is the unit that it states of angles, whichever of its variables these are.
    """

    path: Path
    variables: Mapping[str, Variable] = field(default_factory=dict)
    unusable: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    words: Mapping[str, np.ndarray] = field(default_factory=dict)
    angles: str = ""


def told_apart(paths: Sequence[Path]) -> list[str]:
    """Names of files, each with as much of its folder as tells it apart from the others."""
    all_parts = {path.parts for path in paths}

    def name(parts: tuple[str, ...]) -> str:
        ends = (parts[-k:] for k in range(1, len(parts) + 1))
        alone = (end for end in ends if sum(other[-len(end) :] == end for other in all_parts) == 1)
        return Path(*next(alone, parts)).as_posix()

    return [name(path.parts) for path in paths]


def samples_first(variables: Mapping[str, Variable]) -> dict[str, Variable]:
    """Variables of which arrays that lie joints first are turned: k×N, where k < N, beside a vector of N samples.

    Beside an array `outer.q` lie the members of the same structure, as `outer.t`, and those around it, as `t`.
    """
    counts: dict[str, set[int]] = {}
    for name, v in variables.items():
        if v.values.ndim == 1:
            counts.setdefault(name.rpartition(".")[0], set()).add(len(v.values))

    def turned(name: str, v: Variable) -> bool:
        if v.values.ndim != 2 or len(v.values) >= v.values.shape[1]:
            return False
        parts = name.split(".")[:-1]
        around = [".".join(parts[:k]) for k in range(len(parts) + 1)]
        return any(v.values.shape[1] in counts.get(scope, ()) for scope in around)

    return {name: replace(v, values=v.values.T) if turned(name, v) else v for name, v in variables.items()}


def side_by_side(recordings: Sequence[Recording]) -> Recording:
    """Recordings of the same samples, as of loggers that write each array to a file of its own, as one recording.

    Its variables are named `file.variable`, by the names of the files without their endings, and one that has the name
    of its file by that alone.

    Raises:
        ValueError: two files have one name, or another number of samples; the end of a sentence.
    """
    variables: dict[str, Variable] = {}
    unusable: dict[str, str] = {}
    words: dict[str, np.ndarray] = {}
    counts: dict[str, int] = {}
    for r in recordings:
        name = r.path.stem
        if name in counts:
            raise ValueError(f"names two files {name!r}; rename one of them")
        counts[name] = max((len(v.values) for v in r.variables.values() if not v.clock), default=0)
        called = {k: k if k == name else f"{name}.{k}" for k in (*r.variables, *r.unusable)}
        variables |= {called[k]: replace(v, clock=called.get(v.clock, "")) for k, v in r.variables.items()}
        unusable |= {called[k]: reason for k, reason in r.unusable.items()}
        words |= {called[k]: values for k, values in r.words.items()}
    if len(set(counts.values())) > 1:
        said = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise ValueError(
            f"names files with different numbers of samples ({said}), which do not lie side by side; delete "
            "the samples that only some have, or leave one here and give columns of the others their `file` and `time`"
        )
    return Recording(recordings[0].path, variables, unusable, words=words)
