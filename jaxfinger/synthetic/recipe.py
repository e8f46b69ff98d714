"""What is simulated: the specimen, the trials, the sensors. One TOML table each, every key optional."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from jaxfinger.data import EXPERIMENTS
from jaxfinger.data.toml import NotEmpty, OneOf, Place, Positive, Share, Within, read_toml, structure

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
class Channel:
    """`[sensors.<channel>]`: one kind of sensor, in the channel's unit."""

    std: NotNegative  # of the noise
    resolution: Positive  # of the converter
    coloured: Share = 0.4  # share of the noise's variance that is correlated in time
    correlation_time: Positive = 0.03  # s, of that share
    offset: NotNegative = 0.0  # standard deviation of a constant a trial: zeroing, taring


@dataclass(frozen=True)
class Sensors:
    """`[sensors]`: the paper's test-bed, Sec. II-C."""

    q: Channel = Channel(2e-4, 2.0 * np.pi / 2**14)  # AA5048B, 14 bit
    tendon_force: Channel = Channel(0.03, 200.0 / 2**12)  # KD60 ±100 N on EL3008, 12 bit
    tendon_excursion: Channel = Channel(1e-5, 1e-6, offset=2e-4)  # the motor's encoder on its pulley
    joint_torque: Channel = Channel(3e-4, 1.0 / 2**16)  # ±0.5 N m, 16 bit, tared before every trial
    fingertip_force: Channel = Channel(0.02, 100.0 / 2**16)  # K3D40 ±50 N, 16 bit
    outliers: Share = 0.0  # share of samples hit by a spike
    outlier_size: Annotated[tuple[float, float], Within(0.0, above=True)] = (10.0, 50.0)  # times the channel's noise
    clock_jitter: NotNegative = 2e-6  # s


@dataclass(frozen=True)
class Cad:
    """`[cad]`: how well ID.1 knows the links; what the file says is drawn with these standard deviations."""

    mass: NotNegative = 0.0  # share of each mass
    com: NotNegative = 0.0  # m


@dataclass(frozen=True)
class Recipe:
    """A simulated session."""

    seed: Some = 0
    specimen: SpecimenRecipe = field(default_factory=SpecimenRecipe)
    trials: Trials = field(default_factory=Trials)
    sensors: Sensors = field(default_factory=Sensors)
    cad: Cad = field(default_factory=Cad)


def read_recipe(path: str | os.PathLike) -> Recipe:
    """A recipe from its TOML file.

    Raises:
        UserError: the file cannot be read, or a key is unknown, of the wrong type, or out of its range.
    """
    document = read_toml(Path(path), "check the name")
    return structure(_merged(asdict(Recipe()), document.content), Recipe, document.place)


def recipe_from(table: dict[str, Any]) -> Recipe:
    """A recipe from nested dictionaries: the defaults, with the given keys replaced.

    Raises:
        UserError: a key is unknown or has the wrong type or a value out of its range.
    """
    return structure(_merged(asdict(Recipe()), table), Recipe, Place("recipe"))


def _merged(default: Any, given: Any) -> Any:
    """The defaults of a table with the given keys put over them, at any depth."""
    if not (isinstance(default, Mapping) and isinstance(given, Mapping)):
        return given
    return {**default, **{key: _merged(default.get(key), value) for key, value in given.items()}}
