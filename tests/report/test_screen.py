"""The summary for a terminal."""

from dataclasses import replace

import pytest

from jaxfinger.gap.result import Value
from jaxfinger.report import sentences
from jaxfinger.report.causes import parameters
from jaxfinger.report.screen import comparison, summary

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


def test_what_came_of_effects_of_ones_own_is_said():
    d = ALL["no_gap"]
    text = summary(d, ["tendon_stretch", "tendon_creep"])
    assert "tendon stretch: probability 2 % at T3" in text
    assert "tendon creep: no trial shows it" in text
    assert "YOURS" not in summary(ALL["two"], ["tendon_stretch"])  # which is named
    assert "YOURS" not in summary(d)


def test_what_no_refit_moves_is_said_in_words_or_not_at_all():
    """A load lies in the finger's plane, and whether it is the link's own is no number."""
    values = {"mass": (0.02, 1e-3, "kg"), "x": (0.03, 1e-3, "m"), "y": (0.0, 0.0, "m"), "moved": (0.0, 0.0, "1")}
    site = ("PIP",)
    loaded = replace(
        ALL["explained"].budget[0],
        effect="payload",
        sites=(site,),
        values=tuple(Value(site, name, *of) for name, of in values.items()),
    )
    d = replace(ALL["explained"], named=loaded.keys, budget=(loaded,))
    assert "      mass 20.0 ± 2.0 g; x 30.0 ± 2.0 mm; added to the link" in summary(d).splitlines()
    assert parameters("payload", loaded.values, d) == [
        ("mass", "20.0 ± 2.0 g"),
        ("x", "30.0 ± 2.0 mm"),
        ("", "added to the link"),
    ]
    coupled = parameters("moment_arm_coupling", ALL["coupled"].budget[0].values, d)
    assert coupled[:2] == [("A T1", "1.000 ± 0.020 mm/rad²"), ("T1", "of MCP and PIP")]


def test_a_table_of_several_sessions_says_which_cause_is_at_work_in_which():
    header, rows = comparison(
        {
            "monday.h5": ALL["two"],
            "tuesday.h5": ALL["partly_ambiguous"],
            "rest.h5": replace(ALL["no_gap"], candidates=()),
        }
    )
    assert header == ["cause", "monday.h5", "tuesday.h5", "rest.h5"]
    said = {row[0]: row[1:] for row in rows}
    assert set(said) == {"tendon stretch at T3", "tendon creep at T3", "joint Stribeck at PIP"}
    monday, tuesday, rest = said["tendon stretch at T3"]
    assert " %, compliance " in monday
    assert tuesday == "50 %, compliance 91.0 ± 5.9 µm/N"
    assert rest == "not visible"


def test_the_table_of_several_sessions_has_every_rival_with_its_size_where_it_is_one():
    _, rows = comparison({"a.h5": ALL["ambiguous"], "b.h5": ALL["no_gap"]})
    size = "compliance 91.0 ± 5.9 µm/N"
    assert rows == [
        ["tendon creep at T3", f"36 %, {size}", "not visible"],
        ["tendon stretch at T3", f"62 %, {size}", "2 %"],
    ]
