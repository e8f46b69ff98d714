"""Which effects: every candidate on its own, then further ones on top, against «none» and «unlisted».

1. Screen every effect at every site and shape linearly; refit the strongest few with their shapes free, and the best of
   these again at the nominal model that each leads to.
2. Take the best. What is left of the gap is screened again on top of it; a further effect joins while it explains a
   fair part of what is left beyond the first one's own error of form, and all are refitted together.
3. «Unlisted» competes through the flexible stand-in: the part of the gap that it explains beyond the chosen effects.
4. Evidence counts a limited number of independent looks. A candidate whose log evidence is ½ U below the best one's has
   log L = −½ ν log(1 + U/ν), Student's t with ν looks: Gaussian for a candidate that fits to the noise, and tolerant
   where all forms are a little wrong, as textbook forms are.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit, logsumexp

from jaxfinger.effects import CatalogueEffect
from jaxfinger.gap.evidence import Evidence, Projector
from jaxfinger.gap.held_out import held_out_energies
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.refine import Refined, at_optimum, refine, relinearised
from jaxfinger.gap.screening import Screening, by_site
from jaxfinger.gap.signatures import Signatures, variants
from jaxfinger.gap.standin import REACH, Explained, energy_left, explained
from jaxfinger.identify.stages import Progress

DETECT = 12.0  # log evidence that an effect needs before anything is called a gap: without one, the best has 2 to 5
# Share of the gap that an effect which explains it alone must explain on held-out trials; true ones: 0.23 and more.
CARRIES = 0.15
FURTHER = 30.0  # and a further effect, which must not stand in for the first one's form
LOOKS = 25.0  # ν: independent looks that evidence counts
FORM = 0.1  # share of what an effect explains in a column, that the form of its law may miss
MOST = 2  # effects that a verdict names: three known ones together imitate most that is not known
ADD = 0.3  # share of what is left, that a further effect must explain
SAME_SITE = 0.1  # share of what is explained, that a further effect at the same site must explain
CLOSE = 0.5  # share of what the best explains, from which on a rival is refitted where it leads
COVERED = 0.97  # probability of a set of rivals, among the catalogue, up to which it takes in further ones
RIVALS = 3  # at most in a set
TRIED = 0.01  # share of the gap that a candidate must explain in the fit, to be tried on held-out trials
LOOKED_AT = 12  # candidates for a further effect
LEAST = 100.0  # energy left to the stand-in below which nothing further is looked for
ALONE = 100.0  # energy of a column that is a gap though no known effect explains any: without one, it has up to 48
REVERSALS = "ID.3-dynamic"  # where it has up to 239, since a reversal's time is off by a part of a sample: no such gap
HINT = 20.0  # of it in a column, that a known effect may claim though noise could give it: its law asks for more
# «Unlisted», by how many effects were chosen, since two known ones together imitate more than one does: the share of
# the gap left to the stand-in at which it is as likely as the catalogue, and how sharply. One known effect in another
# textbook form leaves 0.14 at most, and an unknown one that it imitates 0.17; two leave 0.02, and 0.11.
OPEN = {1: (0.155, 0.015), 2: (0.07, 0.015)}
DOUBT = 0.9  # probability of «unlisted» where held-out trials contradict the effects chosen


@dataclass(frozen=True)
class Candidate:
    """One effect at one site, judged."""

    key: tuple[str, tuple[str, ...]]
    probability: float
    held_out: float  # share of the gap that it explains on trials that its refit has not seen: alone, or beside others
    refined: Refined | None
    evidence: Evidence

    @property
    def log_evidence(self) -> float:
        """Against the nominal model; of the refit where there is one."""
        return self.refined.log_evidence if self.refined else self.evidence.log_bf


@dataclass(frozen=True)
class Search:
    """What the search found."""

    gap: float  # energy of the gap that can be explained at all, in squared standard deviations
    detected: bool  # whether there is a gap
    chosen: Refined | None  # the effects of the verdict, refitted together, in order; None where none is seen
    shares: tuple[float, ...]  # of the gap, one a chosen effect: what is lost when it alone is dropped
    candidates: list[Candidate]
    none: float
    unlisted: float
    rival_sets: list[list[tuple]]  # effects that explain as much as the chosen first one
    left: list[Explained]  # what the stand-in explains beyond the chosen effects
    absorbed: list[tuple]  # (key, share) of effects that the file cannot show
    there: Problem  # at the nominal model that the chosen effects lead to

    def doubted(self) -> "Search":
        """The same where held-out trials contradict what was chosen: «unlisted» takes all but a tenth."""
        rest = (1.0 - DOUBT - self.none) / sum(c.probability for c in self.candidates)
        candidates = [replace(c, probability=c.probability * rest) for c in self.candidates]
        return replace(self, candidates=candidates, unlisted=DOUBT, rival_sets=[])


def search(
    problem: Problem,
    catalogue: dict[str, type[CatalogueEffect]],
    quick: bool = False,
    progress: Progress = lambda message: None,
) -> Search:
    """Judge every effect of the catalogue at every site of the finger."""
    screen = Screening.of(problem, variants(catalogue, problem.nominal.finger, problem.scales), progress)
    projector = Projector(problem)
    rt = projector.residual(problem)
    chi2 = float(rt @ rt)
    progress("weighing the evidence")
    screened = screen(projector, rt)
    found = by_site(screened)
    ranked = list(found.values())
    refined: dict[tuple, Refined] = {}
    for e in _worth(ranked, 3 if quick else 8):
        progress(f"refitting with {e.variant.effect.ID} at {', '.join(e.variant.site)}")
        refined[e.variant.key] = refine(problem, [e.variant], [start_of(e)], chi2, projector)
    if not refined or max(r.log_evidence for r in refined.values()) < DETECT:
        return _none_named(problem, ranked, refined, {}, explained(problem, problem.r))

    best = max(refined.values(), key=lambda r: r.log_evidence)
    start, there = problem, {}
    for k in _rivals(refined, best, chi2, 1 if quick else RIVALS):
        progress(f"refitting with {k[0]} at {', '.join(k[1])} where it leads")
        forms = [refine(problem, [e.variant], [start_of(e)], chi2, projector) for e in other_forms(screened, found[k])]
        led = [relinearised(problem, r, chi2) for r in (refined[k], *forms)]
        there[k], refined[k] = max(led, key=lambda x: x[1].log_evidence)
    best = max((refined[k] for k in there), key=lambda r: r.log_evidence)
    problem, chosen = there[best.keys[0]], best
    if not quick:
        chosen = _add(problem, screen, best, chi2, rt[: problem.r.size], progress)
    if len(chosen.variants) > 1:
        # Of two effects, neither need be the one that explains most alone: its rivals are taken as the first too.
        rivals = [k for k in there if k != best.keys[0]]
        pairs = [_add(there[k], screen, refined[k], chi2, rt[: problem.r.size], progress) for k in rivals]
        led = [relinearised(there[r.keys[0]], r, chi2) for r in (chosen, *pairs) if len(r.variants) > 1]
        problem, chosen = max(led, key=lambda x: x[1].log_evidence)
    left = explained(problem, chosen.residual)
    gap = chi2 - chosen.chi2 + energy_left(left)
    shares = _shares(problem, chosen, chi2, gap)
    held_out = _held_out(start, there, ranked, refined, screen, chi2, gap)
    if len(chosen.variants) > 1:
        held_out |= _beside(problem, chosen, chi2, gap)
    alone = len(chosen.variants) == 1 and energy_left(left) < OPEN[1][0] * gap
    if alone and held_out[chosen.keys[0]] < CARRIES:
        return _none_named(start, ranked, refined, held_out, explained(start, start.r))
    return _judge(problem, ranked, refined, held_out, chosen, shares, gap, left)


def _rivals(refined: dict[tuple, Refined], best: Refined, chi2: float, most: int) -> list[tuple]:
    """The strongest candidates, the best first: those that explain about as much as it does."""
    close = [k for k, r in refined.items() if chi2 - r.chi2 > CLOSE * (chi2 - best.chi2)]
    return sorted(close, key=lambda k: -refined[k].log_evidence)[:most]


def other_forms(screened: list[Evidence], first: Evidence) -> list[Evidence]:
    """The strongest variant of every other choice, which no refit moves, of the same effect and site: a coarse grid of
    the other shapes, or a friction that is refitted with it, may have put the wrong one first.
    """
    chosen = [first]
    for e in screened:
        close = e.variant.key == first.variant.key and e.explained > CLOSE * first.explained
        if close and not any(_choices(e) == _choices(x) for x in chosen):
            chosen.append(e)
    return chosen[1:]


def _choices(e: Evidence) -> list[float]:
    shapes = e.variant.effect.shape_parameters()
    return [v for n, v in e.variant.shape if shapes[n].moves == "not"]


def _worth(ranked: list[Evidence], most: int) -> list[Evidence]:
    """The candidates that a refit of their shapes could still bring to the top."""
    best = ranked[0].explained
    return [e for e in ranked[:most] if e.log_bf > 5.0 and e.explained > 0.2 * best]


def start_of(e: Evidence) -> dict[str, float]:
    """Amplitudes to start a refit from, in their own units."""
    return {n: float(a) * unit for (n, unit), a in zip(e.variant.sizes.items(), e.amplitudes, strict=True)}


def _add(problem, screen, best: Refined, chi2: float, without, progress) -> Refined:
    """Further effects on top of the best, while each explains a fair part of what is left.

    Real effects do not follow a textbook form to the letter: in a column that the chosen effects changed, the share
    FORM of what they explain there may be theirs still, and counts for no other. `without`: white residuals of the
    nominal model alone.
    """
    chosen, cell = best, problem.column_of_row
    while len(chosen.variants) < MOST:
        theirs = FORM * np.maximum(np.bincount(cell, without**2 - chosen.residual**2, len(problem.columns)), 0.0)
        energies = {(x.experiment, x.channel, x.column): x.energy for x in explained(problem, chosen.residual)}
        left = np.array([energies.get(k, 0.0) for k in problem.columns])
        still = float(np.maximum(left - theirs, 0.0)[left > REACH].sum())
        if left[left > HINT].sum() < LEAST:
            break
        on_top = Projector(problem, chosen.columns)
        rt = on_top.residual(problem, problem.r - chosen.change)
        ranked = [e for e in by_site(screen(on_top, rt)).values() if e.variant.key not in chosen.keys]
        drops = [_drop(screen.signatures_of(e), e, on_top, rt, cell, len(problem.columns)) for e in ranked[:LOOKED_AT]]
        first = int(np.argmax([_fits(drop, left) for drop in drops]))
        e, credit = ranked[first], float(np.maximum(drops[first] - theirs, 0.0).sum())
        # At the site of an effect that is there already, another form of it is likelier than a second cause.
        same = any(set(e.variant.site) & set(v.site) for v in chosen.variants)
        need = max(ADD * still, 2 * FURTHER, SAME_SITE * (chi2 - chosen.chi2) if same else 0.0)
        if e.log_bf < FURTHER or credit < need:
            break
        progress(f"adding {e.variant.effect.ID} at {', '.join(e.variant.site)}")
        items, starts = at_optimum(chosen)
        together = refine(problem, [*items, e.variant], [*starts, start_of(e)], chi2)
        if chosen.chi2 - together.chi2 < need:
            break
        chosen = together
    return chosen


def _drop(Z, e: Evidence, projector: Projector, rt, cell, count: int) -> np.ndarray:
    """What a candidate with the signatures Z explains in every column."""
    change = e.amplitudes @ projector(Z)
    return np.bincount(cell, (rt**2 - (rt - change) ** 2)[: cell.size], count)


def _fits(drop: np.ndarray, left: np.ndarray) -> float:
    """Gain in log L of all columns: a true cause explains a column to the noise, an imitator a part of many."""
    before, after = np.maximum(left, 0.0), np.maximum(left - drop, 0.0)
    return float(0.5 * LOOKS * np.sum(np.log1p(before / LOOKS) - np.log1p(after / LOOKS)))


def _held_out(start, there, ranked, refined, screen: Screening, chi2: float, gap: float) -> dict[tuple, float]:
    """Share of the gap that each candidate explains alone on held-out trials: the strongest where they have led, others
    at the nominal model; of those that explain any of what they have seen.
    """
    some = {e.variant.key: e for e in ranked if e.explained > TRIED * gap}
    members = {
        k: refined[k].change[None] if k in refined else screen.signatures_of(e)
        for k, e in some.items()
        if k not in there
    }
    alone, with_member = held_out_energies(start, list(members.values()))
    left = dict(zip(members, with_member.tolist(), strict=True))
    left |= {k: float(held_out_energies(problem, [refined[k].change[None]])[1][0]) for k, problem in there.items()}
    return {k: _share(alone - x, alone, chi2 - gap) for k, x in left.items()}


def _beside(problem: Problem, chosen: Refined, chi2: float, gap: float) -> dict[tuple, float]:
    """Share of the gap that each of the effects chosen together explains on held-out trials beside the others."""
    signatures = Signatures(problem)
    changes = np.concatenate([signatures.of([e]) for e in chosen.effects])
    less_one = [np.delete(changes, i, axis=0) for i in range(len(changes))]
    alone, (together, *left) = held_out_energies(problem, [changes, *less_one])
    return {k: _share(x - together, alone, chi2 - gap) for k, x in zip(chosen.keys, left, strict=True)}


def _share(gain: float, alone: float, noise: float) -> float:
    """Of what the nominal model alone misses beyond the noise."""
    return float(np.clip(gain / max(alone - noise, 1e-9), 0.0, 1.0))


def _shares(problem, chosen: Refined, chi2: float, gap: float) -> tuple[float, ...]:
    """What is lost when one effect alone is dropped, as a share of the gap."""
    if len(chosen.variants) == 1:
        return ((chi2 - chosen.chi2) / gap,)
    items, starts = at_optimum(chosen)
    projector, out = Projector(problem), []
    for i in range(len(items)):
        rest = refine(problem, items[:i] + items[i + 1 :], starts[:i] + starts[i + 1 :], chi2, projector)
        out.append((rest.chi2 - chosen.chi2) / gap)
    return tuple(out)


def _judge(there: Problem, ranked, refined, held_out, chosen, shares, gap, left) -> Search:
    """Probabilities: rivals of the first effect by their evidence, «unlisted» by what all leave unexplained."""
    first, beyond = chosen.keys[int(np.argmax(shares))], energy_left(left)
    logs = _log_evidences(ranked, refined)
    most = max(r.log_evidence for r in refined.values())
    log_l = {k: -0.5 * LOOKS * np.log1p(2.0 * (most - np.clip(v, 0.0, most)) / LOOKS) for k, v in logs.items()}
    total = logsumexp(list(log_l.values()))
    share_left = beyond / gap
    even, width = OPEN[len(chosen.variants)]
    unlisted = max(float(expit((share_left - even) / width)), 0.01)
    probability = {k: float(np.exp(v - total)) * (1 - unlisted) for k, v in log_l.items()}
    if len(chosen.variants) > 1:
        # Each effect at work counts alike: a double is scored one half for each of its effects.
        probability = {k: 0.1 * p for k, p in probability.items()}
        for k in chosen.keys:
            probability[k] += 0.9 * (1 - unlisted) / len(chosen.keys)
    none = 1e-6
    scale = (1 - none) / (sum(probability.values()) + unlisted)
    probability = {k: p * scale for k, p in probability.items()}
    rivals = [first]
    mass = np.exp(log_l[first] - total)
    for k in sorted(log_l, key=lambda k: -log_l[k]):
        if mass >= COVERED or len(rivals) == RIVALS:
            break
        if k != first and log_l[k] > log_l[first] - 4.0:
            rivals.append(k)
            mass += np.exp(log_l[k] - total)
    return Search(
        gap,
        True,
        chosen,
        shares,
        _candidates(ranked, probability, held_out, refined),
        none,
        unlisted * scale,
        [rivals] if len(rivals) > 1 else [],
        left,
        _absorbed(ranked),
        there,
    )


def _log_evidences(ranked: list[Evidence], refined: dict[tuple, Refined]) -> dict[tuple, float]:
    """Of every candidate alone, against the nominal model: of its refit where there is one."""
    return {e.variant.key: e.log_bf for e in ranked} | {k: r.log_evidence for k, r in refined.items()}


def _candidates(ranked: list[Evidence], probability, held_out, refined) -> list[Candidate]:
    """All of them, the likeliest first."""
    keyed = {e.variant.key: e for e in ranked}
    judged = [Candidate(k, probability[k], held_out.get(k, 0.0), refined.get(k), e) for k, e in keyed.items()]
    return sorted(judged, key=lambda c: -c.probability)


def _absorbed(ranked: list[Evidence]) -> list[tuple]:
    """What the nominal parameters imitate with this file's trials, and to which share."""
    return [(e.variant.key, e.absorbed) for e in ranked if e.absorbed > 0.99]


def _none_named(
    problem: Problem, ranked: list[Evidence], refined, held_out: dict[tuple, float], left: list[Explained]
) -> Search:
    """No effect is seen above the noise, or none that held-out trials know: the weak evidence that there is shares what
    «none» leaves, or «unlisted» where some other smooth law is seen.
    """
    gap = sum(x.energy for x in left if x.energy > ALONE and x.experiment != REVERSALS)
    strongest = max((r.log_evidence for r in refined.values()), default=ranked[0].log_bf)
    none = 1e-6 if gap else float(np.clip(expit((DETECT - strongest) / 2.0), 0.5, 0.995))
    known = 0.1 if gap else 0.7 * (1 - none)
    logs = _log_evidences(ranked, refined)
    weights = {k: np.exp(0.2 * (np.clip(v, -5.0, strongest) - strongest)) for k, v in logs.items()}
    total = sum(weights.values())
    probability = {k: float(w * known / total) for k, w in weights.items()}
    candidates = _candidates(ranked, probability, held_out, refined)
    unlisted, absorbed = 1 - none - known, _absorbed(ranked)
    return Search(gap, gap > 0, None, (), candidates, none, unlisted, [], left, absorbed, problem)
