"""Channels that contradict each other are reported, and a sound session has no contradiction."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.bad_input import complaints, mistakes
from jaxfinger.data import Session, Trial
from jaxfinger.data.checks.work import suspects
from tests.units import Scale

FRICTION = 0.004  # N m


@pytest.fixture(scope="module")
def sound(session):
    """Session with friction in the moving joint, so that a cycle takes work from the motor."""
    trial = session["03-ID.3-dynamic-MCP"]
    way = np.sign(np.gradient(trial.q[:, 0]))
    torque = trial.joint_torque + FRICTION * way[:, None]
    return replace(session, trials={**session.trials, trial.name: replace(trial, joint_torque=torque)})


def test_a_sound_session_has_no_contradiction(sound):
    assert not any("contradict" in text or "work" in text or "excursions along" in text for text in complaints(sound))


@pytest.mark.parametrize(
    ("experiment", "channel", "change", "words"),
    [
        ("ID.4", "joint_torque", lambda x: -x, "T1 at MCP (8 against -5 mm); check the sign"),
        ("ID.2", "tendon_excursion", lambda x: -x, "T1 at MCP (-8 against 5 mm); check the sign"),
        ("ID.4", "joint_torque", lambda x: 10 * x, "T1 at MCP (8 against 50 mm); check the units"),
        ("ID.4", "tendon_force", lambda x: 9.81 * x, "check the units or the column"),
        ("VD.1", "tendon_excursion", lambda x: -x, "not those that ID.2 shows"),
        ("ID.3-dynamic", "joint_torque", lambda x: -x, "takes work out of the joint in every cycle: MCP"),
        ("ID.2", "tendon_excursion", lambda x: 1e-3 * x, "moment arms of 0.0"),
        ("ID.3-dynamic", "joint_torque", lambda x: 0 * x, "is 0 at every sample, as no sensor is"),
        ("ID.2", "tendon_excursion", lambda x: 0 * x, "columns T1, T2 are 0 at every sample, as no sensor is"),
        ("VD.2", "fingertip_force", lambda x: 1e3 * x, "the fingertip presses with"),
    ],
)
def test_what_contradicts_is_said(sound, experiment, channel, change, words):
    def wrong(trial: Trial) -> Trial:
        values = getattr(trial, channel)
        return trial if trial.experiment != experiment else replace(trial, **{channel: change(values)})

    found = complaints(replace(sound, trials={t.name: wrong(t) for t in sound})) - complaints(sound)
    assert any(words in text for text in found), found


def let_go(loss: float) -> Trial:
    """ID.4 of T1, whose arm at MCP is 8 mm: pulled in steps and let go in steps, with a share lost to friction."""
    steps = np.repeat([0.0, 4.0, 8.0, 12.0, 8.0, 4.0, 2.0, 0.0], 50)
    tension = np.convolve(np.pad(steps, 10, "edge"), np.full(21, 1 / 21), "valid")
    arrives, at = np.zeros(len(tension)), 0.0
    for i, f in enumerate(tension):
        at = arrives[i] = np.clip(at, f * (1.0 - loss), f * (1.0 + loss))
    count, nothing = len(tension), np.zeros(len(tension))
    return Trial(
        name="05-ID.4-T1-let-go",
        experiment="ID.4",
        time=np.arange(count) * 0.02,
        q=np.column_stack([np.full(count, 0.5), nothing]),
        joint="MCP",
        tendon="T1",
        tendon_force=np.column_stack([tension, nothing, np.full(count, np.nan)]),
        joint_torque=np.column_stack([0.01 - 0.008 * arrives, np.full(count, np.nan)]),
    )


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.35, 0.66])
def test_friction_is_no_wrong_scale_where_a_tendon_is_let_go(sound, loss):
    assert not any("contradict" in text for text in complaints(with_trial(sound, let_go(loss))))


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.35])
@pytest.mark.parametrize(
    ("channel", "factor", "arms"), [("tendon_excursion", 2.0, "(16 against"), ("tendon_force", 2.0, "(8 against")]
)
def test_twice_the_scale_is_said_where_a_tendon_is_let_go(sound, loss, channel, factor, arms):
    """Pulled only, a tendon that loses half of its tension would show the same torque."""

    def wrong(trial: Trial) -> Trial:
        values = getattr(trial, channel)
        return trial if values is None else replace(trial, **{channel: factor * values})

    session = with_trial(sound, let_go(loss))
    said = complaints(replace(session, trials={t.name: wrong(t) for t in session}))
    assert any(f"T1 at MCP {arms}" in text and "check the scale" in text for text in said), said


def with_trial(session: Session, trial: Trial) -> Session:
    return replace(session, trials={**session.trials, trial.name: trial})


@pytest.mark.parametrize("size", [0.05, 1.0, 20.0])
def test_free_paths_are_long_for_their_machine(sound, size):
    machine = Scale(mass=size**3, length=size, time=size**0.5)(sound)
    turned = {
        t.name: replace(t, tendon_excursion=-t.tendon_excursion) if t.experiment == "VD.1" else t for t in machine
    }
    words = "not those that ID.2 shows"
    assert not any(words in text for text in complaints(machine))
    assert any(words in text for text in complaints(replace(machine, trials=turned)))


def test_an_excursion_that_stands_still_is_said_though_it_has_noise(sound):
    """The tendon crosses the joint, and its pull turns the joint: the column belongs to another sensor, or to none."""
    trial = sound["01-ID.2-MCP"]
    excursion = trial.tendon_excursion.copy()
    excursion[:, 0] = 0.003 + 1e-5 * np.random.default_rng(0).standard_normal(len(excursion))
    said = complaints(replace(sound, trials={**sound.trials, trial.name: replace(trial, tendon_excursion=excursion)}))
    assert any("T1 at MCP (" in text and "against 5 mm); check the units or the column" in text for text in said)


@pytest.mark.parametrize("factor", [0.1, -0.1])
def test_an_arm_that_is_small_beside_the_others_is_said_where_the_torque_is_not(sound, factor):
    """One column in cm read as mm: the arm is a tenth of the others, as that of a tendon near the axis may be."""
    trial = sound["01-ID.2-MCP"]
    scaled = replace(trial, tendon_excursion=trial.tendon_excursion * [factor, 1.0, 1.0])
    said = complaints(replace(sound, trials={**sound.trials, trial.name: scaled}))
    assert any(f"T1 at MCP ({8 * factor:.3g} against 5 mm)" in text for text in said), said


def test_a_fingertip_on_the_last_axis_is_said_where_it_presses(sound):
    """Where nothing is pressed, nobody needs the contact point."""
    axial = replace(sound, finger=replace(sound.finger, fingertip=np.array([0.0, 0.01, 0.0])))
    pressed = {n: t for n, t in axial.trials.items() if t.experiment == "VD.2"}
    words = "lies on the axis of joint PIP"
    assert any(words in text for text in complaints(axial))
    assert not any(words in text for text in complaints(sound))
    free = replace(axial, trials={n: t for n, t in axial.trials.items() if n not in pressed})
    assert not any(words in text for text in complaints(free))


def test_a_late_torque_is_not_said_to_have_the_wrong_sign_alone(sound):
    trial = sound["03-ID.3-dynamic-MCP"]
    late = replace(trial, joint_torque=np.roll(trial.joint_torque, 100, axis=0))
    said = complaints(replace(sound, trials={**sound.trials, trial.name: late}))
    assert any("check the sign of joint_torque and of q, and whether one of the two is late" in text for text in said)


def test_most_mistakes_of_a_mapping_are_said(sound):
    """Each mistake is made in all trials alike, as a mapping makes it.

    Up to 16 mistakes stay silent here: the session has a single ID.4 trial, and no VD.3 with excursions of a third
    joint.
    """
    before = complaints(sound)
    silent = [
        name
        for name, mistake in mistakes(sound)
        if complaints(replace(sound, trials={t.name: mistake(t) for t in sound})) <= before
    ]
    assert len(silent) <= 16, silent


@pytest.mark.parametrize(
    ("found", "agreed", "expected"),
    [
        ([("T1", "MCP")], [("T2", "MCP")], "tendon_excursion or tendon_force of T1"),
        ([("T1", "MCP"), ("T1", "PIP")], [("T2", "MCP"), ("T2", "PIP")], "tendon_excursion or tendon_force of T1"),
        ([("T1", "PIP"), ("T2", "PIP")], [("T1", "MCP"), ("T2", "MCP")], "joint_torque or q of PIP"),
        ([("T1", "MCP")], [], "joint_torque, tendon_excursion, tendon_force or q"),
        ([("T1", "MCP")], [("T2", "MCP"), ("T1", "PIP")], "joint_torque, tendon_excursion, tendon_force or q"),
    ],
)
def test_what_agrees_narrows_down_what_may_be_wrong(found, agreed, expected):
    assert suspects(found, agreed) == expected
