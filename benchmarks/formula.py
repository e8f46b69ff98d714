"""Fit the ten numbers of the diagnosis's formula (`jaxfinger/gap/formula.py`) by log score on sealed cases.

    jaxfinger sealed make cases --split develop --count 40
    python benchmarks/formula.py weigh records cases           # 1.5 to 8 minutes a case; resumes after a stop
    python benchmarks/formula.py weigh records cases --withheld
    python benchmarks/formula.py score records
    python benchmarks/formula.py fit records

`weigh` searches every case and stores the evidence of every set of causes that the search weighs. With `--withheld`
the first of its effects is taken out of the catalogue, so that something unlisted is at work. `score` prints, by
kind of case, the log score of these records: the mean over cases of Σ log P of what is true, over all causes that a
session's trials can show and «something unlisted»; their Brier score Σ (P − truth)²; and how many causes are probable
(`MIN_NAMED_PROBABILITY`) or doubted (less, but `MIN_DOUBTED_PROBABILITY`), of those that are at work and of others.
`fit` maximises the log score. Probabilities are clipped by `CLIP`, since no search visits every set. Each number has a
log-normal prior around its present value, a factor of `PRIOR_FACTOR` per standard deviation. Scores are cross-validated
over `FOLDS` parts of the cases.
"""

import argparse
import pickle
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, astuple, dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from jaxfinger.data import read_session
from jaxfinger.gap.columns import Counts
from jaxfinger.gap.costs import CauseKey, Costs
from jaxfinger.gap.diagnose import candidate_effects, search_for_causes
from jaxfinger.gap.formula import Evidence, Parameters, log_likelihood, unexplained, unlisted
from jaxfinger.gap.laws_of_time import without_laws_of_time
from jaxfinger.gap.posterior import MIN_NAMED_PROBABILITY, genuine_probabilities
from jaxfinger.gap.problem import build
from jaxfinger.gap.sets import Weighed
from jaxfinger.gap.signatures import catalogue_for
from jaxfinger.identify import Recipe
from jaxfinger.sealed.run import CASES_PER_PROCESS
from jaxfinger.sealed.truth import UNLISTED, read_truth

CLIP = 1e-3  # least probability: a cause that no visited set has costs at most 7 nats
# Least probability of a cause that `score` counts as doubted: most causes that were never likely have less than 0.01.
MIN_DOUBTED_PROBABILITY = 0.1
PRIOR_FACTOR = 3.0  # wide: it only keeps numbers that the cases do not determine
FOLDS = 5
MAX_SETS = 100  # likeliest sets of a case that `fit` keeps, for speed


@dataclass(frozen=True)
class Record:
    """Evidence from one case's search."""

    case: str
    counts: Counts
    evidence: dict[frozenset[CauseKey], Evidence]
    screened: frozenset[frozenset[CauseKey]]  # sets that have not been weighed in settled weights
    explainable: dict[CauseKey, np.ndarray]
    at_work: frozenset[CauseKey]
    parameters: Parameters

    def likeliest(self) -> "Record":
        """Keep the likeliest sets, and each of them without one of its causes."""
        costs, best = self.costs(self.parameters), {frozenset(): self.evidence[frozenset()]}
        for keys in sorted(self.evidence, key=lambda k: costs.of(k) - self.evidence[k].score)[:MAX_SETS]:
            best[keys] = self.evidence[keys]
        for keys in list(best):
            best |= {less: self.evidence[less] for k in keys if (less := keys - {k}) in self.evidence}
        return replace(self, evidence=best)

    def costs(self, p: Parameters) -> Costs:
        """Costs of sets under other parameters."""
        return Costs(p, unexplained(self.counts, self.evidence[frozenset()], p), self.explainable)

    def probabilities(self, p: Parameters) -> dict[CauseKey, float]:
        """Probability that each cause, and «something unlisted», is at work."""
        costs, sets = self.costs(p), list(self.evidence)
        # The causes' values stay. They are at an optimum, so the evidence changes with them in second order only.
        e, o, explained, score = (np.array(x) for x in zip(*self.evidence.values(), strict=True))
        was, is_now = (log_likelihood(self.counts, e, o, explained, q)[0].sum(axis=-1) for q in (self.parameters, p))
        scores = score + is_now - was
        w = costs.probabilities(dict(zip(sets, scores.tolist(), strict=True)))
        evidence = {k: self.evidence[k]._replace(score=s) for k, s in zip(sets, scores.tolist(), strict=True)}
        settled = [(x.score - costs.of(k), k) for k, x in evidence.items() if k not in self.screened]
        _, best = max(settled, key=lambda x: x[0])
        probability = dict.fromkeys(self.explainable, 0.0)
        for keys, v in w.items():
            for key in keys:
                probability[key] += v
        other = unlisted(self.counts, evidence[best], p)
        for key, genuine in genuine_probabilities(costs, self.counts, evidence, best, other).items():
            probability[key] *= genuine
        probability[UNLISTED] = other
        return probability

    def log_score(self, p: Parameters) -> float:
        """Σ log P of the truth about every cause and «unlisted»."""
        probability = self.probabilities(p)
        P = np.clip(np.array(list(probability.values())), CLIP, 1.0 - CLIP)
        true = np.array([key in self.at_work for key in probability])
        return float(np.sum(np.log(np.where(true, P, 1.0 - P))))


def weigh(folder: Path, withheld: bool) -> Record | None:
    """Search one case and record its evidence; None if its first effect is to be withheld, and it has none."""
    recipe, truth = Recipe(), read_truth(folder, folder.parent.with_name(f"{folder.parent.name}-truth"))
    if withheld and not truth.listed:
        return None
    without = (truth.listed[0][0],) if withheld else ()
    problem = build(read_session(folder / "fit.h5"), recipe)
    effects = candidate_effects(problem, catalogue_for(recipe, None, problem.nominal.finger), {}, without)
    search, _ = search_for_causes(without_laws_of_time(problem, effects), effects)
    costs, visited = search.costs, search.visited
    return Record(
        folder.name,
        search.baseline.columns.counts,
        visited.evidence,
        frozenset(keys for keys, how in visited.weighed.items() if how is Weighed.SCREENED),
        search.table.explainable,
        frozenset(UNLISTED if effect in without else (effect, site) for effect, site in truth.at_work),
        costs.parameters,
    )


def moved(x: Iterable[float]) -> Parameters:
    """Multiply the formula's present numbers by e to the x."""
    return Parameters(*(v * float(np.exp(d)) for v, d in zip(astuple(Parameters()), x, strict=True)))


def fit(records: list[Record]) -> Parameters:
    """Maximise the log score over the numbers, with their prior."""

    def loss(x: np.ndarray) -> float:
        p = moved(x)
        return -sum(r.log_score(p) for r in records) + 0.5 * float(np.sum((x / np.log(PRIOR_FACTOR)) ** 2))

    start = np.zeros(len(astuple(Parameters())))
    simplex = np.vstack([start, start + 0.5 * np.eye(len(start))])
    options = {"maxfev": 600, "xatol": 0.02, "fatol": 0.05, "initial_simplex": simplex}
    return moved(minimize(loss, start, method="Nelder-Mead", options=options).x)


def mean(records: list[Record], p: Parameters) -> float:
    """Mean log score of the cases."""
    return float(np.mean([r.log_score(p) for r in records]))


def score(records: list[Record], p: Parameters) -> None:
    """Print the scores of the cases, those with and without an unlisted effect and with several causes apart."""
    kinds: dict[str, list[Record]] = {}
    for r in records:
        beside = "with an unlisted effect" if UNLISTED in r.at_work else "without an unlisted effect"
        kinds.setdefault(f"{'several' if len(r.at_work) > 1 else 'at most one'}, {beside}", []).append(r)
    for kind, some in sorted(kinds.items()):
        found = [(r, r.probabilities(p)) for r in some]
        brier = np.mean([sum((P - (k in r.at_work)) ** 2 for k, P in of.items()) for r, of in found])
        causes = [(P, k in r.at_work) for r, of in found for k, P in of.items() if k != UNLISTED]
        probable = [true for P, true in causes if P >= MIN_NAMED_PROBABILITY]
        doubted = [true for P, true in causes if MIN_DOUBTED_PROBABILITY <= P < MIN_NAMED_PROBABILITY]
        listed = sum(len(r.at_work - {UNLISTED}) for r in some)
        called = sum(of[UNLISTED] >= MIN_NAMED_PROBABILITY for _, of in found)
        print(
            f"{kind}: {len(some)} cases; log score {mean(some, p):.2f}, Brier score {brier:.2f}; of {listed} causes at "
            f"work {sum(probable)} probable, {sum(doubted)} doubted; of others {len(probable) - sum(probable)} "
            f"probable, {len(doubted) - sum(doubted)} doubted; something unlisted probable in {called}"
        )


def main() -> None:
    """Weigh cases, or score them; or print present and fitted numbers, and log scores on cases that did not choose."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=["weigh", "score", "fit"])
    parser.add_argument("records", type=Path)
    parser.add_argument("cases", type=Path, nargs="*")
    parser.add_argument("--withheld", action="store_true", help="take the first effect of a case out of the catalogue")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    if options.what == "weigh":
        options.records.mkdir(parents=True, exist_ok=True)
        folders = sorted(f.parent for cases in options.cases for f in cases.glob("*/fit.h5"))
        suffix = ".withheld.pickle" if options.withheld else ".pickle"
        files = {f: options.records / f"{f.parent.name}-{f.name}{suffix}" for f in folders}
        todo = [f for f, file in files.items() if not file.exists()]
        at_once = options.workers * CASES_PER_PROCESS
        for some in (todo[i : i + at_once] for i in range(0, len(todo), at_once)):
            with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
                for folder, record in zip(some, pool.map(partial(weigh, withheld=options.withheld), some), strict=True):
                    if record is not None:
                        files[folder].write_bytes(pickle.dumps(record))
                        print(f"{folder.name}: log score {record.log_score(record.parameters):.2f}", flush=True)
        return
    records = [pickle.loads(f.read_bytes()).likeliest() for f in sorted(options.records.glob("*.pickle"))]
    if options.what == "score":
        score(records, Parameters())
        return
    whole = fit(records)
    print(
        f"{len(records)} cases; log score a case {mean(records, Parameters()):.2f}, fitted {mean(records, whole):.2f}"
    )
    for name, value in asdict(whole).items():
        print(f"  {name:<20}{getattr(Parameters(), name):8.3g} -> {value:.3g}")
    parts = [records[i::FOLDS] for i in range(FOLDS)]
    seen = [fit([r for p in parts if p is not part for r in p]) for part in parts]
    scores = [[mean(part, Parameters()), mean(part, p)] for part, p in zip(parts, seen, strict=True)]
    before, after = np.mean(scores, axis=0)
    print(f"on the fifths that did not choose: {before:.2f} -> {after:.2f}")


if __name__ == "__main__":
    main()
