"""The least squares behind every fit, where a full step leads astray."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from jaxfinger.effects import CatalogueEffect
from jaxfinger.errors import UserError
from jaxfinger.experiments import predict, prepare
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.identify.solve import solve
from jaxfinger.identify.stages import first_noise, sources_of

EXPERIMENT, CHANNEL = "ID.3-static", "joint_torque"


class Logarithm(CatalogueEffect):
    """10 N mm · log(1 + a): from a = 0, a Newton step towards a = −0.95 lands where no logarithm is."""

    ID: ClassVar = "logarithm"
    PLACE: ClassVar = "joint"
    AMPLITUDES: ClassVar = {"a": ("1", 0.5, True)}
    SHOWS: ClassVar = {EXPERIMENT: (CHANNEL,)}

    a: Float[Array, ""]

    def torque(self, x, memory, h):
        return h.at[self.index[0]].add(1e-2 * jnp.log1p(self.a))


@pytest.fixture(scope="module")
def problem(short, short_truth):
    """A model with the effect at a = 0, its position in the flat vector, and data of a = −0.95 without noise."""
    stack = prepare(short, [t.name for t in short if t.experiment == EXPERIMENT])[EXPERIMENT]
    effect = Logarithm.at(short_truth.model.finger, ("MCP",), a=0.0)
    model = eqx.tree_at(lambda m: m.effects, short_truth.model, (effect,), is_leaf=lambda v: isinstance(v, tuple))
    parameters = describe(model)
    (position,) = (i for i, p in enumerate(parameters) if p.group == "effects")
    true = eqx.tree_at(lambda m: m.effects[0].a, model, jnp.asarray(-0.95))
    y = predict(true, stack.batch.x, (CHANNEL,))[CHANNEL] * stack.batch.mask[CHANNEL]
    noise = {(EXPERIMENT, CHANNEL): first_noise(stack, CHANNEL)}
    batch = eqx.tree_at(lambda b: b.y[CHANNEL], stack.batch, y)
    reads = {EXPERIMENT: (CHANNEL,)}
    source = sources_of({EXPERIMENT: stack}, reads, noise, parameters)[EXPERIMENT]
    return model, position, source._replace(batch=batch)


def test_a_step_to_where_the_model_is_not_defined_is_halved(problem):
    model, position, source = problem
    found, solution = solve(model, np.array([position]), {EXPERIMENT: source})
    assert solution.converged
    assert float(ravel(found)[position]) == pytest.approx(-0.95, abs=1e-3)


def test_a_start_where_the_model_is_not_defined_is_refused(problem):
    model, position, source = problem
    astray = eqx.tree_at(lambda m: m.effects[0].a, model, jnp.asarray(-2.0))
    with pytest.raises(UserError, match="nothing finite where the fit starts"):
        solve(astray, np.array([position]), {EXPERIMENT: source})
