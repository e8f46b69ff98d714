"""`gap.json`, schema jaxfinger-gap/2 (docs/gap-json.md): SI units, angles in rad, no NaN."""

from __future__ import annotations

import json
from pathlib import Path

from jaxfinger.data.atomic import atomic_path, folder_to_fill
from jaxfinger.effects import Site
from jaxfinger.gap.result import Candidate, Cause, Diagnosis, Key, NextExperiment, Value
from jaxfinger.identify.fit_file import save_fit
from jaxfinger.report import sentences

SCHEMA = "jaxfinger-gap/2"


def as_gap_json(d: Diagnosis) -> dict:
    """Content of `gap.json` as a dictionary."""
    return {
        "schema": SCHEMA,
        **_of(d, "data", "specimen", "against"),
        "verdict": {
            "status": str(d.status),
            "effects": [_key(k) for k in d.named],
            "summary": sentences.summary(d),
        },
        "budget": [_cause(c) for c in d.budget],
        "unexplained": {
            "share": d.unexplained.share,
            "share_ci95": list(d.unexplained.share_ci95),
            "depends_on": list(d.unexplained.depends_on),
            "proposal": d.unexplained.proposal.formula if d.unexplained.proposal else None,
        },
        "relevance": [_of(x, "experiment", "channel", "units", "gap", "signal", "relative") for x in d.relevance],
        "not_judged": [_of(x, "experiment", "channel") | {"reason": sentences.reason(x)} for x in d.not_judged],
        "where": [
            _of(p, "experiment", "trial", "channel", "site")
            | {"region": _of(p, "variable", "low", "high"), "share": p.share}
            for p in d.where
        ],
        "candidates": [_candidate(c) for c in d.candidates],
        "none": _chance(d.none),
        "unlisted": _chance(d.unlisted),
        "ambiguous_sets": [[_key(k) for k in members] for members in d.ambiguous_sets],
        "next_experiment": _next(d.next_experiment) if d.next_experiment else None,
        "gap": [
            _of(x, "experiment", "channel", "units", "noise", "before", "after", "closed")
            | {"closed_ci95": list(x.closed_ci95)}
            for x in d.closures
        ],
    }


def text(d: Diagnosis) -> str:
    """Content of `gap.json` as text."""
    return json.dumps(as_gap_json(d), indent=1, allow_nan=False, ensure_ascii=False)


def write(d: Diagnosis, folder: str | Path, overwrite: bool = False) -> None:
    """Write `gap.json`, `nominal.json` and `augmented.json` into a folder, which is made if it does not exist.

    Raises:
        UserError: one of them exists and `overwrite` is false, or the folder cannot be written.
    """
    with folder_to_fill(folder) as folder:
        with atomic_path(folder / "gap.json", overwrite) as part:
            part.write_text(text(d), encoding="utf-8")
        save_fit(d.nominal, folder / "nominal.json", overwrite)
        save_fit(d.augmented, folder / "augmented.json", overwrite)


def _cause(c: Cause) -> dict:
    return {
        "effect": c.effect,
        "site": _sites(c),
        "probability": _chance(c.probability),
        "share": c.share,
        "share_ci95": list(c.share_ci95),
        "channels": {f"{k.experiment}/{k.name}": share for k, share in c.channels.items()},
        "parameters": _parameters(c.values, c.sites),
    }


def _candidate(c: Candidate) -> dict:
    return _key(c.key) | {
        "probability": _chance(c.probability),
        "parameters": _parameters(c.values, (c.key.site,)),
        "held_out_gain": c.held_out,
    }


def _next(step: NextExperiment) -> dict:
    return {
        "experiment": step.experiment,
        "description": sentences.next_trial(step),
        "separates": list(step.separates),
    }


def _of(record: object, *names: str) -> dict:
    """Fields of a record under their own names."""
    return {name: getattr(record, name) for name in names}


def _chance(probability: float) -> float:
    """A probability clipped to 0 and 1, since rounding may lift a sum of weights above 1."""
    return min(max(probability, 0.0), 1.0)


def _key(key: Key) -> dict:
    return {"effect": key.effect, "site": list(key.site)}


def _sites(cause: Cause) -> list[str]:
    """Names in the one site, or with several sites the name of each."""
    return list(cause.sites[0]) if len(cause.sites) == 1 else ["-".join(s) for s in cause.sites]


def _parameters(values: tuple[Value, ...], sites: tuple[Site, ...]) -> dict:
    """Values by the parameter's name, or with several sites by name and site."""
    return {
        v.name if len(sites) == 1 else f"{v.name} {'-'.join(v.site)}": _of(v, "value", "std", "units") for v in values
    }
