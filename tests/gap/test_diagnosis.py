"""A diagnosis from end to end: the planted causes are found, and all that is returned agrees with itself."""

from dataclasses import fields, replace

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from jaxfinger.effects import CATALOGUE, CatalogueEffect, amplitude
from jaxfinger.errors import UserError
from jaxfinger.gap import Status, diagnose, fit_with
from jaxfinger.gap.columns import Columns
from jaxfinger.gap.parts import channels_not_judged
from jaxfinger.gap.result import Key, NotJudged, Reason
from jaxfinger.gap.signatures import whitened
from jaxfinger.gap.where import where
from jaxfinger.identify import Fit, Recipe
from jaxfinger.identify.noise import whiten
from jaxfinger.identify.nominal import nominal_model
from jaxfinger.report.sentences import summary

from .conftest import PLANTED, RIVALS, TRUTH, WITHOUT, session_with


@pytest.fixture(scope="module")
def messages():
    return []


@pytest.fixture(scope="module")
def diagnosis(messages):
    return diagnose(session_with(PLANTED), without=WITHOUT, progress=messages.append)


def values(cause):
    return {v.name: v for v in cause.values}


def test_the_planted_cause_its_site_and_its_size_are_named(diagnosis):
    assert diagnosis.status is Status.EXPLAINED
    assert diagnosis.named == (Key(*TRUTH),)
    (cause,) = diagnosis.budget
    assert cause.probability > 0.9
    assert values(cause)["x0"].units == "rad"
    assert values(cause)["x0"].value == pytest.approx(0.1, rel=0.2)
    assert values(cause)["a"].value == pytest.approx(1.0, abs=0.15)
    assert diagnosis.candidates[0].key == Key(*TRUTH)


def test_no_number_of_a_candidate_is_certain(diagnosis):
    """Rivals outside of the fit have intervals, too; a choice of form, side or place and a full share have none."""
    for candidate in diagnosis.candidates:
        effect = CATALOGUE[candidate.key.effect]
        choices = {n for n, p in effect.shape_parameters().items() if p.moves == "not"}
        choices |= {
            v.name
            for v in candidate.values
            if v.name in effect.amplitudes() and v.value >= effect.amplitudes()[v.name].most
        }
        for v in candidate.values:
            assert np.isfinite(v.std)
            assert (v.std == 0.0) == (v.name in choices), (candidate.key, v)


def test_the_budget_is_the_gap(diagnosis):
    """The one cause has nearly all of the gap of each column, and little is left."""
    (cause,) = diagnosis.budget
    assert cause.share > 0.85
    assert cause.share_ci95[0] <= cause.share <= cause.share_ci95[1]
    assert diagnosis.unexplained.share < 0.15
    largest = max(diagnosis.channels, key=lambda x: x.gap)
    assert (largest.channel, largest.column) == ("joint_torque", "PIP")
    assert largest.gap > largest.noise
    assert len(largest.by_cause) == 1
    assert largest.by_cause[0] > 0.8
    assert {c.experiment for c in cause.channels} == {x.experiment for x in diagnosis.channels}


def test_a_gap_has_a_size_in_physical_units(diagnosis):
    """It is the rms of the residuals beyond the noise, and nothing is tolerated unless the user says so."""
    for x in diagnosis.relevance:
        (line,) = [c for c in diagnosis.closures if (c.experiment, c.channel) == (x.experiment, x.channel)]
        assert x.gap == pytest.approx(np.sqrt(line.before**2 - line.noise**2), rel=0.1)
        assert 0.0 < x.relative == pytest.approx(x.gap / x.signal)
        assert not x.tolerated


def test_the_gap_lies_at_the_joint_and_closes_on_held_out_trials(diagnosis):
    assert (diagnosis.where[0].channel, diagnosis.where[0].site) == ("joint_torque", "PIP")
    line = max(diagnosis.closures, key=lambda x: x.before / x.noise)
    assert line.channel == "joint_torque"
    assert line.closed > 0.9
    assert line.closed_ci95[0] <= line.closed <= line.closed_ci95[1]


@pytest.mark.long
def test_two_causes_are_both_named_and_keep_their_sizes():
    relaxation = "elastic_relaxation", ("MCP",)
    found = diagnose(session_with(PLANTED, (*relaxation, {"stiffness": 0.1, "T": 1.0})), without=WITHOUT)
    assert found.status is Status.EXPLAINED
    assert set(found.named) == {Key(*TRUTH), Key(*relaxation)}
    by = {c.effect: values(c) for c in found.budget}
    assert by["joint_presliding"]["x0"].value == pytest.approx(0.1, rel=0.2)
    assert by["elastic_relaxation"]["stiffness"].value == pytest.approx(0.1, rel=0.2)
    assert by["elastic_relaxation"]["T"].value == pytest.approx(1.0, rel=0.3)
    # A column with a large gap hides none with a small one: each cause closes the column of its own joint.
    for x in found.channels:
        own = [c.effect for c in found.budget].index("joint_presliding" if x.column == "PIP" else "elastic_relaxation")
        assert np.argmax(x.by_cause) == own


@pytest.mark.long
def test_a_first_look_names_what_the_whole_one_does(diagnosis):
    """A first look reads half the samples, and fits causes and nominal parameters in turn."""
    look = diagnose(session_with(PLANTED), without=WITHOUT, quick=True)
    assert (look.status, look.named) == (diagnosis.status, diagnosis.named)
    ours, theirs = (values(d.budget[0]) for d in (look, diagnosis))
    for name in ours:
        std = np.hypot(ours[name].std, theirs[name].std)
        assert ours[name].value == pytest.approx(theirs[name].value, abs=4.0 * std)


@pytest.mark.long
def test_a_fit_with_the_effect_that_is_known_to_be_there_is_that_of_the_diagnosis(diagnosis):
    known = fit_with(session_with(PLANTED), [TRUTH])
    for ours, theirs in zip(known.model.effects, diagnosis.augmented.model.effects, strict=True):
        assert ours.values() == pytest.approx(theirs.values(), rel=1e-2)


@pytest.mark.long
def test_a_fit_with_an_effect_that_cannot_be_there_is_refused():
    session = session_with()
    with pytest.raises(UserError, match="joint_presliding is not at T1; it has MCP, PIP, DIP"):
        fit_with(session, [("joint_presliding", ("T1",))])
    with pytest.raises(UserError, match=r"joint_coulomb is a term of the recipe.s own model"):
        fit_with(session, [("joint_coulomb", ("PIP",))])
    with pytest.raises(UserError, match=r"no trial shows force_sensor_rotation at fingertip; record VD\.2"):
        fit_with(session, [("force_sensor_rotation", ("fingertip",))])
    with pytest.raises(UserError, match="no effect stiction"):
        fit_with(session, [("stiction", ("PIP",))])


def test_nothing_is_named_where_nothing_is():
    found = diagnose(session_with(), without=WITHOUT)
    assert found.status is Status.NO_GAP
    assert not found.named
    assert not found.budget
    assert found.none > 0.9
    assert found.unlisted < 0.1
    assert not found.relevance
    assert max(c.probability for c in found.candidates) < 0.1
    assert found.augmented is found.nominal


def test_signatures_are_whitened_as_the_residuals_are(planted):
    problem = planted
    rng = np.random.default_rng(0)
    for e, channel in (("ID.3-dynamic", "joint_torque"), ("ID.2", "tendon_excursion")):
        rows, stack = problem.rows[e], problem.stacks[e]
        raw = rng.standard_normal((1, *stack.batch.y[channel].shape))
        pick = np.arange(rows.size)
        mine = whitened(raw, problem, rows, pick, channel)[0]
        filters = jnp.asarray(problem.noise[e, channel].coefficients)
        white = whiten(jnp.asarray(raw[0]), stack.batch.mask[channel], filters, channel == "tendon_excursion")
        reference = np.asarray(white)[rows.column, rows.trial, rows.time]
        np.testing.assert_allclose(mine, reference, rtol=1e-6, atol=1e-6 * np.abs(reference).max())


def test_where_finds_a_planted_gap(planted):
    """White noise everywhere, and five deviations more in the upper angles of one trial."""
    problem = planted
    rows = problem.rows["ID.3-dynamic"]
    r = np.random.default_rng(1).standard_normal(problem.r.size)
    trial, column = int(rows.trial[-1]), int(rows.column[rows.trial == rows.trial[-1]][0])
    mine = (rows.trial == trial) & (rows.column == column)
    q = np.asarray(problem.stacks["ID.3-dynamic"].batch.x.q)[column, trial, rows.time]
    threshold = np.quantile(q[mine], 2 / 3)
    r[rows.start : rows.start + rows.size][mine & (q > threshold)] += 5.0
    (place, *rest) = where(replace(problem, r=r))
    assert not rest
    assert place.trial == problem.stacks["ID.3-dynamic"].trials[trial]
    assert place.site == problem.nominal.finger.joint_names[column]
    assert place.variable == "q"
    assert place.low == pytest.approx(threshold, abs=0.05)
    assert place.share > 0.9


def test_no_place_stands_out_of_white_noise(planted):
    assert where(replace(planted, r=np.random.default_rng(2).standard_normal(planted.r.size))) == []


def three_seconds(measured=True):
    """A session of three seconds of ID.2: 30 rows of a first look, where a column has 50 at least."""
    session = session_with()
    trial = next(iter(session.select("ID.2")))
    arrays = {f.name: getattr(trial, f.name) for f in fields(trial)}
    short = replace(trial, **{k: x[:300] for k, x in arrays.items() if isinstance(x, np.ndarray)})
    if not measured:
        short = replace(short, tendon_excursion=np.full_like(short.tendon_excursion, np.nan))
    return replace(session, trials={short.name: short})


def test_the_data_of_a_fit_of_the_session_itself_are_said_to_count_twice():
    session, other = three_seconds(), session_with(seed=9)
    said = []
    for of in (session, other):
        fit = Fit.before(of, Recipe(), nominal_model(of, Recipe()))
        said.append(summary(diagnose(session, without=WITHOUT, quick=True, against=fit)))
    assert ["was made from this session, whose data then count twice" in x for x in said] == [True, False]


@pytest.mark.parametrize(("measured", "reason"), [(False, Reason.NOT_MEASURED), (True, Reason.FEW_SAMPLES)])
def test_a_session_in_which_too_few_samples_count_is_not_judged(measured, reason):
    found = diagnose(three_seconds(measured), without=WITHOUT, quick=True)
    assert found.status is Status.NOT_JUDGED
    assert found.not_judged == (NotJudged("ID.2", "tendon_excursion", reason),)
    assert not found.named
    assert found.augmented is found.nominal


def test_a_channel_with_too_few_samples_is_listed_as_not_judged(planted):
    columns = Columns.of(planted)
    assert channels_not_judged(planted, columns) == ()
    fewer = Columns(tuple(c for c in columns.items if c.experiment != "ID.2"))
    assert channels_not_judged(planted, fewer) == (NotJudged("ID.2", "tendon_excursion", Reason.FEW_SAMPLES),)


def test_progress_is_told(diagnosis, messages):
    assert len(messages) > 5
    assert any("refitting" in m for m in messages)


def test_an_unknown_effect_to_leave_out_is_refused():
    with pytest.raises(UserError, match="no effect joint_magic"):
        diagnose(session_with(), without=("joint_magic",))


class SumOfAngles(CatalogueEffect):
    """A torque periodic in the sum of two angles."""

    ID = "sum_of_angles"
    PLACE = "joint pair"

    a: Float[Array, ""] = amplitude("N m", 0.02, "torque", signed=True)

    def torque(self, x, memory, h):
        i, j = self.index
        return h.at[i].add(self.a * jnp.sin(6.0 * (x.q[i] + x.q[j])))


@pytest.mark.parametrize("known", [RIVALS, ("tendon_backlash", "tendon_stretch")])
@pytest.mark.long
def test_a_law_that_nobody_listed_gets_a_proposal_in_closed_form(known):
    """It does so whether the catalogue's effects explain some of the gap or none of it.

    Nothing is named in either case, and the augmented model is the nominal one.
    """
    session = session_with((SumOfAngles, ("PIP", "DIP"), {"a": 3e-3}))
    found = diagnose(session, without=tuple(set(CATALOGUE) - set(known)), quick=True)
    assert found.status is Status.UNEXPLAINED
    assert not found.named
    assert found.unlisted > 0.5
    assert found.augmented is found.nominal
    assert found.unexplained.where.column == "PIP"
    assert found.unexplained.proposal is not None
    assert found.unexplained.proposal.site == "PIP"
    assert found.unexplained.proposal.share > 0.5
    assert found.where[0].site == "PIP"
    assert all(x.relative < 0.9 for x in found.relevance)
