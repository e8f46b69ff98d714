"""How long trials last and how fast joints move, said for a person who knows the rig."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.data.signals.pace import pace_in_words, speed
from tests.data.conftest import make_session

TIME = np.arange(2000) / 100.0


@pytest.mark.parametrize("spikes", [0, 5])
def test_the_speed_is_that_of_the_joint_at_its_fastest(spikes):
    x = 0.5 * np.sin(3.0 * TIME)
    x[100 : 100 + 300 * spikes : 300] += 40.0
    assert speed(TIME, x) == pytest.approx(1.5, rel=0.05)
    assert speed(TIME, np.zeros(2000)) == 0.0


def test_times_that_are_wrong_by_a_factor_show(session):
    said = pace_in_words(session)
    slow = replace(session, trials={n: replace(t, time=10.0 * t.time) for n, t in session.trials.items()})
    assert (said, pace_in_words(slow)) == (
        "8 trials of 8.99 s; MCP turns fastest, at 40 degrees/s in 08-ID.3-dynamic",
        "8 trials of 89.9 s; MCP turns fastest, at 4 degrees/s in 08-ID.3-dynamic",
    )


def test_noise_of_held_joints_is_no_motion(session):
    held = session.select("ID.4")
    assert "no joint moves" in pace_in_words(replace(session, trials={t.name: t for t in held}))


@pytest.fixture
def session():
    return make_session()
