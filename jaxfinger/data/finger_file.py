"""The finger in TOML, read and written. Mapping, rig and finger files describe a finger in this one form:

    [finger]
    gravity = [0.0, 0.0, -9.81]       # m/s², in the base frame
    fingertip = [0.03, 0.0, 0.0]      # m, in the last link's frame
    [[finger.joints]]                 # base to tip; the link that moves with the joint is described here too
    name = "MCP"
    axis = [0.0, 1.0, 0.0]
    origin = [0.0, 0.0, 0.0]          # m, in the parent link's frame
    limits_deg = [-10.0, 90.0]        # or limits = [-0.17, 1.57] in rad (m where type = "prismatic")
    mass = 0.02                       # kg
    com = [0.02, 0.0, 0.0]            # m
    inertia = [[1e-6, 0, 0], [0, 4e-6, 0], [0, 0, 4e-6]]   # kg m², about the centre of mass
    rotor_inertia = 2e-6              # kg m², optional: of a geared motor, reflected to the joint
    [[finger.tendons]]
    name = "T1"
    crosses = ["MCP"]
    excursion = { MCP = [0.008, 1e-3] }   # m/rad, m/rad², …, optional: excursion over angle, where CAD knows it

A line `finger = "session.h5"` or `finger = "finger.toml"` takes the description from another file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from jaxfinger.data.checks.finger import UNIT_AXIS_TOLERANCE, check_finger
from jaxfinger.data.findings import Report
from jaxfinger.data.session import FingerDescription
from jaxfinger.data.toml import Fault, Place, Within, as_key, one_of, quoted, read_toml, structure

Vector = tuple[float, float, float]
NotNegative = Annotated[float, Within(0.0)]


@dataclass(frozen=True)
class Joint:
    """`[[finger.joints]]`: a joint and its link. Units m, kg, kg m², and rad (m for a prismatic joint)."""

    name: str
    axis: Vector
    origin: Vector
    mass: Annotated[float, Within(0.0, unit="kg", above=True)]
    com: Vector
    inertia: tuple[Vector, Vector, Vector]
    limits: tuple[float, float] | None = None
    limits_deg: tuple[float, float] | None = None
    type: Literal["revolute", "prismatic"] = "revolute"
    mass_std: NotNegative | None = None
    com_std: Annotated[Vector, Within(0.0)] | None = None
    rotor_inertia: NotNegative | None = None
    rotor_inertia_std: NotNegative | None = None

    def __post_init__(self):
        if (self.limits is None) == (self.limits_deg is None):
            raise Fault("must be given once: `limits` in rad, or `limits_deg`", "limits")
        key = "limits" if self.limits_deg is None else "limits_deg"
        if self.type == "prismatic" and key == "limits_deg":
            raise Fault("are degrees of a joint that slides; write `limits` in m", key)
        lower, upper = self.range
        if lower >= upper:
            raise Fault("must be [lower, upper], the lower first", key)
        length = float(np.linalg.norm(self.axis))
        if abs(length - 1.0) > UNIT_AXIS_TOLERANCE:
            raise Fault(f"is {length:.4g} long; divide it by its length", "axis")
        if self.rotor_inertia is None and self.rotor_inertia_std is not None:
            raise Fault("is missing beside `rotor_inertia_std`; write both, or neither", "rotor_inertia")

    @property
    def range(self) -> tuple[float, float]:
        """Lower and upper limit, rad (m for a prismatic joint)."""
        if self.limits is not None:
            return self.limits
        lower, upper = np.radians(np.array(self.limits_deg, np.float64))
        return float(lower), float(upper)


@dataclass(frozen=True)
class Tendon:
    """`[[finger.tendons]]`. `excursion` holds the coefficients of q, q², … in m/rad, m/rad², … by joint."""

    name: str
    crosses: tuple[str, ...]
    active: bool = True
    excursion: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    excursion_std: Mapping[str, Annotated[tuple[float, ...], Within(0.0)]] = field(default_factory=dict)

    def __post_init__(self):
        for key, by_joint in (("excursion", self.excursion), ("excursion_std", self.excursion_std)):
            for joint, coefficients in by_joint.items():
                if joint not in self.crosses:
                    raise Fault(f"names {joint}, which the tendon does not cross; add it to `crosses`", key, joint)
                if key == "excursion_std" and len(coefficients) != len(self.excursion.get(joint, ())):
                    count = len(self.excursion.get(joint, ()))
                    raise Fault(f"has {len(coefficients)} numbers where `excursion` has {count}", key, joint)
        if self.excursion and set(self.excursion) != set(self.crosses):
            missing = next(joint for joint in self.crosses if joint not in self.excursion)
            raise Fault(f"says nothing of {missing}, which the tendon crosses; write all joints, or none", "excursion")


@dataclass(frozen=True)
class Finger:
    """`[finger]`: gravity in m/s² in the base frame, fingertip in m in the last link's frame, joints and tendons."""

    gravity: Vector
    fingertip: Vector
    joints: tuple[Joint, ...]
    tendons: tuple[Tendon, ...] = ()

    def __post_init__(self):
        if not self.joints:
            raise Fault("is empty; write [[finger.joints]] for each joint, base to tip", "joints")
        names = [joint.name for joint in self.joints]
        for i, tendon in enumerate(self.tendons):
            for k, joint in enumerate(tendon.crosses):
                try:
                    one_of(joint, names)
                except Fault as fault:
                    raise Fault(fault.message, "tendons", i, "crosses", k) from None
        for kind, rows in (("joints", self.joints), ("tendons", self.tendons)):
            for i, row in enumerate(rows):
                if row.name in [other.name for other in rows[:i]]:
                    raise Fault("is taken already; give each its own name", kind, i, "name")
        for key in ("mass_std", "com_std", "rotor_inertia", "rotor_inertia_std"):
            without = [i for i, joint in enumerate(self.joints) if getattr(joint, key) is None]
            if without and len(without) < len(names):
                none = ", 0 where there is no rotor" if key.startswith("rotor") else ""
                raise Fault(f"is missing, and other joints have it; write it{none}", "joints", without[0], key)


def finger_from(source: str | Finger, place: Place) -> FingerDescription:
    """Description of a finger. `source` is its table, or the name of a session (HDF5) or TOML file that holds one.

    Raises:
        UserError: the other file cannot be read, or the checker refuses the finger.
    """
    if isinstance(source, Finger):
        return _sound(_description(source), place)
    other = Path(place.file).parent / source
    if other.suffix.lower() in (".h5", ".hdf5"):
        from jaxfinger.data.hdf5 import read_session

        return read_session(other, trials=()).finger
    if other.suffix.lower() != ".toml":
        place.fail(f"is {source!r}; name a session (.h5) or a TOML file with a table [finger]")
    document = read_toml(other, f"correct `{place.key}` in {place.file}")
    if "finger" not in document.content:
        document.place.fail("has no table [finger]; write it as docs/your-own-data.md says")
    inner = document.place / "finger"
    return finger_from(structure(document.content["finger"], Finger, inner), inner)


def _sound(finger: FingerDescription, place: Place) -> FingerDescription:
    """Check a finger and return it; UserError at the fault's key where the checker refuses it."""
    report = Report()
    check_finger(finger, report)
    if (fault := report.fatal) is not None:
        kind, *key = fault.place.removeprefix("/finger").strip("/").split("/")
        if fault.row is not None:  # The file has links in the tables of their joints.
            place = place / ("tendons" if kind == "tendons" else "joints") / fault.row / key[0]
            place.fail(fault.message)
        place.fail(": ".join(filter(None, ["/".join([kind, *key]), fault.message])))
    return finger


def _description(finger: Finger) -> FingerDescription:
    """Convert the tables of a finger to arrays."""
    joints, tendons = finger.joints, finger.tendons
    names = tuple(joint.name for joint in joints)

    def stack(key: str) -> np.ndarray:
        return np.array([getattr(joint, key) for joint in joints], np.float64)

    def optional(key: str) -> np.ndarray | None:
        return None if getattr(joints[0], key) is None else stack(key)

    powers = max((len(c) for t in tendons for c in t.excursion.values()), default=0)

    def excursion(key: str) -> np.ndarray | None:
        if not any(getattr(tendon, key) for tendon in tendons):
            return None
        table = np.full((len(tendons), len(names), powers), np.nan)
        for row, tendon in zip(table, tendons, strict=True):
            if tendon.excursion:
                row[:] = 0.0
            for joint, coefficients in getattr(tendon, key).items():
                row[names.index(joint), : len(coefficients)] = coefficients
        return table

    return FingerDescription(
        gravity=np.array(finger.gravity),
        joint_names=names,
        axis=stack("axis"),
        origin=stack("origin"),
        limits=stack("range"),
        mass=stack("mass"),
        com=stack("com"),
        inertia=stack("inertia"),
        fingertip=np.array(finger.fingertip),
        tendon_names=tuple(tendon.name for tendon in tendons),
        active=np.array([tendon.active for tendon in tendons], bool),
        crosses=np.array([[name in tendon.crosses for name in names] for tendon in tendons], bool).reshape(
            len(tendons), len(names)
        ),
        prismatic=tuple(joint.type == "prismatic" for joint in joints),
        mass_std=optional("mass_std"),
        com_std=optional("com_std"),
        rotor_inertia=optional("rotor_inertia"),
        rotor_inertia_std=optional("rotor_inertia_std"),
        excursion=excursion("excursion"),
        excursion_std=excursion("excursion_std"),
    )


def finger_toml(finger: FingerDescription) -> str:
    """Text of a TOML file that describes the finger, the inverse of `finger_from`."""
    lines = ["[finger]", f"gravity = {_numbers(finger.gravity)}", f"fingertip = {_numbers(finger.fingertip)}"]
    for i, name in enumerate(finger.joint_names):
        lines += ["", "[[finger.joints]]", f"name = {quoted(name)}"]
        if finger.prismatic[i]:
            lines.append('type = "prismatic"')
        for key in ("axis", "origin", "limits", "mass", "com", "inertia"):
            lines.append(f"{key} = {_numbers(getattr(finger, key)[i])}")
        for key in ("mass_std", "com_std", "rotor_inertia", "rotor_inertia_std"):
            if (values := getattr(finger, key)) is not None:
                lines.append(f"{key} = {_numbers(values[i])}")
    for k, name in enumerate(finger.tendon_names):
        crossed = [i for i in range(finger.m) if finger.crosses[k, i]]
        lines += [
            "",
            "[[finger.tendons]]",
            f"name = {quoted(name)}",
            f"active = {str(bool(finger.active[k])).lower()}",
        ]
        lines.append(f"crosses = [{', '.join(quoted(finger.joint_names[i]) for i in crossed)}]")
        for key in ("excursion", "excursion_std"):
            values = getattr(finger, key)
            if values is not None and not np.isnan(values[k]).all():
                by_joint = (f"{as_key(finger.joint_names[i])} = {_numbers(values[k, i])}" for i in crossed)
                lines.append(f"{key} = {{ {', '.join(by_joint)} }}")
    return "\n".join(lines) + "\n"


def _numbers(value: np.ndarray | float) -> str:
    """Numbers in TOML, with the fewest digits that give the same floats when read."""
    return str(np.asarray(value, np.float64).tolist())
