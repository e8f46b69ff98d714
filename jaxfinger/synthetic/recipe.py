"""What is simulated: the specimen, the trials, the sensors. One TOML table each, every key optional.

In the place of `[specimen]` stands `[finger]`, as mappings and rig files have it, or the name of a file with it; then a
finger file is a recipe too. What a finger does beside its links' weight and inertia, `[terms]` says.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from jaxfinger.data import EXPERIMENTS, FingerDescription
from jaxfinger.data.finger_file import Finger, finger_from
from jaxfinger.data.toml import Fault, NotEmpty, OneOf, Place, Positive, Share, Within, one_of, read_toml, structure

# A quick session of one joint or a few, for studies over many of them.
SHORT: Mapping[str, Any] = {
    "experiments": ["ID.2", "ID.3-static", "ID.3-dynamic", "ID.4"],
    "rate": 200.0,
    "id2": {"strokes": 2, "stroke_time": 3.0},
    "id3_static": {"step": 20.0},
    "id3_dynamic": {"cycles": 1, "speeds": [1.0, 2.0]},
    "id4": {"tensions": [4.0, 7.0, 10.0]},
}

Count = Annotated[int, Within(1)]
Some = Annotated[int, Within(0)]
NotNegative = Annotated[float, Within(0.0)]
Several = Annotated[tuple[float, ...], NotEmpty(), Within(0.0, above=True)]
Postures = tuple[tuple[float, ...], ...]  # degrees, one angle a joint; empty: taken from the finger's limits


@dataclass(frozen=True)
class SpecimenRecipe:
    """`[specimen]`: which finger."""

    kind: Literal["paper", "polynomial", "random"] = "paper"
    name: str = ""
    passive_tendon: bool = False  # paper: T5 pulls where it is taut
    seed: Some = 0  # random: which one
    joints: Count = 3  # random
    layout: Literal["planar", "abduction", "spatial"] = "planar"  # random
    tendons: Literal["antagonists", "fewest"] = "antagonists"  # random: 2 m or m + 1 tendons


@dataclass(frozen=True)
class JointTerms:
    """`[terms.joints.<joint>]`: torque of springs, of friction and of damping."""

    elastic: tuple[float, ...] = (0.0,)  # N m/rad^p of τ_k, p = 0, 1, …
    friction: tuple[float, ...] = (0.0,)  # N m/rad^p of |τ_f|, p = 0, 1, …
    damping: NotNegative = 0.0  # N m s/rad


@dataclass(frozen=True)
class TendonTerms:
    """`[terms.tendons.<tendon>]`: the tension that is lost on the way, a₀ + a₁ f."""

    constant: NotNegative = 0.0  # a₀, N
    proportional: NotNegative = 0.0  # a₁


@dataclass(frozen=True)
class Terms:
    """`[terms]`: what is not said of is not there."""

    joints: Mapping[str, JointTerms] = field(default_factory=dict)
    tendons: Mapping[str, TendonTerms] = field(default_factory=dict)


@dataclass(frozen=True)
class DescribedFinger:
    """The specimen that a finger's description and its terms make."""

    finger: FingerDescription
    terms: Terms
    name: str = ""


@dataclass(frozen=True)
class Excursions:
    """`[trials.id2]`: one joint moved slowly through its range."""

    repeats: Some = 2
    postures: Postures = ()  # of the other joints
    strokes: Count = 4
    stroke_time: Positive = 5.0  # s
    tension: Positive = 2.0  # N


@dataclass(frozen=True)
class Static:
    """`[trials.id3_static]`: one joint stepped through held angles, up and back."""

    repeats: Some = 2
    postures: Postures = ()
    step: Positive = 10.0  # degrees
    move: Positive = 0.8  # s
    dwell: NotNegative = 1.2  # s


@dataclass(frozen=True)
class Sweeps:
    """`[trials.id3_dynamic]`: one joint swept at several speeds."""

    repeats: Some = 2
    postures: Postures = ()
    speeds: Several = (0.5, 1.0, 1.5)  # rad/s
    cycles: Count = 2


@dataclass(frozen=True)
class Pulls:
    """`[trials.id4]`: one tendon pulled in steps, a joint held by the torque sensor."""

    repeats: Some = 2
    postures: Postures = ()
    tensions: Several = (4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0)  # N
    release: bool = True  # let go in the same steps
    joints: Literal["distal", "all"] = "distal"  # which of the joints that the tendon crosses
    move: Positive = 0.4  # s
    dwell: NotNegative = 0.8  # s


@dataclass(frozen=True)
class FreePaths:
    """`[trials.vd1]`: all joints led by hand."""

    repeats: Some = 1
    motions: Some = 3
    duration: Positive = 20.0  # s
    tension: Positive = 2.0  # N


@dataclass(frozen=True)
class Contacts:
    """`[trials.vd2]`: fingertip against the force sensor, one tendon stepped."""

    repeats: Some = 2
    postures: Postures = ()
    tendons: tuple[str, ...] = ()  # empty: the active tendon that crosses most joints
    tensions: Several = tuple(float(f) for f in range(4, 16))  # N
    move: Positive = 0.3  # s
    dwell: NotNegative = 0.7  # s


@dataclass(frozen=True)
class Drives:
    """`[trials.vd3]`: tendons drive the free finger along a trajectory."""

    repeats: Some = 1
    motions: Some = 2
    duration: Positive = 8.0  # s
    centre: Share = 0.2  # share of a joint's range: bowstringing flexors make a far flexed finger unstable
    amplitude: Share = 0.12  # share of a joint's range to either side
    rate: Positive = 1000.0  # Hz: the simulation's own and the recording's


@dataclass(frozen=True)
class Trials:
    """`[trials]`: what is recorded."""

    experiments: Annotated[tuple[str, ...], OneOf(EXPERIMENTS)] = EXPERIMENTS
    rate: Positive = 1000.0  # Hz
    motion_seed: Some = 0  # of the motions led by hand; the noise has its own
    id2: Excursions = Excursions()
    id3_static: Static = Static()
    id3_dynamic: Sweeps = Sweeps()
    id4: Pulls = Pulls()
    vd1: FreePaths = FreePaths()
    vd2: Contacts = Contacts()
    vd3: Drives = Drives()


@dataclass(frozen=True)
class Sensor:
    """`[sensors.<channel>]`: one kind of sensor, in the channel's unit."""

    std: NotNegative  # of the noise
    resolution: Positive  # of the converter
    coloured: Share = 0.4  # share of the noise's variance that is correlated in time
    correlation_time: Positive = 0.03  # s, of that share
    offset: NotNegative = 0.0  # standard deviation of a constant a trial: zeroing, taring


@dataclass(frozen=True)
class Sensors:
    """`[sensors]`: the paper's test-bed, Sec. II-C."""

    q: Sensor = Sensor(2e-4, 2.0 * np.pi / 2**14)  # AA5048B, 14 bit
    tendon_force: Sensor = Sensor(0.03, 200.0 / 2**12)  # KD60 ±100 N on EL3008, 12 bit
    tendon_excursion: Sensor = Sensor(1e-5, 1e-6, offset=2e-4)  # the motor's encoder on its pulley
    joint_torque: Sensor = Sensor(3e-4, 1.0 / 2**16)  # ±0.5 N m, 16 bit, tared before every trial
    fingertip_force: Sensor = Sensor(0.02, 100.0 / 2**16)  # K3D40 ±50 N, 16 bit
    outliers: Share = 0.0  # share of samples hit by a spike
    outlier_size: Annotated[tuple[float, float], Within(0.0, above=True)] = (10.0, 50.0)  # times the channel's noise
    clock_jitter: NotNegative = 2e-6  # s


@dataclass(frozen=True)
class Cad:
    """`[cad]`: how well ID.1 knows the links; what the file says is drawn with these standard deviations."""

    mass: NotNegative = 0.0  # share of each mass
    com: NotNegative = 0.0  # m


@dataclass(frozen=True)
class SessionRecipe:
    """A simulated session."""

    seed: Some = 0
    specimen: SpecimenRecipe | DescribedFinger = field(default_factory=SpecimenRecipe)
    trials: Trials = field(default_factory=Trials)
    sensors: Sensors = field(default_factory=Sensors)
    cad: Cad = field(default_factory=Cad)


@dataclass(frozen=True)
class SessionRecipeFile(SessionRecipe):
    """A recipe as its file has it: `specimen`, or a finger and its terms."""

    specimen: SpecimenRecipe = field(default_factory=SpecimenRecipe)
    finger: str | Finger | None = None
    terms: Terms = field(default_factory=Terms)

    def __post_init__(self):
        if self.finger is None and self.terms != Terms():
            raise Fault("are those of a finger; write `finger`, or leave them out", "terms")
        if self.finger is not None and replace(self.specimen, name="") != SpecimenRecipe():
            raise Fault("says which finger, as `finger` does; leave one of them out", "specimen")


def read_session_recipe(path: str | os.PathLike) -> SessionRecipe:
    """A recipe from its TOML file.

    Raises:
        UserError: the file cannot be read, or a key is unknown, of the wrong type, or out of its range.
    """
    document = read_toml(Path(path), "check the name")
    return _recipe(document.content, document.place)


def recipe_from(table: Mapping[str, Any]) -> SessionRecipe:
    """A recipe from nested dictionaries: the defaults, with the given keys replaced.

    Raises:
        UserError: a key is unknown or has the wrong type or a value out of its range.
    """
    return _recipe(table, Place("recipe"))


def _recipe(table: Mapping[str, Any], place: Place) -> SessionRecipe:
    said = structure(_merged(asdict(SessionRecipeFile()), table), SessionRecipeFile, place)
    specimen: SpecimenRecipe | DescribedFinger = said.specimen
    if said.finger is not None:
        finger = finger_from(said.finger, place / "finger")
        for kind, names, known in (
            ("joints", said.terms.joints, finger.joint_names),
            ("tendons", said.terms.tendons, finger.tendon_names),
        ):
            for name in names:
                try:
                    one_of(name, known)
                except Fault as fault:
                    (place / "terms" / kind / name).fail(fault.message)
        unknown = _unrouted(finger)
        if unknown is not None:
            message = f"says no `excursion` of tendon {unknown}, and it cannot be simulated without moment arms"
            (place / "finger").fail(f"{message}; write what CAD says of them, or simulate a fit")
        specimen = DescribedFinger(finger, said.terms, said.specimen.name)
    return SessionRecipe(said.seed, specimen, said.trials, said.sensors, said.cad)


def _unrouted(finger: FingerDescription) -> str | None:
    """The first active tendon whose moment arms the finger does not know."""
    arms = [None] * finger.n if finger.excursion is None else finger.excursion
    rows = zip(finger.tendon_names, finger.active, arms, strict=True)
    return next((name for name, active, c in rows if active and (c is None or np.isnan(c).any())), None)


def _merged(default: Any, given: Any) -> Any:
    """The defaults of a table with the given keys put over them, at any depth."""
    if not (isinstance(default, Mapping) and isinstance(given, Mapping)):
        return given
    return {**default, **{key: _merged(default.get(key), value) for key, value in given.items()}}
