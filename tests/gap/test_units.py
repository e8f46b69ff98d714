"""A verdict is about a machine, not about the units or the scale that it is written in."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.gap import diagnose

from .conftest import TRUTH, WITHOUT, session_with

pytestmark = pytest.mark.long


def scaled(session, mass=1.0, length=1.0, time=1.0):
    """The same motions and weights of a machine whose masses, lengths and times are others, by these factors."""
    force, torque = mass * length / time**2, mass * length**2 / time**2
    f = session.finger
    finger = replace(
        f,
        gravity=f.gravity * length / time**2,
        origin=f.origin * length,
        fingertip=f.fingertip * length,
        mass=f.mass * mass,
        mass_std=f.mass_std * mass,
        com=f.com * length,
        com_std=f.com_std * length,
        inertia=f.inertia * mass * length**2,
    )

    def by(factor, values):
        return None if values is None else values * factor

    trials = {
        name: replace(
            t,
            time=t.time * time,
            session_start=by(time, t.session_start),
            tendon_force=by(force, t.tendon_force),
            tendon_excursion=by(length, t.tendon_excursion),
            joint_torque=by(torque, t.joint_torque),
            fingertip_force=by(force, t.fingertip_force),
        )
        for name, t in session.trials.items()
    }
    return replace(session, finger=finger, trials=trials)


@pytest.fixture(scope="module")
def session():
    return session_with((*TRUTH, {"a": 1.0, "x0": 0.1}))


@pytest.fixture(scope="module")
def found(session):
    return diagnose(session, without=WITHOUT, quick=True)


@pytest.mark.parametrize(
    "factors", [{"mass": 1e-3, "length": 10.0}, {"time": 2.0}], ids=["masses and lengths", "times"]
)
def test_the_verdict_its_probabilities_and_its_shares_are_the_same_at_another_scale(session, found, factors):
    other = diagnose(scaled(session, **factors), without=WITHOUT, quick=True)
    assert (other.status, other.named) == (found.status, found.named)
    near = 1e-3 if "time" not in factors else 0.02  # channels are reduced to a rate in Hz
    assert other.none == pytest.approx(found.none, abs=near)
    assert other.unlisted == pytest.approx(found.unlisted, abs=near)
    mine, theirs = ({c.key: c.probability for c in d.candidates} for d in (found, other))
    assert theirs == pytest.approx(mine, abs=near)
    assert [c.share for c in other.budget] == pytest.approx([c.share for c in found.budget], abs=10 * near)
    ours, same = ({v.name: v.value for v in d.budget[0].values} for d in (found, other))
    np.testing.assert_allclose(same["x0"], ours["x0"], rtol=10 * near)  # an angle
