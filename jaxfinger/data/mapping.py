"""Tables of a mapping file: keys that are known, values of the right kind, and the finger inline."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from jaxfinger.data.parse import listed
from jaxfinger.data.session import FingerDescription
from jaxfinger.errors import UserError

ROOT_KEYS = ("specimen", "source", "created", "finger", "trials", "channels")
TRIAL_KEYS = (
    *("file", "experiment", "joint", "tendon", "complete", "motion", "session_start"),
    *("time", "rate_hz", "span", "channels"),
)
COLUMN_KEYS = ("from", "column", "scale", "offset", "units", "time")
_FINGER_KEYS = ("gravity", "fingertip", "joints", "tendons")
_JOINT_KEYS = ("name", "axis", "type", "origin", "limits", "mass", "com", "inertia", "mass_std", "com_std")
_TENDON_KEYS = ("name", "active", "crosses")


@dataclass(frozen=True)
class Where:
    """A place in a mapping file, for sentences about it."""

    file: str
    key: str = ""

    def __truediv__(self, key: str) -> Where:
        return Where(self.file, f"{self.key}.{key}" if self.key else key)

    def fail(self, message: str) -> NoReturn:
        raise UserError(f"{self.file}: {self.key + ': ' if self.key else ''}{message}")

    def known(self, table: Any, keys: Collection[str]) -> None:
        """Refuse keys that nobody reads: they are misspelt more often than not."""
        if not isinstance(table, Mapping):
            self.fail("must be a table")
        for key in table:
            if key not in keys:
                self.fail(f"has the unknown key {key!r}; it may have {listed(tuple(keys), 20)}")

    def need(self, table: Mapping[str, Any], key: str) -> Any:
        if key not in table:
            self.fail(f"has no `{key}`; write it")
        return table[key]

    def text(self, table: Mapping[str, Any], key: str) -> str:
        value = self.need(table, key)
        if not isinstance(value, str):
            self.fail(f"has {key} = {value!r}; it must be a string")
        return value

    def table(self, table: Mapping[str, Any], key: str) -> Mapping[str, Any]:
        value = self.need(table, key)
        if not isinstance(value, Mapping):
            self.fail(f"has a `{key}` that is no table; write it as one")
        return value

    def rows(self, table: Mapping[str, Any], key: str, keys: Collection[str]) -> list[Mapping[str, Any]]:
        value = table.get(key, [])
        if not isinstance(value, list):
            self.fail(f"has a `{key}` that is no list of tables; write [[{key}]] for each")
        for i, row in enumerate(value):
            (self / f"{key}[{i}]").known(row, keys)
        return value

    def numbers(self, table: Mapping[str, Any], key: str, shape: tuple[int, ...]) -> np.ndarray:
        try:
            return np.asarray(self.need(table, key), np.float64).reshape(shape)
        except (TypeError, ValueError):
            self.fail(f"has a `{key}` that is not {'×'.join(map(str, shape)) or 'one'} numbers; correct it")


def finger_from(table: Mapping[str, Any], where: Where) -> FingerDescription:
    """The finger from tables `[[joints]]` and `[[tendons]]`, in the units of the format (SI)."""
    where.known(table, _FINGER_KEYS)
    joints = where.rows(table, "joints", _JOINT_KEYS)
    tendons = where.rows(table, "tendons", _TENDON_KEYS)
    if not joints:
        where.fail("has no joint; write [[finger.joints]] for each, base to tip")
    names = tuple((where / f"joints[{i}]").text(joint, "name") for i, joint in enumerate(joints))

    def stack(key: str, shape: tuple[int, ...]) -> np.ndarray:
        return np.stack(
            [(where / f"joints.{name}").numbers(joint, key, shape) for name, joint in zip(names, joints, strict=True)]
        )

    def optional(key: str, shape: tuple[int, ...]) -> np.ndarray | None:
        return stack(key, shape) if any(key in joint for joint in joints) else None

    crosses = np.zeros((len(tendons), len(names)), bool)
    for i, tendon in enumerate(tendons):
        for joint in (where / f"tendons[{i}]").need(tendon, "crosses"):
            if joint not in names:
                (where / f"tendons[{i}]").fail(f"crosses {joint!r}, which is no joint; there are {listed(names)}")
            crosses[i, names.index(joint)] = True
    kinds = [joint.get("type", "revolute") for joint in joints]
    for name, kind in zip(names, kinds, strict=True):
        if kind not in ("revolute", "prismatic"):
            (where / f"joints.{name}").fail(f"has type {kind!r}; it must be 'revolute' or 'prismatic'")
    return FingerDescription(
        gravity=where.numbers(table, "gravity", (3,)),
        joint_names=names,
        axis=stack("axis", (3,)),
        origin=stack("origin", (3,)),
        limits=stack("limits", (2,)),
        mass=stack("mass", ()),
        com=stack("com", (3,)),
        inertia=stack("inertia", (3, 3)),
        fingertip=where.numbers(table, "fingertip", (3,)),
        tendon_names=tuple((where / f"tendons[{i}]").text(tendon, "name") for i, tendon in enumerate(tendons)),
        active=np.array([bool(tendon.get("active", True)) for tendon in tendons], bool),
        crosses=crosses,
        prismatic=tuple(kind == "prismatic" for kind in kinds),
        mass_std=optional("mass_std", ()),
        com_std=optional("com_std", (3,)),
    )
