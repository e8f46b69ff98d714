"""The simulated finger against independent references: potential energy, derivatives, laws of friction."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxfinger.rig.contract import Mode
from jaxfinger.rig.simulated.plant import DT, Plant, default_truth

angles = st.lists(st.floats(-0.1, 1.3), min_size=3, max_size=3)


def potential(q: np.ndarray) -> float:
    """Potential energy −Σ m g·p, J, by rotation matrices."""
    f = default_truth().finger
    rotation, place, energy = np.eye(3), np.zeros(3), 0.0
    for j in range(3):
        place = place + rotation @ f.origin[j]
        c, s = np.cos(q[j]), np.sin(q[j])
        rotation = rotation @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        energy -= f.mass[j] * f.gravity @ (place + rotation @ f.com[j])
    return energy


def gradient(f, q, h=1e-6):
    return np.array([(f(q + h * e) - f(q - h * e)) / (2 * h) for e in np.eye(3)])


@settings(max_examples=30, deadline=None)
@given(angles)
def test_gravity_torque_is_the_slope_of_the_potential(q):
    plant = Plant()
    plant.q = list(q)
    np.testing.assert_allclose(plant.gravity_torque(), gradient(potential, np.array(q)), atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(angles)
def test_moment_arms_are_the_slope_of_excursion(q):
    plant = Plant()

    def excursion(q):
        plant.q = list(q)
        return np.array(plant.excursion())

    slope = gradient(excursion, np.array(q)).T
    plant.q = list(q)
    np.testing.assert_allclose(plant.moment_arms(), slope, atol=1e-9)


def test_moment_arms_have_the_papers_range():
    plant = Plant()
    for tendon, joint, low, high in (
        (0, 0, -0.9, 3.7),
        (0, 1, 4.3, 8.8),
        (1, 2, -6.6, -5.8),
        (2, 0, 5.8, 10.3),
        (3, 0, 5.5, 10.5),
    ):
        values = []
        for angle in np.linspace(0.0, 1.57, 30):
            plant.q = [0.0, 0.0, 0.0]
            plant.q[joint] = angle
            values.append(plant.moment_arms()[tendon][joint] * 1e3)
        assert min(values) == pytest.approx(low, abs=0.5)
        assert max(values) == pytest.approx(high, abs=0.5)


@settings(max_examples=20, deadline=None)
@given(angles, st.lists(st.floats(-5, 5), min_size=3, max_size=3))
def test_inertial_terms_keep_the_energy(q, qd):
    """Power balance of a free chain: q̇ᵀ N = ½ q̇ᵀ Ṁ q̇, and M is symmetric and positive."""
    plant = Plant()
    q, qd, h = np.array(q), np.array(qd), 1e-6

    def mass(q):
        plant.q = list(q)
        return plant.mass_matrix()

    rate = (mass(q + h * qd) - mass(q - h * qd)) / (2 * h)
    matrix = mass(q)
    plant.qd = list(qd)
    assert qd @ plant.coriolis() == pytest.approx(0.5 * qd @ rate @ qd, abs=1e-9)
    np.testing.assert_allclose(matrix, matrix.T)
    assert np.linalg.eigvalsh(matrix)[0] > 0


def held(tension):
    plant = Plant()
    plant.prepare([Mode.MOTOR, Mode.FIXED, Mode.FIXED], [0.5, 0.3, 0.2], False)
    plant.q = [0.5, 0.3, 0.2]
    torque = []
    for t in tension:
        plant.step([0.0, 0.0, float(t), 0.0], (0.5, 0.0, 0.0))
        torque.append((plant.external_torque, plant.transmitted[2]))
    return plant, np.array(torque)


def test_tension_at_a_held_joint_rises_with_loss_and_stays_on_a_plateau_when_it_falls():
    truth = default_truth()
    up, down = np.linspace(0, 10, 1000), np.linspace(10, 5, 500)
    plant, path = held(np.concatenate([up, down]))
    loss = np.minimum(truth.a0[2] + truth.a1[2] * up, up)
    np.testing.assert_allclose(path[:1000, 1], up - loss, atol=1e-9)
    top = 10 - (truth.a0[2] + truth.a1[2] * 10)
    slips = down + truth.a0[2] + truth.a1[2] * down
    np.testing.assert_allclose(path[1000:, 1], np.minimum(top, slips), atol=1e-9)
    arm = plant.moment_arms()[2][0]
    still = plant.gravity_torque()[0] + np.polyval(truth.elastic[0][::-1], 0.5)
    np.testing.assert_allclose(path[:, 0], still - arm * path[:, 1], atol=1e-12)


def test_contact_force_balances_a_frictionless_planar_load():
    """VD.2: the force is the least-squares solution of Jᵀ f = G + τ_k − Cᵀ f_j."""
    truth, plant = default_truth(), Plant()
    q = np.radians([10.0, 40.0, 35.0])
    plant.prepare([Mode.FREE] * 3, q.tolist(), True)
    plant.q = q.tolist()
    for t in np.linspace(0, 9, 300):
        plant.step([0.0, float(t), 0.0, 0.0], None)

    def tip(q):
        a = np.cumsum(q)
        lengths = np.array([0.045, 0.028, 0.023])
        return np.array([lengths @ np.cos(a), -lengths @ np.sin(a)])

    h = 1e-6
    jacobian = np.array([(tip(q + h * e) - tip(q - h * e)) / (2 * h) for e in np.eye(3)])  # Jᵀ
    elastic = np.array([np.polyval(truth.elastic[j][::-1], q[j]) for j in range(3)])
    need = np.array(plant.gravity_torque()) + elastic - np.array(plant.moment_arms()).T @ plant.transmitted
    expected = np.linalg.lstsq(jacobian, need, rcond=None)[0]
    np.testing.assert_allclose([plant.tip_force[0], plant.tip_force[2]], expected, atol=1e-6)
    assert plant.tip_force[1] == 0.0


def test_a_free_finger_comes_to_rest_and_friction_holds_it_there():
    plant = Plant()
    plant.q = [0.4, 0.3, 0.2]
    plant.prepare([Mode.FREE] * 3, [0.0] * 3, False)
    for _ in range(2500):
        plant.step([3.0, 2.5, 2.5, 2.5], None)
    still = list(plant.q)
    for _ in range(500):
        plant.step([3.0, 2.5, 2.5, 2.5], None)
    np.testing.assert_allclose(plant.q, still, atol=1e-9)  # It sticks and does not creep.
    for _ in range(500):
        plant.step([3.0, 2.5, 2.4, 2.5], None)
    np.testing.assert_allclose(plant.q, still, atol=1e-9)  # Friction takes a small change of tension.
    assert DT == 1e-3
