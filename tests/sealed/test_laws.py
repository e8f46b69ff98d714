"""Nominal laws and departures against calculations by hand."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.sealed.departures import LISTED, UNLISTED, draw, presliding
from jaxfinger.sealed.laws import Finger, Situation
from jaxfinger.sealed.record import commanded, last_direction, record
from jaxfinger.sealed.severity import NoiseFreeSession, calibrate


def held(nominal, f):
    n = len(f)
    tension = np.zeros((n, nominal.n))
    tension[:, 0] = f
    zero = np.zeros((n, nominal.m))
    return Situation(np.arange(n) * 0.1, np.arange(n) * 0.1, zero, zero, zero, tension, zero, held=True)


def test_held_tendon_rises_with_loss_keeps_its_plateau_and_slips_back(nominal):
    a0, a1 = nominal.specimen.friction[0]
    f = np.array([0.0, 4.0, 10.0, 9.5, 9.0, 4.0])
    reaching = nominal.reaching_held(held(nominal, f))[:, 0]
    top = 10.0 - (a0 + 10 * a1)
    assert reaching[1] == pytest.approx(4 - (a0 + 4 * a1))
    assert reaching[2] == pytest.approx(top)
    assert reaching[3] == pytest.approx(top)  # 9.5 N is within the loss of the plateau.
    assert reaching[5] == pytest.approx(4 + (a0 + 4 * a1))
    assert np.all(
        nominal.reaching_held(held(nominal, f))[:, 1:] == 0.0
    )  # Slack tendons have neither tension nor friction.


def test_loss_never_exceeds_the_tension(nominal):
    s = held(nominal, np.array([0.0, 0.05, 0.2]))
    assert np.all(nominal.loss(s)[0] <= s.f + 1e-15)


def test_coupling_matrix_is_the_derivative_of_excursion(specimen, nominal):
    coupling = draw("moment_arm_coupling", specimen.finger, np.random.default_rng(0))
    finger = Finger(specimen, [coupling], nominal.plant)
    q, h, now = np.array([0.4, 0.7, 0.3]), 1e-6, np.array(0.0)

    def length(x):
        z = np.zeros(3)
        return finger.path(Situation(now, now, x, z, z, np.full(finger.n, 2.0), z))[0]

    z = np.zeros(3)
    _, arm = finger.path(Situation(now, now, q, z, z, np.full(finger.n, 2.0), z))
    numeric = np.stack([(length(q + h * e) - length(q - h * e)) / (2 * h) for e in np.eye(3)], axis=1)
    np.testing.assert_allclose(arm, numeric, atol=1e-10)


def test_direction_is_kept_through_a_stop():
    rate = np.array([[0.0], [1.0], [0.0], [0.0], [-1.0], [0.0]])
    assert last_direction(rate)[:, 0].tolist() == [1, 1, 1, 1, -1, -1]


@pytest.mark.parametrize("form", ["dahl", "lugre", "maxwell_slip"])
def test_presliding_builds_up_to_coulomb_and_starts_anew_at_a_reversal(form):
    x0, z = 0.01, np.zeros(presliding.ELEMENTS)
    for _ in range(400):
        z = presliding.advance(form, z, np.array(2e-4), x0)
    assert presliding.friction(z) == pytest.approx(1.0, abs=0.01)
    after = presliding.advance(form, z, np.array(-1e-3), x0)
    assert 0.5 < presliding.friction(after) < 1.0
    for _ in range(400):
        after = presliding.advance(form, after, np.array(-2e-4), x0)
    assert presliding.friction(after) == pytest.approx(-1.0, abs=0.01)


def test_dahl_does_not_depend_on_the_step():
    once = presliding.advance("dahl", np.zeros(5), np.array(0.02), 0.01)
    z = np.zeros(5)
    for _ in range(100):
        z = presliding.advance("dahl", z, np.array(2e-4), 0.01)
    np.testing.assert_allclose(z, once, atol=1e-12)


def test_noise_free_session_without_departures_leaves_no_trace(specimen, plans, sensors):
    assert np.all(NoiseFreeSession(specimen, plans, sensors).trace([])[0] == 0.0)


@pytest.mark.parametrize("effect", [*LISTED, *UNLISTED])
def test_every_departure_vanishes_with_its_size_and_shows_at_its_start(effect, specimen, plans, sensors):
    session = NoiseFreeSession(specimen, plans, sensors)
    site = np.random.default_rng(1)
    # A presliding length has an effect in coarse samples however small it is. Its smallest size stands for zero.
    for _ in range(8):
        departure = draw(effect, specimen.finger, site)
        assert departure is not None
        full = np.sqrt(np.mean(session.trace([departure])[0] ** 2))
        if full > 1e-3:
            break
    assert full > 1e-3
    small = departure.resized(max(departure.size * 1e-3, departure.smallest))
    assert np.sqrt(np.mean(session.trace([small])[0] ** 2)) < (0.9 if departure.smallest > 1e-9 else 0.05) * full


def test_drive_inertia_is_seen_by_the_motor_only(specimen, plans, nominal):
    departure = draw("drive_inertia", specimen.finger, np.random.default_rng(0))
    finger = Finger(specimen, [departure], nominal.plant)
    for plan in plans:
        if plan.experiment == "ID.3-dynamic" and plan.joint == departure.index[0]:
            m = commanded(plan)
            added = record(finger, plan, m).torque - record(nominal, plan, m).torque
            np.testing.assert_allclose(added[:, plan.joint], departure.size * m.qdd[:, plan.joint], atol=1e-15)
        if plan.experiment == "VD.2":
            m = commanded(plan)
            np.testing.assert_array_equal(record(finger, plan, m).force, record(nominal, plan, m).force)


def test_a_refit_absorbs_what_the_nominal_model_can_say(specimen, plans, sensors):
    """Nothing remains of a change of stiffness. A stretch remains in the channel where it acts."""
    session = NoiseFreeSession(specimen, plans, sensors)
    stiffer = replace(specimen, elastic=specimen.elastic * 1.05)
    rows = [
        after - before
        for coarse in session.trials
        for (*_, after), (*_, before) in zip(
            session.rows(Finger(stiffer), coarse, coarse.motion, True),
            session.rows(session.nominal, coarse, coarse.motion, True),
            strict=True,
        )
    ]
    change = np.concatenate(rows)
    assert np.abs(session.refitted(change)).max() < 1e-3 * np.abs(change).max()
    sized, reached, where = calibrate(session, draw("tendon_stretch", specimen.finger, np.random.default_rng(0)), 5.0)
    assert reached == pytest.approx(5.0, rel=0.11)
    assert where[1] == "tendon_excursion"
    assert sized.size > 0
