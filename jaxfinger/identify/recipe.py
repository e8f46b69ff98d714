"""A recipe: what a researcher edits to move from one finger to another. TOML, strict about unknown keys."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

from jaxfinger.data.session import EXPERIMENTS
from jaxfinger.data.toml import Fault, OneOf, Place, Within, read_toml
from jaxfinger.data.toml import structure as from_tables
from jaxfinger.errors import UserError, did_you_mean

PAPER = ("joint_elastic", "joint_coulomb", "joint_damping", "tendon_friction", "gravity")
# Terms that real machines need: a constant torque, friction by direction, friction that grows with the torque of the
# joint's own drive, and the reflected inertia of a geared rotor.
TERMS = (*PAPER, "joint_offset", "joint_friction_asymmetric", "joint_torque_friction", "rotor_inertia")
STAGES = ("ID.2", "ID.3-static", "ID.3-dynamic", "ID.4")


@dataclass(frozen=True)
class ModelRecipe:
    """Which terms the nominal model has, and their degrees."""

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
    """How the fits are done."""

    stages: Annotated[tuple[str, ...], OneOf(STAGES)] = STAGES
    huber: Annotated[float, Within(0.0)] = 3.0  # robust limit in standard deviations; 0 for plain least squares
    free_inertia: bool = False  # estimate masses and centres of mass too, with CAD as the prior
    joint_experiments: Annotated[tuple[str, ...], OneOf(EXPERIMENTS)] = STAGES  # what the joint refinement reads


@dataclass(frozen=True)
class ValidationRecipe:
    """What validation reads."""

    experiments: Annotated[tuple[str, ...], OneOf(EXPERIMENTS)] = ("VD.1", "VD.2", "VD.3")


@dataclass(frozen=True)
class Recipe:
    """One specimen's recipe; every field has the paper's choice as its default."""

    name: str = "paper"
    model: ModelRecipe = field(default_factory=ModelRecipe)
    fit: FitRecipe = field(default_factory=FitRecipe)
    validation: ValidationRecipe = field(default_factory=ValidationRecipe)


def read_recipe(path: str | Path | None) -> Recipe:
    """The recipe in a TOML file, or a shipped one by its name; the paper's where there is none.

    >>> import jaxfinger as jf
    >>> jf.recipe("emps").model.terms
    ('joint_elastic', 'joint_coulomb', 'joint_damping')

    Raises:
        UserError: there is no such recipe, or a key of it is wrong; it names the key to mend.
    """
    if path is None:
        return Recipe()
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
    """A recipe from nested dictionaries, strictly."""
    return from_tables(content, Recipe, Place(where))


def as_dict(recipe: Recipe) -> dict:
    """For a result file."""
    return asdict(recipe)


def _folders() -> list[Path]:
    """Where the shipped recipes lie: in an installed package, or in a checkout."""
    here = Path(__file__).resolve().parents[1]
    return [folder for folder in (here / "fits", here.parent / "fits") if folder.is_dir()]


def _shipped(name: str) -> Path | None:
    """A recipe that comes with the package, by its name with or without `.toml`."""
    candidates = (folder / (name if name.endswith(".toml") else f"{name}.toml") for folder in _folders())
    return next((path for path in candidates if path.exists()), None)


def _shipped_names() -> list[str]:
    return sorted(path.stem for folder in _folders() for path in folder.glob("*.toml"))
