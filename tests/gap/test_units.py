"""A verdict depends neither on the units nor on the scale of the machine."""

import numpy as np
import pytest

from jaxfinger.gap import diagnose
from tests.units import Scale

from .conftest import PLANTED, WITHOUT, session_with

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def session():
    return session_with(PLANTED)


@pytest.fixture(scope="module")
def found(session):
    return diagnose(session, without=WITHOUT, quick=True)


@pytest.mark.parametrize(
    "factors", [{"mass": 1e-3, "length": 10.0}, {"time": 2.0}], ids=["masses and lengths", "times"]
)
def test_the_verdict_its_probabilities_and_its_shares_are_the_same_at_another_scale(session, found, factors):
    other = diagnose(Scale(**factors)(session), without=WITHOUT, quick=True)
    assert (other.status, other.named) == (found.status, found.named)
    near = 1e-3 if "time" not in factors else 0.02  # channels are reduced to a rate in Hz
    assert other.none == pytest.approx(found.none, abs=near)
    assert other.unlisted == pytest.approx(found.unlisted, abs=near)
    mine, theirs = ({c.key: c.probability for c in d.candidates} for d in (found, other))
    assert theirs == pytest.approx(mine, abs=near)
    assert [c.share for c in other.budget] == pytest.approx([c.share for c in found.budget], abs=10 * near)
    ours, same = ({v.name: v.value for v in d.budget[0].values} for d in (found, other))
    np.testing.assert_allclose(same["x0"], ours["x0"], rtol=10 * near)  # an angle
