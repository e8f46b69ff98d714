"""Simulation: energy, closed forms of dry friction, agreement with inverse dynamics."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pinocchio as pin

from jaxfinger.model import Finger, Model, simulate
from tests.model.fingers import description, in_pinocchio, model

DT = 1e-3
run = eqx.filter_jit(simulate)


def frictionless(d) -> Model:
    f = model(d, elastic_degree=1)
    torque = f.joint_torque
    return eqx.tree_at(
        lambda f: (f.joint_torque, f.moment_arm.coefficients),
        f,
        (
            eqx.tree_at(
                lambda h: (h.elastic, h.damping, h.friction),
                torque,
                (jnp.abs(torque.elastic), 0 * torque.damping, 0 * torque.friction),
            ),
            0 * f.moment_arm.coefficients,
        ),
    )


def test_energy_of_the_free_finger_is_kept_to_integration_error():
    d = description(3, 3)
    f = frictionless(d)
    chain, _ = in_pinocchio(d)
    data, elastic = chain.createData(), np.asarray(f.joint_torque.elastic)

    def energy(q, qd):
        spring = (elastic * q[:, None] ** np.array([1, 2]) / np.array([1, 2])).sum()
        return pin.computeMechanicalEnergy(chain, data, q, qd) + spring

    errors = []
    for steps in (100, 200, 400):  # for the first 0.2 s
        time = np.arange(401) * 0.2 / steps
        q, qd = (
            np.asarray(a).T[: steps + 1] for a in run(f, time, np.zeros((d.n, 401)), jnp.full(3, 0.5), jnp.zeros(3))
        )
        E = np.array([energy(*s) for s in zip(q, qd, strict=True)])
        kinetic = max(abs(E[0] - energy(s, np.zeros(3))) for s in q)
        errors.append(np.abs(E - E[0]).max() / kinetic)
    assert errors[-1] < 1e-4  # of the energy that moves; the rule is of first order where Coriolis forces act
    order = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(order > 0.95), (errors, order)


def slider(friction: float, damping: float = 0.0) -> Model:
    """Mass of 1 kg on a rail without gravity and tendon forces: q in m, τ in N."""
    d = replace(
        description(0, 1, n=1),
        gravity=np.zeros(3),
        prismatic=(True,),
        axis=np.array([[1.0, 0.0, 0.0]]),
        mass=np.ones(1),
    )
    f = Model.zeros(Finger.from_description(d))
    return eqx.tree_at(
        lambda f: (f.joint_torque.friction, f.joint_torque.damping),
        f,
        (f.joint_torque.friction.at[0, 0].set(friction), jnp.full(1, damping)),
    )


def drive(f: Model, push: float, speed: float, duration: float = 1.0):
    time = np.arange(round(duration / DT) + 1) * DT
    still = np.zeros((1, time.size))
    q, qd = run(f, time, still, jnp.zeros(1), jnp.full(1, speed), jnp.full((1, time.size), push))
    return time, np.asarray(q[0]), np.asarray(qd[0])


def test_dry_friction_sticks_below_its_limit():
    _, q, qd = drive(slider(2.0), push=1.9, speed=0.0)
    assert np.abs(q).max() < 1e-14
    assert np.abs(qd).max() < 1e-14


def test_dry_friction_slides_above_its_limit():
    t, q, qd = drive(slider(2.0), push=3.0, speed=0.0)
    np.testing.assert_allclose(qd, (3.0 - 2.0) * t, atol=1e-9)
    np.testing.assert_allclose(q, 0.5 * t**2, atol=1e-6)


def test_a_sliding_mass_stops_and_stays():
    """It slides by v₀²/2F in the time v₀/F and does not turn back."""
    t, q, qd = drive(slider(2.0), push=0.0, speed=1.0)
    moving = t < 0.5 - DT
    np.testing.assert_allclose(qd[moving], 1.0 - 2.0 * t[moving], atol=1e-9)
    np.testing.assert_allclose(q[-1], 0.25, atol=1e-6)
    assert np.abs(qd[t > 0.5 + DT]).max() < 1e-12


def test_a_tendon_that_sticks_holds_the_joint():
    """A tendon with a loss of a₀ = 1 N at an arm of 0.1 m/m resists 0.1 N in either direction."""
    f = slider(0.0)
    f = eqx.tree_at(
        lambda f: (f.moment_arm.coefficients, f.tendon_friction.constant),
        f,
        (f.moment_arm.coefficients.at[0, 0].set(0.1), jnp.ones(1)),
    )
    time = np.arange(1001) * DT
    for push, expected in ((-0.95, 0.0), (-1.05, 0.0), (-1.2, -0.1), (-0.8, 0.1)):
        pull = np.full((1, time.size), 10.0)
        _, qd = run(f, time, pull, jnp.zeros(1), jnp.zeros(1), jnp.full((1, time.size), push))
        np.testing.assert_allclose(qd[0, -1], expected, atol=1e-9)


def test_damping_decays_exponentially():
    t, _, qd = drive(slider(0.0, damping=3.0), push=0.0, speed=1.0)
    np.testing.assert_allclose(qd, np.exp(-3.0 * t), rtol=5e-3)
