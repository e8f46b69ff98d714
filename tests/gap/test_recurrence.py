"""A law that recurs within a trial is a gap where no trial repeats it, however quick and however large it is."""

import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap import Status, diagnose
from jaxfinger.synthetic import recipe_from
from tests.gap.conftest import TABLE, session_with

ALONE = recipe_from(
    {
        **TABLE,
        "trials": {
            "rate": 200.0,
            "experiments": ["ID.3-dynamic"],
            "id3_dynamic": {"repeats": 1, "postures": [[25, 30, 45]], "cycles": 1},
        },
    }
)
RIPPLES = ("torque_ripple", "joint_presliding")
SITE = ("PIP",)


def diagnosed(A, candidates):
    """Of one trial of each joint with a ripple of five periods in its range; the noise of a sample is 0.14 mN m."""
    session = session_with(("torque_ripple", SITE, {"A": A, "B": 0.0, "p": 32.0}), recipe=ALONE)
    return diagnose(session, quick=True, without=tuple(set(CATALOGUE) - set(candidates)))


@pytest.mark.parametrize("A", [5e-4, 4e-3])
def test_a_ripple_of_any_size_is_named(A):
    found = diagnosed(A, RIPPLES)
    assert found.status is Status.EXPLAINED
    assert {(k.effect, k.site) for k in found.named} == {("torque_ripple", SITE)}


def test_without_a_ripple_there_is_no_gap():
    assert diagnosed(0.0, RIPPLES).status is Status.NO_GAP
