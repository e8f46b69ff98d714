"""The specimen's functions give the figures of the paper (Table I, Figs. 5–9 and their text)."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.model import Finger, rigid_body
from jaxfinger.synthetic import SpecimenPlant, paper_finger, recipe_from, session_plan

MM, NMM = 1e3, 1e3
ORDER = range(1, 5)
RANGES = {  # Table I, mm: tendon, joint, max, min
    ("T1", "MCP"): (3.7, -0.9),
    ("T1", "PIP"): (8.8, 4.3),
    ("T2", "MCP"): (-5.9, -7.7),
    ("T2", "PIP"): (-4.8, -7.7),
    ("T2", "DIP"): (-5.8, -6.6),
    ("T3", "MCP"): (10.3, 5.8),
    ("T4", "MCP"): (10.5, 5.5),
}


def _over_range(specimen):
    limits = specimen.description.limits
    return np.linspace(limits[:, 0], limits[:, 1], 901, axis=1)


@pytest.mark.parametrize(("tendon", "joint"), RANGES)
def test_moment_arms_span_table_1(tendon, joint):
    """The table is of the derivative of the fourth-order polynomial that fits the excursion in ID.2."""
    specimen = paper_finger()
    d = specimen.description
    i, j = d.tendon_names.index(tendon), d.joint_names.index(joint)
    plans = session_plan(d, recipe_from({"trials": {"rate": 50.0, "experiments": ["ID.2"]}}).trials)
    q = next(p.q[j] for p in plans if p.joint == j)
    powers = np.stack([np.ones_like(q), *(q**p for p in ORDER)], axis=1)
    coefficients = np.linalg.lstsq(powers, specimen.routes[i][j].excursion(q))[0][1:]
    slopes = np.stack([p * _over_range(specimen)[j] ** (p - 1) for p in ORDER], axis=1)
    arm = slopes @ coefficients * MM
    assert (arm.max(), arm.min()) == pytest.approx(RANGES[tendon, joint], abs=0.03)


def test_tendons_cross_only_what_table_1_lists():
    specimen = paper_finger()
    crossed = np.array([[route is not None for route in routes] for routes in specimen.routes])
    assert np.array_equal(crossed, specimen.description.crosses)


def test_t1_turns_from_extensor_to_flexor_at_the_mcp():
    """The table's signs count, not the text's (dataset format, last section)."""
    arm = paper_finger().moment_arm(_over_range(paper_finger()))[0, 0]
    assert arm[0] < 0 < arm[-1]
    assert (np.diff(arm) > 0).all()


@pytest.mark.parametrize(("tendon", "joint"), [(0, 1), (2, 0), (3, 0)])
def test_flexors_lift_off_and_are_no_fourth_order_polynomials(tendon, joint):
    """The nominal fit misses them by hundredths of a millimetre, as VD.1 of the paper does."""
    specimen = paper_finger()
    q = _over_range(specimen)[joint]
    route = specimen.routes[tendon][joint]
    powers = np.stack([q**p for p in ORDER], axis=1)
    l = route.excursion(q)
    residual = (l - powers @ np.linalg.lstsq(powers, l, rcond=None)[0]) * MM
    assert 0.005 < residual.std() < 0.04
    assert route.moment_arm(q).max() > route.radius + 3e-3


def test_gravity_at_the_mcp_runs_from_15_to_5():
    finger = Finger.from_description(paper_finger().description)
    q = jnp.deg2rad(jnp.array([[10.0, 70.0], [0.0, 0.0], [0.0, 0.0]]))
    assert np.asarray(rigid_body.gravity_torque(finger, q))[0] * NMM == pytest.approx([15.0, 5.0], abs=0.5)


def test_elastic_torque_peaks_at_30_at_45_degrees():
    specimen = paper_finger()
    q = _over_range(specimen)
    torque = specimen.elastic(q)[0] * NMM
    assert torque.max() == pytest.approx(30.0, abs=0.2)
    assert np.rad2deg(q[0, torque.argmax()]) == pytest.approx(45.0, abs=2.0)


def test_friction_reaches_9_at_70_degrees():
    specimen = paper_finger()
    q = np.deg2rad(np.linspace([10.0, 0.0, 0.0], [70.0, 0.0, 0.0], 61, axis=1))
    friction = specimen.coulomb(q)[0] * NMM
    assert friction.max() == friction[-1] == pytest.approx(9.0, abs=0.1)


def test_damping_is_close_to_none():
    specimen = paper_finger()
    q = np.deg2rad([[40.0], [0.0], [0.0]])
    assert specimen.viscous(np.full((3, 1), 1.5))[0, 0] < 0.02 * specimen.coulomb(q)[0, 0]


def test_tendon_losses():
    """T3 loses 1.5 N of 4 N and 4 N of 10 N; T1 less at low tension, with a steeper slope."""
    loss = paper_finger().loss(np.tile([4.0, 10.0], (5, 1)))
    assert loss[2] == pytest.approx([1.5, 4.0])
    assert loss[0, 0] < loss[2, 0]
    assert np.diff(loss[0]) > np.diff(loss[2])
    assert np.array_equal(paper_finger().loss(np.zeros((5, 2))), np.zeros((5, 2)))


def test_fingertip_force_slope():
    """VD.2 at 10°, 40°, 35°, T2 from 4 to 15 N: between −0.1485 (measured) and −0.1788 (the paper's model) along x."""
    recipe = recipe_from({"trials": {"rate": 100.0, "experiments": ["VD.2"], "vd2": {"postures": [[10, 40, 35]]}}})
    specimen = paper_finger(passive_tendon=True)
    plan = session_plan(specimen.description, recipe.trials)[0]
    force = SpecimenPlant(specimen).prescribed(plan)["fingertip_force"]
    held = plan.hold >= 0
    slope, _ = np.polyfit(plan.tension[1, held], force[0, held], 1)
    assert -0.1788 < slope < -0.1485
    assert np.abs(force[1]).max() < 1e-9
    assert 1.5 < -force[0, -1] < 2.6
