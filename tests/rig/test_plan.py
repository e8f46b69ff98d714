"""Plans are checked command by command before anything moves."""

import re

import numpy as np
import pytest

from jaxfinger.errors import UserError
from jaxfinger.rig import estimate, parse_plan, parse_rig
from jaxfinger.rig.backend import JointMove, Setup, TensionRamp
from jaxfinger.rig.protocols import PROTOCOLS, Mark, Start
from jaxfinger.rig.simulated.examples import plan_toml, rig_toml

HEAD = '[plan]\nname = "p"\n[[trial]]\n'


def steps(text, rig):
    (trial,) = parse_plan(HEAD + text, rig).trials
    return list(trial.protocol(rig))


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ('experiment = "ID.5"', 4, "choose one of"),
        ('experiment = "ID.2"\njoint = "XIP"', 5, "choose one of MCP, PIP, DIP"),
        ('experiment = "ID.2"', 3, "trial[0].joint: is missing"),
        (
            'experiment = "ID.2"\njoint = "MCP"\npretention = 2.0',
            6,
            "trial[0].pretention: is unknown (did you mean 'pretension'?)",
        ),
        ('experiment = "ID.2"\njoint = "MCP"\nshare = 0.99', 6, "into its stops"),
        ('experiment = "ID.4"\njoint = "PIP"\ntendon = "T3"', 5, "T3 does not cross PIP"),
        ('experiment = "VD.2"\ntendon = "T2"\nlevels = [15.0, 4.0]', 6, "rising"),
        ('experiment = "VD.2"\ntendon = "T2"\nlevels = [4.0, 25.0]', 3, "25 N for T2 is outside 0 to 18 N"),
        ('experiment = "ID.3-static"\njoint = "MCP"\nrange_deg = [0.0, 92.0]', 3, "outside -8.0° to 90.0°"),
        ('experiment = "ID.3-dynamic"\njoint = "MCP"\nspeeds_deg_s = [400.0]', 3, "°/s for MCP is outside"),
        (
            'experiment = "ID.3-dynamic"\njoint = "MCP"\nacceleration_deg_s2 = 30000.0',
            3,
            "30000.0°/s² for MCP is outside 0 to 1200.0°/s²; change this [[trial]], or [limits] of",
        ),
        ('experiment = "ID.3-static"\njoint = "MCP"\nacceleration_deg_s2 = 0.0', 3, "0.0°/s² for MCP is outside"),
        ('experiment = "ID.3-dynamic"\njoint = "MCP"\nspeeds_deg_s = []', 6, "speeds_deg_s: is empty"),
        ('experiment = "ID.2"\njoint = "MCP"\nposture_deg = [0.0, 190.0, 0.0]', 6, "outside its limits"),
        (
            'experiment = "ID.2"\njoint = "MCP"\nposture_deg = [0.35, 0.52, 0.0]',
            6,
            "0.35, 0.52, 0 are all within 2° of straight, so these seem to be radians; "
            "give it in degrees (20, 30, 0), or 0 for each joint that is straight",
        ),
        ('experiment = "ID.2"\njoint = "MCP"\nposture_deg = [0.5, 1.0, 0.5]', 6, "give it in degrees (29, 57, 29)"),
        ('experiment = "ID.2"\njoint = "MCP"\nposture_deg = [0.0, 1.0, 0.0]', 6, "so these seem to be radians"),
        ('experiment = "VD.3"\nmean = [1.0]', 5, "4 active tendons"),
        ('experiment = "ID.2"\njoint = "MCP"\nrepeats = 1000000000', 6, "outside 1 to 1000"),
        ('experiment = "ID.3-dynamic"\njoint = "MCP"\npasses = 1000000000', 6, "outside 1 to 1000"),
        ('experiment = "ID.3-static"\njoint = "MCP"\nstep_deg = 1e-9', 6, "it must be at least 0.01 deg"),
        ('experiment = "VD.3"\nseconds = 7000.0\ninterval = 0.01', 3, "more than 100000 steps"),
        ('experiment = "VD.1"\nseconds = 1e9', 5, "which is outside 0.2 to 7200 s"),
        ('experiment = "ID.4"\njoint = "MCP"\ntendon = "T3"\ndwell = 1e5', 7, "which is outside 0.2 to 7200 s"),
        ('experiment = "VD.3"\ninterval = 0.0', 5, "must be above 0"),
        (
            'experiment = "ID.3-static"\njoint = "MCP"\nrange_deg = [0.0, 1.2]',
            6,
            "spans 1.2°, less than one step of 10°",
        ),
        (
            'experiment = "ID.3-dynamic"\njoint = "MCP"\nspeeds_deg_s = [0.5, 1.0, 1.5]',
            3,
            "takes 110 s for one command, longer than 60 s; see the unit of its rate or speed",
        ),
        ('experiment = "ID.2"\njoint = "MCP"\ntension_rate = 0.01', 3, "takes 200 s for one command"),
        (
            'experiment = "ID.3-dynamic"\njoint = "MCP"\nrange_deg = [0.2, 1.1]',
            6,
            "spans 0.9°, less than 10 % of the range of MCP; give it in degrees, and at least 10.2° wide",
        ),
        (
            'experiment = "ID.3-static"\njoint = "MCP"\nrange_deg = [0.0, 1.2]\nstep_deg = 0.2',
            6,
            "spans 1.2°, less than",
        ),
        (
            'experiment = "ID.2"\njoint = "MCP"\ntimeout = 0',
            3,
            "by hand 3 times takes 12 s, longer than the timeout of 0 s",
        ),
        ('experiment = "ID.2"\njoint = "MCP"\npasses = 40', 3, "of 120 s; give at least 160 s"),
        ('experiment = "ID.2"\njoint = "MCP"\npretension = 1e-9', 6, "is 1e-09 N; it must be at least 0.6 N"),
        ('experiment = "ID.4"\njoint = "MCP"\ntendon = "T3"\ndwell = 0', 7, "is 0 s, which is outside 0.2 to 7200 s"),
        ('experiment = "VD.1"\nseconds = 0', 5, "is 0 s, which is outside 0.2 to 7200 s"),
        ('experiment = "VD.1"\npretension = 0.0', 5, "must be at least 0.6 N"),
        ('experiment = "ID.4"\njoint = "MCP"\ntendon = "T3"\nlevels = [1e-9, 2.0]', 7, "must be at least 0.6 N"),
        ('experiment = "VD.3"\nmean = [2.0, 2.0, -2.0, 2.0]', 5, "is -2 N; it must be at least 0.6 N"),
    ],
)
def test_a_mistake_names_its_line(rig, text, line, says):
    with pytest.raises(UserError, match=f"plan.toml, line {line}: ") as error:
        parse_plan(HEAD + text, rig)
    assert says in str(error.value)


def test_repeats_share_their_motion(rig):
    plan = parse_plan(HEAD + 'experiment = "ID.2"\njoint = "MCP"\nrepeats = 3', rig)
    assert [t.name for t in plan.trials] == ["01-ID.2-MCP", "02-ID.2-MCP", "03-ID.2-MCP"]
    assert len({t.motion for t in plan.trials}) == 1
    assert len({t.motion for t in parse_plan(plan_toml(2), rig).trials}) == len(
        {t.line for t in parse_plan(plan_toml(2), rig).trials}
    )


def test_the_shipped_plan_holds_every_experiment(rig):
    plan = parse_plan(plan_toml(), rig)
    assert {t.experiment for t in plan.trials} == set(PROTOCOLS)
    assert all(estimate(t, rig).seconds > 1.0 for t in plan.trials)


@pytest.mark.parametrize(
    "posture",
    ["0.0, 0.0, 0.0", "0.5, 1.0, 15.0", "0.35, 20.0, 30.0", "2.25, 0.0, 0.0", "-1.0, 0.0, 0.35"],
)
def test_small_postures_in_degrees_are_taken(rig, posture):
    """Straight; or one beyond 2 rad, or beyond a joint's lower end if read as rad."""
    assert parse_plan(HEAD + f'experiment = "ID.2"\njoint = "MCP"\nposture_deg = [{posture}]', rig).trials


def test_the_default_posture_is_checked_too():
    text = rig_toml()
    assert "limits = " in text
    short = parse_rig(re.sub("limits = .*", "limits_deg = [-10.0, 15.0]", text))
    with pytest.raises(UserError, match=r"plan.toml, line 3: .*posture_deg: 20° for MCP is outside its limits -10° to"):
        parse_plan(HEAD + 'experiment = "VD.1"', short)
    parse_plan(HEAD + 'experiment = "VD.1"\nposture_deg = [15.0, -10.0, 5.0]', short)


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        (
            'experiment = "ID.3-static"\nrange_deg = [0.0, 70.0]',
            "between 0° and 70°, 69 % of its range, at up to 30°/s.",
        ),
        ('experiment = "ID.3-dynamic"\nposture_deg = [22.5, 80.0, 20.0]', "between 10° and 65°, 54 % of its range, at"),
        ('experiment = "ID.3-dynamic"\nrange_deg = [30.0, 50.0]\nspeeds_deg_s = [0.5, 1.5]', "at up to 1.5°/s."),
        ('experiment = "ID.3-static"\nposture_deg = [85.0, 0.0, 0.0]', "between 0° and 85°, 83 % of its range"),
    ],
)
def test_the_prompt_before_the_motor_moves_says_how_far_and_how_fast(rig, keys, says):
    """Whoever presses Enter sees a plan in another unit; so does the dry run."""
    (trial,) = parse_plan(f'{HEAD}{keys}\njoint = "MCP"', rig).trials
    *_, prompt = estimate(trial, rig).prompts
    assert prompt.startswith("The drives are off. Couple the external motor to MCP; the other joints stay fixed. The")
    assert says in prompt


def test_the_prompt_asks_for_the_angles_of_the_plan(rig):
    (trial,) = parse_plan(f'{HEAD}experiment = "ID.2"\njoint = "MCP"\nposture_deg = [22.5, 0.4, -5.0]', rig).trials
    assert "Fix all joints: MCP 22.5°, PIP 0.4°, DIP -5°." in estimate(trial, rig).prompts[0]


def test_a_prompt_after_which_something_moves_says_hands_off(rig):
    """The motor, or a tendon, moves as soon as the prompt is answered."""
    for trial in parse_plan(plan_toml(), rig).trials:
        for step in trial.protocol(rig):
            if isinstance(step, Setup):
                assert ("hands off" in step.prompt) == (not step.hand), trial.name


def test_an_estimate_counts_the_time_to_speed_up_and_to_slow_down(rig):
    """40° at 50 °/s²: half of it takes √(40/50) s, and the motor never reaches 100 °/s."""
    text = 'experiment = "ID.3-dynamic"\njoint = "PIP"\nrange_deg = [0.0, 40.0]\nspeeds_deg_s = [100.0]\n'
    one, three = (
        estimate(parse_plan(f"{HEAD}{text}acceleration_deg_s2 = 50.0\npasses = {n}", rig).trials[0], rig).seconds
        for n in (1, 3)
    )
    assert three - one == pytest.approx(4 * 2 * (40 / 50) ** 0.5)


def test_static_torque_holds_up_and_back(rig):
    done = steps('experiment = "ID.3-static"\njoint = "PIP"\nrange_deg = [0.0, 40.0]\nstep_deg = 10.0', rig)
    angle, held = None, []
    for step in done:
        if isinstance(step, JointMove):
            angle = step.target
        elif isinstance(step, Mark) and step.hold >= 0:
            held.append((np.degrees(angle), step.joint_direction["PIP"]))
    angles, directions = zip(*held, strict=True)
    assert directions == (1,) * 5 + (-1,) * 5
    np.testing.assert_allclose(angles[1:5], [10, 20, 30, 40])
    np.testing.assert_allclose(angles[6:], [30, 20, 10, 0], atol=1e-12)


@pytest.mark.parametrize("experiment", ["ID.3-static", "ID.3-dynamic", "ID.4"])
def test_torque_is_tared_unloaded_before_the_motor_is_coupled(rig, experiment):
    extra = '\ntendon = "T3"' if experiment == "ID.4" else ""
    names = []
    tensions = dict.fromkeys(rig.finger.tendon_names, 9.0)
    for step in steps(f'experiment = "{experiment}"\njoint = "MCP"{extra}', rig):
        names.append(f"motor {step.motor}" if isinstance(step, Setup) else type(step).__name__)
        if isinstance(step, TensionRamp):
            tensions.update(step.targets)
        if names[-1] == "Tare":
            assert set(tensions.values()) == {0.0}
            assert "motor MCP" not in names
    assert names.index("Tare") < names.index("motor MCP") < names.index("Start")


def test_tendon_friction_steps_up_and_down_with_the_others_slack(rig):
    done = steps('experiment = "ID.4"\njoint = "MCP"\ntendon = "T2"\nlevels = [2.0, 4.0, 6.0]', rig)
    begin = next(i for i, s in enumerate(done) if isinstance(s, Start))
    pulled = [s.targets for s in done[begin:] if isinstance(s, TensionRamp)]
    assert [t["T2"] for t in pulled] == [2.0, 4.0, 6.0, 4.0, 2.0]
    assert all(set(t) == {"T2"} for t in pulled)
    assert [s.tendon_direction["T2"] for s in done if isinstance(s, Mark) and s.hold >= 0] == [1, 1, 1, -1, -1]


def test_trajectory_is_the_same_for_the_same_seed(rig):
    first, second = (steps(f'experiment = "VD.3"\nseed = {seed}', rig) for seed in (3, 3))
    assert first == second
    assert first != steps('experiment = "VD.3"\nseed = 4', rig)
