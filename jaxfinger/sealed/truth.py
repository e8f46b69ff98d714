"""Read verdicts and truths. Only `close_case` and scoring call this, never a diagnosis."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from jaxfinger.errors import UserError

Cause = tuple[str, tuple[str, ...]]  # effect, site
NONE: Cause = ("none", ())
UNLISTED: Cause = ("unlisted", ())
# Nats (odds of 20 to 1), below which data do not tell two causes apart, or a cause from none.
MIN_DISTANCE = 3.0
# Share of some channel's gap: a cause that closes more ought to be named. Less is hardly seen on a diagnosis's page.
MIN_CLOSED_SHARE = 0.1
# Severity, in units of the noise of a hold's mean: the mean of a hundred holds has as much noise. An effect that
# reaches less at every physical size, such as an error of a fingertip's sensor in a session that has no contact, leaves
# no trace to diagnose: it counts as not at work.
MIN_REACHED = 0.1


@dataclass(frozen=True)
class Truth:
    """True causes of a case, in order of severity, those of the catalogue first."""

    name: str
    kind: str  # none, listed, unlisted, double, several
    causes: tuple[Cause, ...]
    listed: tuple[Cause, ...] = ()  # causes of the catalogue
    matters: tuple[Cause, ...] = ()  # listed causes that close more than MIN_CLOSED_SHARE of some channel's gap
    # True values of the catalogue's parameters.
    known: Mapping[Cause, Mapping[str, float]] = field(default_factory=dict)
    severity: float | str | None = None
    reached: float | None = None  # severity that the calibration reached; None if unknown
    specimen: str = ""
    fresh: tuple[Mapping, ...] = ()
    rivals: int | None = None  # causes less than MIN_DISTANCE from the truth, «none» included; None if not computed

    @property
    def at_work(self) -> frozenset[Cause]:
        """Candidates that are at work: the listed causes, «unlisted» for any others, or «none»."""
        strange = {UNLISTED} if set(self.causes) - set(self.listed) else set()
        return frozenset({*self.listed, *strange} or {NONE})


@dataclass(frozen=True)
class Diagnosis:
    """Verdict of a `gap.json`, with its cost in seconds."""

    status: str  # no_gap, explained, partly, ambiguous, unexplained, not_judged, or failed
    named: tuple[Cause, ...]
    sets: tuple[tuple[Cause, ...], ...]
    probability: dict[Cause, float]
    seconds: float | None = None
    fresh: tuple[Mapping, ...] = ()  # rms on the fresh trials, before and after
    values: Mapping[Cause, Mapping[str, tuple[float, float]]] = field(default_factory=dict)  # (value, std) by cause

    @property
    def answer(self) -> tuple[Cause, ...]:
        """Answer of the verdict: the first ambiguous set, or the named causes."""
        if self.status == "ambiguous" and self.sets:
            return self.sets[0]
        return self.named if self.status in ("explained", "partly", "ambiguous") else ()


def read_truth(folder: Path, truth_root: Path | None) -> Truth:
    """Read the truth of a case: `TRUTH/<case>.json`, or `truth.json` beside the data.

    Raises:
        UserError: There is no truth, or it is not JSON.
    """
    name = folder.name
    files = ([truth_root / f"{name}.json"] if truth_root else []) + [folder / "truth.json"]
    file = next((f for f in files if f.exists()), None)
    if file is None:
        raise UserError(
            f"{folder}: no truth for this case in {' or '.join(str(f) for f in files)}; say where it is with --truth"
        )
    data = _load(file)
    effects = [e for e in data["effects"] if e.get("reached", MIN_REACHED) >= MIN_REACHED]
    effects.sort(key=lambda e: -float(e.get("reached", 0.0)))
    stated = data.get("kind") if len(effects) == len(data["effects"]) else None
    listed = [e for e in effects if e["listed"]]
    kinds = {0: "none", 1: "listed" if listed else "unlisted", 2: "double"}
    causes = {_cause(e): e for e in [*listed, *(e for e in effects if not e["listed"])]}
    return Truth(
        name,
        stated or kinds.get(len(effects), "several"),
        tuple(causes),
        tuple(map(_cause, listed)),
        tuple(_cause(e) for e in listed if e.get("closes", 1.0) > MIN_CLOSED_SHARE),
        {c: e.get("known", {}) for c, e in causes.items()},
        effects[0].get("severity") if effects else None,
        effects[0].get("reached") if effects else None,
        data.get("specimen", ""),
        tuple(data.get("fresh", ())),
        len(data["rivals"]) + (data["energy"] < MIN_DISTANCE) if "rivals" in data else None,
    )


def read_diagnosis(folder: Path) -> Diagnosis:
    """Read the verdict in a folder that `diagnose` wrote. Without a `gap.json` its status is `failed`.

    Raises:
        UserError: `gap.json` is not JSON, or of another schema.
    """
    file = folder / "gap.json"
    cost = _load(folder / "run.json") if (folder / "run.json").exists() else {}
    if not file.exists():
        return Diagnosis("failed", (), (), {}, cost.get("seconds"))
    data = _load(file)
    try:
        verdict = data["verdict"]
        probability = {_cause(c): float(c["probability"]) for c in data["candidates"]}
        probability[NONE], probability[UNLISTED] = float(data["none"]), float(data["unlisted"])
        fresh = _load(folder / "fresh.json")["rows"] if (folder / "fresh.json").exists() else ()
        return Diagnosis(
            verdict["status"],
            tuple(_cause(c) for c in verdict["effects"]),
            tuple(tuple(_cause(c) for c in members) for members in data["ambiguous_sets"]),
            probability,
            cost.get("seconds"),
            tuple(fresh),
            {_cause(c): {n: (p["value"], p["std"]) for n, p in c["parameters"].items()} for c in data["budget"]},
        )
    except (KeyError, TypeError) as error:
        raise UserError(
            f"{file}: not a gap.json of schema jaxfinger-gap/2 (missing {error}); diagnose the case again"
        ) from None


def _cause(entry: Mapping) -> Cause:
    return entry["effect"], tuple(entry["site"])


def _load(file: Path) -> dict:
    try:
        return json.loads(file.read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise UserError(f"{file}: cannot be read as JSON ({error}); run the case again") from None
