"""A tendon whose moment arms contradict `crosses` or the known excursions is named, and a sound one is not."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.bad_input import complaints
from tests.data.checks.test_columns import of, turning

KNOWN = np.array([[[0.008, 1e-3], [0.005, 0.0]], [[-0.007, 0.0], [0.0, 0.0]], np.full((2, 2), np.nan)])
SOUND = (0.0088, -0.007)  # m: arms of T1 and T2 at MCP, about q = 0.4 rad


def said(session):
    return [text for text in complaints(session) if "does not cross joint" in text or "other moment arms" in text]


def test_a_tendon_that_travels_where_it_does_not_cross_is_named(session):
    (found,) = said(of(session, turning(0, SOUND), turning(1, (0.005, 0.004))))
    assert "tendon T2 does not cross joint PIP, yet is pulled in by 4.01 mm a radian" in found
    assert "add PIP to its `crosses`" in found
    assert "T1" not in found


@pytest.mark.parametrize("arm", [0.0, 1e-3])
def test_a_tendon_that_is_dragged_along_is_not_named(session, arm):
    assert said(of(session, turning(0, SOUND), turning(1, (0.005, arm)))) == []


def test_noise_at_a_joint_that_no_measured_tendon_crosses_is_not_named(session):
    """There, the largest arm is one of noise."""
    alone = of(session, turning(1, (0.0, 0.0)))
    crosses = alone.finger.crosses.copy()
    crosses[0, 1] = False
    for trials in ({}, {"ID.2-0": turning(0, SOUND)}):
        other = replace(alone, finger=replace(alone.finger, crosses=crosses), trials={**alone.trials, **trials})
        assert said(other) == []


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        ((1.0, -1.0), "T2 (-1 times); correct the sign of `excursion`"),
        ((2.0, 2.0), "T2 (2 times); correct the scale, as a diameter for a radius gives,"),
        ((0.5, 0.5), "T2 (0.5 times); correct the scale, as a diameter for a radius gives,"),
        ((0.1, 1.0), "T1 (0.1 times); correct the scale of `excursion`"),
        ((57.3, 57.3), "as degrees for rad give"),
        ((-1.0, -1.0), "T1 (-1 times), T2 (-1 times); correct the sign"),
    ],
)
def test_arms_that_are_not_the_known_ones_are_named(session, factors, words):
    trial = turning(0, np.multiply(SOUND, factors))
    assert said(of(session, turning(0, SOUND), known=KNOWN)) == []
    (found,) = said(of(session, trial, known=KNOWN))
    assert words in found
    assert not any("look exchanged" in text for text in complaints(of(session, trial, known=KNOWN)))


@pytest.mark.parametrize("factors", [(0.8, 1.25), (1.3, 1.3)])
def test_cad_that_is_off_by_less_than_a_diameter_is_sound(session, factors):
    assert said(of(session, turning(0, np.multiply(SOUND, factors)), known=KNOWN)) == []


def test_cad_that_says_how_little_it_knows_is_sound(session):
    off = of(session, turning(0, np.multiply(SOUND, 2.0)), known=KNOWN)
    std = np.where(np.isnan(KNOWN), np.nan, 0.5 * np.abs(KNOWN))
    assert said(off)
    assert said(replace(off, finger=replace(off.finger, excursion_std=std))) == []


def test_a_known_arm_that_is_small_may_be_wrong_by_its_size(session):
    small = KNOWN.copy()
    small[1, 0, 0] = -0.001
    assert said(of(session, turning(0, (0.0088, 0.0005)), known=small)) == []
