"""The driven finger: dry friction that is not smoothed, and the balance of energy."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from jaxfinger.compilation import quick_options
from jaxfinger.errors import UserError
from jaxfinger.experiments import prepare
from jaxfinger.experiments.predict import predict_compiled
from jaxfinger.model import Finger, rigid_body
from jaxfinger.synthetic import (
    SpecimenPlant,
    paper_finger,
    polynomial_finger,
    random_finger,
    recipe_from,
    session_plan,
    simulate,
    true_model,
)
from jaxfinger.synthetic.controller import distribute
from jaxfinger.synthetic.driven import at_rest, friction_impulse, step
from jaxfinger.synthetic.routes import PolynomialRoute
from jaxfinger.synthetic.specimen import GrowingFriction, PolynomialFriction, PolynomialSpring

SPECIMEN = paper_finger()
FINGER = Finger.from_description(SPECIMEN.description)


def _potential(q):
    """Potential energy of gravity and springs, J, by plane geometry."""
    d = SPECIMEN.description
    pitch = np.cumsum(q, axis=0)
    height, energy = np.zeros(q.shape[1]), SPECIMEN.elastic_energy(q)
    for i in range(3):
        energy = energy - d.mass[i] * d.gravity[2] * (height - d.com[i, 0] * np.sin(pitch[i]))
        height = height - (d.origin[i + 1, 0] if i < 2 else 0.0) * np.sin(pitch[i])
    return energy


def _energy(q, v):
    M = np.asarray(jax.jit(rigid_body.mass_matrix, compiler_options=quick_options())(FINGER, jnp.asarray(q)))
    return 0.5 * np.einsum("it,ijt,jt->t", v, M, v) + _potential(q)


@pytest.fixture(scope="module")
def driven():
    """A plan, its plant, and position, velocity and tension of the driven trial."""
    recipe = recipe_from({"trials": {"experiments": ["VD.3"], "vd3": {"motions": 1, "duration": 3.0}}})
    plan = session_plan(SPECIMEN.description, recipe.trials)[0]
    plant = SpecimenPlant(SPECIMEN)
    controller = plant.controller(plan)
    return plan, plant, plant.simulator(plan.q[:, 0], plan.time[1], controller)


def test_tendons_move_every_joint_along_the_plan(driven):
    plan, plant, (q, v, tension) = driven
    assert np.abs(q - plan.q).max() < 0.1
    assert (np.ptp(q, axis=1) > 0.15).all()
    assert (np.mean(np.abs(v) > 1e-3, axis=1) > 0.6).all()  # it sticks at reversals
    active = SPECIMEN.description.active
    least = plant.controller(plan).least[:, None]
    assert (least[active] > 0.0).all()
    assert (tension >= 0.99 * least).all()
    assert tension[active].max() < 20.0
    assert not tension[~active].any()


def test_work_of_the_tendons_is_stored_or_lost_to_friction(driven):
    plan, _, (q, v, tension) = driven
    dt = plan.time[1]
    middle, rate = 0.5 * (q[:, 1:] + q[:, :-1]), np.diff(q, axis=1) / dt
    pulled = np.diff(SPECIMEN.excursion(q), axis=1)
    f = 0.5 * (tension[:, 1:] + tension[:, :-1])  # acts from one sample to the next, but for a slow change
    work = (f * pulled).sum()
    joints = (SPECIMEN.coulomb(middle) * np.abs(rate)).sum() * dt
    tendons = (SPECIMEN.loss(f) * np.abs(pulled)).sum()
    damping = (SPECIMEN.viscous(rate) * rate).sum() * dt
    stored = np.diff(_energy(q[:, [0, -1]], v[:, [0, -1]]))[0]
    lost = joints + tendons + damping
    assert lost > 0.01
    assert work == pytest.approx(stored + lost, rel=0.01)


def test_the_recorded_tension_acts_at_its_own_instant():
    """What (1) leaves of a free finger does not follow the rate of its tension, as half a sample of delay would."""
    specimen, rate = polynomial_finger(SPECIMEN), 500.0
    quiet = {c: {"std": 0.0, "resolution": 1e-9} for c in ("q", "tendon_force", "tendon_excursion")}
    drives = {"motions": 1, "duration": 4.0, "rate": rate}
    recipe = recipe_from({"trials": {"experiments": ["VD.3"], "vd3": drives}, "sensors": quiet | {"clock_jitter": 0.0}})
    found, model = prepare(simulate(recipe, plant=SpecimenPlant(specimen)))["VD.3"], true_model(specimen)
    left = predict_compiled(model, found.batch.x, ("joint_torque",))["joint_torque"]
    counts = np.asarray(found.batch.mask["joint_torque"]) > 0
    C = np.asarray(model.moment_arm.coupling(found.batch.x.q))
    delayed = np.einsum("nmbt,nbt->mbt", C, np.gradient(found.batch.x.tension, found.dt, axis=-1)) * 0.5 / rate
    for joint in (1, 2):  # the model of the MCP's heavier load leaves as much
        y, x = np.asarray(left)[joint][counts[joint]], delayed[joint][counts[joint]]
        assert len(y) > 20
        assert abs(y @ x / (x @ x)) < 0.3


def test_frictionless_undriven_finger_keeps_its_energy():
    free = replace(
        SPECIMEN,
        friction=GrowingFriction((0.0,) * 3, (0.0,) * 3),
        damping=(0.0,) * 3,
        loss_constant=(0.0,) * 5,
        loss_proportional=(0.0,) * 5,
    )

    start = at_rest(FINGER, jnp.array([0.6, 0.4, 0.7]))
    advance = jax.jit(lambda state, h: step(free, FINGER, state, jnp.zeros(5), h), compiler_options=quick_options())

    def drift(h):
        """Change of energy over 50 ms of free motion, as a share of the potential energy that became kinetic."""
        state = start
        for _ in range(round(0.05 / h)):
            state = advance(state, h)
        q, v = (np.stack(x, axis=1) for x in ((start.q, state.q), (start.v, state.v)))
        return abs(np.diff(_energy(q, v))[0]) / np.diff(_potential(q))[0] * -1

    coarse, fine = drift(5e-4), drift(2.5e-4)
    assert 0 < coarse < 5e-3
    assert fine < 0.4 * coarse  # second order


def test_finger_sticks_where_friction_can_hold_it():
    """Nothing moves under tensions between the one that pulls the finger up and the one that lets it down."""
    advance = jax.jit(lambda state, f: step(SPECIMEN, FINGER, state, f, 5e-4), compiler_options=quick_options())
    q0 = np.deg2rad([[55.0], [50.0], [40.0]])
    zero = np.zeros_like(q0)
    resisting = np.asarray(rigid_body.inverse_dynamics(FINGER, q0, zero, zero)) + SPECIMEN.elastic(q0)
    C = SPECIMEN.moment_arm(q0)[:, :, 0]
    tension = np.array([*np.linalg.lstsq(C[:3].T, resisting[:, 0], rcond=None)[0], 0.0, 0.0])
    assert (tension[:3] > 0).all()
    state = at_rest(FINGER, jnp.asarray(q0[:, 0]))
    for shift in (0.0, 0.3, -0.3):
        state = advance(state, jnp.asarray(tension + np.array([0, 0, shift, 0, 0])))
        assert np.abs(state.v).max() < 1e-9
    state = advance(state, jnp.asarray(tension + np.array([0, 0, 8.0, 0, 0])))
    assert state.v[0] > 1e-3


@pytest.mark.parametrize("seed", range(5))
def test_friction_impulses_oppose_sliding_and_nothing_else(seed):
    """Coulomb's law: below its limit where nothing slides, at its limit and against the motion where it does."""
    rng = np.random.default_rng(seed)
    D = np.vstack([np.eye(3), rng.uniform(-0.01, 0.01, (4, 3))])
    root = rng.standard_normal((3, 3))
    A = D @ (root @ root.T + np.eye(3)) @ D.T
    limit, rates = rng.uniform(0.0, 1.0, 7) * np.r_[np.ones(3), 50 * np.ones(4)], D @ rng.standard_normal(3) * 3
    impulse = np.asarray(friction_impulse(jnp.asarray(A), jnp.asarray(rates), jnp.asarray(limit), jnp.zeros(7)))
    left = rates - A @ impulse
    assert (np.abs(impulse) <= limit + 1e-12).all()
    sliding = np.abs(left) > 1e-6
    assert np.abs(impulse[sliding]) == pytest.approx(limit[sliding], rel=1e-6)
    assert (np.sign(impulse[sliding]) == np.sign(left[sliding])).all()


def _resized(mass, length, rotor, slides):
    """A finger of two joints and four tendons with other masses, lengths and rotors.

    Torques of springs and friction keep their ratio to that of the weight. A joint that slides has 40 mm of travel for
    each rad, times `length`. `rotor` is the inertia of the joints' rotors over that of a link.
    """
    s, slides = polynomial_finger(random_finger(3, 2)), np.array(slides)
    d, (spring,), friction = s.description, s.springs, s.friction
    assert isinstance(spring, PolynomialSpring)
    assert isinstance(friction, PolynomialFriction)
    unit = np.where(slides, 0.04 * length, 1.0)  # of a joint's coordinate

    def rows(coefficients, factor):
        """Coefficients of polynomials in the joints' coordinates."""
        return tuple(
            tuple(factor * c / u**p for p, c in enumerate(row, 1)) for u, row in zip(unit, coefficients, strict=True)
        )

    def route(old, u):
        return old and PolynomialRoute(tuple(length * c / u**p for p, c in enumerate(old.coefficients, 1)))

    return replace(
        s,
        description=replace(
            d,
            origin=length * d.origin,
            mass=mass * d.mass,
            com=length * d.com,
            inertia=mass * length**2 * d.inertia,
            rotor_inertia=rotor * 2e-5 * mass * length**2 / unit**2,
            limits=d.limits * unit[:, None],
            prismatic=tuple(slides.tolist()),
        ),
        routes=tuple(tuple(map(route, routes, unit)) for routes in s.routes),
        springs=(PolynomialSpring(rows(spring.coefficients, mass * length)),),
        friction=PolynomialFriction(rows(friction.coefficients, mass * length)),
        damping=tuple(mass * length * np.array(s.damping) / unit**2),
        loss_constant=tuple(mass * np.array(s.loss_constant)),
    )


def _tracks(specimen):
    """Whether VD.3 keeps within a fifth of its travel of the plan, and no tendon falls slack."""
    recipe = recipe_from({"trials": {"experiments": ["VD.3"], "vd3": {"motions": 1, "duration": 2.0}}})
    plan = session_plan(specimen.description, recipe.trials)[0]
    channels = SpecimenPlant(specimen).driven(plan)
    error = np.abs(channels["q"] - plan.q).max(axis=1)
    return (error < 0.2 * np.ptp(plan.q, axis=1)).all() and channels["tendon_force"].min() > 0.0


@pytest.mark.parametrize(
    ("mass", "length", "rotor", "slides"),
    [(1.0, 1.0, 500.0, (True, False)), (0.01, 0.1, 0.0, (False, False)), (100.0, 100.0, 0.01, (True, False))],
)
def test_fingers_of_any_size_are_driven(mass, length, rotor, slides):
    """With 500 times the inertia of a link, 0.01 kg m², the rotors are those of a robot's geared motors."""
    assert _tracks(_resized(mass, length, rotor, slides))


@pytest.mark.long
@given(
    st.floats(-2.0, 2.0).map(lambda p: 10.0**p),
    st.floats(-1.0, 2.0).map(lambda p: 10.0**p),
    st.floats(-2.0, 3.0).map(lambda p: 10.0**p),
    st.tuples(st.booleans(), st.booleans()),
)
@settings(max_examples=20, deadline=None)
def test_fingers_of_every_size_are_driven(mass, length, rotor, slides):
    assert _tracks(_resized(mass, length, rotor, slides))


@pytest.mark.parametrize("fewest", [False, True])
def test_tensions_give_every_torque_that_pulling_can(fewest):
    """The reference is SciPy's least squares with bounds. With one tendon more than joints it pulls against all."""
    rng = np.random.default_rng(0)
    C = rng.standard_normal((6, 3, 20))
    if fewest:
        C = np.concatenate([C[:3], -np.einsum("n,nmt->mt", [0.05, 0.3, 1.0], C[:3])[None]])
    torque, least = rng.standard_normal((3, 20)), np.full(len(C), 0.1)
    found = distribute(C, torque, least)
    for t in range(20):
        best = lsq_linear(C[..., t].T, torque[:, t], (least, np.inf), method="bvls")
        np.testing.assert_allclose(C[..., t].T @ found[:, t], C[..., t].T @ best.x, atol=1e-3)
    assert (found >= least[:, None]).all()


def test_motion_beyond_the_limits_is_refused(driven):
    plan, plant, _ = driven
    far = replace(plan, q=plan.q + np.array([[0.0], [1.2], [0.0]]))
    with pytest.raises(UserError, match="beyond its limits; lower"):
        plant.driven(far)
