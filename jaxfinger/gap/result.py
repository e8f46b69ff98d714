"""What a diagnosis found: numbers, names and kinds, no sentence. `report` turns them into words and a page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from jaxfinger.effects import Site
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.propose import Proposal
from jaxfinger.identify import Fit

OPEN = 1.3  # rms of a channel after, in that of its noise, which is itself known to a fifth


class Status(StrEnum):
    """The verdict, by the ids of `gap.json`."""

    NO_GAP = "no_gap"  # nothing beyond the noise in any channel that was judged
    EXPLAINED = "explained"  # every channel comes down to its noise, or to what the user tolerates
    PARTLY = "partly"  # the named causes are at work, and the rest is open
    AMBIGUOUS = "ambiguous"  # rivals that the trials cannot tell apart
    UNEXPLAINED = "unexplained"  # a gap of which no known cause explains a fair part
    NOT_JUDGED = "not_judged"  # no channel has a sample that counts


class Reason(StrEnum):
    """Why a channel is not judged."""

    NOTHING_COUNTS = "nothing_counts"  # no sample of it passed the experiment's rules
    FEW_SAMPLES = "few_samples"  # too few samples count to tell a law from noise
    NOT_PREDICTED = "not_predicted"  # the other simulator says nothing of it


@dataclass(frozen=True, order=True)
class Key:
    """One cause at one site: an effect's id, or `changed_` and a group of nominal parameters."""

    effect: str
    site: Site


@dataclass(frozen=True, order=True)
class ExperimentChannel:
    """One channel of one experiment, or one of its columns."""

    experiment: str
    name: str  # for example `joint_torque`
    column: str | None = None  # name of the joint, tendon or axis; None: all columns together


@dataclass(frozen=True)
class Value:
    """One parameter of a cause at one of its sites."""

    site: Site
    name: str
    value: float
    std: float
    units: str


@dataclass(frozen=True)
class Cause:
    """One line of the budget: one effect, at one site or at several that came in together."""

    effect: str
    sites: tuple[Site, ...]
    probability: float  # that it is at work (at several sites: at each of them)
    share: float  # of the gap, mean over channels with a gap, lost on held-out trials when it alone is dropped
    share_ci95: tuple[float, float]
    channels: dict[ExperimentChannel, float]  # the same of each channel that it changes, columns together
    values: tuple[Value, ...]

    @property
    def keys(self) -> tuple[Key, ...]:
        """Its sites one by one."""
        return tuple(Key(self.effect, s) for s in self.sites)


@dataclass(frozen=True)
class Unexplained:
    """What of the gap no named cause closes."""

    share: float  # mean over channels with a gap
    share_ci95: tuple[float, float]
    depends_on: tuple[str, ...]  # variables of the smooth law that carry most of it: `tension`, `q`, …
    where: ExperimentChannel | None  # the column with most of it
    proposal: Proposal | None  # a closed form, unproven


@dataclass(frozen=True)
class Relevance:
    """How large a channel's gap is in the world."""

    experiment: str
    channel: str
    units: str
    gap: float  # rms beyond the noise, in `units`
    signal: float  # rms of the channel about its mean, over the same samples
    relative: float  # gap / signal
    tolerated: bool  # whether the user's tolerance covers it


@dataclass(frozen=True)
class NotJudged:
    """A channel that is no part of the verdict."""

    experiment: str
    channel: str
    reason: Reason


@dataclass(frozen=True)
class ChannelBudget:
    """How the misfit of one column with a gap is made up, on held-out trials. Shares are of its gap; what causes close
    together, or only together, makes them sum to more or less than one.
    """

    experiment: str
    channel: str
    column: str
    units: str
    noise: float  # rms
    gap: float  # rms of what the nominal model misses beyond the noise
    by_cause: tuple[float, ...]  # in the order of `Diagnosis.budget`: lost when this cause alone is dropped
    unexplained: float  # left with all causes in


@dataclass(frozen=True)
class Candidate:
    """One cause at one site, tried."""

    key: Key
    probability: float  # that it is at work, alone or with others
    log_evidence: float  # of the best set with it less the best set without it
    held_out: float  # share of the gap that it explains on trials that its fit has not seen
    values: tuple[Value, ...]


@dataclass(frozen=True)
class Absorbed:
    """A cause that the nominal parameters imitate with this file's trials."""

    key: Key
    share: float  # of its signature that they imitate
    hidden: tuple[Value, ...]  # per amplitude: `value` 0 and the `std` that the trials leave it, all that could hide


@dataclass(frozen=True)
class Closure:
    """How far one channel closes on held-out trials: rms in its unit, at the rate of the fit."""

    experiment: str
    channel: str
    units: str
    noise: float
    before: float
    after: float
    closed: float
    closed_ci95: tuple[float, float]
    resolvable: bool  # whether the gap before stands out of the noise
    diverged: bool = False  # whether a forward simulation ran away: it closes nothing, and says nothing

    @property
    def stays_open(self) -> bool:
        """Whether a channel with a gap misses more than its noise after all. Angles simulated forward are not judged by
        that, since they amplify what is small.
        """
        judged = self.resolvable and not self.diverged and self.channel != "q"
        return judged and self.noise > 0 and self.after > OPEN * self.noise


def tolerated(line: Closure, relevance: Sequence[Relevance], tolerance: Mapping[str, float]) -> bool:
    """Whether what a channel misses beyond its noise after all, beside its signal, is within the user's tolerance."""
    left = max(line.after**2 - line.noise**2, 0.0) ** 0.5
    signal = {(x.experiment, x.channel): x.signal for x in relevance}.get((line.experiment, line.channel), 0.0)
    return left <= tolerance.get(line.channel, -1.0) * signal


def still_open(
    closures: Sequence[Closure], relevance: Sequence[Relevance], tolerance: Mapping[str, float]
) -> list[Closure]:
    """Channels that stay open by more than the user tolerates."""
    return [x for x in closures if x.stays_open and not tolerated(x, relevance, tolerance)]


@dataclass(frozen=True)
class Left:
    """What a smooth law could still explain in one column, beyond the causes."""

    experiment: str
    channel: str
    column: str
    energy: float  # in squared standard deviations, above what noise gives
    by_variable: dict[str, float]  # the same, for the features of one variable alone


@dataclass(frozen=True)
class Place:
    """Where the nominal model misses."""

    experiment: str
    trial: str
    channel: str
    site: str
    variable: str
    low: float
    high: float
    share: float  # of the gap's energy above noise, in the whole file


@dataclass(frozen=True)
class Change:
    """A nominal parameter that two sessions, or simulator and finger, disagree on."""

    name: str
    group: str
    units: str
    before: float
    before_std: float
    after: float
    after_std: float
    probability: float  # that it has changed


@dataclass(frozen=True)
class Posture:
    """Where a joint is in a trial that has not been run: rad, m where it slides."""

    joint: str
    low: float
    high: float
    moves: bool
    slides: bool


@dataclass(frozen=True)
class NextExperiment:
    """The trial that would best separate rivals."""

    experiment: str
    lacking: bool  # whether the session has no trial of it
    joint: str | None  # that is driven, in an experiment of one joint
    tendon: str | None  # that is pulled, at held joints
    postures: tuple[Posture, ...]
    tension: float | None  # N, the highest; None without tension
    steps: bool  # whether it is pulled in steps
    released: bool  # and let go in steps again
    speed: float | None  # rad/s; None where joints rest
    slides: bool  # whether that speed is m/s for some joint
    times: int  # how often
    evidence: float  # expected, of all those times together
    separates: tuple[str, ...]  # ids of effects


@dataclass(frozen=True, repr=False)
class Diagnosis:
    """Everything that a report shows."""

    status: Status
    named: tuple[Key, ...]  # in order of their share; under `ambiguous` the likeliest of the first set
    data: str  # file name
    specimen: str
    against: str | None  # file name of the fit
    quick: bool
    tolerance: dict[str, float]  # by channel, of its signal; empty: none
    budget: tuple[Cause, ...]  # in order of their share
    unexplained: Unexplained
    channels: tuple[ChannelBudget, ...]
    relevance: tuple[Relevance, ...]
    not_judged: tuple[NotJudged, ...]
    closures: tuple[Closure, ...]
    where: tuple[Place, ...]
    candidates: tuple[Candidate, ...]  # most probable first
    none: float  # probability that nothing is at work
    unlisted: float  # that something which the catalogue lacks is
    ambiguous_sets: tuple[tuple[Key, ...], ...]
    next_experiment: NextExperiment | None
    absorbed: tuple[Absorbed, ...]
    changes: tuple[Change, ...]
    left: tuple[Left, ...]  # largest first
    nominal: Fit
    augmented: Fit  # the nominal one where nothing is named
    problem: Problem | None  # the recordings and residuals, for figures; None where they are let go

    def __repr__(self) -> str:
        named = ", ".join(f"{k.effect} at {'-'.join(k.site)}" for k in self.named) or "nothing named"
        return f"Diagnosis({self.data!r}: {self.status}; {named})"
