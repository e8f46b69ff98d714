"""The verdict: first that of the posterior alone, then on held-out trials."""

from collections.abc import Mapping
from dataclasses import dataclass

from jaxfinger.gap.closure import MIN_RESOLVABLE_RATIO
from jaxfinger.gap.costs import CauseKey
from jaxfinger.gap.parts import mean_squares
from jaxfinger.gap.posterior import MIN_NAMED_PROBABILITY, Posterior
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.result import Closure, Relevance, Status, still_open, tolerated


@dataclass(frozen=True)
class Verdict:
    """Status and causes (effect and site) that follow from the posterior alone, without held-out trials."""

    status: Status
    named: tuple[CauseKey, ...]
    rivals: tuple[CauseKey, ...] = ()  # causes that could replace one another, in the posterior's order

    @property
    def blamed(self) -> tuple[CauseKey, ...]:
        """Causes that are named, or that the trials cannot tell apart."""
        return tuple(dict.fromkeys((*self.named, *self.rivals)))


def verdict_of(problem: Problem, found: Posterior, relevance: tuple[Relevance, ...]) -> Verdict:
    """Verdict of the posterior; held-out trials decide later between `partly` and `explained` (`confirmed`).

    Without a cause to name it is `unexplained` if some channel's mean square is surely above that of its noise,
    whatever the evidence, or if there is a gap and something unlisted is probable.
    """
    rivals = tuple(key for keys in found.ambiguous for key in keys)
    if found.named:
        return Verdict(Status.PARTLY, found.named, rivals)
    if rivals:
        return Verdict(Status.AMBIGUOUS, rivals[:1], rivals)
    matters = [x for x in relevance if not x.tolerated]
    seen = any(
        missed > MIN_RESOLVABLE_RATIO * noise
        for missed, noise in (mean_squares(problem, x.experiment, x.channel) for x in matters)
    )
    unlisted = bool(matters) and found.unlisted > MIN_NAMED_PROBABILITY
    return Verdict(Status.UNEXPLAINED if seen or unlisted else Status.NO_GAP, ())


def confirmed(
    status: Status,
    found: Posterior,
    lines: tuple[Closure, ...],
    relevance: tuple[Relevance, ...],
    tolerance: Mapping[str, float],
) -> Status:
    """`explained` in place of `partly` where every channel closes to its noise, or to the user's tolerance.

    `lines` are the channels' gaps on held-out trials. If something unlisted is probable, only the tolerance counts:
    what is left of every gap must be within it. Another simulator that has no gap once it is retuned is `unexplained`
    where held-out trials are predicted worse with the new parameters, and not to the noise.
    """
    if status is Status.NO_GAP and any(x.gets_worse for x in still_open(lines, relevance, tolerance)):
        return Status.UNEXPLAINED
    if status is not Status.PARTLY or found.ambiguous or still_open(lines, relevance, tolerance):
        return status
    with_gap = {(x.experiment, x.channel) for x in relevance}
    matter = [x for x in lines if (x.experiment, x.channel) in with_gap and not tolerated(x, relevance, tolerance)]
    return Status.EXPLAINED if found.unlisted <= MIN_NAMED_PROBABILITY or not matter else status


def consistent_with(status: Status, found: Posterior, gaps: bool) -> tuple[float, float]:
    """Probabilities of «nothing» and «something unlisted» at work, bounded so that they agree with the verdict.

    `gaps` says whether any channel has a gap. Where a gap has no named cause, or the named causes leave it open on
    held-out trials, «unlisted» is at least one half. Under `no_gap`, where many columns have traces and none has a gap,
    it is at most one half.
    """
    if status is Status.NO_GAP and not gaps:
        unlisted = min(found.unlisted, 1.0 - MIN_NAMED_PROBABILITY)
        return max(found.none, 1.0 - unlisted), unlisted
    left_open = status is Status.UNEXPLAINED or (status is Status.PARTLY and not found.ambiguous)
    unlisted = max(found.unlisted, MIN_NAMED_PROBABILITY) if left_open else found.unlisted
    return min(found.none, 1.0 - unlisted), unlisted
