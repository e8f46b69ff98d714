"""Routes and specimens: derivatives, energies, random and polynomial fingers."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxfinger.model import Motion, external_torque, rigid_body
from jaxfinger.synthetic import paper_finger, polynomial_finger, random_finger, specimen_of, true_model
from jaxfinger.synthetic.recipe import DescribedFinger, JointTerms, Terms
from jaxfinger.synthetic.routes import WrappedRoute
from tests.data.conftest import make_finger

LAYOUTS = st.sampled_from(["planar", "abduction", "spatial"])
TENDONS = st.sampled_from(["antagonists", "fewest"])


def _inside(specimen, count, seed=0):
    low, high = specimen.description.limits.T
    return np.random.default_rng(seed).uniform(low[:, None] + 1e-3, high[:, None] - 1e-3, (low.size, count))


def _check_moment_arm(specimen, q):
    h = 1e-6
    C = specimen.moment_arm(q)
    for i in range(len(q)):
        step = np.zeros_like(q)
        step[i] = h
        numeric = (specimen.excursion(q + step) - specimen.excursion(q - step)) / (2 * h)
        assert C[:, i] == pytest.approx(numeric, abs=2e-8)


@pytest.mark.parametrize("specimen", [paper_finger(True), polynomial_finger(paper_finger())], ids=lambda s: s.name)
def test_moment_arm_is_the_derivative_of_the_excursion(specimen):
    _check_moment_arm(specimen, _inside(specimen, 200))
    assert specimen.excursion(np.zeros((3, 1))) == pytest.approx(0.0, abs=1e-15)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**16), m=st.integers(1, 7), layout=LAYOUTS, tendons=TENDONS)
def test_random_fingers_hold_together(seed, m, layout, tendons):
    specimen = random_finger(seed, m, layout, tendons)
    q = _inside(specimen, 20, seed)
    _check_moment_arm(specimen, q)
    d = specimen.description
    assert (d.m, d.n) == (m, 2 * m if tendons == "antagonists" else m + 1)
    assert np.linalg.norm(d.axis, axis=1) == pytest.approx(np.ones(m))
    assert (np.abs(specimen.moment_arm(q)).max(axis=2) > 0).tolist() == d.crosses.tolist()
    assert np.abs(specimen.moment_arm(q)).max() < 0.02
    assert (specimen.coulomb(q) > 0).all()


@settings(max_examples=50, deadline=None)
@given(
    radius=st.floats(2e-3, 7e-3),
    x=st.floats(-1e-3, 1e-3),
    z=st.floats(-1e-3, 1e-3),
    height=st.floats(-3e-3, 3e-3),
    dorsal=st.booleans(),
    on_distal=st.booleans(),
)
def test_wrapped_path_is_no_shorter_than_the_straight_one_and_clears_the_surface(
    radius, x, z, height, dorsal, on_distal
):
    wrapped = WrappedRoute((-15e-3, height), (14e-3, height), (x, z), radius, dorsal, on_distal)
    straight = WrappedRoute((-15e-3, height), (14e-3, height))
    q = np.linspace(0.0, 1.4, 200)
    length = wrapped._length_at_zero - wrapped.excursion(q)
    chord = straight._length_at_zero - straight.excursion(q)
    assert (length >= chord - 1e-12).all()
    assert np.abs(np.diff(wrapped.moment_arm(q))).max() < 5e-4  # lifts off without a jump


@pytest.mark.parametrize("specimen", [paper_finger(True), polynomial_finger(paper_finger())], ids=lambda s: s.name)
def test_elastic_torque_is_the_gradient_of_its_energy(specimen):
    q = _inside(specimen, 50)
    gradient = jax.vmap(jax.grad(specimen.elastic_energy), in_axes=1, out_axes=1)(jnp.asarray(q))
    assert specimen.elastic(q) == pytest.approx(np.asarray(gradient), abs=1e-12)


def test_passive_tendon_couples_pip_and_dip_only_where_it_is_taut():
    with_it, without = paper_finger(True), paper_finger(False)
    slack = np.deg2rad([[30.0], [40.0], [35.0]])
    taut = np.deg2rad([[30.0], [90.0], [10.0]])
    assert np.array_equal(with_it.elastic(slack), without.elastic(slack))
    pull = (with_it.elastic(taut) - without.elastic(taut))[:, 0]
    assert pull[0] == 0.0
    assert pull[1] > 0 > pull[2]  # resists flexion of the PIP, flexes the DIP


def test_polynomial_finger_is_exactly_the_nominal_model():
    specimen = polynomial_finger(paper_finger())
    model = true_model(specimen)
    q = _inside(specimen, 30)
    active = specimen.description.active
    assert np.asarray(model.moment_arm.excursion(jnp.asarray(q)))[active] == pytest.approx(
        specimen.excursion(q)[active], abs=1e-15
    )
    zero, f = np.zeros_like(q), np.tile(np.linspace(0.0, 12.0, 30), (5, 1)) * active[:, None]
    rest = np.ones_like(f), np.zeros(30), zero
    x = Motion(*map(jnp.asarray, (np.zeros(30), q, 0.3 + zero, zero, f, 1.0 + zero, *rest)))
    at_rest = Motion(*map(jnp.asarray, (np.zeros(30), q, zero, zero, 0.0 * f, zero, *rest)))
    difference = np.asarray(external_torque(model, x) - external_torque(model, at_rest))
    moving = np.asarray(rigid_body.coriolis(model.finger, x.q, x.qd))
    expected = moving + specimen.viscous(0.3 + zero) + specimen.coulomb(q)
    expected -= np.einsum("nmt,nt->mt", specimen.moment_arm(q), f - specimen.loss(f))
    assert difference == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("powers", [1, 2, 6])
def test_a_described_finger_may_have_fewer_or_more_powers_than_the_papers_and_joints_may_differ(powers):
    finger = make_finger()
    rng = np.random.default_rng(0)
    arms = 1e-3 * rng.standard_normal((3, 2, powers)) * finger.crosses[..., None]
    finger = replace(finger, excursion=arms, excursion_std=None)
    terms = {"MCP": JointTerms(elastic=(0.0, 0.03), friction=(1e-3,)), "PIP": JointTerms((0.0, 0.02, 0.0, 0.01))}
    specimen = specimen_of(DescribedFinger(finger, Terms(terms)))
    model, q = true_model(specimen), _inside(specimen, 20)
    excursion = np.asarray(model.moment_arm.excursion(jnp.asarray(q)))
    assert excursion[finger.active] == pytest.approx(specimen.excursion(q)[finger.active], abs=1e-15)
    assert np.asarray(model.joint_torque.elastic_torque(jnp.asarray(q))) == pytest.approx(specimen.elastic(q))
    assert np.asarray(model.joint_torque.friction_magnitude(jnp.asarray(q))) == pytest.approx(specimen.coulomb(q))
