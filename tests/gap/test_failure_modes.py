"""Ways in which a diagnosis could mislead its user, each tested on a session whose causes are known."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.effects.joint import JointPresliding
from jaxfinger.gap import Status, diagnose
from jaxfinger.gap.result import Key
from jaxfinger.identify import Recipe
from jaxfinger.identify.parameters import describe
from jaxfinger.synthetic import recipe_from

from .conftest import PLANTED, RIVALS, TABLE, TRUTH, WITHOUT, session_with

pytestmark = pytest.mark.long


def test_without_one_trial_the_verdict_is_the_same():
    session = session_with(PLANTED)
    gone = next(t.name for t in session if t.experiment == "ID.3-dynamic" and t.joint == TRUTH[1][0])
    less = session.with_trials([t.name for t in session if t.name != gone])
    assert diagnose(less, without=WITHOUT, quick=True).named == (Key(*TRUTH),)


def test_a_users_copy_of_a_listed_effect_is_its_rival_and_not_its_better():
    class Twin(JointPresliding):
        ID = "my_presliding"

    found = diagnose(session_with(PLANTED), without=WITHOUT, effects={"my_presliding": Twin})
    assert found.status is Status.AMBIGUOUS
    twins = {Key(*TRUTH), Key("my_presliding", TRUTH[1])}
    assert set(found.ambiguous_sets[0]) == twins
    probability = {c.key: c.probability for c in found.candidates}
    np.testing.assert_allclose([probability[k] for k in twins], 0.5, atol=0.1)
    assert found.next_experiment is None  # no trial tells an effect from its copy


def test_a_gain_that_friction_absorbs_is_not_named():
    """While a tendon is only pulled further, a gain error of its sensor and affine friction have the same effect."""
    trials = TABLE["trials"] | {
        "experiments": ["ID.2", "ID.3-static", "ID.4"],
        "id4": {"repeats": 2, "postures": [[25, 30, 45]], "release": False, "dwell": 0.4},
    }
    keep = {*RIVALS, "tension_sensor_scale", "tendon_friction_saturating"}
    truth = ("tension_sensor_scale", ("T1",), {"gain": 0.05})
    session = session_with(truth, recipe=recipe_from(TABLE | {"trials": trials}))
    found = diagnose(session, without=tuple(sorted(set(CATALOGUE) - keep)), quick=True)
    assert found.status is Status.NO_GAP


@pytest.mark.parametrize(
    "truth",
    [
        ("joint_stribeck", ("PIP",), {"a": 3.0, "v_s": 0.5, "delta": 1.0}),
        ("drive_inertia", ("PIP",), {"inertia": 1e-4}),
    ],
    ids=lambda t: t[0],
)
def test_without_sweeps_the_moves_between_holds_show_what_depends_on_speed(truth):
    """Three quarters of this friction fall with speed, as with negative damping; one linearisation is not enough."""
    trials = TABLE["trials"] | {"experiments": ["ID.2", "ID.3-static"]}
    keep = {*RIVALS, "drive_inertia", "torque_ripple"}
    session = session_with(truth, recipe=recipe_from(TABLE | {"trials": trials}))
    found = diagnose(session, without=tuple(sorted(set(CATALOGUE) - keep)))
    assert found.status is Status.EXPLAINED
    assert found.named == (Key(*truth[:2]),)


def test_a_little_friction_of_the_wrap_is_seen_though_a_lot_would_slip_elsewhere():
    trials = TABLE["trials"] | {
        "experiments": ["ID.2", "ID.3-static", "ID.4"],
        "id4": {"repeats": 2, "postures": [[25, 30, 45], [70, 60, 60]], "dwell": 0.4},
    }
    keep = {*RIVALS, "tendon_friction_capstan", "tendon_friction_presliding", "tendon_friction_saturating"}
    truth = ("tendon_friction_capstan", ("T1",), {"mu": 0.01})
    session = session_with(truth, recipe=recipe_from(TABLE | {"trials": trials}))
    found = diagnose(session, without=tuple(sorted(set(CATALOGUE) - keep)))
    assert found.named == (Key(*truth[:2]),)
    (capstan,) = found.augmented.model.effects
    np.testing.assert_allclose(float(capstan.mu), 0.01, rtol=0.2)


def test_no_cause_is_larger_than_its_law_holds():
    """A magnet is never three radii off its axis: the law of a small eccentricity says nothing there."""
    truth = ("encoder_eccentricity", ("PIP",), {"A": 3.0, "B": -2.0})
    bounds = CATALOGUE[truth[0]].amplitudes()
    found = diagnose(session_with(truth), without=tuple(sorted(set(CATALOGUE) - {*RIVALS, truth[0]})), quick=True)
    values = [v for c in found.candidates if c.key == Key(*truth[:2]) for v in c.values]
    assert values
    assert all(abs(v.value) <= bounds[v.name].most + 1e-9 for v in values)


def test_the_order_of_the_trials_in_a_file_says_nothing():
    """A sensor drifts with the clock, not with the order of the trials in a file."""
    keep = {*RIVALS, "torque_sensor_drift"}
    session = session_with(("torque_sensor_drift", ("torque_sensor",), {"slope": 1e-4, "A": 1e-3, "P": 250.0}))
    backwards = replace(session, trials=dict(reversed(session.trials.items())))
    without = tuple(sorted(set(CATALOGUE) - keep))
    found = [diagnose(s, without=without, quick=True) for s in (session, backwards)]
    assert {f.named for f in found} == {(Key("torque_sensor_drift", ("torque_sensor",)),)}
    probabilities = [{c.key: c.probability for c in f.candidates} for f in found]
    assert probabilities[0] == pytest.approx(probabilities[1], abs=1e-3)


def test_a_nominal_model_more_flexible_than_needed_hides_no_cause():
    recipe = Recipe(model=replace(Recipe().model, elastic_degree=5, moment_arm_degree=6, friction_degree=4))
    assert diagnose(session_with(PLANTED), recipe, without=WITHOUT, quick=True).named == (Key(*TRUTH),)
    assert diagnose(session_with(), recipe, without=WITHOUT, quick=True).status is Status.NO_GAP


def test_many_repeats_of_what_no_candidate_explains_make_none_right():
    """Repeats reduce noise but tell nothing about the form of a law. A law with the sign reversed stays unexplained
    however often it is repeated, and no amplitude gets a sign that it cannot have.
    """
    trials = TABLE["trials"] | {k: TABLE["trials"][k] | {"repeats": 4} for k in ("id2", "id3_static", "id3_dynamic")}
    upside_down = ("joint_stribeck", ("PIP",), {"a": -0.8, "v_s": 0.2, "delta": 2.0})
    session = session_with(upside_down, recipe=recipe_from(TABLE | {"trials": trials}))
    found = diagnose(session, without=WITHOUT, quick=True)
    assert found.status is Status.UNEXPLAINED
    for candidate in found.candidates:
        signs = {n: p.signed for n, p in CATALOGUE[candidate.key.effect].amplitudes().items()}
        assert all(signs.get(v.name, True) or v.value >= 0.0 for v in candidate.values)


def test_what_the_finger_decides_of_an_effect_is_not_fitted():
    """A fit moves the place of a stop, but not the range of the joint, which the file states."""
    keep = {"joint_stop", "torque_ripple"}
    truth = ("joint_stop", ("PIP",), {"stiffness": 0.05, "place": 0.7, "end": 1.0})
    found = diagnose(session_with(truth), without=tuple(sorted(set(CATALOGUE) - keep)))
    assert found.named == (Key(*truth[:2]),)
    (stop,) = found.augmented.model.effects
    joint = found.problem.nominal.finger.joint_names.index("PIP")
    np.testing.assert_array_equal(stop.limits, found.problem.nominal.finger.limits[joint])
    np.testing.assert_allclose(float(stop.place), 0.7, atol=0.01)
    np.testing.assert_allclose(float(stop.stiffness), 0.05, rtol=0.1)
    fitted = [describe(found.augmented.model)[i].name for i in found.augmented.estimated]
    assert [name for name in fitted if name.startswith("joint_stop")] == [
        f"joint_stop PIP {n}" for n in ("stiffness", "place")
    ]


@pytest.mark.parametrize("end", [0.0, -1.0], ids=["both", "one"])
def test_a_joint_that_stiffens_at_both_ends_is_told_from_one_that_stiffens_at_one(end):
    keep = {*RIVALS, "elastic_hardening", "joint_stop"}
    truth = ("elastic_hardening", ("PIP",), {"tau_end": 0.01, "width": 0.15, "end": end})
    found = diagnose(session_with(truth), without=tuple(sorted(set(CATALOGUE) - keep)), quick=True)
    assert (found.status, found.named) == (Status.EXPLAINED, (Key(*truth[:2]),))
    values = {v.name: v for v in found.budget[0].values}
    assert values["end"].value == end
    for name in ("tau_end", "width"):
        assert abs(values[name].value - truth[2][name]) < 3.0 * values[name].std


def test_a_wide_spectrum_is_told_from_one_relaxation_time():
    truth = ("elastic_relaxation", ("PIP",), {"stiffness": 0.01, "T": 1.0, "decades": 2.0})
    found = diagnose(session_with(truth), without=tuple(sorted(set(CATALOGUE) - {*RIVALS, truth[0]})))
    assert found.status is Status.EXPLAINED
    assert found.named == (Key(*truth[:2]),)
    (relaxation,) = found.augmented.model.effects
    assert float(relaxation.decades) == 2.0
    np.testing.assert_allclose([float(relaxation.stiffness), float(relaxation.T)], [0.01, 1.0], rtol=0.2)
