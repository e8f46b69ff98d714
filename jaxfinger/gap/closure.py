"""Closure of the gap: rms before, rms after and noise on trials that no fit has seen, in physical units.

Each third of the trials is held out in turn, stratified by experiment, joint and tendon (`folds`).
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfinger.data.schema import CHANNELS, channel_units
from jaxfinger.effects import Scales
from jaxfinger.experiments import prepare
from jaxfinger.gap.augment import Fitted, Residuals, limits, residuals_by, without_shapes
from jaxfinger.gap.budget import DRAWS
from jaxfinger.gap.folds import FOLDS, equilibrated, fold_of_row, folds
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.result import Closure
from jaxfinger.gap.smooth_laws import measured_columns
from jaxfinger.identify.parameters import Free, ravel
from jaxfinger.identify.predictions import simulate_trials
from jaxfinger.identify.prior import Prior
from jaxfinger.identify.solve import bounded_least_squares
from jaxfinger.model import Model

# Mean square before, relative to that of the noise, from which a gap is said to close. With less, `closed` divides a
# difference of two nearly equal numbers, of which the noise is itself an estimate.
MIN_RESOLVABLE_RATIO = 1.1
# Of a trial's length. A repeat whose length differs by more was cut off, and is not compared.
MAX_LENGTH_DIFFERENCE = 0.1
MIN_SAMPLES = 10  # A trial with fewer held-out samples of a channel has no mean square worth the name.


def closures(problem: Problem, augmented: Fitted | None, forward: bool = True) -> tuple[Closure, ...]:
    """One line for each channel that is judged, and with `forward` one for the simulated angles of VD.3.

    Before is the nominal model refitted without the held-out trials, or the other simulator as it is; after is the
    augmented model refitted likewise. With None for `augmented` after equals before.
    """
    fold, of_row = folds(problem), fold_of_row(problem)
    # By experiment and channel, of each trial: mean squares before, after and of the noise, and the number of samples.
    energies: dict[tuple[str, str], list[np.ndarray]] = {}
    models, judged = [], {(e, c) for e, c, _, _ in measured_columns(problem)}
    for k in range(FOLDS):
        seen = {e: f != k for e, f in fold.items()}
        (before, old), (after, new) = _before_and_after(problem, augmented, of_row != k, seen)
        models.append((before, after))
        for e, c in (of for of in old if of in judged):
            mask = np.asarray(problem.stacks[e].batch.mask[c]) * ~seen[e]
            count = mask.sum(axis=(0, 2))
            energy = [_squares(m[e, c], mask, c) for m in (old, new)]
            noise = (mask * problem.noise[e, c].std[:, None, None] ** 2).sum(axis=(0, 2))
            values = np.stack([*(x / np.maximum(count, 1.0) for x in (*energy, noise)), count], axis=1)
            if np.any(count >= MIN_SAMPLES):
                energies.setdefault((e, c), []).extend(values[count >= MIN_SAMPLES])
    prismatic = problem.session.finger.prismatic
    lines = [_line(e, c, channel_units(c, prismatic), np.array(values)) for (e, c), values in energies.items()]
    if forward and "VD.3" in problem.stacks:
        values, diverged = _forward(problem, fold["VD.3"], models)
        lines.append(_line("VD.3", "q", channel_units("q", prismatic), np.array(values), diverged))
    return tuple(lines)


def _before_and_after(
    problem: Problem,
    augmented: Fitted | None,
    training: Bool[np.ndarray, " N"],
    seen: dict[str, Bool[np.ndarray, "_B _T"]],
) -> tuple[tuple[Model, Residuals], tuple[Model, Residuals]]:
    """Models before and after, refitted to the training rows (the samples `seen`), each with its residuals.

    A linear step may lead a shape too far. Of the refits with and without shapes the one that fits its own trials
    better is taken, and neither if the model before fits them best.
    """

    def refit(
        model: Model, free: Int[np.ndarray, " p"], J: Float[np.ndarray, "N p"], r: Float[np.ndarray, " N"]
    ) -> Model:
        return _refit(model, free, J, r, training, problem.prior, problem.scales)

    model = problem.simulator or refit(problem.nominal, problem.free, problem.J, problem.r)
    before = best = model, residuals_by(problem.sources, model)
    if augmented is None:
        return before, best
    whole, every = augmented.fit.model, augmented.fit.estimated
    shapeless = without_shapes(whole, every)
    for free in (every, shapeless) if len(shapeless) < len(every) else (every,):
        model = refit(whole, free, augmented.J[:, np.isin(every, free)], augmented.r)
        residuals = augmented.residuals_of(model)
        if _misfit(problem, residuals, seen) < _misfit(problem, best[1], seen):
            best = model, residuals
    return before, best


def _forward(
    problem: Problem, fold: Int[np.ndarray, "B T"], models: list[tuple[Model, Model]]
) -> tuple[list[tuple[float, ...]], bool]:
    """Mean squares of simulated q before, after and of the noise, with the number of samples; and whether any diverged.

    Each trial is simulated by the models (before, after) of the fold that holds out its first sample. Its noise is the
    spread between repeats of its motion.
    """
    session, trials = problem.session, problem.stacks["VD.3"].trials
    stack = prepare(session, list(trials), reduced=False)["VD.3"]
    pairs = [models[k] for k in fold[:, 0]]
    old = simulate_trials([before for before, _ in pairs], session, stack)
    new = dict(old)
    changed = [after is not before for before, after in pairs]
    if any(changed):
        # One call simulates all trials, so that one program is compiled. It needs a model of the same structure for
        # each: where a fold keeps the model before, another fold's model fills in and its paths are dropped.
        some = pairs[changed.index(True)][1]
        paths = simulate_trials([a if c else some for (_, a), c in zip(pairs, changed, strict=True)], session, stack)
        new |= {name: paths[name] for name, c in zip(trials, changed, strict=True) if c}
    out, diverged = [], False
    for name in trials:
        q = session[name].q
        motion = float(np.mean((q - q.mean(axis=0)) ** 2))
        # An error of half a turn is that of a simulation that has diverged.
        errors = [np.fmin(np.abs(q - np.nan_to_num(p[name]["q"], nan=np.inf)), np.pi) for p in (old, new)]
        squares = [float(np.nanmean(x**2)) for x in errors]
        diverged |= squares[1] > motion  # A finger that stands still would be nearer.
        out.append((*squares, _spread(problem, name), float(len(q))))
    return out, diverged


def _spread(problem: Problem, name: str) -> float:
    """Variance of q between repeats of a trial's motion, rad², half the mean square difference; 0 without repeats."""
    trial = problem.session[name]
    if trial.motion is None:
        return 0.0
    repeats = [t for t in problem.session if t.motion == trial.motion and t.experiment == "VD.3" and t.name != name]
    squares = [
        np.mean((trial.q[: len(t.q)] - t.q[: len(trial.q)]) ** 2)
        for t in repeats
        if abs(len(t.q) - len(trial.q)) < MAX_LENGTH_DIFFERENCE * len(trial.q)
    ]
    return float(0.5 * np.mean(squares)) if squares else 0.0


def _refit(model: Model, free, J, r, training, prior: Prior, scales: Scales) -> Model:
    """The model after one linear step that fits the training rows and the prior on its first parameters.

    Parameters stay within the bounds of their effects. Those that the training rows do not show stay within a few
    standard deviations of the whole fit (`folds.equilibrated`).
    """
    theta, mean, root = np.asarray(ravel(model))[free], np.asarray(prior.mean), np.asarray(prior.root)
    offset = root @ (theta[: len(mean)] - mean)
    J, kept, scale = equilibrated(J, np.pad(root, ((0, 0), (0, len(free) - len(mean)))))
    room = [(end - theta) / np.where(scale > 0.0, scale, 1.0) for end in limits(model, free, scales)]
    b = np.concatenate([-r[training], offset, np.zeros(len(free))])
    delta = bounded_least_squares(np.vstack([J[training], kept]), b, *room) * scale
    return Free.at(model, free).set(model, theta + delta)


def _misfit(problem: Problem, residuals: Residuals, keep: dict[str, Bool[np.ndarray, "_B _T"]]) -> float:
    """Sum of squares, in squared standard deviations of the noise, over the samples where `keep` is true."""
    total = 0.0
    for (e, c), x in residuals.items():
        mask = np.asarray(problem.stacks[e].batch.mask[c]) * keep[e]
        total += float(_squares(x / problem.noise[e, c].std[:, None, None], mask, c).sum())
    return total


def _squares(x: Float[np.ndarray, "columns B T"], mask: np.ndarray, channel: str) -> Float[np.ndarray, " B"]:
    """Sum of squares of each trial."""
    return (centred(x, mask, channel) ** 2).sum(axis=(0, 2))


def centred(x: Float[np.ndarray, "columns B T"], mask: np.ndarray, channel: str) -> Float[np.ndarray, "columns B T"]:
    """x with masked samples zero; excursions, whose zero is arbitrary, less the mean of each column and trial."""
    x = np.where(mask > 0, x, 0.0)
    if CHANNELS[channel].free_zero:
        x = (x - x.sum(axis=-1, keepdims=True) / np.maximum(mask.sum(axis=-1, keepdims=True), 1.0)) * (mask > 0)
    return x


def _line(e: str, c: str, units: str, values: Float[np.ndarray, "B 4"], diverged: bool = False) -> Closure:
    """rms values over the held-out trials, and the interval of `closed` from a bootstrap over trials.

    Columns of `values`: mean squares before, after and of the noise, and the number of samples.
    """
    rows = np.arange(len(values))
    sums = values * np.append(values[:, [3, 3, 3]], np.ones((len(values), 1)), axis=1)

    def averages(drawn: Int[np.ndarray, "D B"]) -> Float[np.ndarray, "3 D"]:
        """Mean squares before, after and of the noise, of each draw of trials."""
        total = sums[drawn].sum(axis=1)
        return total[:, :3].T / total[:, 3]

    def closed(before, after, noise):
        # A draw that lacks the trials with the gap has none, and `closed` is not defined for it.
        seen = before > MIN_RESOLVABLE_RATIO * noise
        return np.where(seen, 1.0 - (after - noise) / np.where(seen, before - noise, 1.0), np.nan)

    before, after, noise = (float(x) for x in averages(rows[None])[:, 0])
    value = float(closed(before, after, noise))
    resolvable = bool(np.isfinite(value))
    draws = closed(*averages(np.random.default_rng(0).choice(rows, (DRAWS, len(rows)))))
    draws = draws[np.isfinite(draws)]
    low, high = np.quantile(draws, (0.025, 0.975)) if resolvable and len(draws) else (0.0, 0.0)
    if diverged:
        value, low, high = 0.0, 0.0, 0.0
    return Closure(
        e,
        c,
        units,
        noise**0.5,
        before**0.5,
        after**0.5,
        float(np.clip(np.nan_to_num(value), -1.0, 1.0)),
        (float(np.clip(low, -1, 1)), float(np.clip(high, -1, 1))),
        resolvable and not diverged,
        diverged,
    )
