"""Fits of many sessions at once equal single fits, report members that fail, and can be shared among processes."""

import pickle
import socket
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.errors import UserError
from jaxfinger.identify import compress, fit_many, identify, refit
from jaxfinger.identify.nominal import nominal_model
from jaxfinger.identify.parameters import ravel
from jaxfinger.identify.uncertainty import draw_weights
from jaxfinger.synthetic import measure


@pytest.fixture(scope="module")
def sessions(clean):
    return [measure(clean, seed) for seed in range(3)]


def without_excursion(session):
    lost = {
        t.name: replace(t, tendon_excursion=np.full_like(t.tendon_excursion, np.nan))
        for t in session.select("ID.2", joint="MCP")
    }
    return replace(session, trials={**session.trials, **lost})


def with_bursts(session):
    """Session with torques 3 N mm too large in every fiftieth sample, in bursts of five."""
    rng = np.random.default_rng(0)

    def hit(trial):
        torque = trial.joint_torque.copy()
        for first in rng.choice(len(torque) - 5, len(torque) // 250, replace=False):
            torque[first : first + 5] += 3e-3
        return replace(trial, joint_torque=torque)

    trials = {t.name: hit(t) if t.experiment == "ID.3-dynamic" else t for t in session}
    return replace(session, trials=trials)


def with_vaguer_links(session):
    """Session whose description knows masses and centres of mass ten times less well."""
    vague = {k: 10.0 * getattr(session.finger, k) for k in ("mass_std", "com_std")}
    return replace(session, finger=replace(session.finger, **vague))


def with_heavier_links(session):
    return replace(session, finger=replace(session.finger, mass=1.2 * session.finger.mass))


@pytest.fixture(scope="module")
def members(sessions, session, staged):
    """Fits of two plain sessions, one without excursions of a joint, and the second with bursts, heavy, vague links."""
    second = sessions[1]
    odd = [without_excursion(sessions[2]), with_bursts(second), with_heavier_links(second), with_vaguer_links(second)]
    return fit_many([*sessions[:2], *odd], staged, session)


@pytest.mark.long
def test_members_that_fail_are_named_and_spoil_nothing(members):
    np.testing.assert_array_equal(members.failed, [False, False, True, False, False, False])
    assert np.isnan(members.values[2]).all()
    assert np.isfinite(members.values[[0, 1, 3, 4, 5]]).all()


@pytest.mark.long
def test_members_are_the_fits_of_each_session_alone(members, sessions, staged):
    free = staged.estimated
    for k, session in enumerate(sessions[:2]):
        alone = identify(session)
        difference = (members.values[k] - np.asarray(ravel(alone.model)))[free] / alone.std[free]
        # A single fit estimates its own noise, so that its weights differ a little.
        assert np.abs(difference).max() < 0.5
        assert np.median(np.abs(difference)) < 0.1
        # It also tells from its own scatter how wide its intervals must be; a member has that of the template.
        ratio = members.std[k][free] / alone.std[free]
        assert 0.7 < ratio.min() < ratio.max() < 1.4
        assert abs(np.log(np.median(ratio))) < 0.1


@pytest.mark.long
def test_members_are_what_identify_finds_from_the_same_start_outliers_included(members, sessions, staged):
    """Solver, rows and weights are the same."""
    own = replace(staged.model, finger=nominal_model(sessions[1], staged.recipe).finger)
    again, free = replace(staged, model=own, stages=()), staged.estimated
    for k, member in ((3, with_bursts(sessions[1])), (1, sessions[1])):
        start = again.made_from(member)  # so that its noise counts for the member
        alone = np.asarray(ravel(identify(member, start=start, stages=("ID.2", "ID.3-dynamic", "ID.4")).model))
        scale = np.maximum(np.abs(alone), staged.std)[free]
        assert np.abs((members.values[k] - alone)[free] / scale).max() < 1e-8
    # Without robust weights the bursts would move estimates by several standard deviations.
    assert np.abs((members.values[3] - members.values[1])[free] / staged.std[free]).max() < 1.5


@pytest.mark.long
def test_the_template_itself_comes_back(members, staged):
    free = staged.estimated
    difference = (members.values[0] - np.asarray(ravel(staged.model)))[free] / staged.std[free]
    assert np.abs(difference).max() < 0.05
    np.testing.assert_allclose(members.std[0][free], staged.std[free], rtol=0.02)


@pytest.mark.long
def test_members_keep_their_own_links(members, sessions, staged):
    """Heavier links change gravity torques, and thus the estimated elastic torques."""
    heavy = with_heavier_links(sessions[1])
    alone = identify(heavy)
    free = staged.estimated
    np.testing.assert_allclose(members.model(4).finger.mass, heavy.finger.mass)
    difference = (members.values[4] - np.asarray(ravel(alone.model)))[free] / alone.std[free]
    assert np.abs(difference).max() < 0.5
    assert np.abs((members.values[4] - members.values[0])[free] / staged.std[free]).max() > 3.0


@pytest.mark.long
def test_members_keep_their_own_standard_deviations_of_what_is_given(members, sessions):
    """The errors of links that CAD gives enter elastic torque and tendon friction."""
    alone = identify(with_vaguer_links(sessions[1]))
    free, given = alone.estimated, np.setdiff1d(np.flatnonzero(alone.std), alone.estimated)
    np.testing.assert_allclose(members.std[5][given], alone.std[given])
    np.testing.assert_allclose(members.values[5], members.values[1])
    ratio = members.std[5][free] / alone.std[free]
    assert 0.7 < ratio.min() < ratio.max() < 1.4
    assert (members.std[5][free] / members.std[1][free]).max() > 2.0


@pytest.mark.long
def test_members_keep_their_own_prior_whatever_stands_beside_them(sessions, session, staged):
    recipe = replace(staged.recipe, fit=replace(staged.recipe.fit, free_inertia=True))
    template, vague = identify(session, recipe), with_vaguer_links(sessions[1])
    members, alone = fit_many([sessions[1], vague], template, session), identify(vague, recipe)
    free = alone.estimated
    difference = (members.values - np.asarray(ravel(alone.model)))[:, free] / alone.std[free]
    assert np.abs(difference[1]).max() < 0.5
    assert np.abs(difference[0]).max() > 1.0  # the narrow prior leads elsewhere
    ratio = members.std[1][free] / alone.std[free]
    assert 0.7 < ratio.min() < ratio.max() < 1.4


def test_a_session_whose_description_knows_other_values_is_refused(session, staged):
    known = replace(session, finger=replace(session.finger, mass_std=None))
    with pytest.raises(UserError, match="gives a standard deviation of mass MCP; give it in both"):
        fit_many([session, known], staged, session)


def test_a_session_of_another_finger_is_refused(session, staged):
    other = replace(session, finger=replace(session.finger, joint_names=("A", "B", "C")))
    with pytest.raises(UserError, match="has not the joints and tendons"):
        fit_many([session, other], staged, session)


def test_a_session_of_another_protocol_is_refused(session, staged):
    with pytest.raises(UserError, match=r"has not the ID\.2 trials"):
        fit_many([session, session.select("ID.4")], staged, session)


PROCESS = """
import pickle, sys
import numpy as np
from jaxfinger.identify.distributed import fit_many_distributed, initialise, refit_distributed
address, process, source, target = sys.argv[1:]
initialise(address, 2, int(process))
compressed, weights, sessions, fit, session = pickle.load(open(source, "rb"))
theta, failed = refit_distributed(compressed, weights)
found = fit_many_distributed(sessions, fit, session)
np.savez(target + process, theta=theta, failed=failed, values=found.values, std=found.std, spoilt=found.failed)
"""


@pytest.mark.long
def test_two_processes_share_refits_and_sessions(sessions, session, staged, members, tmp_path):
    """Of three sessions the first process fits two and the second one."""
    compressed = compress(session, staged)
    weights = draw_weights(compressed.strata, 5, np.random.default_rng(0))
    weights[3] = np.nan
    source, target = tmp_path / "work", str(tmp_path / "result")
    source.write_bytes(
        pickle.dumps((compressed, weights, [*sessions[:2], without_excursion(sessions[2])], staged, session))
    )
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{s.getsockname()[1]}"
    command = [sys.executable, "-c", PROCESS, address]
    running = [subprocess.Popen([*command, str(k), str(source), target]) for k in range(2)]
    try:
        assert [p.wait(timeout=200) for p in running] == [0, 0]
    finally:
        for p in running:
            p.kill()
    theta, failed = refit(compressed, weights)
    for k in range(2):
        result = np.load(f"{target}{k}.npz")
        np.testing.assert_array_equal(result["failed"], failed)
        np.testing.assert_allclose(result["theta"], theta, rtol=1e-9)
        np.testing.assert_array_equal(result["spoilt"], members.failed[:3])
        np.testing.assert_allclose(result["values"], members.values[:3], rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(result["std"], members.std[:3], rtol=1e-6, atol=1e-12)


def test_no_session_gives_no_member(session, staged):
    assert fit_many([], staged, session).values.shape == (0, ravel(staged.model).size)
