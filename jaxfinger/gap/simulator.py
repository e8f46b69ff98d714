"""Another simulator in the model's place: what is diagnosed is measurement minus its prediction.

The nominal model that imitates the predictions best, the emulator, tells which parameters and effects could change
them:

    y' = ŷ(θ_s) + (y − y_s),   θ_s = argmin ‖W (y_s − ŷ(θ))‖

A diagnosis of y' then puts every effect on top of the simulator, its parameters retuned.
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxfinger.data import Predictions, Session
from jaxfinger.errors import UserError
from jaxfinger.experiments import Stack, predict, prepare
from jaxfinger.identify import Recipe
from jaxfinger.identify.noise import Noise
from jaxfinger.identify.parameters import Free, describe
from jaxfinger.identify.solve import solve
from jaxfinger.identify.stages import (
    GROUP_OF_TERM,
    first_noise,
    free_groups,
    nominal_model,
    sources_of,
)
from jaxfinger.identify.start import start_values
from jaxfinger.model import Model

ABSENT = 0.003  # of a channel's range: a term of the emulator that moves nothing by more is not in the simulator


def emulate(
    session: Session, recipe: Recipe, stacks: dict[str, Stack], predictions: Predictions, coarse: int = 1
) -> tuple[Model, Recipe, dict[str, Stack]]:
    """The emulator, the recipe without the terms that the simulator lacks, and the stacks of y'.

    Raises:
        UserError: the file predicts no channel of the session's trials.
    """
    rest = prepare(session, minus=predictions, coarse=coarse)
    rest = {e: s for e, s in rest.items() if any(np.any(m) for m in s.batch.mask.values())}
    if not rest:
        raise UserError(
            f"{session.file}: none of its trials is in the predictions; predict its trials under their own names"
        )
    told = {e: _told(stacks[e], s) for e, s in rest.items()}
    noise = _measured_noise(stacks, told)
    emulator = _imitate(session, recipe, told, noise)
    lacks = {t for t in recipe.model.terms if t in GROUP_OF_TERM and _absent(emulator, GROUP_OF_TERM[t], told)}
    if lacks:
        terms = tuple(t for t in recipe.model.terms if t not in lacks)
        recipe = replace(recipe, model=replace(recipe.model, terms=terms))
        emulator = _imitate(session, recipe, told, noise)
    return emulator, recipe, {e: _rebased(s, _predict(emulator, told[e])) for e, s in rest.items()}


def _told(measured: Stack, rest: Stack) -> Stack:
    """The predictions, reduced as the measurements are: y − (y − y_s)."""
    mask = {c: measured.batch.mask[c] * rest.batch.mask[c] for c in rest.batch.mask}
    y = {c: (measured.batch.y[c] - rest.batch.y[c]) * mask[c] for c in mask}
    return replace(measured, batch=eqx.tree_at(lambda b: (b.y, b.mask), measured.batch, (y, mask)))


def _rebased(rest: Stack, predicted: dict) -> Stack:
    y = {c: (rest.batch.y[c] + predicted[c]) * rest.batch.mask[c] for c in rest.batch.y}
    return replace(rest, batch=eqx.tree_at(lambda b: b.y, rest.batch, y))


def _predict(model: Model, stack: Stack) -> dict:
    return eqx.filter_jit(predict)(model, stack.batch.x, stack.experiment.channels)


def _measured_noise(stacks: dict[str, Stack], told: dict[str, Stack]) -> dict[tuple[str, str], Noise]:
    """For each channel the largest noise that its measurements have in any experiment. Predictions themselves have none
    where joints are held, and neither has the measured torque of VD.3, which is nothing throughout.
    """
    most: dict[str, float] = {}
    for stack in stacks.values():
        for c in stack.experiment.channels:
            most[c] = max(most.get(c, 0.0), float(first_noise(stack, c, stack.batch.y[c]).std.max()))
    return {
        (e, c): Noise.white(np.full(len(y), most[c]), "measured") for e, s in told.items() for c, y in s.batch.y.items()
    }


def _imitate(session: Session, recipe: Recipe, told: dict[str, Stack], noise: dict[tuple[str, str], Noise]) -> Model:
    """The nominal model nearest to the predictions; masses and centres of mass stay as CAD has them."""
    model = nominal_model(session, recipe)
    parameters = describe(model)
    reads = {e: s.experiment.channels for e, s in told.items()}
    groups = free_groups(recipe)
    free = np.array([i for i, p in enumerate(parameters) if p.group in groups and p.determinable], dtype=int)
    sources = sources_of(told, reads, noise, parameters)
    return solve(start_values(model, free, parameters, sources), free, sources)[0]


def _absent(emulator: Model, group: str, told: dict[str, Stack]) -> bool:
    """Whether the predictions stay the same without a group of the emulator's parameters."""
    positions = np.array([i for i, p in enumerate(describe(emulator)) if p.group == group])
    without = Free.at(emulator, positions).set(emulator, jnp.zeros(positions.size))
    for stack in told.values():
        full, less = _predict(emulator, stack), _predict(without, stack)
        for c, mask in stack.batch.mask.items():
            change = np.abs(np.asarray((full[c] - less[c]) * mask)).max(axis=(-2, -1))
            if np.any(change > ABSENT * np.ptp(np.asarray(stack.batch.y[c]), axis=(-2, -1))):
                return False
    return True
