"""Reading verdicts and truths. Only closing and scoring come here; nothing that diagnoses does."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from jaxfinger.errors import UserError

Cause = tuple[str, tuple[str, ...]]  # effect, site
NONE: Cause = ("none", ())
UNLISTED: Cause = ("unlisted", ())
TELLING = 3.0  # nats: below, two causes look alike, or a cause looks like none


@dataclass(frozen=True)
class Truth:
    """What is the matter with a case; effects in order of size."""

    name: str
    kind: str  # none, listed, unlisted, double
    causes: tuple[Cause, ...]
    severity: float | str | None = None
    reached: float | None = None  # severity that the calibration reached; None where the source does not say
    specimen: str = ""
    fresh: tuple[Mapping, ...] = ()
    rivals: int | None = None  # causes that no method could tell from the truth with this session; None: not computed

    def shares(self) -> dict[Cause, float]:
        """Where the probability should lie: one half on each effect of a double."""
        if self.kind == "none":
            return {NONE: 1.0}
        if self.kind == "unlisted":
            return {UNLISTED: 1.0}
        return {cause: 1.0 / len(self.causes) for cause in self.causes}


@dataclass(frozen=True)
class Diagnosis:
    """What a `gap.json` says, and what it cost."""

    status: str  # no_gap, explained, ambiguous, unexplained, or failed
    named: tuple[Cause, ...]
    sets: tuple[tuple[Cause, ...], ...]
    probability: dict[Cause, float]
    seconds: float | None = None
    fresh: tuple[Mapping, ...] = ()  # rms on the fresh trials, before and after

    @property
    def answer(self) -> tuple[Cause, ...]:
        """The set that the verdict stands for: the first ambiguous set, or what it names."""
        if self.status == "ambiguous" and self.sets:
            return self.sets[0]
        return self.named if self.status in ("explained", "ambiguous") else ()


FAILED = Diagnosis("failed", (), (), {})


def read_truth(folder: Path, truth_root: Path | None) -> Truth:
    """The truth of a case: `TRUTH/<case>.json`, or `truth.json` beside the data as the practice cases have it."""
    name = folder.name
    files = ([truth_root / f"{name}.json"] if truth_root else []) + [folder / "truth.json"]
    file = next((f for f in files if f.exists()), None)
    if file is None:
        raise UserError(
            f"{folder}: no truth for this case in {' or '.join(str(f) for f in files)}; say where it is with --truth"
        )
    data = _load(file)
    effects = sorted(data["effects"], key=lambda e: -float(e.get("reached", 0.0)))
    listed = [e for e in effects if e["listed"]]
    kind = data.get("kind") or (
        "none" if not effects else "unlisted" if not listed else "double" if len(effects) > 1 else "listed"
    )
    return Truth(
        name,
        kind,
        tuple((e["effect"], tuple(e["site"])) for e in effects),
        effects[0].get("severity") if effects else None,
        effects[0].get("reached") if effects else None,
        data.get("specimen", ""),
        tuple(data.get("fresh", ())),
        len(data["rivals"]) + (data["energy"] < TELLING) if "rivals" in data else None,
    )


def read_diagnosis(folder: Path) -> Diagnosis:
    """The verdict in a folder that `diagnose` wrote; `FAILED` where it wrote none."""
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
        )
    except (KeyError, TypeError) as error:
        raise UserError(
            f"{file}: not a gap.json of schema jaxfinger-gap/1 (missing {error}); diagnose the case again"
        ) from None


def _cause(entry: Mapping) -> Cause:
    return entry["effect"], tuple(entry["site"])


def _load(file: Path) -> dict:
    try:
        return json.loads(file.read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise UserError(f"{file}: cannot be read as JSON ({error}); run the case again") from None
