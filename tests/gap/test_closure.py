"""Bounds of a refit, and the interval of how far a gap closes."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.effects import CATALOGUE, Scales
from jaxfinger.gap import smooth_laws
from jaxfinger.gap.augment import nominal_fit
from jaxfinger.gap.closure import _line, closures
from jaxfinger.gap.columns import Columns
from jaxfinger.gap.exact import within_bounds
from jaxfinger.gap.parts import channels_not_judged
from jaxfinger.gap.result import Reason
from jaxfinger.identify.parameters import Free
from jaxfinger.model import Finger
from jaxfinger.synthetic import paper_finger, polynomial_finger, true_model


@pytest.fixture(scope="module")
def finger() -> Finger:
    return true_model(polynomial_finger(paper_finger())).finger


@pytest.mark.parametrize("effect", sorted(CATALOGUE))
def test_bounds_hold_every_number_and_leave_a_plausible_effect_alone(effect, finger):
    kind = CATALOGUE[effect]
    site = kind.sites(finger)[0]
    scales = Scales.of(finger)
    shape, sizes = kind.shapes(finger, site, scales)[0], kind.sizes(scales, site)
    plausible = kind.at(finger, site, **shape, **sizes)
    for name, value in within_bounds(plausible, scales).values().items():
        assert value == pytest.approx(plausible.values()[name])
    far = kind.at(finger, site, **shape, **{n: -size for n, size in sizes.items()})
    for name, p in kind.amplitudes().items():
        assert (within_bounds(far, scales).values()[name] < 0.0) == p.signed


def test_a_length_that_a_linear_step_turned_negative_comes_back(finger):
    kind = CATALOGUE["joint_presliding"]
    effect = kind.at(finger, ("PIP",), a=1.0, x0=-0.3)
    scales = Scales.of(finger)
    least = min(kind.worth_trying(scales, ("PIP",))["x0"])
    assert 0.0 < within_bounds(effect, scales).values()["x0"] <= least


def test_trials_without_a_gap_do_not_widen_the_interval_of_how_far_it_closes():
    """Two trials of twenty show the gap; draws of the bootstrap without either of them do not count."""
    rng = np.random.default_rng(1)
    noise = 1.0 + 0.02 * rng.standard_normal((20, 2))
    before = np.where(np.arange(20) < 2, 400.0, 1.0) * noise[:, 0]
    after = np.where(np.arange(20) < 2, 5.0, 1.0) * noise[:, 1]
    rows = np.stack([before, after, np.ones(20), np.full(20, 100.0)], axis=1)
    line = _line("ID.4", "tendon_excursion", "m", rows)
    assert line.closed == pytest.approx(1 - 4.0 / 399.0, abs=2e-3)
    assert 0.95 < line.closed_ci95[0] <= line.closed <= line.closed_ci95[1] <= 1.0
    nothing = _line("ID.4", "tendon_excursion", "m", rows[2:])
    assert (nothing.closed, nothing.closed_ci95, nothing.resolvable) == (0.0, (0.0, 0.0), False)


def test_a_simulation_that_runs_away_closes_nothing():
    rows = np.stack([np.full(6, 4.0), np.full(6, 0.1), np.full(6, 0.01), np.full(6, 100.0)], axis=1)
    assert _line("VD.3", "q", "rad", rows).closed > 0.9
    line = _line("VD.3", "q", "rad", rows, diverged=True)
    assert (line.closed, line.closed_ci95, line.diverged, line.resolvable) == (0.0, (0.0, 0.0), True, False)


def test_a_channel_that_is_not_judged_has_no_closure(planted, monkeypatch):
    every = {(x.experiment, x.channel) for x in closures(planted, None, False)}
    rows: dict[tuple[str, str], int] = {}
    for e, c, _, pick in smooth_laws.measured_columns(planted):
        rows[e, c] = max(rows.get((e, c), 0), len(pick))
    fewest = min(rows, key=rows.__getitem__)
    monkeypatch.setattr(smooth_laws, "MIN_ROWS", rows[fewest] + 1)
    judged = {(x.experiment, x.channel) for x in closures(planted, None, False)}
    refused = {(x.experiment, x.channel) for x in channels_not_judged(planted, Columns.of(planted))}
    assert fewest in refused
    assert judged | refused == every
    assert not judged & refused


def test_each_channel_that_is_not_judged_has_its_own_mend(planted):
    """A sensor that nobody read, a sample that breaks a rule, and a simulator's silence ask for different things."""
    e, c = "ID.3-static", "joint_torque"
    stack = planted.stacks[e]
    empty = {k: jnp.zeros_like(m) for k, m in stack.batch.mask.items()}
    batch = replace(stack.batch, mask=empty)

    def reasons(measured: bool, **changes) -> dict[tuple[str, str], Reason]:
        stacks = planted.stacks | {e: replace(stack, batch=batch, measured={c: measured})}
        found = channels_not_judged(replace(planted, **{"stacks": stacks} | changes), Columns.of(planted))
        return {(x.experiment, x.channel): x.reason for x in found}

    assert reasons(True) == {(e, c): Reason.NOTHING_COUNTS}
    assert reasons(False) == {(e, c): Reason.NOT_MEASURED}
    assert reasons(False, simulator=planted.nominal) == {(e, c): Reason.NOT_PREDICTED}
    unread = {t.name: replace(t, joint_torque=None) if t.experiment == e else t for t in planted.session}
    blind = replace(planted.session, trials=unread)
    assert reasons(False, simulator=planted.nominal, session=blind) == {(e, c): Reason.NOT_MEASURED}
    less = {k: s for k, s in planted.stacks.items() if k != e}
    assert reasons(True, simulator=planted.nominal, stacks=less) == {(e, c): Reason.NOT_PREDICTED}


def test_of_another_simulator_after_is_what_retuning_leaves(planted):
    """Where nothing is named, too: a wrong parameter alone is no reason to say that nothing closes."""
    at = Free.at(planted.nominal, planted.free)
    wrong = at.set(planted.nominal, 1.5 * np.asarray(at.get(planted.nominal)))
    own = {(x.experiment, x.channel): x for x in closures(planted, None, False)}
    other = replace(planted, simulator=wrong)
    for x in closures(other, nominal_fit(other), False):
        assert x.before > 2.0 * x.after
        assert x.after == pytest.approx(own[x.experiment, x.channel].after, rel=0.05)
