"""The diagnosis on one screen."""

import pytest

from jaxfinger.report import sentences
from jaxfinger.report.screen import summary

from .fabricated import every

ALL = every()


@pytest.mark.parametrize("name", ALL)
def test_it_fits_on_a_screen_and_says_the_verdict(name):
    lines = summary(ALL[name]).splitlines()
    assert len(lines) <= 40
    assert max(map(len, lines)) <= 120
    assert sentences.headline(ALL[name]) in lines
    assert "nan" not in summary(ALL[name])


def test_a_bar_shows_every_part():
    text = summary(ALL["two"])
    bar = next(line for line in text.splitlines() if "ID.4 joint torque PIP" in line).split()[0]
    assert len(bar) == 30
    assert bar.count("▓") in range(17, 20)  # 62 % of a gap that is 97 % of the bar
    assert bar.count("?") in (1, 2)
    assert "▓ joint Stribeck at PIP" in text
