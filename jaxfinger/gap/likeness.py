"""Whether predictions look like the measurements at all, or like them after a user's mistake is mended.

Columns are compared about their means in each trial, since zeros of encoders and tares are arbitrary. The share of a
measured column's motion that predictions miss after a mend M is

    E(M) = ‖y − M p‖² / ‖y‖²

where M is a sign, the factor of a unit, another column, another trial or a shift in time. A simulator may be poor, so
that a mistake is only what explains nearly everything where the predictions as they are explain next to nothing. M is
a choice among a few, and is never fitted. Shares have no unit, so that the rule is the same for every machine.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import reduce
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfinger.data import Predictions, Session, Trial
from jaxfinger.data.findings import Report
from jaxfinger.data.predictions import predicted_at
from jaxfinger.data.schema import CHANNELS
from jaxfinger.data.units import TO_SI
from jaxfinger.errors import listed
from jaxfinger.experiments import EXPERIMENTS
from jaxfinger.gap.comparison import MIN_MISSED, Comparison, compare, comparisons

# E that a mend leaves. Predictions within 30 % of the measured motion are those of a poor simulator, mended.
MAX_MENDED = 0.1
# E that a mend leaves where one column shows it. A spring that turns the weight's torque round makes a simulator
# without it look wrong in sign, but within a tenth only by a rare chance, which two columns do not share.
MAX_MENDED_ALONE = 0.01
# Relative to the factor of a unit: predictions that are off by more may be in the unit, or have a gear in between.
MAX_UNIT_ERROR = 0.1
# Factor from which predictions are not too large by a wrong parameter.
MIN_CERTAIN_FACTOR = 30.0
# Share of the motion that the best factor explains. Friction that is left out can leave four tenths, unrelated motion
# none but by chance.
MIN_RELATED = 0.1
# E from which predictions miss too much to be called poor: they are four times too large.
MAX_MISSED = 9.0
# Share of the channel's largest rms in any trial. What moves less may be a side effect, which simulators leave out.
MIN_SIZE = 0.1
# Share of a trial by which predictions may be shifted: a larger part of the motion would be compared with nothing.
MAX_SHIFT = 0.25


class Mistake(NamedTuple):
    """A mistake that a mend explains."""

    places: tuple[tuple[str, int], ...]  # trial and column of each comparison that it explains
    left: float  # largest E that the mend leaves
    says: str  # of «predictions of A, B», with the mend
    can_be_meant: bool = False  # whether a simulator may predict so without a mistake

    @property
    def trials(self) -> tuple[str, ...]:
        """Names of the trials, in their order."""
        return tuple(dict.fromkeys(trial for trial, _ in self.places))

    @property
    def columns(self) -> tuple[int, ...]:
        """Indices of the columns."""
        return tuple(sorted({column for _, column in self.places}))

    @property
    def certain(self) -> bool:
        """Whether it can be nothing else."""
        return not self.can_be_meant and (self.left <= MAX_MENDED_ALONE or len(self.columns) > 1)


def check_likeness(session: Session, predictions: Predictions, report: Report) -> None:
    """Report predictions that do not look like the measurements: errors where it can be nothing else than a mistake.

    `predictions` fit the session's trials (`refuse_misfits`).
    """
    compared = list(comparisons(session, predictions))
    for channel in dict.fromkeys(c.channel for c in compared):
        mine = [c for c in compared if c.channel == channel]
        names = CHANNELS[channel].columns(session.finger)
        least = MIN_SIZE**2 * max(float(c.size.max()) for c in mine)
        mine = _report_still(session, mine, least, names, report)
        while mistake := _largest_mistake(session, predictions, mine):
            say = report.error if mistake.certain else report.warning
            said = f"predictions of {_named(mistake.columns, names)} {mistake.says}"
            for trial in mistake.trials:
                say(f"/trials/{trial}/{channel}", said if mistake.certain else f"{said}, or go on if it is meant so")
            mine = [_unexplained(c, mistake) for c in mine]
        _report_unlike(mine, least, names, report)
    _report_free_torque(session, predictions, report)


# What may be wrong ----------------------------------------------------------------------------------------------------
def _report_free_torque(session: Session, predictions: Predictions, report: Report) -> None:
    """Report a torque of the free finger that is zero throughout: no model explains a measured motion exactly."""
    for trial in session.select("VD.3"):
        torque = predictions.get(trial.name, {}).get("joint_torque")
        if torque is not None and np.isfinite(torque).any() and not np.nansum(np.abs(torque)):
            said = "predictions are zero throughout; give the torque that the measured motion would still need"
            report.error(f"/trials/{trial.name}/joint_torque", f"{said} from outside, or leave the channel out")


def _report_still(
    session: Session, compared: list[Comparison], least: float, names: tuple[str, ...], report: Report
) -> list[Comparison]:
    """Report columns that do not change while the measured ones move; return the comparisons without them."""
    large = [(c, c.moves & (c.size >= least)) for c in compared]
    moving = [(c, moves) for c, moves in large if moves.any()]
    # From hold to hold, a simulator without friction, spring and weight needs no torque.
    driven = any(not EXPERIMENTS[session.trials[c.trials[0]].experiment].stepped for c, _ in moving)
    nothing_told = driven and all(c.still[moves].all() for c, moves in moving)
    columns = {int(j) for c, moves in moving for j in np.flatnonzero(moves & c.still)}
    for c, moves in moving:
        if (moves & c.still).any():
            say = report.error if nothing_told else report.warning
            said = f"predictions of {_named(columns, names)} do not change while the measurements move"
            mend = "give what the simulator computes, or NaN throughout where it computes nothing"
            say(f"/trials/{c.trials[0]}/{c.channel}", f"{said}; {mend}")
    return [c.without(c.still) for c in compared]


def _largest_mistake(session: Session, predictions: Predictions, compared: list[Comparison]) -> Mistake | None:
    """The mistake that explains most comparisons; None where no mend explains any."""
    finders = (_exchanged_columns, _exchanged_trials, _turned_or_scaled, _shifted)
    found = [x for find in finders for x in find(session, predictions, compared)]
    return max(found, key=lambda x: len(x.places), default=None)


def _turned_or_scaled(session: Session, predictions: Predictions, compared: list[Comparison]) -> Iterator[Mistake]:
    """Columns that fit with another sign, in another unit, or with both."""
    found: dict[tuple[str, float], list[tuple[str, int, float, float]]] = defaultdict(list)
    for c in compared:
        for j in np.flatnonzero(c.unlike):
            slides = c.channel == "joint_torque" and session.finger.prismatic[j]
            si = {"tendon_excursion": "m", "joint_torque": "N" if slides else "N m"}.get(c.channel, "N")
            left = {factor: float(c.missed(factor)[j, j]) for factor in _factors(si)}
            factor = min(left, key=left.__getitem__)
            if left[factor] <= MAX_MENDED:
                found[si, factor].append((c.trials[0], int(j), float(c.told[j, j] / abs(c.cross[j, j])), left[factor]))
    as_they_are = {(session.trials[c.trials[0]].experiment, j) for c in compared for j in _fitting(c)}
    for (si, factor), places in found.items():
        left, columns = max(left for *_, left in places), {j for _, j, *_ in places}
        alone = len(columns) == 1 and left > MAX_MENDED_ALONE
        # Where most of the torque is left out, the rest may be like it and small. In one column that is no rare chance.
        if alone and abs(factor) > 1.0:
            continue
        surely = len(columns) > 1 and left <= MAX_MENDED_ALONE
        can_be_meant = factor > 1.0 / MIN_CERTAIN_FACTOR and not (factor > MIN_CERTAIN_FACTOR and surely)
        # A moment arm of the wrong sign turns the torque in the trials of one tendon.
        somewhere_right = any((session.trials[t].experiment, j) in as_they_are for t, j, *_ in places)
        can_be_meant |= somewhere_right
        times = float(np.median([times for *_, times, _ in places]))
        says = _turned_or_scaled_by(factor, si, times)
        yield Mistake(tuple(p[:2] for p in places), left, says, can_be_meant)


def _fitting(c: Comparison) -> list[int]:
    """Columns that are alike as they are."""
    return [int(j) for j in np.flatnonzero(np.diag(c.missed()) < MIN_MISSED)]


def _factors(si: str) -> dict[float, str]:
    """Factors that bring wrong signs and units to those of the session, with the name of the wrong unit."""
    units = {u.factor: name for name, u in reversed(TO_SI.items()) if u.si == si and u.factor != 1.0}
    units |= {TO_SI["deg"].factor: "deg"}
    units.pop(TO_SI["gon"].factor, None)  # Sizes do not tell it from degrees.
    units = {1.0 / f: name for f, name in units.items()} | units
    return {sign * f: name for sign in (1.0, -1.0) for f, name in ({1.0: si} | units).items() if sign * f != 1.0}


def _turned_or_scaled_by(factor: float, si: str, times: float) -> str:
    """What is wrong and how to mend it, where predictions are `times` as large as measured."""
    unit, wrong, mends = _factors(si)[factor], [], []
    if unit_is_sure := abs(times * abs(factor) - 1.0) < MAX_UNIT_ERROR:
        times = 1.0 / abs(factor)
    if factor < 0.0:
        wrong.append("have the opposite sign of the measurements")
        mends.append("turn the sign, which is to be that of the session")
    if abs(factor) != 1.0:
        size = f"{_number(times)} times as large" if times > 1.0 else f"{_number(1.0 / times)} times as small"
        wrong.append(f"are about {size} as measured")
        mend = "give the simulator angles in rad, not degrees" if unit == "deg" else f"give {si}, not {unit}"
        mends.append(mend if unit_is_sure else "look at units and gear ratios")
    return f"{' and '.join(wrong)}; {', and '.join(mends)}"


def _number(x: float) -> str:
    return f"{x:.0f}" if x >= 10.0 else f"{x:.2g}"


def _exchanged_columns(session: Session, predictions: Predictions, compared: list[Comparison]) -> Iterator[Mistake]:
    """Columns that fit if they are exchanged, in all trials together."""
    if not compared:
        return
    c = reduce(Comparison.__add__, compared)
    missed = c.missed()
    bad = np.flatnonzero(c.unlike)
    to = {int(j): int(np.argmin(missed[j])) for j in bad if missed[j].min() <= MAX_MENDED}
    # Each of them is the place of another one: copies of one good column do not count.
    while set(to) != set(to.values()):
        to = {j: i for j, i in to.items() if i in to and j in to.values()}
    if not to:
        return
    left = max(float(missed[j, i]) for j, i in to.items())
    names = CHANNELS[c.channel].columns(session.finger)
    pairs = ", ".join(f"the prediction of {names[i]} is like the measured {names[j]}" for j, i in to.items())
    turned = all(c.missed(-1.0)[j, j] <= MAX_MENDED for j in to)
    mend = "exchange them, or turn their signs, which would fit as well" if turned else "exchange them"
    places = tuple((x.trials[0], j) for x in compared for j in to if x.unlike[j])
    yield Mistake(places, left, f"look exchanged: {pairs}; {mend}")


def _exchanged_trials(session: Session, predictions: Predictions, compared: list[Comparison]) -> Iterator[Mistake]:
    """Trials of one experiment that fit if their predictions are exchanged."""
    bad = {c.trials[0]: c for c in compared if c.unlike.any()}
    like: dict[str, tuple[str, float]] = {}
    for name, c in bad.items():
        trial, unlike = session.trials[name], np.flatnonzero(c.unlike)
        measured = getattr(trial, c.channel)
        for other in bad:
            there = session.trials[other]
            if other == name or there.experiment != trial.experiment or len(there.time) != len(trial.time):
                continue
            told = predicted_at(predictions[other], c.channel, there, measured.shape)
            left = float(np.diag(compare(name, c.channel, measured, told).missed())[unlike].max())
            if left <= min(MAX_MENDED, like.get(name, ("", np.inf))[1]):
                like[name] = other, left
    while set(like) != {other for other, _ in like.values()}:
        sources = {other for other, _ in like.values()}
        like = {name: x for name, x in like.items() if x[0] in like and name in sources}
    if like:
        places = tuple((name, int(j)) for name in like for j in np.flatnonzero(bad[name].unlike))
        mend = "exchange the trials, or what the simulator reads of them"
        pairs = listed([f"those of {other} fit {name}" for name, (other, _) in like.items()])
        yield Mistake(places, max(left for _, left in like.values()), f"look exchanged: {pairs}; {mend}", True)


def _shifted(session: Session, predictions: Predictions, compared: list[Comparison]) -> Iterator[Mistake]:
    """Columns that fit if they are shifted in time. A gap may do the same, as a channel that is late."""
    found: dict[bool, list[tuple[str, int, float, float]]] = defaultdict(list)
    for c in compared:
        if c.unlike.any():
            trial = session.trials[c.trials[0]]
            measured = getattr(trial, c.channel)
            told = predicted_at(predictions[trial.name], c.channel, trial, measured.shape)
            for j in np.flatnonzero(c.unlike):
                shift, left = _best_shift(trial, measured[:, j], told[:, j])
                if left <= MAX_MENDED:
                    found[shift > 0.0].append((trial.name, int(j), shift, left))
    for late, places in found.items():
        shift = abs(float(np.median([shift for *_, shift, _ in places])))
        says = f"come about {shift:.2g} s too {'late' if late else 'early'}; give them at the session's times"
        yield Mistake(tuple(p[:2] for p in places), max(left for *_, left in places), says, True)


def _best_shift(trial: Trial, y: Float[np.ndarray, " N"], p: Float[np.ndarray, " N"]) -> tuple[float, float]:
    """Time by which p comes after y where E is least, s, and that E."""
    from scipy.signal import correlate  # slow to import, and few diagnoses have predictions

    rows = np.isfinite(y) & np.isfinite(p)
    if rows.sum() < 3:
        return 0.0, np.inf
    grid = np.linspace(trial.time[0], trial.time[-1], len(trial.time))
    y, p = (np.interp(grid, trial.time[rows], x[rows] - x[rows].mean()) for x in (y, p))
    n, most, one = len(grid), int(MAX_SHIFT * len(grid)), np.ones(len(grid))

    def over_lags(a: Float[np.ndarray, " N"], b: Float[np.ndarray, " N"]) -> Float[np.ndarray, " L"]:
        """Σ a(t) b(t + lag) over the samples that both have, for lags from −most to most."""
        return correlate(b, a, method="fft")[n - 1 - most : n + most]

    moved, told = over_lags(y**2, one), over_lags(one, p**2)
    missed = (moved - 2.0 * over_lags(y, p) + told) / np.maximum(moved, 1e-9 * float(y @ y))
    k = int(np.argmin(missed))
    return (k - most) * float(grid[1] - grid[0]), float(missed[k])


def _report_unlike(compared: list[Comparison], least: float, names: tuple[str, ...], report: Report) -> None:
    """Report columns that a constant would predict better, and that no factor would make alike, or only a small one."""
    if not compared:
        return
    together = reduce(Comparison.__add__, compared)
    missed, moved, told = (np.diag(x) for x in (together.missed(), together.moved, together.told))
    related = np.maximum(np.diag(together.cross), 0.0) ** 2 >= MIN_RELATED * moved * told
    unlike = np.where(related, missed > MAX_MISSED, missed > 1.0) & np.isfinite(missed) & (together.size >= least)
    for j in np.flatnonzero(unlike):
        said = (
            f"predictions of {names[j]} miss the measured motion by {_number(math.sqrt(missed[j]))} times its own size"
        )
        mend = "look at units, signs, columns and times, or go on if it is meant so"
        for c in compared:
            if 1.0 < c.missed()[j, j] < np.inf:
                report.warning(f"/trials/{c.trials[0]}/{c.channel}", f"{said}; {mend}")


# How it is said -------------------------------------------------------------------------------------------------------
def _named(columns: Iterable[int], names: tuple[str, ...]) -> str:
    return listed([names[j] for j in sorted(columns)])


def _unexplained(c: Comparison, mistake: Mistake) -> Comparison:
    """The comparison without the columns that a mistake explains."""
    explained = [j for trial, j in mistake.places if trial in c.trials]
    return c.without(np.isin(np.arange(len(c.moves)), explained))
