"""The result of a diagnosis as data: numbers, names and enums. `report` turns it into sentences and a page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

from jaxfinger.effects import Site
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.propose import Proposal
from jaxfinger.identify import Fit

# A channel stays open where its rms with the causes in exceeds that of its noise by this factor. The noise itself is
# known to a fifth, so that a smaller excess may be an error of its estimate.
MAX_CLOSED_RMS = 1.3
MIN_SHARE = 0.005  # Share of a gap: in whole percents a smaller one is 0 %.


class Status(StrEnum):
    """The verdict; values are the ids in `gap.json`."""

    NO_GAP = "no_gap"  # no channel that was judged misses more than its noise
    EXPLAINED = "explained"  # with the named causes every channel comes down to its noise or the user's tolerance
    PARTLY = "partly"  # causes are named, and part of the gap stays open
    AMBIGUOUS = "ambiguous"  # the trials cannot tell some rival causes apart
    UNEXPLAINED = "unexplained"  # there is a gap, and no cause is probable enough to be named
    NOT_JUDGED = "not_judged"  # no channel has enough samples that count


class Reason(StrEnum):
    """Why a channel is not judged."""

    NOTHING_COUNTS = "nothing_counts"  # no sample passed the experiment's rules
    NOT_MEASURED = "not_measured"  # no trial measured it
    FEW_SAMPLES = "few_samples"  # too few samples count to tell a law from noise
    NOT_PREDICTED = "not_predicted"  # the other simulator does not predict it


@dataclass(frozen=True, order=True)
class Key:
    """Name of one cause at one site: the id of an effect, or `changed_` and a group of nominal parameters."""

    effect: str
    site: Site


@dataclass(frozen=True, order=True)
class ExperimentChannel:
    """One channel of one experiment, or one of its columns."""

    experiment: str
    name: str  # for example `joint_torque`
    column: str | None = None  # name of the joint, tendon or axis; None stands for all columns together


@dataclass(frozen=True)
class Value:
    """One parameter of a cause at one of its sites."""

    site: Site
    name: str
    value: float  # in `units`
    std: float  # in `units`
    units: str


@dataclass(frozen=True)
class Cause:
    """One line of the budget: one effect at all sites where it is in the chosen set."""

    effect: str
    sites: tuple[Site, ...]
    probability: float  # that it is at work; with several sites, the smallest of theirs
    share: float  # of the gap that comes back on held-out trials without it: mean over channels with a gap
    share_ci95: tuple[float, float]
    channels: dict[ExperimentChannel, float]  # share of each channel's gap, mean over its columns with a gap
    values: tuple[Value, ...]

    @property
    def keys(self) -> tuple[Key, ...]:
        """One key for each site."""
        return tuple(Key(self.effect, s) for s in self.sites)


@dataclass(frozen=True)
class Unexplained:
    """The part of the gap that no named cause closes."""

    share: float  # of the gap, mean over channels with a gap
    share_ci95: tuple[float, float]
    depends_on: tuple[str, ...]  # up to two variables with which a smooth law explains it: `tension`, `q`, …
    where: ExperimentChannel | None  # the column with the largest part of it
    proposal: Proposal | None  # a closed form for a person to check


@dataclass(frozen=True)
class Relevance:
    """Size of a channel's gap in physical units and relative to the channel's signal."""

    experiment: str
    channel: str
    units: str
    gap: float  # rms beyond the noise, in `units`
    signal: float  # rms of the channel about its mean in the experiment that moves it most, in `units`
    relative: float  # gap / signal
    tolerated: bool  # whether the user's tolerance covers the gap


@dataclass(frozen=True)
class NotJudged:
    """A channel that the verdict does not cover."""

    experiment: str
    channel: str
    reason: Reason


@dataclass(frozen=True)
class ChannelBudget:
    """Budget of one column with a gap, as shares of its gap on held-out trials.

    Shares need not sum to one: a part that either of two causes closes counts for neither, and a part that only both
    together close counts for both.
    """

    experiment: str
    channel: str
    column: str
    units: str
    noise: float  # rms, in `units`
    gap: float  # rms of the nominal model's residual beyond the noise, in `units`
    by_cause: tuple[float, ...]  # share that comes back without this cause alone, in the order of `Diagnosis.budget`
    unexplained: float  # share that is left with all causes in


@dataclass(frozen=True)
class Candidate:
    """One cause at one site that was tried."""

    key: Key
    probability: float  # that it is at work, alone or with others
    held_out: float  # share of the gap that it explains on trials that its fit has not seen
    values: tuple[Value, ...]


@dataclass(frozen=True)
class Absorbed:
    """A cause that the nominal parameters imitate on the trials of this file."""

    key: Key
    share: float  # of the signature's energy that they imitate
    hidden: tuple[Value, ...]  # for each amplitude: `value` 0, and as `std` the size that could stay hidden


@dataclass(frozen=True)
class Closure:
    """Gap of one channel on held-out trials without and with the causes, at the sample rate of the fit."""

    experiment: str
    channel: str
    units: str
    noise: float  # rms, in `units`
    before: float  # rms of the nominal model's (or the other simulator's) residual, in `units`
    after: float  # rms of the augmented model's residual, in `units`
    closed: float  # 1 − (after² − noise²) / (before² − noise²)
    closed_ci95: tuple[float, float]
    resolvable: bool  # whether the gap before stands out from the noise
    diverged: bool = False  # whether a forward simulation ran away; `closed` is then 0 and means nothing

    @property
    def stays_open(self) -> bool:
        """Whether a channel with a gap still misses more than its noise with the causes in.

        Simulated angles do not count, since forward simulation amplifies small errors.
        """
        judged = self.resolvable and not self.diverged and self.channel != "q"
        return judged and self.noise > 0 and self.after > MAX_CLOSED_RMS * self.noise

    @property
    def gets_worse(self) -> bool:
        """Whether the causes surely make the predictions of held-out trials worse."""
        return self.resolvable and not self.diverged and self.closed_ci95[1] < 0.0


def tolerated(line: Closure, relevance: Sequence[Relevance], tolerance: Mapping[str, float]) -> bool:
    """Whether the rest of a channel's gap, relative to its signal, is within the user's tolerance."""
    left = max(line.after**2 - line.noise**2, 0.0) ** 0.5
    signal = {(x.experiment, x.channel): x.signal for x in relevance}.get((line.experiment, line.channel), 0.0)
    return left <= tolerance.get(line.channel, -1.0) * signal


def still_open(
    closures: Sequence[Closure], relevance: Sequence[Relevance], tolerance: Mapping[str, float]
) -> list[Closure]:
    """Channels that stay open and whose rest the user does not tolerate."""
    return [x for x in closures if x.stays_open and not tolerated(x, relevance, tolerance)]


@dataclass(frozen=True)
class Left:
    """The part of one column's residual, with the causes in, that a smooth law could still explain."""

    experiment: str
    channel: str
    column: str
    energy: float  # of the explained part in squared standard deviations of the noise, less its expectation under noise
    by_variable: dict[str, float]  # the same for the features of one variable alone


@dataclass(frozen=True)
class Place:
    """A region of one trial's motion in which the nominal model misses a channel by much."""

    experiment: str
    trial: str
    channel: str
    site: str
    variable: str  # `time`, `q`, `qd` or `tendon_force`
    low: float  # of the variable, SI
    high: float
    share: float  # of the energy above noise in all places that stand out in the file


@dataclass(frozen=True)
class Change:
    """A nominal parameter whose value differs between two sessions, or between another simulator and the finger."""

    name: str
    group: str
    units: str
    before: float  # in the earlier session, or in the simulator
    before_std: float  # 0 for a simulator
    after: float
    after_std: float
    probability: float  # that it has changed


@dataclass(frozen=True)
class Posture:
    """Range of one joint in a proposed trial: rad, or m for a sliding joint."""

    joint: str
    low: float
    high: float
    moves: bool
    slides: bool


@dataclass(frozen=True)
class NextExperiment:
    """The trial that is expected to separate rivals best."""

    experiment: str
    lacking: bool  # whether the session has no trial of this experiment
    joint: str | None  # the driven joint, in an experiment of one joint
    tendon: str | None  # the pulled tendon, in an experiment with held joints
    postures: tuple[Posture, ...]
    tension: float | None  # N, the largest; None without tension
    steps: bool  # whether tension rises in steps
    released: bool  # whether it also falls in steps
    speed: float | None  # rad/s, 99th percentile of the fastest joint's; None where joints rest
    slides: bool  # whether some joint slides, so that its speed is in m/s
    times: int  # number of repeats
    evidence: float  # expected log evidence of all repeats together
    separates: tuple[str, ...]  # ids of effects


@dataclass(frozen=True, repr=False)
class Diagnosis:
    """Everything that a report shows.

    The verdict is `status` and `named`. The causes' shares are in `budget`, the shrinkage of each channel's gap in
    `closures`, and the model with the causes in `augmented`.
    """

    status: Status
    named: tuple[Key, ...]  # largest share first; under `ambiguous` the likeliest member of the first ambiguous set
    data: str  # file name
    specimen: str
    against: str | None  # file name of the earlier fit
    quick: bool
    tolerance: dict[str, float]  # by channel, as a share of its signal; empty where the user gave none
    budget: tuple[Cause, ...]  # largest share first
    unexplained: Unexplained
    channels: tuple[ChannelBudget, ...]
    relevance: tuple[Relevance, ...]
    not_judged: tuple[NotJudged, ...]
    closures: tuple[Closure, ...]
    where: tuple[Place, ...]
    candidates: tuple[Candidate, ...]  # most probable first
    none: float  # probability that no cause is at work
    unlisted: float  # probability that something is at work which the catalogue lacks
    ambiguous_sets: tuple[tuple[Key, ...], ...]
    next_experiment: NextExperiment | None
    absorbed: tuple[Absorbed, ...]
    changes: tuple[Change, ...]
    left: tuple[Left, ...]  # largest energy first
    nominal: Fit
    augmented: Fit  # the nominal fit where nothing is named
    problem: Problem | None  # recordings and residuals, for figures; None where they were dropped to save memory
    # Sentences on another simulator's predictions and the trials that they lack, or on an earlier fit.
    doubts: tuple[str, ...] = ()

    @property
    def blamed(self) -> set[Key]:
        """Causes that the verdict names, and all members of the sets that it cannot tell apart."""
        return set(self.named).union(*self.ambiguous_sets)

    def __repr__(self) -> str:
        named = ", ".join(f"{k.effect} at {'-'.join(k.site)}" for k in self.named) or "nothing named"
        return f"Diagnosis({self.data!r}: {self.status}; {named})"
