"""Recipes: the choices of a fit that change from one finger to another, in a TOML file without unknown keys."""

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from jaxfinger.data.session import EXPERIMENT_NAMES
from jaxfinger.data.toml import Fault, OneOf, Place, Within, read_toml
from jaxfinger.data.toml import structure as from_tables
from jaxfinger.errors import UserError, did_you_mean

PAPER = ("joint_elastic", "joint_coulomb", "joint_damping", "tendon_friction", "gravity")
# Beside the paper's terms, those that other machines need: a constant torque, friction that differs by direction,
# friction in proportion to the torque of the joint's own drive, and the reflected inertia of a geared rotor.
TERMS = (*PAPER, "joint_offset", "joint_friction_asymmetric", "joint_torque_friction", "rotor_inertia")
STAGE_NAMES = ("ID.2", "ID.3-static", "ID.3-dynamic", "ID.4")


@dataclass(frozen=True)
class ModelRecipe:
    """Terms of the nominal model and their polynomial degrees."""

    moment_arm_degree: Annotated[int, Within(1, 10)] = 4
    cross_terms: bool = False  # q_a q_b, q_a² q_b, q_a q_b² in f(q); they need a trial that moves two joints
    elastic_degree: Annotated[int, Within(0, 9)] = 2
    friction_degree: Annotated[int, Within(0, 9)] = 2
    terms: Annotated[tuple[str, ...], OneOf(TERMS)] = PAPER  # a term left out is a candidate of the diagnosis

    def __post_init__(self):
        if {"joint_offset", "joint_elastic"} <= set(self.terms):
            raise Fault("has joint_offset beside joint_elastic, which starts with a constant: leave one out", "terms")


@dataclass(frozen=True)
class FitRecipe:
    """Options of the fits."""

    stages: Annotated[tuple[str, ...], OneOf(STAGE_NAMES)] = STAGE_NAMES
    huber: Annotated[float, Within(0.0)] = 3.0  # robust limit in standard deviations; 0 for plain least squares
    free_inertia: bool = False  # estimate masses and centres of mass too, with CAD as the prior
    joint_experiments: Annotated[tuple[str, ...], OneOf(EXPERIMENT_NAMES)] = STAGE_NAMES  # that the joint fit reads


@dataclass(frozen=True)
class ValidationRecipe:
    """Experiments that validation reads."""

    experiments: Annotated[tuple[str, ...], OneOf(EXPERIMENT_NAMES)] = ("VD.1", "VD.2", "VD.3")


@dataclass(frozen=True)
class Recipe:
    """Recipe of one specimen; the default of every field is the paper's choice."""

    name: str = "paper"
    model: ModelRecipe = field(default_factory=ModelRecipe)
    fit: FitRecipe = field(default_factory=FitRecipe)
    validation: ValidationRecipe = field(default_factory=ValidationRecipe)


def read_recipe(path: str | os.PathLike | Mapping[str, Any] | None) -> Recipe:
    """Read a recipe from a TOML file, or a shipped one by its name; for None, the paper's.

    In place of a file, dictionaries may hold its keys (docs/how-to-choose.md). Those that are left out are the paper's.

    >>> import jaxfinger as jf
    >>> jf.recipe("emps").model.terms
    ('joint_elastic', 'joint_coulomb', 'joint_damping')
    >>> jf.recipe({"name": "stiffer", "model": {"elastic_degree": 4}}).model.elastic_degree
    4

    Raises:
        UserError: there is no such recipe, or a key of it is wrong; it names the key to mend.
    """
    if path is None:
        return Recipe()
    if isinstance(path, Mapping):
        return structure(dict(path), "the recipe")
    path = Path(path)
    if not path.exists():
        path = _shipped(path.name) or path
    if not path.exists():
        raise UserError(
            f"{path}: does not exist{did_you_mean(path.stem, _shipped_names())}; give a file, or the name of a "
            f"shipped recipe: {', '.join(_shipped_names())}"
        )
    return read_toml(path, "give a recipe file, or none for the paper's").read(Recipe)


def structure(content: dict, where: str) -> Recipe:
    """Recipe from nested dictionaries.

    `where`: file or place that messages name.

    Raises:
        UserError: a key is unknown or its value is not allowed.
    """
    return from_tables(content, Recipe, Place(where))


def checked(recipe: Recipe) -> Recipe:
    """The recipe, which Python may have made, with the checks of a file.

    Raises:
        UserError: a value is not allowed.
    """
    return structure(as_dict(recipe), f"recipe {recipe.name!r}")


def as_dict(recipe: Recipe) -> dict:
    """Nested dictionaries of the recipe, for a result file."""
    return asdict(recipe)


def _folders() -> list[Path]:
    """Folders of the shipped recipes, in an installed package or in a checkout."""
    here = Path(__file__).resolve().parents[1]
    return [folder for folder in (here / "fits", here.parent / "fits") if folder.is_dir()]


def _shipped(name: str) -> Path | None:
    """Path of a shipped recipe by its name, with or without `.toml`; None where there is none."""
    candidates = (folder / (name if name.endswith(".toml") else f"{name}.toml") for folder in _folders())
    return next((path for path in candidates if path.exists()), None)


def _shipped_names() -> list[str]:
    return sorted(path.stem for folder in _folders() for path in folder.glob("*.toml"))
