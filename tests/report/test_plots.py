"""Figures as functions: they draw on the axes that they are given, and show their arguments."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.errors import UserError
from jaxfinger.identify.sensitivity import Sensitivity
from jaxfinger.report import plots
from jaxfinger.report.curves import Curve, Curves
from jaxfinger.report.plots.gap import segments
from jaxfinger.report.theme import LOOK, axes_or_new

from .fabricated import BARS, LINES, every, fits, trace


def held(shifts, count=30):
    """A sensitivity in which some trials shift some parameters by given numbers of standard deviations."""
    fit = fits()[1]
    values = np.zeros((count, fit.std.size))
    for (row, column), shift in shifts.items():
        values[row, fit.estimated[column]] = shift * fit.std[fit.estimated[column]]
    return Sensitivity("trials", tuple(f"t{k}" for k in range(count)), values, values)


DRAWN = {
    "budget": lambda ax: plots.budget(every()["two"], ax),
    "closure": lambda ax: plots.closure(LINES, ax),
    "signal": lambda ax: plots.signal(trace(), ax),
    "residuals": lambda ax: plots.residuals(trace(), ax),
    "intervals": lambda ax: plots.intervals(fits()[1], None, fits()[0], ax),
    "correlation": lambda ax: plots.correlation(fits()[1], 8, ax),
    "influence": lambda ax: plots.influence(held({(0, 1): 1.0, (2, 3): -0.5}), fits()[1], ax=ax),
}


@pytest.mark.parametrize("name", DRAWN)
def test_axes_are_taken_and_returned(name):
    ax = axes_or_new(None)
    before = set(map(id, ax.figure.axes))
    assert DRAWN[name](ax) is ax
    assert set(map(id, ax.figure.axes)) == before
    assert DRAWN[name](None) is not ax
    sizes = {t.get_fontsize() for t in ax.findobj(lambda a: hasattr(a, "get_fontsize")) if t.get_text()}
    assert min(sizes) >= LOOK["font.size"]


@pytest.mark.parametrize(
    "bar",
    [
        *BARS,
        replace(BARS[0], by_cause=(), unexplained=0.9),
        replace(BARS[1], by_cause=(0.9,)),
        replace(BARS[0], gap=0.0),
    ],
)
def test_a_bar_is_whole(bar):
    noise, causes, together, left = segments(bar)
    assert noise + sum(causes) + together + left == pytest.approx(1.0)
    assert min([noise, together, left, *causes]) >= 0.0
    of_noise = bar.noise**2 / (bar.noise**2 + bar.gap**2)
    assert left == pytest.approx(bar.unexplained * (1 - of_noise))
    if len(bar.by_cause) < 2:
        assert together == 0.0
        assert sum(causes) == pytest.approx(sum(bar.by_cause) * (1 - of_noise))
    else:
        assert noise == pytest.approx(of_noise)


def test_one_cause_has_no_more_of_a_bar_than_comes_back_without_it():
    """What it neither closes nor leaves is a gap that held-out trials do not show."""
    noise, causes, together, left = segments(replace(BARS[0], by_cause=(0.03,), unexplained=0.0))
    assert causes[0] < 0.03
    assert (together, left) == (0.0, 0.0)
    assert noise > 0.97


def test_a_bar_keeps_the_proportion_of_its_causes():
    """Shares that sum to more than all causes close are scaled down in proportion."""
    _, causes, together, _ = segments(replace(BARS[2], by_cause=(0.6, 0.3), unexplained=0.4))
    assert causes[0] == pytest.approx(2 * causes[1])
    assert together == pytest.approx(0.0)


@pytest.mark.parametrize("after", [0.05, 0.3, 1.0, 40.0])
def test_every_rms_lies_within_its_panel(after):
    ax = plots.closure([replace(LINES[0], before=2.0 * LINES[0].noise, after=after * LINES[0].noise)])
    low, high = ax.get_xlim()
    assert low < min(after, 2.0)
    assert max(after, 2.0) < high


def test_what_ran_away_and_what_has_no_noise_is_not_drawn():
    ax = plots.closure([replace(LINES[0], diverged=True), LINES[2], LINES[1]])
    texts = [t.get_text() for t in ax.texts]
    assert "VD.1 · tendon excursion" in texts
    assert not any(t.startswith(("ID.4", "VD.3")) for t in texts)


def test_correlated_neighbours_are_shown():
    ax = plots.correlation(fits()[0], 6)
    assert len(ax.get_yticklabels()) == 6
    assert sum(len(c.get_offsets()) for c in ax.collections) >= 5


def test_squares_of_parameters_with_long_names_do_not_touch(monkeypatch):
    names = [f"elastic_relaxation joint{k} stiffness" for k in range(10)]
    monkeypatch.setattr("jaxfinger.report.plots.fit.correlations", lambda fit: (names, np.ones((10, 10))))
    ax = plots.correlation(fits()[0], 10, axes_or_new(None, 3.35, 3.0))
    ax.figure.draw_without_rendering()
    numbers = [t.get_window_extent() for t in ax.get_xticklabels()]
    assert all(left.x1 < right.x0 for left, right in itertools.pairwise(numbers))
    cells = np.abs(np.diff(ax.transData.transform([(0.0, 0.0), (1.0, 1.0)]), axis=0)) * 72.0 / ax.figure.dpi
    assert np.sqrt(max(c.get_sizes().max(initial=0.0) for c in ax.collections)) < cells.min()
    legend = ax.get_legend().get_window_extent()
    assert 0.0 <= legend.x0 < legend.x1 <= ax.figure.bbox.width


def test_of_many_influences_the_largest_are_shown():
    ax = plots.influence({"trials": held({(7, 3): 2.0, (21, 5): -1.0})}, fits()[1], most=2)
    names = [row["name"] for row in fits()[1].table()]
    assert [t.get_text() for t in ax.get_yticklabels()] == ["t7", "t21"]
    assert [t.get_text() for t in ax.get_xticklabels()] == [names[3], names[5]]
    up, down = (c.get_sizes()[0] for c in ax.collections)
    assert up == pytest.approx(2.0 * down)
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["up 2 σ", "down 2 σ"]


def test_what_one_trial_alone_tells_of_is_as_large_as_the_largest():
    ax = plots.influence(held({(7, 3): 2.0, (21, 5): np.inf}), fits()[1], most=2)
    squares = ax.collections[0]
    assert len(set(squares.get_sizes())) == 1


def test_a_curve_that_a_fit_has_not_is_refused():
    fit, straight = fits()[1], Curve(*np.zeros((3, 5)))
    with pytest.raises(UserError, match=r"no moment arm about joint 'mcp' \(did you mean 'MCP'\?\); there are MCP"):
        plots.moment_arms(Curves({("T1", "MCP"): straight}, {}, {}), "mcp")
    with pytest.raises(UserError, match="no torque of joint 'thumb'"):
        plots.joint_torque(fit, "thumb")
    with pytest.raises(UserError, match="no estimated parameter 'mass'"):
        plots.intervals(fit, ["mass"])


def test_a_diagnosis_is_drawn_like_its_closures():
    d, (one, other) = every()["two"], (axes_or_new(None), axes_or_new(None))
    plots.closure(d, one)
    plots.closure(d.closures, other)
    assert [t.get_text() for t in one.texts] == [t.get_text() for t in other.texts] != []


def test_measured_in_points_and_the_model_as_lines():
    time, y = np.linspace(0.0, 1.0, 5000), np.ones((5000, 3)) * [1.0, 2.0, np.nan]
    ax = plots.over_time(time, ["a", "b", "c"], y, y + 0.1)
    styles = [(line.get_marker(), line.get_linestyle()) for line in ax.lines]
    assert styles == [(".", "None"), ("None", "-")] * 2
    assert max(len(line.get_xdata()) for line in ax.lines) < 1300
    texts = [t.get_text() for t in ax.get_legend().get_texts()]
    assert texts == ["a", "b", "measured", "model"]
