"""Least squares of a fit on problems where a full Gauss–Newton step fails."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Float

from jaxfinger.effects import CatalogueEffect, amplitude
from jaxfinger.errors import UserError
from jaxfinger.experiments import predict, prepare
from jaxfinger.identify.fit_with_noise import first_noise
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.identify.solve import KINK_TOLERANCE, ROUGH_TOLERANCE, bounded_least_squares, solve
from jaxfinger.identify.sources import sources_of

EXPERIMENT, CHANNEL = "ID.3-static", "joint_torque"


class Bend(CatalogueEffect):
    """Torque of 10 N mm · law(a) at a joint."""

    PLACE: ClassVar = "joint"

    a: Float[Array, ""] = amplitude("1", 0.5, signed=True)

    def torque(self, x, memory, h):
        return h.at[self.index[0]].add(1e-2 * self.law(self.a))


class Logarithm(Bend):
    """log(1 + a): a Newton step from a = 0 towards a = −0.95 leaves the domain of the logarithm."""

    ID: ClassVar = "logarithm"
    law = staticmethod(jnp.log1p)


class Kink(Bend):
    """a above zero and −0.8 a below, with its minimum at the kink."""

    ID: ClassVar = "kink"

    @staticmethod
    def law(a):
        return jnp.maximum(a, -0.8 * a)


class Overshoot(Bend):
    """a and a − 0.95 a² in turn (Dennis and Schnabel 1996, §10.2).

    With data −1 and 1 every Gauss–Newton step ends nearly as far beyond the minimum as it started before it.
    """

    ID: ClassVar = "overshoot"

    def torque(self, x, memory, h):
        law = jnp.where(jnp.sin(3.0 * x.time) > 0.0, self.a, self.a - 0.95 * self.a**2)
        return h.at[self.index[0]].add(1e-2 * law)


def _problem_of(kind, short, short_truth, start, true, shift=0.0):
    """Model with the effect at `start`, the effect's position in the flat vector, and noiseless data.

    The data are those of the effect at `true`, plus `shift` N m at its joint.
    """
    stack = prepare(short, [t.name for t in short if t.experiment == EXPERIMENT])[EXPERIMENT]
    effect = kind.at(short_truth.model.finger, ("MCP",), a=start)
    model = eqx.tree_at(lambda m: m.effects, short_truth.model, (effect,), is_leaf=lambda v: isinstance(v, tuple))
    parameters = describe(model)
    (position,) = (i for i, p in enumerate(parameters) if p.group == "effects")
    at_truth = eqx.tree_at(lambda m: m.effects[0].a, model, jnp.asarray(true))
    y = predict(at_truth, stack.batch.x, (CHANNEL,))[CHANNEL].at[effect.index[0]].add(shift)
    noise = {(EXPERIMENT, CHANNEL): first_noise(stack, CHANNEL, stack.batch.y[CHANNEL])}
    batch = eqx.tree_at(lambda b: b.y[CHANNEL], stack.batch, y * stack.batch.mask[CHANNEL])
    reads = {EXPERIMENT: (CHANNEL,)}
    source = sources_of({EXPERIMENT: stack}, reads, noise, parameters)[EXPERIMENT]
    return model, position, source._replace(batch=batch)


@pytest.fixture(scope="module")
def problem(short, short_truth):
    return _problem_of(Logarithm, short, short_truth, start=0.0, true=-0.95)


def test_a_step_to_where_the_model_is_not_defined_is_cut(problem):
    model, position, source = problem
    found, solution = solve(model, np.array([position]), {EXPERIMENT: source})
    assert solution.converged
    assert float(ravel(found)[position]) == pytest.approx(-0.95, abs=1e-3)


def _overshoot(first, short, short_truth):
    """Problem whose data are `first` and −`first` in turn, in the unit of `Bend`."""
    model, position, source = _problem_of(Overshoot, short, short_truth, start=0.3, true=0.0)
    joint = source.batch.y[CHANNEL][model.effects[0].index[0]]
    side = 1e-2 * jnp.where(jnp.sin(3.0 * source.batch.x.time) > 0.0, first, -first)
    shifted = source.batch.y[CHANNEL].at[model.effects[0].index[0]].set(joint + side) * source.batch.mask[CHANNEL]
    return model, position, source._replace(batch=eqx.tree_at(lambda b: b.y[CHANNEL], source.batch, shifted))


def test_steps_that_overshoot_settle_in_the_light_of_those_before(short, short_truth):
    model, position, source = _overshoot(-1.0, short, short_truth)
    found, solution = solve(model, np.array([position]), {EXPERIMENT: source}, tolerance=ROUGH_TOLERANCE)
    assert solution.converged
    assert solution.linearisations <= 10
    settled, exact = solve(model, np.array([position]), {EXPERIMENT: source})
    std = _std(exact, source, position)
    assert abs(float(ravel(found)[position] - ravel(settled)[position])) < 2 * ROUGH_TOLERANCE * std


@pytest.mark.parametrize(("steps", "near"), [(9, True), (6, False)])
def test_a_search_out_of_steps_has_converged_where_its_last_ones_tell_that_the_optimum_is_near(
    steps, near, short, short_truth, monkeypatch
):
    """With these data every step is a third of the one before it, on the same side of the optimum."""
    model, position, source = _overshoot(0.3, short, short_truth)
    settled, exact = solve(model, np.array([position]), {EXPERIMENT: source})
    monkeypatch.setattr("jaxfinger.identify.solve.MAX_STEPS", steps)
    found, solution = solve(model, np.array([position]), {EXPERIMENT: source})
    assert solution.linearisations == steps < exact.linearisations
    assert solution.converged == near
    away = abs(float(ravel(found)[position] - ravel(settled)[position]))
    assert (away < KINK_TOLERANCE * _std(exact, source, position)) == near


def _std(solution, source, position) -> float:
    """Standard deviation of one free parameter."""
    J = solution.linearised[EXPERIMENT].jacobian[..., list(source.positions).index(position)]
    return float(np.linalg.norm(J)) ** -1.0


@pytest.mark.parametrize(("low", "high", "end"), [(-0.5, 2.0, -0.5), (0.0, 2.0, 0.0), (-2.0, 2.0, -0.95)])
def test_what_has_limits_ends_within_them(problem, low, high, end):
    model, position, source = problem
    limits = np.array([low]), np.array([high])
    found, solution = solve(model, np.array([position]), {EXPERIMENT: source}, limits=limits)
    assert solution.converged
    assert float(ravel(found)[position]) == pytest.approx(end, abs=1e-3)


def test_a_start_where_the_model_is_not_defined_is_refused(problem):
    model, position, source = problem
    astray = eqx.tree_at(lambda m: m.effects[0].a, model, jnp.asarray(-2.0))
    with pytest.raises(UserError, match="nothing finite where the fit starts"):
        solve(astray, np.array([position]), {EXPERIMENT: source})


def test_a_kink_within_a_tenth_of_a_standard_deviation_ends_the_search(short, short_truth):
    model, position, source = _problem_of(Kink, short, short_truth, start=1.0, true=0.0)
    _, smooth = solve(model, np.array([position]), {EXPERIMENT: source})
    std = _std(smooth, source, position)
    unreachable = _problem_of(Kink, short, short_truth, start=1.0, true=0.0, shift=-3e-4 * std)
    found, solution = solve(unreachable[0], np.array([position]), {EXPERIMENT: unreachable[2]})
    assert solution.converged
    assert solution.linearisations <= 6
    assert abs(float(ravel(found)[position])) < 0.1 * std
    assert float(jnp.sum(solution.linearised[EXPERIMENT].white ** 2)) == pytest.approx(2.0 * solution.cost)


@given(st.integers(0, 10_000))
@settings(max_examples=50, deadline=None)
def test_a_bounded_step_is_the_lowest_within_its_bounds(seed):
    rng = np.random.default_rng(seed)
    A, b = rng.standard_normal((5, 3)) * [1.0, 1e-3, 1e3], rng.standard_normal(5)
    low, high = -rng.uniform(0.0, 1.0, 3), rng.uniform(0.0, 1.0, 3)
    low[0], high[1] = 0.0, 0.0  # at a bound
    x = bounded_least_squares(A, b, low, high)
    assert np.all((low - 1e-9 <= x) & (x <= high + 1e-9))
    others = rng.uniform(low, high, (200, 3))
    assert np.linalg.norm(A @ x + b) <= np.linalg.norm(others @ A.T + b, axis=1).min() + 1e-9
