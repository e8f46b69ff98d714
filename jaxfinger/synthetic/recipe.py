"""What is simulated: the specimen, the trials, the sensors. One TOML table each, every key optional."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import cattrs
import numpy as np

from jaxfinger.data import EXPERIMENTS
from jaxfinger.errors import UserError

# A quick session of one joint or a few, for studies over many of them.
SHORT: Mapping[str, Any] = {
    "experiments": ["ID.2", "ID.3-static", "ID.3-dynamic", "ID.4"],
    "rate": 200.0,
    "id2": {"strokes": 2, "stroke_time": 3.0},
    "id3_static": {"step": 20.0},
    "id3_dynamic": {"cycles": 1, "speeds": [1.0, 2.0]},
    "id4": {"tensions": [4.0, 7.0, 10.0]},
}

Postures = tuple[tuple[float, ...], ...]  # degrees, one angle a joint; empty: taken from the finger's limits


@dataclass(frozen=True)
class SpecimenRecipe:
    """`[specimen]`: which finger."""

    kind: Literal["paper", "polynomial", "random"] = "paper"
    name: str = ""
    passive_tendon: bool = False  # paper: T5 pulls where it is taut
    seed: int = 0  # random: which one
    joints: int = 3  # random
    layout: Literal["planar", "abduction", "spatial"] = "planar"  # random
    tendons: Literal["antagonists", "fewest"] = "antagonists"  # random: 2 m or m + 1 tendons


@dataclass(frozen=True)
class Excursions:
    """`[trials.id2]`: one joint moved slowly through its range."""

    repeats: int = 2
    postures: Postures = ()  # of the other joints
    strokes: int = 4
    stroke_time: float = 5.0  # s
    tension: float = 2.0  # N


@dataclass(frozen=True)
class Static:
    """`[trials.id3_static]`: one joint stepped through held angles, up and back."""

    repeats: int = 2
    postures: Postures = ()
    step: float = 10.0  # degrees
    move: float = 0.8  # s
    dwell: float = 1.2  # s


@dataclass(frozen=True)
class Sweeps:
    """`[trials.id3_dynamic]`: one joint swept at several speeds."""

    repeats: int = 2
    postures: Postures = ()
    speeds: tuple[float, ...] = (0.5, 1.0, 1.5)  # rad/s
    cycles: int = 2


@dataclass(frozen=True)
class Pulls:
    """`[trials.id4]`: one tendon pulled in steps, a joint held by the torque sensor."""

    repeats: int = 2
    postures: Postures = ()
    tensions: tuple[float, ...] = (4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0)  # N
    release: bool = True  # let go in the same steps
    joints: Literal["distal", "all"] = "distal"  # which of the joints that the tendon crosses
    move: float = 0.4  # s
    dwell: float = 0.8  # s


@dataclass(frozen=True)
class FreePaths:
    """`[trials.vd1]`: all joints led by hand."""

    repeats: int = 1
    motions: int = 3
    duration: float = 20.0  # s
    tension: float = 2.0  # N


@dataclass(frozen=True)
class Contacts:
    """`[trials.vd2]`: fingertip against the force sensor, one tendon stepped."""

    repeats: int = 2
    postures: Postures = ()
    tendons: tuple[str, ...] = ()  # empty: the active tendon that crosses most joints
    tensions: tuple[float, ...] = tuple(float(f) for f in range(4, 16))  # N
    move: float = 0.3  # s
    dwell: float = 0.7  # s


@dataclass(frozen=True)
class Drives:
    """`[trials.vd3]`: tendons drive the free finger along a trajectory."""

    repeats: int = 1
    motions: int = 2
    duration: float = 8.0  # s
    centre: float = 0.2  # share of a joint's range: bowstringing flexors make a far flexed finger unstable
    amplitude: float = 0.12  # share of a joint's range to either side
    rate: float = 1000.0  # Hz: the simulation's own and the recording's


@dataclass(frozen=True)
class Trials:
    """`[trials]`: what is recorded."""

    experiments: tuple[str, ...] = EXPERIMENTS
    rate: float = 1000.0  # Hz
    motion_seed: int = 0  # of the motions led by hand; the noise has its own
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

    std: float  # of the noise
    resolution: float  # of the converter
    coloured: float = 0.4  # share of the noise's variance that is correlated in time
    correlation_time: float = 0.03  # s, of that share
    offset: float = 0.0  # standard deviation of a constant a trial: zeroing, taring


@dataclass(frozen=True)
class Sensors:
    """`[sensors]`: the paper's test-bed, Sec. II-C."""

    q: Channel = Channel(2e-4, 2.0 * np.pi / 2**14)  # AA5048B, 14 bit
    tendon_force: Channel = Channel(0.03, 200.0 / 2**12)  # KD60 ±100 N on EL3008, 12 bit
    tendon_excursion: Channel = Channel(1e-5, 1e-6, offset=2e-4)  # the motor's encoder on its pulley
    joint_torque: Channel = Channel(3e-4, 1.0 / 2**16)  # ±0.5 N m, 16 bit, tared before every trial
    fingertip_force: Channel = Channel(0.02, 100.0 / 2**16)  # K3D40 ±50 N, 16 bit
    outliers: float = 0.0  # share of samples hit by a spike
    outlier_size: tuple[float, float] = (10.0, 50.0)  # times the channel's noise
    clock_jitter: float = 2e-6  # s


@dataclass(frozen=True)
class Cad:
    """`[cad]`: how well ID.1 knows the links; what the file says is drawn with these standard deviations."""

    mass: float = 0.0  # share of each mass
    com: float = 0.0  # m


@dataclass(frozen=True)
class Recipe:
    """A simulated session."""

    seed: int = 0
    specimen: SpecimenRecipe = field(default_factory=SpecimenRecipe)
    trials: Trials = field(default_factory=Trials)
    sensors: Sensors = field(default_factory=Sensors)
    cad: Cad = field(default_factory=Cad)


_CONVERTER = cattrs.Converter(forbid_extra_keys=True)
_CONVERTER.register_structure_hook(float, lambda value, _: _number(value))
_CONVERTER.register_structure_hook(int, lambda value, _: _whole(value))
_CONVERTER.register_structure_hook(bool, lambda value, _: _switch(value))


def read_recipe(path: str | os.PathLike) -> Recipe:
    """A recipe from its TOML file.

    Raises:
        UserError: the file cannot be read, or a key is unknown or has the wrong type.
    """
    try:
        with open(path, "rb") as file:
            table = tomllib.load(file)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); check the name") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: is not TOML ({error}); mend the line") from None
    return recipe_from(table, str(path))


def recipe_from(table: dict[str, Any], place: str = "recipe") -> Recipe:
    """A recipe from nested dictionaries: the defaults, with the given keys replaced.

    Raises:
        UserError: a key is unknown or has the wrong type or a value out of its range.
    """
    try:
        recipe = _CONVERTER.structure(_merged(asdict(Recipe()), table), Recipe)
    except cattrs.BaseValidationError as error:
        raise UserError(f"{place}: {_sentence(cattrs.transform_error(error, path='')[0])}; mend this key") from None
    _refuse_impossible(recipe, place)
    return recipe


def _merged(default: Any, given: Any) -> Any:
    """The defaults of a table with the given keys put over them, at any depth."""
    if not (isinstance(default, dict) and isinstance(given, dict)):
        return given
    return {**default, **{key: _merged(default.get(key), value) for key, value in given.items()}}


def _sentence(message: str) -> str:
    """`reason @ .table.key` of cattrs, the place first."""
    reason, _, place = message.rpartition(" @ ")
    reason = reason.replace("extra fields found", "unknown key").replace("unknown error ", "")
    return f"{place.strip('.') or 'top level'}: {reason}"


def _refuse_impossible(recipe: Recipe, place: str) -> None:
    """Durations, rates, tensions and resolutions are positive, shares lie within [0, 1], experiments exist."""
    for key, value in _leaves(asdict(recipe)):
        name = key.rpartition(".")[2]
        if name in ("coloured", "outliers", "amplitude", "centre"):
            if not 0.0 <= value <= 1.0:
                raise UserError(f"{place}: {key} is {value}; it must lie between 0 and 1")
        elif name in ("tensions", "speeds"):
            if not value or min(value) <= 0.0:
                raise UserError(f"{place}: {key} is {list(value)}; give at least one number greater than zero")
        elif isinstance(value, int | float):
            may_vanish = name in ("repeats", "motions", "dwell", "seed", "motion_seed", "std", "offset", "clock_jitter")
            if not (value >= 0 if may_vanish or key.startswith("cad.") else value > 0 or isinstance(value, bool)):
                raise UserError(f"{place}: {key} is {value}; it must be greater than zero")
    for name in recipe.trials.experiments:
        if name not in EXPERIMENTS:
            raise UserError(f"{place}: trials.experiments names {name!r}; choose from {', '.join(EXPERIMENTS)}")


def _leaves(table: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"expected a number, found {value!r}")
    return float(value)


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"expected a whole number, found {value!r}")
    return value


def _switch(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError(f"expected true or false, found {value!r}")
    return value
