"""The catalogue of effects that the nominal model leaves out. `docs/add-an-effect.md` tells how to add one."""

import importlib.util
import inspect
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path

from jaxfinger.effects import body, changed, drive, joint, nominal, sensors, tendon, transmission
from jaxfinger.effects.base import Amplitude, CatalogueEffect, Shape, Site, amplitude, shape
from jaxfinger.effects.changed import Changed
from jaxfinger.effects.scales import Scales
from jaxfinger.errors import UserError, did_you_mean, require
from jaxfinger.model import Finger


def _effects_in(module) -> dict[str, type[CatalogueEffect]]:
    return {
        c.ID: c
        for _, c in inspect.getmembers(module, inspect.isclass)
        if issubclass(c, CatalogueEffect) and "ID" in c.__dict__ and c.__module__ == module.__name__
    }


CATALOGUE: dict[str, type[CatalogueEffect]] = {}
for _module in (joint, drive, tendon, transmission, body, sensors):
    CATALOGUE |= _effects_in(_module)
NOMINAL_TERMS = _effects_in(nominal)  # candidates only where a recipe leaves the term out
PLACES = ("joint", "tendon", "joint pair", "tendon pair")  # of several sites; other places are single ones
CHANGED = _effects_in(changed)  # candidates only beside an earlier fit


def nominal_terms(elastic_degree: int, friction_degree: int) -> dict[str, type[CatalogueEffect]]:
    """Effects that stand for terms a recipe may leave out, by id, as polynomials of the given degrees."""
    degrees = {"joint_elastic": elastic_degree, "joint_coulomb": friction_degree}
    return {n: nominal.of_degree(c, degrees[n]) if n in degrees else c for n, c in NOMINAL_TERMS.items()}


def changes(elastic_degree: int, friction_degree: int, moment_arm_degree: int) -> dict[str, type[CatalogueEffect]]:
    """Effects that stand for changes of nominal parameters since an earlier fit, by id, as polynomials of the given
    degrees. One of degree zero has no copy beside the effect that changes the constant alone.
    """
    degrees = {"changed_elastic": elastic_degree, "changed_friction": friction_degree}
    copies = {n for n, degree in degrees.items() if degree == 0}
    degrees["changed_moment_arm"] = moment_arm_degree - 1
    return {n: nominal.of_degree(c, degrees[n]) if n in degrees else c for n, c in CHANGED.items() if n not in copies}


# A user's own effects: the Python file that defines them, or their classes by id.
OwnEffects = str | os.PathLike | Mapping[str, type[CatalogueEffect]]


def own_effects(effects: OwnEffects | None) -> dict[str, type[CatalogueEffect]]:
    """A user's own effects by id, loaded from their file or checked likewise.

    Raises:
        UserError: As of `load`; or a class is no effect, or stands under another name than its ID.
    """
    if isinstance(effects, str | os.PathLike):
        return load(effects)
    require((Mapping, None), effects=effects)
    for name, kind in (effects or {}).items():
        if not (inspect.isclass(kind) and issubclass(kind, CatalogueEffect)):
            raise UserError(f"effects[{name!r}]: is no subclass of jaxfinger.effects.CatalogueEffect; give the class")
        if not hasattr(kind, "ID"):
            raise UserError(f"effects[{name!r}]: {kind.__name__} has no ID; give it one")
        if name != kind.ID:
            raise UserError(f"effects[{name!r}]: {kind.__name__} has the ID {kind.ID}, not {name}; give it by its ID")
        _refuse_faulty(kind, f"effects[{name!r}]")
    return dict(effects or {})


def file_of(kind: type[CatalogueEffect]) -> str:
    """File that defines an effect; of a class that was typed into a session of Python or a notebook, its module."""
    try:
        return inspect.getfile(kind)
    except (TypeError, OSError):
        return kind.__module__


def load(path: str | os.PathLike) -> dict[str, type[CatalogueEffect]]:
    """Load the effects that a user's Python file defines, by id.

    Raises:
        UserError: The file cannot be loaded or defines no effect. An id is missing, taken by the catalogue or by
            another effect of the file, or no plain word; a sentence for people or the amplitude is missing.
    """
    path = Path(path)
    spec = importlib.util.spec_from_file_location(f"jaxfinger_user_{path.stem}", path)
    if spec is None or spec.loader is None or not path.exists():
        raise UserError(f"{path}: is not a Python file with effects")
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as e:  # The file is a user's program, which may raise anything.
        raise UserError(f"{path}: cannot be loaded: {type(e).__name__}: {e}") from e
    _refuse_lost(path, module)
    found = _effects_in(module)
    if not found:
        raise UserError(f"{path}: defines no effect; subclass jaxfinger.effects.CatalogueEffect and give it an ID")
    for kind in found.values():
        _refuse_faulty(kind, path)
        for sentence in ("HAPPENS", "LOOKS", "CHANGE", "__doc__"):
            if not getattr(kind, sentence):
                raise UserError(f"{path}: {kind.__name__} has no {sentence.strip('_')}; write its sentence")
    return found


def _refuse_faulty(kind: type[CatalogueEffect], where: str | Path) -> None:
    """Refuse a user's effect whose id is taken or no plain word, or that has no place or amplitude."""
    name, place = kind.ID, getattr(kind, "PLACE", None)
    if name in CATALOGUE | NOMINAL_TERMS | CHANGED:
        raise UserError(f"{where}: {kind.__name__} has the ID {name}, which the catalogue has; choose another")
    if not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise UserError(f"{where}: {kind.__name__} has the ID {name!r}; use small letters, digits and underscores")
    if "sites" not in vars(kind) and place not in PLACES and (near := did_you_mean(place, PLACES)):
        raise UserError(f"{where}: {kind.__name__} has the PLACE {place!r}{near}")
    if not kind.amplitudes():
        raise UserError(f"{where}: {kind.__name__} has no amplitude; declare a field with `amplitude`")


def _refuse_lost(path: Path, module) -> None:
    """Refuse effects of a user's file that would be passed over: those without an ID of their own, and namesakes."""
    kinds = [c for _, c in inspect.getmembers(module, inspect.isclass) if issubclass(c, CatalogueEffect)]
    kinds = [c for c in kinds if c.__module__ == module.__name__]
    named: dict[str, type] = {}
    for kind in kinds:
        own, parents = kind.__dict__.get("ID"), {base for c in kinds for base in c.__mro__[1:]}
        if own is None and kind not in parents:
            raise UserError(f"{path}: {kind.__name__} has no ID of its own and would be passed over; give it one")
        if own is not None and (other := named.setdefault(own, kind)) is not kind:
            raise UserError(f"{path}: {other.__name__} and {kind.__name__} have the same ID {own}; give each its own")


def to_dict(effect: CatalogueEffect, units: dict[str, str]) -> dict:
    """Describe an effect as a result file holds it. `units`: those of its parameters at its site, by name."""
    parameters = {k: {"value": v, "units": units[k]} for k, v in effect.values().items()}
    return {"effect": effect.ID, "site": list(effect.site), "parameters": parameters}


def from_dict(finger: Finger, content: dict, extra: dict[str, type[CatalogueEffect]] | None = None) -> CatalogueEffect:
    """Read back the effect that `to_dict` described.

    `extra`: a user's effects, by id.

    Raises:
        UserError: No effect has this id.
    """
    known = CATALOGUE | NOMINAL_TERMS | CHANGED | (extra or {})
    if content["effect"] not in known:
        raise UserError(
            f"the effect {content['effect']!r} is not in the catalogue; name the Python file that defines it by "
            "--effects, in Python by `effects`"
        )
    values = {k: v["value"] for k, v in content["parameters"].items()}
    return known[content["effect"]].at(finger, tuple(content["site"]), **values)


__all__ = [
    "CATALOGUE",
    "CHANGED",
    "NOMINAL_TERMS",
    "Amplitude",
    "CatalogueEffect",
    "Changed",
    "OwnEffects",
    "Scales",
    "Shape",
    "Site",
    "amplitude",
    "changes",
    "file_of",
    "from_dict",
    "load",
    "nominal_terms",
    "own_effects",
    "shape",
    "to_dict",
]
