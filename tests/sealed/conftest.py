"""A specimen and a short session for all tests of the room."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.sealed.drive import desired_trajectory
from jaxfinger.sealed.laws import Finger
from jaxfinger.sealed.protocols import draw_style, session_plans
from jaxfinger.sealed.sensors import Sensors, draw_sensors
from jaxfinger.sealed.specimens import Specimen, make_specimen


def short(plans, nominal, rng):
    """Keep one trial of every kind, with a VD.3 of two seconds."""
    kept, seen = [], set()
    for plan in plans:
        key = (plan.experiment, plan.joint == 0, plan.tendon == 0)
        if key in seen:
            continue
        seen.add(key)
        if plan.experiment == "VD.3":
            plan = replace(plan, duration=2.0)
            plan = replace(plan, q=desired_trajectory(nominal, plan, rng))
        kept.append(plan)
    return kept


@pytest.fixture(scope="session")
def specimen() -> Specimen:
    return make_specimen("planar", np.random.default_rng(4))


@pytest.fixture(scope="session")
def nominal(specimen) -> Finger:
    return Finger(specimen)


@pytest.fixture(scope="session")
def sensors() -> Sensors:
    return draw_sensors(np.random.default_rng(5))


@pytest.fixture(scope="session")
def plans(specimen, nominal):
    rng = np.random.default_rng(6)
    style = replace(draw_style(rng), missing="", unload=True)
    return short(session_plans(specimen, style, rng), nominal, rng)
