"""The formula on made-up rows: random features, signatures and noise."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.gap.budget import MIN_GAP_EVIDENCE
from jaxfinger.gap.by_column import ByColumn
from jaxfinger.gap.columns import Column, Columns
from jaxfinger.gap.formula import LinearModel, Parameters, unexplained, unlisted
from jaxfinger.gap.parts import columns_with_gap

ROWS, FEATURES, COLUMNS = 400, 20, 6


@pytest.fixture(scope="module")
def columns():
    rng = np.random.default_rng(0)
    basis = [np.linalg.qr(rng.standard_normal((ROWS, FEATURES)))[0] for _ in range(COLUMNS)]
    return Columns(tuple(Column("E", "c", i, np.arange(ROWS) + i * ROWS, U) for i, U in enumerate(basis)))


@pytest.fixture
def rng():
    return np.random.default_rng(1)


def smooth(columns, rng, *where):
    """A random row of length one on the features of some columns, zero in the others."""
    x = np.zeros(ROWS * COLUMNS)
    for c in where:
        a = rng.standard_normal(FEATURES)
        x[columns.items[c].rows] = columns.items[c].basis @ (a / np.linalg.norm(a))
    return x


def quick(columns, rng, c):
    """A random row of length one outside of the features of column c, zero in the others."""
    x, basis = np.zeros(ROWS * COLUMNS), columns.items[c].basis
    a = rng.standard_normal(ROWS)
    a -= basis @ (basis.T @ a)
    x[columns.items[c].rows] = a / np.linalg.norm(a)
    return x


def linear(columns, r, Z, J=None):
    J = np.empty((0, r.size)) if J is None else J
    base = ByColumn.of(columns, np.vstack([r[None], J]))
    return LinearModel(columns, [base], np.zeros((1 + len(J),) * 2), ByColumn.of(columns, Z), Parameters())


def test_a_quiet_cause_counts_beside_a_loud_error(columns, rng):
    """An unknown error in one column, fifty times as large, leaves the gain of a cause in another as it is."""
    z, loud = smooth(columns, rng, 0), smooth(columns, rng, 3)
    noise = rng.standard_normal(ROWS * COLUMNS)
    gains = []
    for size in (0.0, 3000.0):
        model = linear(columns, noise + 60.0 * z + size * loud, 60.0 * z[None])
        gains.append(model.fit(np.array([0])).score - model.null.score)
    assert gains[0] > 20.0
    assert gains[1] == pytest.approx(gains[0], abs=0.5)


def test_an_imitator_that_explains_half_of_every_column_gains_much_less_than_the_cause(columns, rng):
    everywhere = np.stack([smooth(columns, rng, c) for c in range(COLUMNS)])
    noise = rng.standard_normal(ROWS * COLUMNS)
    r = noise + 100.0 * everywhere.sum(axis=0)
    half = everywhere.sum(axis=0) + np.stack([smooth(columns, rng, c) for c in range(COLUMNS)]).sum(axis=0)
    model = linear(columns, r, 100.0 * np.stack([everywhere.sum(axis=0), half]))
    true, imitator = (model.fit(np.array([k])).score - model.null.score for k in (0, 1))
    assert true > 3.0 * imitator


def test_signatures_gain_nothing_from_noise(columns, rng):
    r = rng.standard_normal(ROWS * COLUMNS)
    Z = 20.0 * np.stack([smooth(columns, rng, *range(COLUMNS)) for _ in range(200)])
    model = linear(columns, r, Z)
    found = [model.fit(np.array([k])).score - model.null.score for k in range(len(Z))]
    assert max(found) < 6.0
    assert unexplained(columns.counts, model.null.evidence, Parameters()).sum() == 0.0


def test_a_cause_beside_the_smooth_features_shows_a_gap_in_its_column_and_in_no_other(columns, rng):
    """Friction at reversals acts within a few samples, which no smooth feature describes."""
    z = np.zeros(ROWS * COLUMNS)
    z[columns.items[2].rows[::40]] = 1.0
    model = linear(columns, rng.standard_normal(z.size) + 8.0 * z, 8.0 * z[None])
    found, p = model.fit(np.array([0])), Parameters()
    null = model.null.evidence
    assert unexplained(columns.counts, null, p).max() < MIN_GAP_EVIDENCE
    assert columns_with_gap(columns.counts, null, found.evidence, p) == {2}
    assert columns_with_gap(columns.counts, null, null, p) == set()


def test_a_noise_that_is_larger_than_believed_is_no_gap(columns, rng):
    r = 1.4 * rng.standard_normal(ROWS * COLUMNS)
    null = linear(columns, r, np.empty((0, r.size))).null
    assert unexplained(columns.counts, null.evidence, Parameters()).sum() < 3.0


def test_what_the_nominal_parameters_absorb_is_no_evidence(columns, rng):
    z = smooth(columns, rng, 0, 1)
    r = rng.standard_normal(ROWS * COLUMNS) + 200.0 * z
    model = linear(columns, r, 200.0 * z[None], J=z[None])
    assert model.fit(np.array([0])).score - model.null.score < 0.5


def test_a_step_of_the_screen_is_close_to_the_likeliest_amplitude(columns, rng):
    z = np.stack([smooth(columns, rng, 0, 2), smooth(columns, rng, 1)])
    J = rng.standard_normal((3, ROWS * COLUMNS))
    r = rng.standard_normal(ROWS * COLUMNS) + 30.0 * z[0]
    model = linear(columns, r, 30.0 * z, J=J)
    ends = (np.array([0.0]), np.array([np.inf]))
    screened = model.screen(model.null, [np.array([0]), np.array([1])], [ends, ends])
    for k, more in enumerate(screened):
        gain = more.score if more else 0.0
        fitted = model.fit(np.array([k]), *ends).score - model.null.score
        assert max(gain, 0.0) == pytest.approx(max(fitted, 0.0), abs=0.1 * abs(fitted) + 1.0)


def test_further_rounds_lose_nothing(columns, rng):
    """The nominal model closes what lies outside of the features of a quiet column, at the price of another column."""
    outside = quick(columns, rng, 0)
    r = 0.8 * rng.standard_normal(ROWS * COLUMNS) + 10.0 * outside
    model = linear(columns, r, np.empty((0, r.size)), (outside + 1.5 * smooth(columns, rng, 1))[None])
    again = model.fit(np.empty(0, int), start=model.null.weights)
    assert again.score >= model.null.score - 1e-9


def test_a_cause_that_acts_outside_of_the_features_counts_where_noise_is_less_than_stated(columns, rng):
    """It brings half of its energy, as in noise of known size, less the Occam factor of its one amplitude."""
    z = quick(columns, rng, 0)
    r = 0.6 * rng.standard_normal(ROWS * COLUMNS) + 12.0 * z
    model = linear(columns, r, 12.0 * z[None])
    gain, occam = model.fit(np.array([0])).score - model.null.score, np.log(12.0) + 0.5
    assert gain == pytest.approx(0.5 * (z @ r) ** 2 - occam, rel=0.02)


def test_less_than_a_noise_that_only_residuals_tell_is_no_evidence(columns, rng):
    """Such noise may be a law that the model lacks, and what imitates a part of it is no cause."""
    z = quick(columns, rng, 0)
    r = 0.6 * rng.standard_normal(ROWS * COLUMNS) + 12.0 * z
    unknown = Columns(tuple(replace(c, noise_known=False) for c in columns.items))
    model = linear(unknown, r, 12.0 * z[None])
    assert model.fit(np.array([0])).score < model.null.score


def test_an_amplitude_keeps_to_its_bounds(columns, rng):
    z = smooth(columns, rng, 0)
    r = rng.standard_normal(ROWS * COLUMNS) - 50.0 * z
    model = linear(columns, r, 50.0 * z[None])
    fitted = model.fit(np.array([0]), np.array([0.0]), np.array([np.inf]))
    assert fitted.amplitudes[0] == 0.0
    assert fitted.score <= model.null.score


def test_a_law_of_another_form_is_nothing_unlisted_but_what_no_cause_explains_is(columns, rng):
    """A sixteenth of the explained energy may be left in the cause's own column, but not in another."""
    noise = rng.standard_normal(ROWS * COLUMNS)
    z, there, elsewhere = (smooth(columns, rng, c) for c in (0, 0, 3))
    found = []
    for other in (0.0 * there, there, elsewhere):
        model = linear(columns, noise + 120.0 * z + 30.0 * other, 120.0 * z[None])
        found.append(unlisted(columns.counts, model.fit(np.array([0])).evidence, Parameters()))
    assert found[0] < 0.05
    assert found[1] < 0.05 < 0.95 < found[2]
