"""Free paths whose excursions do not follow the angles are reported, also where a session holds nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.bad_input import complaints
from jaxfinger.data import Trial
from jaxfinger.data.session import Session

TIME = np.arange(0.0, 12.0, 0.01)


def noisy(shape, seed, size):
    return size * np.random.default_rng(seed).standard_normal(shape)


def free_path(session: Session, q=None, arms=((0.008, 0.005), (0.01, 0.0)), known=False, by_id2=False) -> Session:
    """Session of one VD.1 with `q` as its angles, where both joints are led on paths of their own."""
    true = 0.6 + 0.5 * np.sin(2.0 * np.pi * TIME[:, None] * [0.21, 0.34]) + noisy((len(TIME), 2), 0, 1e-4)
    l = np.column_stack([true @ np.transpose(arms), np.full(len(TIME), np.nan)]) + noisy((len(TIME), 3), 1, 2e-5)
    force = np.array([2.0, 2.0, np.nan]) + noisy((len(TIME), 3), 2, 0.02)
    trials = {"1-VD.1": Trial("1-VD.1", "VD.1", TIME, true if q is None else q(true), force, l)}
    for i in range(2 if by_id2 else 0):
        alone = np.where(np.arange(2) == i, true, 0.4 + noisy(true.shape, 3, 1e-4))
        l = np.column_stack([alone @ np.transpose(arms), np.full(len(TIME), np.nan)]) + noisy((len(TIME), 3), 4, 2e-5)
        trials[f"0-ID.2-{i}"] = Trial(f"0-ID.2-{i}", "ID.2", TIME, alone, force, l, joint=("MCP", "PIP")[i])
    of_cad = {} if known else {"excursion": None, "excursion_std": None}
    return replace(session, trials=dict(sorted(trials.items())), finger=replace(session.finger, **of_cad))


def new(session: Session, q, **how) -> str:
    """What the checker says of a free path with other angles and not of the true one."""
    return " ".join(complaints(free_path(session, q, **how)) - complaints(free_path(session, **how)))


@pytest.mark.parametrize("how", [{}, {"known": True}, {"by_id2": True}], ids=["alone", "CAD", "ID.2"])
def test_exchanged_joints_are_told_by_the_excursions(session, how):
    assert not complaints(free_path(session, **how))
    assert "/trials/1-VD.1/q: columns MCP and PIP look exchanged" in new(session, lambda q: q[:, ::-1], **how)


def test_joints_that_all_tendons_cross_alike_cannot_be_told_apart(session):
    finger = replace(session.finger, crosses=np.ones((3, 2), bool))
    crossed = replace(session, finger=finger)
    assert "exchanged" not in new(crossed, lambda q: q[:, ::-1], arms=((0.008, 0.005), (0.009, 0.006)))


def test_an_encoder_that_shows_noise_alone_is_named(session):
    said = new(session, lambda q: np.column_stack([noisy(len(q), 5, 1e-4), q[:, 1]]))
    assert "travel of T1, T2 does not follow the angles" in said
    assert "check the columns of q, first MCP, which stand still" in said


def test_an_encoder_that_reads_the_same_throughout_a_free_path_is_named(session):
    said = new(session, lambda q: np.column_stack([q[:, 0], np.full(len(q), 0.3)]))
    assert (
        "/trials/1-VD.1/q: column PIP is 0.3 at every sample, as no sensor is; check cable and column, or rec" in said
    )


@pytest.mark.parametrize(("name", "tendon", "level"), [("04-ID.4-T1-MCP", 0, 2.0), ("07-VD.3", 1, 3.0)])
def test_a_tension_that_drives_a_trial_and_never_changes_is_named(session, name, tendon, level):
    force = session[name].tendon_force.copy()
    force[:, tendon] = level
    wrong = replace(session, trials={**session.trials, name: replace(session[name], tendon_force=force)})
    said = " ".join(complaints(wrong) - complaints(session))
    assert f"/trials/{name}/tendon_force: column T{tendon + 1} is {level:g} at every sample, as no sensor is" in said
