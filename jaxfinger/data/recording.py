"""What a recording of another tool holds: variables by name, each with its clock, and why some cannot be used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float


@dataclass(frozen=True)
class Variable:
    """Numbers of one name, samples first: (N,) or (N, k), in the units of the recording.

    `columns` are the names that the recording gives to the k columns, where it does. `clock` names the variable that
    says when the samples were taken, where the format ties one to them. `units` is what the recording states.
    `present` (N, k) is false where a column is no part of the sample: messages of several publishers on one topic.
    """

    values: Float[np.ndarray, "N *k"]
    columns: tuple[str, ...] = ()
    clock: str = ""
    units: str = ""
    present: Bool[np.ndarray, "N k"] | None = None


@dataclass(frozen=True)
class Recording:
    """The variables of one file. `unusable` holds those that are there and give no numbers, each with the reason: the
    rest of a sentence that begins with the name. `remarks` are sentences about the file as a whole."""

    path: Path
    variables: Mapping[str, Variable] = field(default_factory=dict)
    unusable: Mapping[str, str] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()
