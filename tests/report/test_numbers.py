"""A number is read in a unit of its size, and no finer than its interval."""

import pytest

from jaxfinger.report.numbers import chance, extremes, measured, percent, percent_range, quantity, reach, with_error


@pytest.mark.parametrize(
    ("value", "units", "text"),
    [
        (6.1e-6, "m", "6.1 µm"),
        (0.02, "m", "20 mm"),
        (0.9997e-3, "m", "1 mm"),
        (1.2e-3, "N m", "1.2 N mm"),
        (36.9, "N", "37 N"),
        (4e-7, "N m", "400 nN m"),
        (0.0025, "kg", "2.5 g"),
        (7.2, "kg", "7.2 kg"),
        (3e-6, "kg m2", "3 mg m²"),
        (0.5, "rad", "29°"),
        (0.1, "rad/s", "5.7°/s"),
        (1.1e4, "N/m", "11 kN/m"),
        (0.52, "1", "0.52"),
        (0.0, "m", "0 m"),
        (2150.0, "m", "2150 m"),
        (float("nan"), "m", "–"),
    ],
)
def test_units_follow_the_size(value, units, text):
    assert quantity(value, units) == text


@pytest.mark.parametrize(
    ("value", "std", "units", "text"),
    [
        (1.29e-12, 1e-9, "kg", "0.0 ± 2.0 µg"),
        (-1e-12, 1e-9, "kg", "0.0 ± 2.0 µg"),
        (9.1e-5, 3e-6, "m/N", "91.0 ± 5.9 µm/N"),
        (0.012, 0.001, "N m s/rad", "12.0 ± 2.0 N mm s/rad"),
        (20.4, 0.2, "N", "20.40 ± 0.39 N"),
        (1e-3, 0.0, "m", "1 mm"),
        (1e-3, None, "m", "1 mm"),
    ],
)
def test_digits_follow_the_interval(value, std, units, text):
    assert measured(value, std, units) == text


def test_a_value_without_an_interval_says_so():
    assert with_error(2.0, None) == "2 ± ?"


@pytest.mark.parametrize(
    ("high", "low", "std", "text"),
    [
        (10.914, 4.786, 0.025, "10.914; 4.786 ± 0.049"),
        (1.00012, 1.0, 6e-4, "1.0001; 1.0000 ± 0.0012"),  # a sliding joint, whose arm is exact to a thousandth
        (29_850.0, 11_580.0, 2000.0, "29850; 11580 ± 3920"),
        (0.0, -0.0, 0.0, "0; 0"),
        (2.0, 1.0, None, "2; 1 ± ?"),
    ],
)
def test_the_reach_of_a_curve_has_the_digits_of_its_interval(high, low, std, text):
    assert reach(high, low, std) == text


@pytest.mark.parametrize(
    ("high", "low", "text"),
    [
        (13.53, -3.04, "13.5; -3.0"),
        (-1e-17, -0.7, "0.000; -0.700"),
        (0.0, 0.0, "0; 0"),
        (4e-4, 1e-4, "0.000400; 0.000100"),
    ],
)
def test_extremes_share_the_digits_of_the_larger(high, low, text):
    assert extremes(high, low) == text


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.41, "41 %"),
        (3e-4, "0.03 %"),
        (0.0, "0 %"),
        (-3e-3, "0 %"),
        (-0.03, "-3 %"),
        (1.0, "100 %"),
        (0.9996, "over 99 %"),
        (1e-7, "under 0.001 %"),
    ],
)
def test_shares(share, text):
    assert percent(share) == text


@pytest.mark.parametrize(("probability", "text"), [(1.0, "over 99 %"), (0.9996, "over 99 %"), (0.41, "41 %")])
def test_no_probability_is_certain(probability, text):
    assert chance(probability) == text


def test_an_interval_about_nothing_has_no_minus_zero():
    assert percent_range(-3e-3, 0.02) == "0 to 2 %"
    assert percent_range(-0.37, 0.0) == "-37 to 0 %"
    assert percent_range(0.996, 0.9999) == "over 99 %"
    assert percent_range(0.498, 0.502) == "50 %"
    assert percent_range(0.0, 0.0) == "0 %"
