"""Texts that an effect has about itself: what happens, what it looks like in the data, what to change."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jaxfinger.effects import CATALOGUE, CHANGED, NOMINAL_TERMS, CatalogueEffect
from jaxfinger.gap.result import Diagnosis, Value
from jaxfinger.report.numbers import measured


@dataclass(frozen=True)
class Words:
    """Texts about a cause; empty where the effect has none."""

    happens: str
    looks: str = ""  # what the effect looks like in the data
    change: str = ""  # what to change in the simulator or on the bench
    form: str = ""  # the law, with the names of its parameters


def words(effect: str, d: Diagnosis) -> Words:
    """Texts about an effect of the catalogue, a term of the nominal model, a user's effect or a changed parameter."""
    cls = _known(d).get(effect)
    return Words(cls.HAPPENS, cls.LOOKS, cls.CHANGE, first_sentence(cls)) if cls else Words("")


def parameters(effect: str, values: Sequence[Value], d: Diagnosis) -> list[tuple[str, str]]:
    """Name and text of every parameter of a cause that people read: its value with its interval.

    A shape that no refit moves is left out. Where it chooses a form, words without a name say which. Both name their
    site where there are several.
    """
    cls, out = _known(d).get(effect), []
    sites = dict.fromkeys(v.site for v in values)
    for site in sites:
        own, at = {v.name: v for v in values if v.site == site}, "-".join(site) if len(sites) > 1 else ""
        fixed = {n for n, p in cls.shape_parameters().items() if p.fixed} if cls else set()
        moved = [v for n, v in own.items() if n not in fixed]
        out += [(f"{v.name} {at}".rstrip(), measured(v.value, v.std, v.units)) for v in moved]
        if cls:
            out += [(at, text) for text in cls.form(d.nominal.model.finger, {n: v.value for n, v in own.items()})]
    return out


def _known(d: Diagnosis) -> Mapping[str, type[CatalogueEffect]]:
    """Effects by id: of the catalogue, of the nominal model, changes, and the user's own that the diagnosis names."""
    of_model = {e.ID: type(e) for e in d.augmented.model.effects if isinstance(e, CatalogueEffect)}
    return of_model | NOMINAL_TERMS | CHANGED | CATALOGUE


def first_sentence(cls: type) -> str:
    """The first sentence of a class's docstring."""
    text = " ".join((inspect.getdoc(cls) or "").split("\n\n")[0].split())
    return text if text.endswith(".") or not text else f"{text}."
