"""Validation: errors of a model's predictions by channel, in units for people, beside the noise floor.

Errors are those of block means at the rate at which a fit reads the experiment (20 Hz, or 50 Hz where it moves fast),
and so is the noise. Excursions are scored after the mean error of each trial is removed, since the zero of an encoder
is arbitrary. Their mean error, like the paper's, is relative to the trial's first sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from html import escape
from typing import NamedTuple

import numpy as np

from jaxfinger.compilation import one_blas_thread
from jaxfinger.data import Session, Trial, low_pass
from jaxfinger.data.schema import CHANNELS
from jaxfinger.errors import UserError, chosen, require
from jaxfinger.experiments import EXPERIMENTS, Stack, not_judged, prepare
from jaxfinger.experiments.table import highest_cutoff
from jaxfinger.identify.ahead import ahead, diverges, noise_of_simulation
from jaxfinger.identify.excursion_path import excursion_path
from jaxfinger.identify.fit import Fit
from jaxfinger.identify.force_slopes import Slope, force_slopes
from jaxfinger.identify.linearise import residuals_of
from jaxfinger.identify.noise import estimate
from jaxfinger.identify.nominal import free_groups
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.identify.predictions import model_for, simulate_trials
from jaxfinger.identify.readings import name_constant, readings_of
from jaxfinger.identify.sources import DEPENDS
from jaxfinger.identify.trial_coverage import name_unfitted
from jaxfinger.model import Model
from jaxfinger.progress import Progress
from jaxfinger.table import Table

# Cut-off, Hz, of the low-pass about which an angle of VD.3 scatters by the encoder's noise: twice the experiment's.
ENCODER_CUTOFF = 20.0


@dataclass(frozen=True)
class Score:
    """Error of one column of a channel over all trials of an experiment, in `units`."""

    experiment: str
    channel: str
    column: str  # joint, tendon or axis
    units: str
    rms: float
    mean: float
    noise: float | None  # standard deviation of the sensor at the same rate; None where it is unknown
    noise_source: str
    samples: int
    trials: int
    method: str = ""  # names the method where an experiment is judged in two ways


@dataclass(frozen=True, repr=False)
class Validation:
    """Scores of a fit on a session."""

    specimen: str
    session: str
    scores: tuple[Score, ...]
    slopes: tuple[Slope, ...] = ()
    messages: tuple[str, ...] = ()  # sentences on what was not validated, and why

    def __repr__(self) -> str:
        count = len(self.scores)
        return f"Validation({self.session!r}: {count} score{'s' * (count != 1)})"

    def _repr_html_(self) -> str:
        return f"<p>{escape(repr(self))}</p>{self.table()._repr_html_()}"

    def table(self) -> Table:
        """One row for each score: experiment, channel, column, rms of the error, noise, and units."""
        names = ("experiment", "channel", "column", "rms", "noise", "units")
        return Table({n: getattr(s, n) for n in names} for s in self.scores)

    def as_dict(self) -> dict:
        """Nested dictionaries, for JSON."""
        return asdict(self)


@one_blas_thread
def validate(
    fit: Fit,
    session: Session,
    experiments: str | Sequence[str] | None = None,
    progress: Progress = lambda message: None,
) -> Validation:
    """Score a fit on the trials of the recipe's validation experiments, or on those of `experiments`, one or more.

    >>> import jaxfinger as jf
    >>> validation = jf.validate(jf.load("fit.json"), jf.read("session.h5"))
    >>> validation
    Validation('session.h5': 1 score)
    >>> (row,) = validation.table()
    >>> f"{row['rms']:.1f} {row['units']} of error, {row['noise']:.1f} of it noise"
    '1.7 N of error, 0.7 of it noise'

    Raises:
        UserError: the session has no trial of these experiments, or is of another finger.
    """
    require(Fit, fit=fit)
    require(Session, session=session)
    model = model_for(fit, session)
    wanted = chosen(experiments or fit.recipe.validation.experiments, EXPERIMENTS, "experiment")
    stacks = readings_of(session, [t.name for t in session if t.experiment in wanted])
    if not stacks:
        has = ", ".join(dict.fromkeys(t.experiment for t in session)) or "no trials"
        raise UserError(
            f"{session.file or 'the session'}: has no trial of {', '.join(wanted)} to validate with, it has {has}; "
            "name its experiments with --experiments"
        )
    scores, slopes, messages = [], [], []
    for name, stack in stacks.items():
        progress(f"validating {name}")
        residuals, floors = _residuals(model, fit, stack)
        if name == "VD.1":
            scores += _integral_scores(model, session, stack, floors["tendon_excursion"])
        for channel, residual in residuals.items():
            scores += _channel_scores(session, stack, channel, residual, floors[channel])
        if name == "VD.2":
            slopes += force_slopes(fit, model, session, stack)
        if name == "VD.3" and not session.finger.n:
            messages.append("VD.3: without tendons nothing drives a simulation; its torques alone are judged")
        elif name == "VD.3":
            progress("simulating VD.3 forward in time")
            simulated, diverging = _simulation_scores(model, session, list(stack.trials))
            scores, messages = scores + simulated, messages + diverging
    depends = {g for e, stack in stacks.items() for c in stack.experiment.channels for g in DEPENDS.get((e, c), ())}
    groups = depends & free_groups(fit.recipe)
    messages += name_unfitted(describe(model), np.asarray(ravel(model)), fit.estimated, groups)
    messages += [f"the session has no {e} trial" for e in wanted if e not in stacks]
    messages += name_constant({e: stack.experiment.channels for e, stack in stacks.items()}, session)
    messages += [f"{experiment}: no {c} sample is judged: {why}" for experiment, c, why in not_judged(stacks)]
    return Validation(session.specimen, session.file, tuple(scores), tuple(slopes), tuple(messages))


# -- channels ---------------------------------------------------------------------------------------------------------


def _residuals(model: Model, fit: Fit, stack: Stack) -> tuple[dict, dict[str, tuple[np.ndarray, str]]]:
    """Residuals by channel, NaN where the mask is 0, and the noise floor of each channel with its source."""
    residuals, floors = {}, {}
    for c, raw in residuals_of(model, stack.batch, stack.experiment.channels).items():
        mask = np.asarray(stack.batch.mask[c]) > 0
        residuals[c] = np.where(mask, raw, np.nan)
        floors[c] = _floor(fit, stack, c, raw)
    return residuals, floors


def _floor(fit: Fit, stack: Stack, channel: str, residual: np.ndarray) -> tuple[np.ndarray, str]:
    """Noise of each column: from repeats or holds, else the fit's of the same sensor, else from fast residuals.

    The torque of a free finger is measured by no sensor: it is zero.
    """
    here = estimate(stack, channel, residual)
    if here.source == "residuals" and not (channel == "joint_torque" and stack.experiment.unloaded):
        rate = stack.experiment.rate
        for (experiment, c), noise in fit.noise.items():
            if c == channel and noise.source != "residuals" and _rate(experiment) == rate:
                return noise.std, f"{noise.source} of {experiment}"
    return here.std, "fast part of the residuals" if here.source == "residuals" else here.source


def _rate(experiment: str) -> float:
    return EXPERIMENTS[experiment].rate


def _channel_scores(session: Session, stack: Stack, channel: str, residual, floor) -> list[Score]:
    """One score for each measured column; `residual` is (columns, B, T), NaN where the mask is 0."""
    share = _share(session, stack, channel)
    sliding = f"inverse dynamics where it slides, {share:.0%} of the samples"
    methods = {"VD.1": "f(q) − f(q(0))", "VD.3": sliding if channel == "joint_torque" else ""}
    method = methods.get(stack.experiment.name, "")
    scores = []
    for k in range(len(columns(session, channel))):
        series = [r[np.isfinite(r)] for r in residual[k]]
        series = [r for r in series if r.size]
        if series:
            errors, noise = _errors(series, CHANNELS[channel].free_zero), (float(floor[0][k]), floor[1])
            scores.append(_score(session, stack.experiment.name, channel, k, errors, noise, method))
    return scores


def _share(session: Session, stack: Stack, channel: str) -> float:
    """Share of the trials' samples whose mask is 1, averaged over the columns."""
    whole = sum(session[name].duration for name in stack.trials) / stack.dt
    mask = np.asarray(stack.batch.mask[channel])
    return float(mask.sum() / (len(mask) * max(whole, 1.0)))


class _Errors(NamedTuple):
    """What the errors of one column come to, in SI units."""

    rms: float
    mean: float
    samples: int
    trials: int


def _errors(series: list[np.ndarray], zeroed: bool) -> _Errors:
    """Sum up the errors of several trials.

    With `zeroed`, the rms is about each trial's mean, and the mean is relative to each trial's first sample.
    """
    mean = float(np.mean(np.concatenate([r - r[0] if zeroed else r for r in series])))
    errors = np.concatenate([r - r.mean() if zeroed else r for r in series])
    return _Errors(float(np.sqrt(np.mean(errors**2))), mean, errors.size, len(series))


def _score(
    session: Session,
    experiment: str,
    channel: str,
    k: int,
    errors: _Errors,
    noise: tuple[float | None, str],
    method: str,
) -> Score:
    """Score of column k of a channel, in the unit for people. `noise`: its standard deviation, in SI, and source."""
    factor, units = display(session, channel, k)
    std, source = noise
    return Score(
        experiment,
        channel,
        columns(session, channel)[k],
        units,
        errors.rms * factor,
        errors.mean * factor,
        None if std is None or not np.isfinite(std) else std * factor,
        source,
        errors.samples,
        errors.trials,
        method,
    )


def columns(session: Session, channel: str) -> tuple[str, ...]:
    """Names of the columns of a channel."""
    return CHANNELS[channel].columns(session.finger)


def display(session: Session, channel: str, k: int) -> tuple[float, str]:
    """Factor from SI and unit for people of a column: mm, N mm, N and degrees; mm and N for a prismatic joint."""
    if channel in ("q", "joint_torque") and session.finger.prismatic[k]:
        return (1e3, "mm") if channel == "q" else (1.0, "N")
    return CHANNELS[channel].people


# -- VD.1: the paper's integral ---------------------------------------------------------------------------------------


def _integral_scores(model: Model, session: Session, stack: Stack, floor) -> list[Score]:
    """Scores of the paper's integral form of VD.1; errors are relative to the first sample."""
    paths = [excursion_path(model, session[name], stack.experiment.pace) for name in stack.trials]
    scores = []
    for k in range(session.finger.n):
        series = [(p.measured - p.integral)[:, k] for p in paths]
        series = [e[np.isfinite(e)] for e in series if np.isfinite(e).any()]
        if series:
            noise, method = (float(floor[0][k]), floor[1]), "∫ C q̇ dt, the paper's"
            scores.append(_score(session, "VD.1", "tendon_excursion", k, _errors(series, False), noise, method))
    return scores


# -- VD.3: forward simulation -----------------------------------------------------------------------------------------


def _simulation_scores(model: Model, session: Session, names: list[str]) -> tuple[list[Score], list[str]]:
    """Scores of simulated angles, from starts all along the trials and from the first sample, and messages."""
    stack = prepare(session, names, reduced=False)["VD.3"]
    paths = simulate_trials([model] * len(stack.trials), session, stack)
    scores = []
    for prediction in ahead(model, session, stack):
        for k in range(session.finger.m):
            series = [prediction.error[np.isfinite(prediction.error[:, k]), k]]
            if series[0].size:
                errors = _errors(series, False)._replace(trials=len(stack.trials))
                noise = _unless_it_diverges(prediction.noise[k], "sensors' noise in state and tension", session, k)
                method = f"{1e3 * prediction.horizon:.0f} ms ahead of the measured state"
                scores.append(_score(session, "VD.3", "q", k, errors, noise, method))
    simulated_noise = noise_of_simulation(model, session, stack)
    for k in range(session.finger.m):
        series = [session[name].q[:, k] - paths[name]["q"][:, k] for name in stack.trials]
        errors = _errors([e[np.isfinite(e)] for e in series], False)
        encoder = float(np.sqrt(np.mean([_encoder(session[name], k) ** 2 for name in stack.trials])))
        method = "simulated forward from the first sample"
        source = "sensors' noise in start, tension and reading"
        noise = _unless_it_diverges(float(np.hypot(encoder, simulated_noise[k])), source, session, k)
        scores.append(_score(session, "VD.3", "q", k, errors, noise, method))
    return scores, _divergence(session, paths)


def _unless_it_diverges(noise: float, source: str, session: Session, k: int) -> tuple[float | None, str]:
    """Noise of a simulation with its source; None where the noise is as large as the joint's range."""
    if noise < np.ptp(session.finger.limits[k]):
        return noise, source
    return None, "none: the sensors' noise alone makes the simulation diverge"


def _divergence(session: Session, paths: dict[str, dict[str, np.ndarray]]) -> list[str]:
    """One sentence for each trial whose whole simulation diverges."""
    out = []
    for name, path in paths.items():
        away = diverges(path["q"], session.finger.limits)
        if away.any():
            joints = ", ".join(j for j, yes in zip(session.finger.joint_names, away, strict=True) if yes)
            out.append(
                f"{name}: simulated from its first sample, {joints} diverges, and its angles say nothing; "
                "judge VD.3 by the errors a moment ahead"
            )
    return out


def _encoder(trial: Trial, k: int) -> float:
    """Standard deviation of an encoder's reading about its low-passed motion, rad."""
    step = float(np.median(np.diff(trial.time)))
    q = trial.q[:, k]
    return float(np.std(q - low_pass(trial.time, q, min(ENCODER_CUTOFF, highest_cutoff(step)))))
