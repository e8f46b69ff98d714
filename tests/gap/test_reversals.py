"""What shows beside reversals of swept joints alone: an inertia that is missing, friction that builds up quickly."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap import diagnose
from jaxfinger.gap.problem import build
from jaxfinger.identify import Recipe
from jaxfinger.synthetic import recipe_from
from tests.gap.conftest import TABLE, session_with

# Joints move at even speeds, and accelerate where they turn back. The recorder gives no directions.
SWEPT = recipe_from({**TABLE, "trials": {**TABLE["trials"], "rate": 500.0}})
INERTIA = 1.5e-4  # kg m²: a torque of 1.5 N mm where the joints turn back, ten times the noise
RIVALS = ("joint_presliding", "joint_stribeck", "drive_inertia", "elastic_relaxation", "channel_delay")
WITHOUT = tuple(sorted(set(CATALOGUE) - set(RIVALS)))


def swept(*effects, seed=3):
    session = session_with(*effects, seed=seed, recipe=SWEPT)
    return replace(session, trials={t.name: replace(t, joint_direction=None) for t in session})


def beside_reversals(problem, joint):
    """White residuals of a joint beside its reversals, and elsewhere."""
    rows = problem.rows["ID.3-dynamic"]
    r = problem.r[rows.start : rows.start + rows.size]
    beside = np.zeros(rows.size, bool)
    beside[np.unique(rows.reversals["joint_torque"].nonzero()[0])] = True
    mine = rows.column == joint
    return r[beside & mine], r[~beside & mine]


@pytest.mark.parametrize("seed", [3, 4])
def test_residuals_beside_reversals_are_white_where_nothing_is_missing(seed):
    problem = build(swept(seed=seed), Recipe())
    beside, others = (np.concatenate(x) for x in zip(*(beside_reversals(problem, i) for i in range(3)), strict=True))
    assert beside.size > 50
    assert 0.6 < np.mean(beside**2) < 1.5
    assert np.abs(beside).max() < 5.0
    assert 0.8 < np.mean(others**2) < 1.2


def test_an_inertia_that_is_missing_shows_most_beside_reversals():
    beside, others = beside_reversals(build(swept(("drive_inertia", ("PIP",), {"inertia": INERTIA})), Recipe()), 1)
    assert np.mean(beside**2) > 2.0 * np.mean(others**2)


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 5])
def test_samples_beside_reversals_tell_over_which_angle_friction_builds_up(seed):
    """Without them the standard deviation of x₀ is 1.0e-3 rad or more."""
    session = swept(("joint_presliding", ("PIP",), {"a": 1.0, "x0": 3e-3}), seed=seed)
    found = diagnose(session, Recipe(), without=WITHOUT)
    assert [(k.effect, k.site) for k in found.named] == [("joint_presliding", ("PIP",))]
    (x0,) = (v for v in found.budget[0].values if v.name == "x0")
    assert x0.std < 6e-4
    assert abs(x0.value - 3e-3) < 2.5 * x0.std
