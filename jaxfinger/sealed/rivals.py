"""Rivals: causes that no method could tell from the true one with the data of the session.

The noise-free residual z that a cause leaves after a refit of the nominal parameters is known. A rival that stands in
for the truth at its best size loses D = ½ ‖z‖² (1 − cos²(z, z_rival)) nats of log likelihood, the quantitative
distinguishability of Lundgren and Jung (2020, arXiv 2009.04756) for known noise. Rows are weighted so that the samples
of one second count once. Causes less than `MIN_DISTANCE` nats apart cannot be told apart.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .cases import rebuild
from .departures import LISTED, draw_at, sites
from .departures.draw import Index, Names
from .severity import COARSE, NoiseFreeSession
from .truth import MIN_DISTANCE

DRAWS = 2  # shapes drawn for each rival and site
NEAREST, MORE = 5, 30  # Further shapes are drawn for the nearest rivals, whose distance decides.


@dataclass(frozen=True)
class Rival:
    """A cause other than the truth, and its distance from the truth in nats."""

    effect: str
    site: tuple[str, ...]
    distance: float


def distances(
    session: NoiseFreeSession,
    left: np.ndarray,
    truth: tuple[str, tuple[str, ...]],
    seed: int,
    draws: int = DRAWS,
    more: int = MORE,
) -> list[Rival]:
    """Distances of all listed causes other than the truth, nearest first.

    `left`: what a refit leaves of the truth's trace. `draws`, `more`: shapes drawn of each cause, and further ones of
    the nearest.
    """
    rng = np.random.default_rng(seed)
    finger = session.specimen.finger
    energy = float(left @ left) / COARSE[250.0]

    def imitated(effect: str, names: Names, index: Index, draws: int) -> float:
        """Energy of the truth's trace along the rival's, for the drawn shape that fits best."""
        best = 0.0
        for _ in range(draws):
            rival = draw_at(effect, (names, index), finger, rng, (0.5, 1.0))
            z = session.refitted(session.trace([rival])[0])
            # Both signs count, since gains and offsets may have either. Causes of positive size may come out too near.
            best = max(best, float(left @ z) ** 2 / max(float(z @ z), 1e-30) / COARSE[250.0])
        return best

    found = {
        (effect, names, index): imitated(effect, names, index, draws)
        for effect in LISTED
        for names, index in sites(effect, finger)
        if (effect, names) != truth
    }
    for key in sorted(found, key=lambda k: -found[k])[:NEAREST]:
        found[key] = max(found[key], imitated(*key, more))
    return sorted(
        (Rival(effect, names, 0.5 * max(energy - best, 0.0)) for (effect, names, _), best in found.items()),
        key=lambda r: r.distance,
    )


def add_rivals(truth_file: Path) -> list[Rival]:
    """Compute the rivals of a case with one effect, and write those within `MIN_DISTANCE` nats into its truth.

    Other cases, and those that have rivals already, return no rivals.
    """
    truth = json.loads(truth_file.read_text())
    if truth["kind"] not in ("listed", "unlisted") or "rivals" in truth:
        return []
    session, departures = rebuild(truth)
    left = session.refitted(session.trace(departures)[0])
    cause = departures[0]
    near = [
        r for r in distances(session, left, (cause.effect, cause.site), truth["seed"][1]) if r.distance < MIN_DISTANCE
    ]
    truth["energy"] = 0.5 * float(left @ left) / COARSE[250.0]
    truth["rivals"] = [{"effect": r.effect, "site": list(r.site), "distance": r.distance} for r in near]
    part = truth_file.with_suffix(".part")
    part.write_text(json.dumps(truth, indent=1))
    os.replace(part, truth_file)
    return near


def add_all(
    truth_root: Path,
    workers: int = 1,
    share: tuple[int, int] = (1, 1),
    progress: Callable[[int, int, str], None] | None = None,
) -> int:
    """Add rivals to all cases of a truth folder, or share (i, n) of them; return how many were looked at.

    `progress` takes (done, total, name).
    """
    files: Sequence[Path] = [
        f for k, f in enumerate(sorted(truth_root.glob("case-*.json")), start=1) if k % share[1] == share[0] % share[1]
    ]
    with ProcessPoolExecutor(workers) as pool:
        jobs = {pool.submit(add_rivals, f): f for f in files}
        for done, job in enumerate(as_completed(jobs), start=1):
            job.result()
            if progress:
                progress(done, len(files), jobs[job].stem)
    return len(files)
