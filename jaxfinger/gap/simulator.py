"""Diagnosis of another simulator, of which only predictions y_s of the session's trials are known.

The emulator is the nominal model that comes nearest to the predictions. Measurements are replaced by y', which differs
from the emulator as they differ from the simulator:

    y' = ŷ(θ_s) + (y − y_s),   θ_s = argmin ‖W (y_s − ŷ(θ))‖

A diagnosis of y' then puts effects on top of the simulator and retunes its parameters, with the derivatives of the
emulator.
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxfinger.data import Predictions, Session
from jaxfinger.data.predictions import refuse_misfits
from jaxfinger.data.schema import CHANNELS
from jaxfinger.errors import UserError, listed
from jaxfinger.experiments import Stack, demean, predict_compiled, prepare
from jaxfinger.identify import Recipe
from jaxfinger.identify.fit_with_noise import first_noise
from jaxfinger.identify.noise import Noise
from jaxfinger.identify.nominal import GROUP_OF_TERM, free_groups, nominal_model
from jaxfinger.identify.parameters import Free, describe
from jaxfinger.identify.solve import solve
from jaxfinger.identify.sources import sources_of
from jaxfinger.identify.stages import STAGES
from jaxfinger.identify.start import start_values
from jaxfinger.model import Model

# Share of a channel's range: a term of the emulator that changes no prediction by more is not in the simulator. It is
# small beside a term that matters, and large beside what a fit makes of a term that the predictions lack.
MIN_TERM_SHARE = 0.003
# Share of a column's rms in one trial. No simulator knows the noise: predictions that miss less repeat the
# measurements, at most rounded to single precision, which has seven digits.
MAX_REPEATED = 1e-6


def emulate(
    session: Session, recipe: Recipe, stacks: dict[str, Stack], predictions: Predictions, coarse: int = 1
) -> tuple[Model, Recipe, dict[str, Stack]]:
    """Fit the emulator; return it, the recipe without the terms that the simulator lacks, and the stacks of y'.

    `stacks` are those of the measurements, `coarse` as in `prepare`.

    Raises:
        UserError: the file predicts no channel of the session's trials, or the predictions do not fit them or repeat
            the measurements.
    """
    refuse_misfits(session, predictions)
    difference = prepare(session, minus=predictions, coarse=coarse)
    difference = {e: s for e, s in difference.items() if any(np.any(m) for m in s.batch.mask.values())}
    if not difference:
        raise UserError(
            f"{session.file}: none of its trials is in the predictions; predict its trials under their own names"
        )
    simulated = {e: _simulated(stacks[e], s) for e, s in difference.items()}
    for e, s in difference.items():
        _refuse_repeated(session, simulated[e], s)
    noise = _measured_noise(stacks, simulated)
    emulator = _imitate(session, recipe, simulated, noise)
    lacks = {t for t in recipe.model.terms if t in GROUP_OF_TERM and _absent(emulator, GROUP_OF_TERM[t], simulated)}
    if lacks:
        terms = tuple(t for t in recipe.model.terms if t not in lacks)
        recipe = replace(recipe, model=replace(recipe.model, terms=terms))
        emulator = _imitate(session, recipe, simulated, noise)
    return emulator, recipe, {e: _rebased(s, _predict(emulator, simulated[e])) for e, s in difference.items()}


def _refuse_repeated(session: Session, simulated: Stack, difference: Stack) -> None:
    """Refuse columns that are the measured ones up to a constant, noise and all; UserError names the first."""
    for c, mask in difference.batch.mask.items():
        told, missed = (np.asarray(demean(b.y[c], mask)) for b in (simulated.batch, difference.batch))
        told, missed = (np.sqrt((x**2).sum(axis=2)) for x in (told, missed))
        repeats = (told > 0.0) & (missed <= MAX_REPEATED * told)
        for trial, columns in zip(difference.trials, repeats.T, strict=True):
            if columns.any():
                names = listed([CHANNELS[c].columns(session.finger)[k] for k in np.flatnonzero(columns)])
                raise UserError(
                    f"{session.file or 'the session'}: /trials/{trial}/{c}: predictions of {names} repeat the "
                    "measurements, noise and all; give what the simulator computes, and leave out what it is given"
                )


def _simulated(measured: Stack, difference: Stack) -> Stack:
    """Stack of the predictions, averaged as the measurements are: y_s = y − (y − y_s)."""
    mask = {c: measured.batch.mask[c] * difference.batch.mask[c] for c in difference.batch.mask}
    y = {c: (measured.batch.y[c] - difference.batch.y[c]) * mask[c] for c in mask}
    return replace(measured, batch=eqx.tree_at(lambda b: (b.y, b.mask), measured.batch, (y, mask)))


def _rebased(difference: Stack, predicted: dict) -> Stack:
    """Stack of y' = ŷ(θ_s) + (y − y_s)."""
    y = {c: (difference.batch.y[c] + predicted[c]) * difference.batch.mask[c] for c in difference.batch.y}
    return replace(difference, batch=eqx.tree_at(lambda b: b.y, difference.batch, y))


def _predict(model: Model, stack: Stack) -> dict:
    return predict_compiled(model, stack.batch.x, stack.experiment.channels)


def _measured_noise(stacks: dict[str, Stack], simulated: dict[str, Stack]) -> dict[tuple[str, str], Noise]:
    """White noise for the fit of the emulator: the largest that each channel's measurements have in any experiment.

    The predictions themselves show none where joints are held, nor does the measured torque of VD.3, which is zero
    throughout; weights from either would be without bound.
    """
    largest: dict[str, float] = {}
    for stack in stacks.values():
        for c in stack.experiment.channels:
            largest[c] = max(largest.get(c, 0.0), float(first_noise(stack, c, stack.batch.y[c]).std.max()))
    return {
        (e, c): Noise.white(np.full(len(y), largest[c]), "measured")
        for e, s in simulated.items()
        for c, y in s.batch.y.items()
    }


def _imitate(
    session: Session, recipe: Recipe, simulated: dict[str, Stack], noise: dict[tuple[str, str], Noise]
) -> Model:
    """The nominal model nearest to the predictions; masses and centres of mass keep the values of CAD.

    It is fitted stage by stage, as to recordings: what a simulator has and the nominal model lacks, such as another
    mass, then stays out of the moment arms. Last come the terms that no stage has read, by all predictions.
    """
    model = nominal_model(session, recipe)
    parameters, left = describe(model), free_groups(recipe)
    stages = [(s.reads, left & set(s.frees)) for s in STAGES.values() if s.name in simulated]
    left -= set().union(*(groups for _, groups in stages))
    everything = {e: s.experiment.channels for e, s in simulated.items()}
    for reads, groups in [*stages, (everything, left)]:
        free = np.array([i for i, p in enumerate(parameters) if p.group in groups and p.determinable], dtype=int)
        if free.size:
            sources = sources_of(simulated, {e: c for e, c in reads.items() if e in simulated}, noise, parameters)
            model = solve(start_values(model, free, parameters, sources), free, sources)[0]
    return model


def _absent(emulator: Model, group: str, simulated: dict[str, Stack]) -> bool:
    """Whether the emulator predicts the same without the parameters of a group."""
    positions = np.array([i for i, p in enumerate(describe(emulator)) if p.group == group])
    without = Free.at(emulator, positions).set(emulator, jnp.zeros(positions.size))
    for stack in simulated.values():
        full, less = _predict(emulator, stack), _predict(without, stack)
        for c, mask in stack.batch.mask.items():
            change = np.abs(np.asarray((full[c] - less[c]) * mask)).max(axis=(-2, -1))
            if np.any(change > MIN_TERM_SHARE * np.ptp(np.asarray(stack.batch.y[c]), axis=(-2, -1))):
                return False
    return True
