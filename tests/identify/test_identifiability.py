"""Invisible combinations are named with the experiment that would determine them; base parameters of known chains."""

import numpy as np
import pytest

from jaxfinger.identify import base_parameters
from jaxfinger.identify.identifiability import directions, name_invisible, name_traded
from jaxfinger.identify.parameters import Parameter
from jaxfinger.model import Finger
from tests.model.fingers import description

PARAMETERS = [
    Parameter("elastic torque MCP^0", "elastic", "N m", "MCP"),
    Parameter("elastic torque MCP^1", "elastic", "N m/rad", "MCP"),
    Parameter("centre of mass MCP x", "com", "m", "MCP"),
]


def test_a_combination_that_is_not_seen_is_named():
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 50))
    J = np.column_stack([a, b, 2 * a])  # the first and the last column are proportional
    found = directions(PARAMETERS, np.arange(3), J.T @ J)
    assert [d.status for d in found] == ["invisible", "seen", "seen"]
    assert set(found[0].shares) == {"elastic torque MCP^0", "centre of mass MCP x"}
    assert "mounted otherwise" in found[0].remedy
    assert "mounted otherwise" in str(found[0])
    (sentence,) = name_invisible(PARAMETERS, np.arange(3), np.array([[1.0, 0.0, -1.0]]) / np.sqrt(2))
    assert "elastic torque MCP^0" in sentence
    assert "ID.3-static of joint MCP" in sentence


def test_parameters_that_no_trial_touches_are_named_together_and_not_as_combinations():
    """Two of them span a plane, of which a solver may give any basis."""
    turned = np.array([[0.6, 0.8, 0.0], [0.8, -0.6, 0.0]])
    (sentence,) = name_invisible(PARAMETERS, np.arange(3), turned)
    assert sentence.startswith("the trials do not show elastic torque MCP^0, elastic torque MCP^1; record ID.3-static")
    (sentence,) = name_invisible(PARAMETERS, np.arange(3), turned, told=[1])
    assert sentence.startswith("the trials do not show elastic torque MCP^0; record ID.3-static")
    assert not name_invisible(PARAMETERS, np.arange(3), turned, told=[0, 1])
    mixed = np.array([[0.0, 1.0, 0.0], [np.sqrt(0.5), 0.0, -np.sqrt(0.5)]])
    mixed = np.array([[0.6, 0.8], [0.8, -0.6]]) @ mixed
    alone, traded = name_invisible(PARAMETERS, np.arange(3), mixed)
    assert alone.startswith("the trials do not show elastic torque MCP^1;")
    assert "elastic torque MCP^1" not in traded
    assert "centre of mass MCP x" in traded


@pytest.mark.parametrize("tendons", [True, False])
def test_no_trial_is_asked_for_that_pulls_a_tendon_where_there_is_none(tendons):
    parameters = [
        Parameter("elastic torque MCP^0", "elastic", "N m", "MCP"),
        Parameter("friction torque by direction MCP", "friction_by_direction", "N m", "MCP"),
        *([Parameter("tendon friction T1 a0", "tendon_friction", "N", tendon="T1")] if tendons else []),
    ]
    (said,) = name_invisible(parameters, np.arange(2), np.array([[1.0, -1.0]]) / np.sqrt(2))
    assert ("and ID.4 with the joint held" in said) is tendons
    assert ("leave one of them out of the recipe" in said) is not tendons


def test_laws_of_different_joints_are_not_mixed_into_one_combination():
    """Joints that turn one way only: each one's friction is its elastic torque. Any basis of that space may come."""
    joints = ("MCP", "PIP", "DIP")
    parameters = [
        Parameter(f"{group} {j}^{power}", group, "N m", j)
        for group in ("elastic", "friction")
        for j in joints
        for power in range(2)
    ]
    pairs = (np.eye(12)[:6] - np.eye(12)[6:]) / np.sqrt(2.0)
    turn, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((6, 6)))
    said = name_invisible(parameters, np.arange(12), turn @ pairs)
    assert len(said) == 3
    for joint, sentence in zip(joints, said, strict=True):
        for power in range(2):
            assert f"+0.71·[elastic {joint}^{power}] -0.71·[friction {joint}^{power}]" in sentence
        assert f"record ID.3-static of joint {joint}, every hold approached from both sides" in sentence
        assert not any(other in sentence for other in joints if other != joint)


def test_a_parameter_that_no_trial_touches_is_invisible():
    J = np.column_stack([np.ones(5), np.zeros(5), np.arange(5.0)])
    assert directions(PARAMETERS, np.arange(3), J.T @ J)[0].shares.keys() == {"elastic torque MCP^1"}


@pytest.mark.parametrize("m", [1, 3])
def test_base_parameters_of_a_spatial_chain(m):
    """A revolute chain with generic axes and gravity along none has 3 + 7 (m − 1) (Gautier 1991; Khalil 2002)."""
    base = base_parameters(Finger.from_description(description(m, m, prismatic=False)))
    assert base.rank == 3 + 7 * (m - 1)
    np.testing.assert_allclose(base.combinations @ base.combinations.T, np.eye(base.rank), atol=1e-10)


def test_base_parameters_of_a_planar_finger():
    """Parallel axes and gravity in their plane leave 3 for each link: 2 mass moments and an inertia."""
    d = description(3, 3, prismatic=False)
    planar = dict(
        axis=np.tile([0.0, 1.0, 0.0], (3, 1)),
        origin=np.array([[0.0, 0, 0], [0.05, 0, 0], [0.03, 0, 0]]),
        gravity=np.array([0.0, 0.0, -9.81]),
    )
    base = base_parameters(Finger.from_description(type(d)(**{**vars(d), **planar})))
    assert base.rank == 9


def alike(correlation: float) -> np.ndarray:
    """Covariance of friction and damping with a correlation, and of two further coefficients of friction with 1."""
    R = np.eye(4)
    R[0, 1] = R[1, 0] = correlation
    R[2, 3] = R[3, 2] = 0.9999
    return R


TRADED = [
    Parameter("friction torque MCP^0", "friction", "N m", "MCP"),
    Parameter("damping MCP", "damping", "N m s/rad", "MCP"),
    Parameter("friction torque MCP^1", "friction", "N m/rad", "MCP"),
    Parameter("friction torque MCP^2", "friction", "N m/rad²", "MCP"),
]


@pytest.mark.parametrize(
    ("correlation", "value", "named"),
    [(-0.9997, 0.2, True), (0.9997, 0.2, True), (-0.97, 0.2, False), (-0.9997, 4.0, False)],
)
def test_two_laws_that_show_only_together_are_named_with_the_trial_that_parts_them(correlation, value, named):
    """Where an interval does not hold zero, the law is known to be there; coefficients of one law say nothing."""
    found = name_traded(TRADED, np.array([value, 0.1, 0.0, 0.0]), alike(correlation), np.arange(4))
    assert len(found) == named
    for sentence in found:
        assert "friction torque MCP^0 and damping MCP only together" in sentence
        assert "or ID.3-dynamic of joint MCP at two speeds or more" in sentence
