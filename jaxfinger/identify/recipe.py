"""A recipe: what a researcher edits to move from one finger to another. TOML, strict about unknown keys."""

import tomllib
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cattrs
from cattrs import transform_error
from cattrs.errors import ClassValidationError

from jaxfinger.errors import UserError

PAPER = ("joint_elastic", "joint_coulomb", "joint_damping", "tendon_friction", "gravity")
# Terms that real machines need: a constant torque, friction by direction, friction that grows with the torque of the
# joint's own drive, and the reflected inertia of a geared rotor.
TERMS = (*PAPER, "joint_offset", "joint_friction_asymmetric", "joint_torque_friction", "rotor_inertia")
STAGES = ("ID.2", "ID.3-static", "ID.3-dynamic", "ID.4")


@dataclass(frozen=True)
class ModelRecipe:
    """Which terms the nominal model has, and their degrees."""

    moment_arm_degree: int = 4
    cross_terms: bool = False  # q_a q_b, q_a² q_b, q_a q_b² in f(q); they need a trial that moves two joints
    elastic_degree: int = 2
    friction_degree: int = 2
    terms: tuple[str, ...] = PAPER  # a term left out is a candidate of the diagnosis


@dataclass(frozen=True)
class FitRecipe:
    """How the fits are done."""

    stages: tuple[str, ...] = STAGES
    huber: float = 3.0  # robust limit in standard deviations; 0 for plain least squares
    free_inertia: bool = False  # estimate masses and centres of mass too, with CAD as the prior
    joint_experiments: tuple[str, ...] = STAGES  # what the joint refinement reads


@dataclass(frozen=True)
class ValidationRecipe:
    """What validation reads."""

    experiments: tuple[str, ...] = ("VD.1", "VD.2", "VD.3")


@dataclass(frozen=True)
class Recipe:
    """One specimen's recipe; every field has the paper's choice as its default."""

    name: str = "paper"
    model: ModelRecipe = field(default_factory=ModelRecipe)
    fit: FitRecipe = field(default_factory=FitRecipe)
    validation: ValidationRecipe = field(default_factory=ValidationRecipe)


def read_recipe(path: str | Path | None) -> Recipe:
    """The recipe in a TOML file; the paper's where there is none. UserError names the key to mend."""
    if path is None:
        return Recipe()
    path = Path(path)
    if not path.exists() and (shipped := _shipped(path.name)) is not None:
        path = shipped
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as e:
        raise UserError(f"{path}: cannot be read ({e.strerror}); give a recipe file, or none for the paper's") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise UserError(f"{path}: is not TOML: {e}") from None
    return structure(content, str(path))


def structure(content: dict, where: str) -> Recipe:
    """A recipe from nested dictionaries, strictly."""
    converter = cattrs.Converter(forbid_extra_keys=True)
    try:
        recipe = converter.structure(content, Recipe)
    except ClassValidationError as e:
        raise UserError(f"{where}: {'; '.join(transform_error(e))}") from None
    for value, known, key in (
        (recipe.model.terms, TERMS, "model.terms"),
        (recipe.fit.stages, STAGES, "fit.stages"),
    ):
        if unknown := set(value) - set(known):
            raise UserError(f"{where}: {key} has {sorted(unknown)}; it takes some of {list(known)}")
    if {"joint_offset", "joint_elastic"} <= set(recipe.model.terms):
        raise UserError(
            f"{where}: model.terms has joint_offset beside joint_elastic, which starts with a constant: leave one out"
        )
    degrees = (recipe.model.moment_arm_degree, recipe.model.elastic_degree + 1, recipe.model.friction_degree + 1)
    if not all(1 <= d <= 10 for d in degrees):
        raise UserError(f"{where}: the degrees in [model] must lie between 1 (moment arm) or 0 (torques) and 10")
    return recipe


def as_dict(recipe: Recipe) -> dict:
    """For a result file."""
    return asdict(recipe)


def _shipped(name: str) -> Path | None:
    """A recipe that comes with the package, by its name with or without `.toml`."""
    here = Path(__file__).resolve().parents[1]
    for folder in (here / "fits", here.parent / "fits"):
        candidate = folder / (name if name.endswith(".toml") else f"{name}.toml")
        if candidate.exists():
            return candidate
    return None
