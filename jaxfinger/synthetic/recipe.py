"""The recipe of a simulated session: specimen, trials, sensors. Each is a TOML table; every key is optional.

A recipe may describe its finger instead of naming a specimen: by `[finger]`, as in mappings and rig files, or by the
name of a file with it. So a finger file is a recipe too. `[terms]` then gives elastic torque, friction, damping, loss.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from jaxfinger.data import EXPERIMENT_NAMES, FingerDescription
from jaxfinger.data.finger_file import Finger, finger_from
from jaxfinger.data.toml import Fault, NotEmpty, OneOf, Place, Positive, Share, Within, one_of, read_toml, structure

# `[trials]` of a short session, for studies over many sessions: the identification trials at 200 Hz, few steps each.
SHORT: Mapping[str, Any] = {
    "experiments": ["ID.2", "ID.3-static", "ID.3-dynamic", "ID.4"],
    "rate": 200.0,
    "id2": {"strokes": 2, "stroke_time": 3.0},
    "id3_static": {"step": 20.0},
    "id3_dynamic": {"cycles": 1, "speeds": [1.0, 2.0]},
    "id4": {"tensions": [4.0, 7.0, 10.0]},
}

PositiveInt = Annotated[int, Within(1)]
NonNegativeInt = Annotated[int, Within(0)]
NotNegative = Annotated[float, Within(0.0)]
PositiveFloats = Annotated[tuple[float, ...], NotEmpty(), Within(0.0, above=True)]
Postures = tuple[tuple[float, ...], ...]  # degrees, one angle per joint; empty: taken from the finger's limits


@dataclass(frozen=True)
class SpecimenRecipe:
    """Keys of `[specimen]`: the finger to simulate."""

    kind: Literal["paper", "polynomial", "random"] = "paper"
    name: str = ""  # empty: the specimen's own name
    passive_tendon: bool = False  # kind paper: T5 pulls where it is taut
    # The rest is for kind random (`random_finger`).
    seed: NonNegativeInt = 0
    joints: PositiveInt = 3
    layout: Literal["planar", "abduction", "spatial"] = "planar"
    tendons: Literal["antagonists", "fewest"] = "antagonists"  # 2 m or m + 1 tendons


@dataclass(frozen=True)
class JointTerms:
    """Keys of `[terms.joints.<joint>]`: elastic torque, friction and damping of a joint."""

    elastic: tuple[float, ...] = (0.0,)  # N m/rad^p of τ_k, p = 0, 1, …
    friction: tuple[float, ...] = (0.0,)  # N m/rad^p of |τ_f|, p = 0, 1, …
    damping: NotNegative = 0.0  # N m s/rad


@dataclass(frozen=True)
class TendonTerms:
    """Keys of `[terms.tendons.<tendon>]`: the loss a₀ + a₁ f_t of a tendon's tension."""

    constant: NotNegative = 0.0  # a₀, N
    proportional: NotNegative = 0.0  # a₁


@dataclass(frozen=True)
class Terms:
    """Tables of `[terms]`. Terms that are not given are zero."""

    joints: Mapping[str, JointTerms] = field(default_factory=dict)
    tendons: Mapping[str, TendonTerms] = field(default_factory=dict)


@dataclass(frozen=True)
class DescribedFinger:
    """A specimen made of a finger's description and its terms."""

    finger: FingerDescription
    terms: Terms
    name: str = ""


@dataclass(frozen=True)
class Excursions:
    """Keys of `[trials.id2]`: one joint moved slowly through its range."""

    repeats: NonNegativeInt = 2
    postures: Postures = ()  # of the other joints
    strokes: PositiveInt = 4
    stroke_time: Positive = 5.0  # s
    tension: Positive = 2.0  # N


@dataclass(frozen=True)
class Static:
    """Keys of `[trials.id3_static]`: one joint stepped through held angles, up and back."""

    repeats: NonNegativeInt = 2
    postures: Postures = ()
    step: Positive = 10.0  # degrees
    move: Positive = 0.8  # s
    dwell: NotNegative = 1.2  # s


@dataclass(frozen=True)
class Sweeps:
    """Keys of `[trials.id3_dynamic]`: one joint swept at several speeds."""

    repeats: NonNegativeInt = 2
    postures: Postures = ()
    speeds: PositiveFloats = (0.5, 1.0, 1.5)  # rad/s
    cycles: PositiveInt = 2


@dataclass(frozen=True)
class Pulls:
    """Keys of `[trials.id4]`: one tendon pulled in steps, a joint held by the torque sensor."""

    repeats: NonNegativeInt = 2
    postures: Postures = ()
    tensions: PositiveFloats = (4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0)  # N
    release: bool = True  # release the tension in the same steps
    joints: Literal["distal", "all"] = "distal"  # the last or all of the joints that the tendon crosses
    move: Positive = 0.4  # s
    dwell: NotNegative = 0.8  # s


@dataclass(frozen=True)
class FreePaths:
    """Keys of `[trials.vd1]`: all joints led by hand."""

    repeats: NonNegativeInt = 1
    motions: NonNegativeInt = 3
    duration: Positive = 20.0  # s
    tension: Positive = 2.0  # N


@dataclass(frozen=True)
class Contacts:
    """Keys of `[trials.vd2]`: fingertip on the force sensor, one tendon stepped."""

    repeats: NonNegativeInt = 2
    postures: Postures = ()
    tendons: tuple[str, ...] = ()  # empty: the active tendon that crosses most joints
    tensions: PositiveFloats = tuple(float(f) for f in range(4, 16))  # N
    move: Positive = 0.3  # s
    dwell: NotNegative = 0.7  # s


@dataclass(frozen=True)
class Drives:
    """Keys of `[trials.vd3]`: tendons drive the free finger along a trajectory."""

    repeats: NonNegativeInt = 1
    motions: NonNegativeInt = 2
    duration: Positive = 8.0  # s
    # Centre of the motion as a share of a joint's range. Bowstringing flexors make a far flexed finger unstable.
    centre: Share = 0.2
    amplitude: Share = 0.12  # share of a joint's range to either side
    rate: Positive = 1000.0  # Hz, of simulation and recording


@dataclass(frozen=True)
class Trials:
    """Keys of `[trials]`: the trials to record."""

    experiments: Annotated[tuple[str, ...], OneOf(EXPERIMENT_NAMES)] = EXPERIMENT_NAMES
    rate: Positive = 1000.0  # Hz
    motion_seed: NonNegativeInt = 0  # seed of the random motions; noise has the recipe's own seed
    id2: Excursions = Excursions()
    id3_static: Static = Static()
    id3_dynamic: Sweeps = Sweeps()
    id4: Pulls = Pulls()
    vd1: FreePaths = FreePaths()
    vd2: Contacts = Contacts()
    vd3: Drives = Drives()


@dataclass(frozen=True)
class Sensor:
    """Keys of `[sensors.<channel>]`: one kind of sensor, in the channel's SI unit."""

    std: NotNegative  # standard deviation of the noise
    resolution: Positive  # step of the converter
    coloured: Share = 0.4  # share of the noise's variance that is correlated in time
    correlation_time: Positive = 0.03  # s, of that share
    offset: NotNegative = 0.0  # standard deviation of an offset per trial, from zeroing or taring


@dataclass(frozen=True)
class Sensors:
    """Keys of `[sensors]`. The defaults are those of the paper's test-bed, Sec. II-C."""

    q: Sensor = Sensor(2e-4, 2.0 * np.pi / 2**14)  # AA5048B, 14 bit
    tendon_force: Sensor = Sensor(0.03, 200.0 / 2**12)  # KD60 ±100 N on EL3008, 12 bit
    tendon_excursion: Sensor = Sensor(1e-5, 1e-6, offset=2e-4)  # the motor's encoder on its pulley
    joint_torque: Sensor = Sensor(3e-4, 1.0 / 2**16)  # ±0.5 N m, 16 bit, tared before every trial
    fingertip_force: Sensor = Sensor(0.02, 100.0 / 2**16)  # K3D40 ±50 N, 16 bit
    outliers: Share = 0.0  # share of samples hit by a spike
    outlier_size: Annotated[tuple[float, float], Within(0.0, above=True)] = (10.0, 50.0)  # range, times the noise's std
    clock_jitter: NotNegative = 2e-6  # s, standard deviation


@dataclass(frozen=True)
class Cad:
    """Keys of `[cad]`: standard deviations of the errors that the session's masses and centres of mass get (ID.1)."""

    mass: NotNegative = 0.0  # as a share of each mass
    com: NotNegative = 0.0  # m


@dataclass(frozen=True)
class SessionRecipe:
    """Recipe of a simulated session. `seed` is that of the noise."""

    seed: NonNegativeInt = 0
    specimen: SpecimenRecipe | DescribedFinger = field(default_factory=SpecimenRecipe)
    trials: Trials = field(default_factory=Trials)
    sensors: Sensors = field(default_factory=Sensors)
    cad: Cad = field(default_factory=Cad)


@dataclass(frozen=True)
class SessionRecipeFile(SessionRecipe):
    """Tables of a recipe's file: `specimen`, or a finger and its terms."""

    specimen: SpecimenRecipe = field(default_factory=SpecimenRecipe)
    finger: str | Finger | None = None
    terms: Terms = field(default_factory=Terms)

    def __post_init__(self):
        if self.finger is None and self.terms != Terms():
            raise Fault("are those of a finger; write `finger`, or leave them out", "terms")
        if self.finger is not None and replace(self.specimen, name="") != SpecimenRecipe():
            raise Fault("says which finger, as `finger` does; leave one of them out", "specimen")


def read_session_recipe(path: str | os.PathLike) -> SessionRecipe:
    """Read a recipe from its TOML file.

    Raises:
        UserError: the file cannot be read, or a key is unknown, of the wrong type, or out of its range.
    """
    document = read_toml(Path(path), "check the name")
    return _recipe(document.content, document.place)


def recipe_from(table: Mapping[str, Any]) -> SessionRecipe:
    """Make a recipe from nested dictionaries: the defaults, with the given keys replaced.

    Raises:
        UserError: a key is unknown or has the wrong type or a value out of its range.
    """
    return _recipe(table, Place("recipe"))


def _recipe(table: Mapping[str, Any], place: Place) -> SessionRecipe:
    """Check the tables of a recipe and turn a described finger into a specimen."""
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
    """Name of the first active tendon without known moment arms, or None."""
    arms = [None] * finger.n if finger.excursion is None else finger.excursion
    rows = zip(finger.tendon_names, finger.active, arms, strict=True)
    return next((name for name, active, c in rows if active and (c is None or np.isnan(c).any())), None)


def _merged(default: Any, given: Any) -> Any:
    """Return the default table with the given keys replaced, at any depth."""
    if not (isinstance(default, Mapping) and isinstance(given, Mapping)):
        return given
    return {**default, **{key: _merged(default.get(key), value) for key, value in given.items()}}
