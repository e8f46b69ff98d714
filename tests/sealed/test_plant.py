"""The rigid body as a MuJoCo model, against closed forms and the power balance."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.sealed.paths import excursion_polynomials, spatial_lengths
from jaxfinger.sealed.plant import Plant
from jaxfinger.sealed.specimens import LAYOUTS, make_specimen


def pendulum(specimen):
    """Description of the first link alone, hanging about y."""
    f = specimen.finger
    return replace(
        f,
        joint_names=f.joint_names[:1],
        axis=f.axis[:1],
        origin=f.origin[:1],
        limits=f.limits[:1],
        mass=f.mass[:1],
        com=f.com[:1],
        inertia=f.inertia[:1],
        crosses=f.crosses[:, :1],
        prismatic=(False,),
        mass_std=None,
        com_std=None,
        gravity=np.array([9.81, 0.0, 0.0]),
    )


def test_pendulum_in_closed_form(specimen):
    f = pendulum(specimen)
    q, qdd = np.array([[0.7]]), np.array([[3.0]])
    x, _, z = f.com[0]
    # Flexion about +y carries +x toward −z; gravity along +x.
    reach = -x * np.sin(0.7) + z * np.cos(0.7)  # ∂x_com/∂q
    inertia = f.inertia[0, 1, 1] + f.mass[0] * (x**2 + z**2)
    torque = Plant(f).inverse_dynamics(q, 0 * q, qdd)
    assert torque[0, 0] == pytest.approx(inertia * 3.0 - f.mass[0] * 9.81 * reach, rel=1e-9)


def test_mass_matrix_is_what_inverse_dynamics_multiplies_by(nominal):
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(0.4, 0.3, (3, 1, nominal.m))
    plant = nominal.plant
    change = plant.inverse_dynamics(q, qd, qdd) - plant.inverse_dynamics(q, qd, 0 * qdd)
    np.testing.assert_allclose(change[0], plant.mass_matrix(q[0]) @ qdd[0], atol=1e-14)


def test_power_balance_along_a_motion():
    """d/dt (½ q̇ᵀ M q̇) = q̇ᵀ (τ − G) for any motion."""
    specimen = make_specimen("human-like", np.random.default_rng(2))
    plant = Plant(specimen.finger)
    t = np.linspace(0, 1, 4001)[:, None]
    phase = np.arange(plant.finger.m)
    q, qd, qdd = 0.4 + 0.3 * np.sin(5 * t + phase), 1.5 * np.cos(5 * t + phase), -7.5 * np.sin(5 * t + phase)
    power = np.sum(qd * (plant.inverse_dynamics(q, qd, qdd) - plant.gravity_torque(q)), axis=1)
    work = np.concatenate([[0.0], np.cumsum((power[1:] + power[:-1]) / 2 * np.diff(t[:, 0]))])
    kinetic = np.array([0.5 * v @ plant.mass_matrix(x) @ v for x, v in zip(q[::500], qd[::500], strict=True)])
    np.testing.assert_allclose(work[::500], kinetic - kinetic[0], atol=1e-6 * kinetic.max())


def test_jacobian_is_the_derivative_of_the_fingertip(nominal):
    q, h = np.array([0.3, 0.5, 0.2]), 1e-6
    numeric = np.stack(
        [(nominal.plant.fingertip(q + h * e) - nominal.plant.fingertip(q - h * e)) / (2 * h) for e in np.eye(3)], axis=1
    )
    np.testing.assert_allclose(nominal.plant.jacobian(q), numeric, atol=1e-9)


@pytest.mark.parametrize("kind", LAYOUTS)
def test_nominal_polynomials_fit_the_spatial_tendons_far_below_noise(kind):
    specimen = make_specimen(kind, np.random.default_rng(9))
    assert specimen.misfit < 1e-6  # m: a tenth of a sample's noise
    active = specimen.finger.active
    assert np.array_equal(specimen.finger.crosses[active], np.any(specimen.excursion[active] != 0, axis=-1))
    assert np.all(specimen.excursion[~active] == 0.0)


def test_paths_separate_by_joint(specimen):
    """MuJoCo's path between symmetric eyelets is l = 2R (cos α − cos(α + q/2)) for a flexor."""
    f = specimen.finger
    arm, alpha = np.zeros((f.n, f.m)), np.full((f.n, f.m), 0.6)
    arm[0, 1] = 6e-3
    q = np.linspace(-0.1, 1.5, 9)
    lengths = spatial_lengths(f, arm, alpha, 1, np.append(q, 0.0))[:, 0]
    radius = 6e-3 / np.sin(0.6)
    np.testing.assert_allclose(lengths[-1] - lengths[:-1], 2 * radius * (np.cos(0.6) - np.cos(0.6 + q / 2)), atol=1e-12)
    coefficients, _ = excursion_polynomials(f, arm, alpha)
    assert coefficients[0, 1, 0] == pytest.approx(6e-3, rel=2e-3)
    arm[0, 1] = -6e-3  # An extensor wraps its pulley: the arm is constant.
    lengths = spatial_lengths(f, arm, alpha, 1, np.append(q, 0.0))[:, 0]
    np.testing.assert_allclose(lengths[-1] - lengths[:-1], -6e-3 * q, atol=1e-9)


def test_cad_is_off_by_what_it_admits():
    z = []
    for seed in range(40):
        s = make_specimen("planar", np.random.default_rng(seed))
        z += list((s.cad.mass - s.finger.mass) / s.finger.mass_std)
    assert 0.8 < np.std(z) < 1.2
