"""Texts that an effect has about itself: what happens, what it looks like in the data, what to change."""

from __future__ import annotations

import inspect
from dataclasses import dataclass

from jaxfinger.effects import CATALOGUE, CHANGED, NOMINAL_TERMS, CatalogueEffect
from jaxfinger.gap.result import Diagnosis


@dataclass(frozen=True)
class Words:
    """Texts about a cause; empty where the effect has none."""

    happens: str
    looks: str = ""  # what the effect looks like in the data
    change: str = ""  # what to change in the simulator or on the bench
    form: str = ""  # the law, with the names of its parameters


def words(effect: str, d: Diagnosis) -> Words:
    """Texts about an effect of the catalogue, a term of the nominal model, a user's effect or a changed parameter."""
    of_model = {e.ID: type(e) for e in d.augmented.model.effects if isinstance(e, CatalogueEffect)}
    known = of_model | NOMINAL_TERMS | CHANGED | CATALOGUE
    if effect not in known:
        return Words("")
    cls = known[effect]
    return Words(cls.HAPPENS, cls.LOOKS, cls.CHANGE, first_sentence(cls))


def first_sentence(cls: type) -> str:
    """The first sentence of a class's docstring."""
    text = " ".join((inspect.getdoc(cls) or "").split("\n\n")[0].split())
    return text if text.endswith(".") or not text else f"{text}."
