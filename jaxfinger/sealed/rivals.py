"""The ceiling: which other causes could not be told from the true one, by any method, with the session at hand.

For the truth, listed or not, and each listed rival, the trace that a nominal refit leaves is known without noise. The
log-likelihood that is lost when the rival, at its best size, stands in for the truth is D = ½ ‖z‖² (1 − cos²(z,
z_rival)), with rows weighted so that the samples of one second count once: the quantitative distinguishability of
Lundgren and Jung (2020, arXiv 2009.04756) for known noise. Below `TELLING` nats the two look alike.
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
from .severity import COARSE, QuietSession
from .truth import TELLING

DRAWS = 2  # shapes tried for each rival and site
NEAREST, MORE = 5, 30  # the nearest by these get more


@dataclass(frozen=True)
class Rival:
    """A cause that could stand in for the truth, and the nats by which it misses."""

    effect: str
    site: tuple[str, ...]
    distance: float


def distances(
    session: QuietSession,
    left: np.ndarray,
    truth: tuple[str, tuple[str, ...]],
    seed: int,
    draws: int = DRAWS,
    more: int = MORE,
) -> list[Rival]:
    """Every listed cause other than the truth with its distance, nearest first. `left`: the truth's trace after
    a refit; `draws`, `more`: shapes that are tried of each, and further ones of the nearest.
    """
    rng = np.random.default_rng(seed)
    finger = session.specimen.finger
    energy = float(left @ left) / COARSE[250.0]

    def imitated(effect: str, names: Names, index: Index, draws: int) -> float:
        """Energy of the truth's trace along the rival's, of the drawn shape that fits best."""
        best = 0.0
        for _ in range(draws):
            rival = draw_at(effect, (names, index), finger, rng, (0.5, 1.0))
            z = session.left(session.trace([rival])[0])
            # Sizes are positive where physics says so, but signs of gains and offsets are free: take either.
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
    """Rebuild a single-effect case from its seed and write its rivals within `TELLING` nats into its truth."""
    truth = json.loads(truth_file.read_text())
    if truth["kind"] not in ("listed", "unlisted") or "rivals" in truth:
        return []
    session, departures = rebuild(truth)
    left = session.left(session.trace(departures)[0])
    cause = departures[0]
    near = [r for r in distances(session, left, (cause.effect, cause.site), truth["seed"][1]) if r.distance < TELLING]
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
    """Rivals of every case under a truth folder (or share i of n); files that have them are left alone."""
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
