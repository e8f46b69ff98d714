"""How far the gap shrinks: before, after and noise on trials that no fit has seen, in physical units.

Trials are held out in turn, stratified by experiment, joint and tendon.
"""

import jax
import numpy as np
from jaxtyping import Float

from jaxfinger.data.schema import channel_units
from jaxfinger.effects import Scales
from jaxfinger.experiments import prepare
from jaxfinger.gap.augment import Fitted, Missed, limits, missed_by, without_shapes
from jaxfinger.gap.folds import FOLDS, equilibrated, fold_of_row, folds
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.result import Closure
from jaxfinger.identify.parameters import Free, ravel
from jaxfinger.identify.predictions import simulate_trials
from jaxfinger.identify.prior import Prior
from jaxfinger.identify.solve import bounded_least_squares
from jaxfinger.model import Model

RESOLVABLE = 1.1  # mean square before over that of the noise, from which on a gap can be said to close


def closures(problem: Problem, augmented: Fitted | None, forward: bool = True) -> tuple[Closure, ...]:
    """One line an experiment and channel, and one for q of VD.3, simulated forward, unless `forward` is false.

    Without `augmented` nothing closes.
    """
    fold, of_row = folds(problem), fold_of_row(problem)
    tried: list[np.ndarray] = []
    if augmented is not None:
        whole, every = augmented.fit.model, augmented.fit.estimated
        shapeless = without_shapes(whole, every)
        tried = [every, shapeless] if len(shapeless) < len(every) else [every]
    energies: dict[tuple[str, str], list[np.ndarray]] = {}  # of each trial: before, after, noise, samples
    models = []
    for k in range(FOLDS):
        training, seen = of_row != k, {e: f != k for e, f in fold.items()}
        refitted = _refit(problem.nominal, problem.free, problem.J, problem.r, training, problem.prior, problem.scales)
        before = after = problem.simulator or refitted
        old = new = missed_by(problem.sources, before)
        # A linear step may lead a shape too far: of refits with shapes and without, that which fits its own trials
        # better; a model that does not hold up without the others has closed nothing.
        for free in tried:
            assert augmented is not None
            columns = augmented.J[:, np.isin(every, free)]
            model = _refit(whole, free, columns, augmented.r, training, problem.prior, problem.scales)
            missed = augmented.missed(model)
            if _misfit(problem, missed, seen) < _misfit(problem, new, seen):
                after, new = model, missed
        models.append((before, after))
        for e, c in old:
            mask = np.asarray(problem.stacks[e].batch.mask[c]) * ~seen[e]
            count = mask.sum(axis=(0, 2))
            energy = [_squares(m[e, c], mask, c) for m in (old, new)]
            noise = (mask * problem.noise[e, c].std[:, None, None] ** 2).sum(axis=(0, 2))
            values = np.stack([*(x / np.maximum(count, 1.0) for x in (*energy, noise)), count], axis=1)
            if np.any(count >= 10):
                energies.setdefault((e, c), []).extend(values[count >= 10])
    prismatic = problem.session.finger.prismatic
    lines = [_line(e, c, channel_units(c, prismatic), np.array(values)) for (e, c), values in energies.items()]
    if forward and "VD.3" in problem.stacks:
        values, runs_away = _forward(problem, fold["VD.3"], models)
        lines.append(_line("VD.3", "q", channel_units("q", prismatic), np.array(values), runs_away))
    return tuple(lines)


def _forward(problem: Problem, fold: np.ndarray, models: list[tuple[Model, Model]]):
    """Mean squares of q, simulated forward by the models that have not seen (the start of) a trial; the noise is the
    spread between repeats of its motion.
    """
    session, trials = problem.session, problem.stacks["VD.3"].trials
    stack = prepare(session, list(trials), reduced=False)["VD.3"]
    pairs = [models[k] for k in fold[:, 0]]
    old = simulate_trials([before for before, _ in pairs], session, stack)
    new = dict(old)
    changed = [after is not before for before, after in pairs]
    if any(changed):
        # All in one call: another trial's model stands in where the fold's choice has changed nothing.
        some = pairs[changed.index(True)][1]
        paths = simulate_trials([a if c else some for (_, a), c in zip(pairs, changed, strict=True)], session, stack)
        new |= {name: paths[name] for name, c in zip(trials, changed, strict=True) if c}
    out, runs_away = [], False
    for name in trials:
        q = session[name].q
        moves = float(np.mean((q - q.mean(axis=0)) ** 2))
        missed = [np.fmin(np.abs(q - np.nan_to_num(p[name]["q"], nan=np.inf)), np.pi) for p in (old, new)]
        squares = [float(np.nanmean(x**2)) for x in missed]
        runs_away |= squares[1] > moves  # worse than a finger that stands still
        out.append((*squares, _spread(problem, name), float(len(q))))
    return out, runs_away


def _spread(problem: Problem, name: str) -> float:
    """Mean square of what tells a trial's q from its repeats', rad²; 0 without repeats."""
    trial = problem.session[name]
    if trial.motion is None:
        return 0.0
    repeats = [t for t in problem.session if t.motion == trial.motion and t.experiment == "VD.3" and t.name != name]
    squares = [
        np.mean((trial.q[: len(t.q)] - t.q[: len(trial.q)]) ** 2)
        for t in repeats
        if abs(len(t.q) - len(trial.q)) < 0.1 * len(trial.q)
    ]
    return float(0.5 * np.mean(squares)) if squares else 0.0


def _refit(model: Model, free, J, r, training, prior: Prior, scales: Scales) -> Model:
    """The model refitted to the training rows and the prior on its first parameters; what neither sees stays within a
    few deviations of the whole fit.
    """
    theta, mean, root = np.asarray(ravel(model))[free], np.asarray(prior.mean), np.asarray(prior.root)
    pull = root @ (theta[: len(mean)] - mean)
    J, kept, scale = equilibrated(J, np.pad(root, ((0, 0), (0, len(free) - len(mean)))))
    room = [(end - theta) / np.where(scale > 0.0, scale, 1.0) for end in limits(model, free, scales)]
    b = np.concatenate([-r[training], pull, np.zeros(len(free))])
    delta = bounded_least_squares(np.vstack([J[training], kept]), b, *room) * scale
    return Free.at(model, free).set(model, jax.device_put(theta + delta))


def _misfit(problem: Problem, missed: Missed, keep: dict[str, np.ndarray]) -> float:
    """Sum of squares over the samples to keep, (B, T) of every experiment, in the noise of a sample."""
    total = 0.0
    for (e, c), x in missed.items():
        mask = np.asarray(problem.stacks[e].batch.mask[c]) * keep[e]
        total += float(_squares(x / problem.noise[e, c].std[:, None, None], mask, c).sum())
    return total


def _squares(missed: Float[np.ndarray, "columns B T"], mask, channel: str) -> Float[np.ndarray, " B"]:
    """Sum of squares by trial; of excursions, which start anywhere, about their mean."""
    x = missed * mask
    if channel == "tendon_excursion":
        x = (x - x.sum(axis=-1, keepdims=True) / np.maximum(mask.sum(axis=-1, keepdims=True), 1.0)) * mask
    return (x**2).sum(axis=(0, 2))


def _line(e: str, c: str, units: str, values: np.ndarray, runs_away: bool = False) -> Closure:
    """rms over the held-out trials, and the interval of `closed` from a bootstrap over trials."""
    rng = np.random.default_rng(0)
    weight = values[:, 3]

    def closed(rows):
        before, after, noise = (np.average(values[rows, k], weights=weight[rows]) for k in range(3))
        # What has no gap, as a draw without the trials that show it, says nothing of how far it closes.
        return 1.0 - (after - noise) / (before - noise) if before > RESOLVABLE * noise else np.nan

    rows = np.arange(len(values))
    before, after, noise = (float(np.average(values[:, k], weights=weight)) for k in range(3))
    value = closed(rows)
    resolvable = bool(np.isfinite(value))
    draws = np.array([closed(rng.choice(rows, len(rows))) for _ in range(400)])
    draws = draws[np.isfinite(draws)]
    low, high = np.quantile(draws, (0.025, 0.975)) if resolvable and len(draws) else (0.0, 0.0)
    if runs_away:
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
        resolvable and not runs_away,
        runs_away,
    )
