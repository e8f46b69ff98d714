"""rms on fresh trials, of known differences."""

import numpy as np
import pytest

from jaxfinger.data import Session, Trial
from jaxfinger.sealed.closure import gap_by_channel
from jaxfinger.sealed.laws import Finger
from jaxfinger.sealed.record import commanded, record


def test_differences_put_in_come_out(specimen, nominal: Finger, plans):
    rng = np.random.default_rng(0)
    trials, predicted = {}, {}
    for plan in plans:
        if plan.experiment not in ("ID.4", "ID.2", "VD.2"):
            continue
        truth = record(nominal, plan, commanded(plan, 50.0))
        trial = Trial(
            plan.name, plan.experiment, truth.time, truth.q, truth.tension, tendon_excursion=truth.excursion,
            joint_torque=truth.torque,
            fingertip_force=truth.force,
        )  # fmt: skip
        said = {"time": truth.time, "tendon_excursion": truth.excursion + 3e-3}  # A constant is no gap.
        if truth.torque is not None:
            said["joint_torque"] = truth.torque + 2e-3
        if truth.force is not None:
            said["fingertip_force"] = truth.force + 0.1 * rng.choice([-1, 1], truth.force.shape)
        trials[plan.name], predicted[plan.name] = trial, said
    gap = gap_by_channel(Session("s", specimen.cad, trials), predicted)
    assert gap["ID.4", "joint_torque"] == pytest.approx(2e-3)
    assert gap["VD.2", "fingertip_force"] == pytest.approx(0.1)
    for experiment in ("ID.2", "ID.4", "VD.2"):
        assert gap[experiment, "tendon_excursion"] == pytest.approx(0.0, abs=1e-12)


def test_torque_of_vd3_counts_only_where_joint_and_tendons_slide(specimen):
    t = np.arange(4000) * 1e-3
    q = np.full((4000, 3), 0.4)
    q[:, 0] += np.where(t < 2, 0.0, 0.3 * (t - 2))  # The base joint rests, then moves at 0.3 rad/s.
    length = Finger(specimen).geometry(q)[0]
    trial = Trial("v", "VD.3", t, q, np.full((4000, 5), 3.0), tendon_excursion=length)
    torque = np.zeros((4000, 3))
    torque[t < 1.9, 0] = 1.0  # Friction at rest takes any value.
    torque[t > 2.1, 0] = 2e-3
    torque[:, 1:] = 1.0
    gap = gap_by_channel(Session("s", specimen.cad, {"v": trial}), {"v": {"time": t, "joint_torque": torque}})
    assert gap["VD.3", "joint_torque"] == pytest.approx(2e-3, rel=0.05)


def test_torque_of_the_driven_joint_counts_in_holds_and_clear_of_reversals(specimen):
    t = np.arange(4000) * 1e-3
    q = np.full((4000, 3), 0.4)
    q[:, 0] += 0.3 * np.abs(t - 2.0)  # The joint turns back at 2 s.
    torque = np.full((4000, 3), np.nan)
    torque[:, 0] = np.where(np.abs(t - 2.0) < 0.02, 1.0, 2e-3)
    sweep = Trial("d", "ID.3-dynamic", t, q, joint_torque=torque, joint=specimen.cad.joint_names[0])
    hold = np.where(t < 1.0, 0, -1).astype(np.int32)
    torque = np.where(hold[:, None] >= 0, torque, torque + 1.0)
    steps = Trial("s", "ID.3-static", t, q, joint_torque=torque, joint=specimen.cad.joint_names[0], hold=hold)
    said = {"time": t, "joint_torque": 0.0 * torque}
    gap = gap_by_channel(Session("s", specimen.cad, {"d": sweep, "s": steps}), {"d": said, "s": said})
    assert gap["ID.3-dynamic", "joint_torque"] == pytest.approx(2e-3)
    assert gap["ID.3-static", "joint_torque"] == pytest.approx(2e-3)
