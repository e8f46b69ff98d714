"""Positions that jump: the finding names the cause, and whoever follows its advice gets the right angles."""

import numpy as np
import pytest

from jaxfinger.data.checks.session import check_session
from jaxfinger.data.findings import Report
from jaxfinger.data.importing.by_mapping import import_session
from jaxfinger.data.session import Session, Trial
from jaxfinger.errors import UserError
from tests.data.conftest import ONE_JOINT, make_finger

RATE = 500.0
TIME = np.arange(3000) / RATE
RNG = np.random.default_rng(0)
NOISE = 3e-4 * RNG.standard_normal(len(TIME))
SWING = 0.6 - 0.55 * np.cos(TIME * 2.0) + NOISE
STAIRS = 0.2 * np.interp(TIME * 2.0 % 6.0, [0, 1, 2, 3, 4, 5, 6], [0, 0, 3, 3, 6, 6, 0]) + NOISE
TRIAL = """
[trials.{name}]
file = "{name}.csv"
experiment = "ID.3-dynamic"
joint = "MCP"
time = "t"
channels.q.MCP = {{ from = "q", {reading} }}
channels.joint_torque.MCP = "tau"
"""


def bring_in(tmp_path, reading, **recorded):
    """Session of a trial for each recording of raw angles, and the sentences about jumps and turns."""
    text = ONE_JOINT
    for name, q in recorded.items():
        table = np.column_stack([TIME, q, 0.01 * SWING + 1e-3 * NOISE])
        np.savetxt(tmp_path / f"{name}.csv", table, "%.9f", ",", header="t,q,tau", comments="")
        text += TRIAL.format(name=name, reading=reading)
    (tmp_path / "m.toml").write_text(text)
    report = Report()
    session = import_session([tmp_path / f"{name}.csv" for name in recorded], tmp_path / "m.toml", report)
    return session, [f.message for f in report if "jump" in f.message or "turn" in f.message]


@pytest.mark.parametrize("zero", [np.deg2rad(25.0), 0.6])
def test_a_zero_within_the_joints_range(tmp_path, zero):
    """The trials begin on either side of the encoder's zero, and one rests on it."""
    truth = {"a": SWING - zero, "b": SWING[::-1] - zero, "rests": 0.02 * SWING - 0.012}
    raw = {name: np.rad2deg(q) % 360.0 for name, q in truth.items()}
    said = bring_in(tmp_path, 'units = "deg"', **raw)[1]
    jumps = [m for m in said if "jumps by a whole turn between two samples" in m]
    assert len(jumps) == 3, said
    assert all("the encoder wraps; unwrap it (`unwrap = true` in a mapping)" in m for m in jumps)
    for advised in ("true", "360"):
        session, said = bring_in(tmp_path, f'units = "deg", unwrap = {advised}', **raw)
        assert said == []
        for name, q in truth.items():
            np.testing.assert_allclose(session[name].q[:, 0], q, atol=1e-8)


def test_a_turn_beside_the_limits(tmp_path):
    said = bring_in(tmp_path, 'units = "deg"', a=np.rad2deg(SWING) - 360.0)[1]
    assert any("a turn beside its limits -0.3 to 1.6; take a whole turn off (`unwrap = true` in" in m for m in said), (
        said
    )
    with pytest.raises(UserError, match="a turn beside its limits"):
        bring_in(tmp_path, 'units = "deg"', a=np.rad2deg(SWING) + 360.0)
    for turn in (-2, -1, 1):
        session, said = bring_in(tmp_path, 'units = "deg", unwrap = true', a=np.rad2deg(SWING) + 360.0 * turn)
        assert said == []
        np.testing.assert_allclose(session["a"].q[:, 0], SWING, atol=1e-8)


@pytest.mark.parametrize("raw", [np.rad2deg(SWING), np.rad2deg(STAIRS)])
def test_degrees_are_no_turns(tmp_path, raw):
    with pytest.raises(UserError, match=r"more than a turn; convert deg to rad \(`units = \"deg\"` in a mapping\)$"):
        bring_in(tmp_path, 'units = "rad"', a=raw)


def test_an_encoder_behind_a_gear(tmp_path):
    """Its turn is a tenth of the joint's, and does not tell in which of its turns a trial begins."""
    counts = np.round((SWING - SWING[0] + 0.01) * 10.0 * 4096 / (2.0 * np.pi)) % 4096
    scaled = f"scale = {2.0 * np.pi / 40960}"
    said = bring_in(tmp_path, scaled, a=counts)[1]
    assert len(said) == 1
    assert "column MCP jumps by 0.628 rad, from one end of its readings to the other, between two samples at" in said[0]
    assert "unwrap it by the variable's own period (`unwrap` in a mapping: 4096 for the counts" in said[0]
    session, said = bring_in(tmp_path, f"{scaled}, unwrap = 4096", a=counts)
    assert said == []
    np.testing.assert_allclose(session["a"].q[:, 0], SWING - SWING[0] + 0.01, atol=2e-4)


def test_lost_samples_are_no_wrap(tmp_path):
    cut = np.concatenate([SWING[:700], SWING[1700:], SWING[1300:1700], np.full(600, SWING[1700])])
    said = bring_in(tmp_path, 'units = "rad"', a=cut)[1]
    assert len(said) == 1
    assert "samples or counts are lost there; cut these places out (`span` or `where` in a mapping)" in said[0]


def session_of(q, l):
    """Session of one trial that turns the first joint, which the first two tendons cross."""
    n = len(q)
    force = np.column_stack([2.0 + 0.02 * RNG.standard_normal((n, 2)), np.full(n, np.nan)])
    rest = 0.4 + 1e-4 * RNG.standard_normal(n)
    l = np.column_stack([l, 0.01 * q + 1e-5 * RNG.standard_normal(n), np.full(n, np.nan)])
    trial = Trial("a", "ID.2", TIME[:n], np.column_stack([q, rest]), force, l, joint="MCP")
    return Session("x", make_finger(), {"a": trial}, created="2026-01-01T00:00:00+00:00")


def jumps_of(q, l):
    report = Report()
    check_session(session_of(q, l), report)
    return [f.sentence for f in report if "jump" in f.message]


def test_an_encoder_of_a_tendon_that_wraps():
    l = (0.008 * SWING + 0.003) % 0.006
    said = jumps_of(SWING, l)
    assert len(said) == 1
    assert said[0].startswith("/trials/a/tendon_excursion: column T1 jumps by 0.006 m, from one end of its readings")
    assert not jumps_of(SWING, np.unwrap(l, period=0.006))
    l[200:260] = np.nan  # The tendon was slack.
    assert len(jumps_of(SWING, l)) == 1


def spiky(x):
    x = x.copy()
    x[[300, 301, 900, 1500, 2200]] += [9.0, 9.0, 2.0 * np.pi, -7.0, 4.0]
    return x


@pytest.mark.parametrize(
    "x",
    [
        SWING,
        STAIRS,
        np.round(SWING, 2),
        np.repeat(SWING[::10], 10),  # logged ten times as fast as measured
        np.where(np.arange(len(SWING)) % 2, 0.3, 0.3002),  # rests between two readings of a coarse encoder
        np.where(TIME < 3.0, 0.1, 1.1) + NOISE,  # a step
        spiky(SWING),
        spiky(0.0 * SWING + 0.3),
    ],
)
def test_sound_positions_do_not_jump(x):
    assert not jumps_of(SWING, 0.008 * x)
    assert not [s for s in jumps_of(x, 0.008 * SWING) if "wraps" in s]


@pytest.mark.parametrize("x", [SWING, STAIRS, np.round(SWING, 2), np.repeat(SWING[::10], 10), spiky(SWING)])
def test_sound_angles_do_not_jump(x):
    assert not jumps_of(x, 0.008 * SWING)
    assert not jumps_of(x[::25], 0.008 * SWING[::25])


def test_encoders_that_jump_together_do_not_wrap():
    """A block of samples that is logged twice, from one end of the motion to the other."""
    twice = np.r_[0:2356, 1571:2215]
    (said,) = jumps_of(SWING[twice], (0.008 * SWING + 0.003)[twice])
    assert "samples or counts are lost there" in said
