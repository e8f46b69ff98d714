"""A model behind the rig's sensors agrees with the specimen whose parameters it has."""

import numpy as np
import pytest

from jaxfinger.data import EXPERIMENTS
from jaxfinger.errors import UserError
from jaxfinger.synthetic import (
    ModelPlant,
    SpecimenPlant,
    nominal_model,
    paper_finger,
    polynomial_finger,
    recipe_from,
    session_plan,
    simulate,
)

SPECIMEN = polynomial_finger(paper_finger())
TRIALS = {"rate": 40.0, "vd3": {"motions": 1, "duration": 2.0, "rate": 1000.0}, "vd1": {"motions": 1}}


@pytest.fixture(scope="module")
def plans():
    plans = session_plan(SPECIMEN.description, recipe_from({"trials": TRIALS}).trials)
    return {plan.experiment: plan for plan in plans}


@pytest.mark.parametrize("experiment", [e for e in EXPERIMENTS if e != "VD.3"])
def test_prescribed_channels_agree(plans, experiment):
    plan, active = plans[experiment], SPECIMEN.description.active
    ours = SpecimenPlant(SPECIMEN).prescribed(plan)
    theirs = ModelPlant(nominal_model(SPECIMEN)).prescribed(plan)
    assert ours.keys() == theirs.keys()
    for channel in ours:
        rows = active if channel.startswith("tendon") else slice(None)
        assert theirs[channel][rows] == pytest.approx(ours[channel][rows], abs=1e-7)


def test_driven_motion_agrees_under_the_same_tension(plans):
    """Two independent steppings of dry friction, under tension that is held over a sample and interpolated."""
    ours = SpecimenPlant(SPECIMEN)
    first = ours.driven(plans["VD.3"])
    second = ModelPlant(nominal_model(SPECIMEN), driver=ours).driven(plans["VD.3"])
    assert np.array_equal(first["tendon_force"], second["tendon_force"])
    assert np.abs(first["q"] - second["q"]).max() < np.deg2rad(0.1)


def test_model_without_a_driver_cannot_be_driven(plans):
    with pytest.raises(UserError, match=r"drop VD\.3"):
        ModelPlant(nominal_model(SPECIMEN)).driven(plans["VD.3"])


def test_session_of_a_model():
    recipe = recipe_from({"trials": TRIALS | {"experiments": ["ID.4"]}})
    session = simulate(recipe, seed=2, plant=ModelPlant(nominal_model(SPECIMEN)))
    assert {t.experiment for t in session} == {"ID.4"}
    assert all(np.isfinite(t.joint_torque).any() for t in session)
