"""Where nothing is missing no gap is found, on machines of any size, inertia, sensors and sampling rate."""

import numpy as np
import pytest

from jaxfinger.gap import Status, diagnose
from jaxfinger.synthetic import recipe_from, simulate

JOINTS, TENDONS = ("J1", "J2"), {"T1": (1.0, 0.0), "T2": (-1.0, 0.0), "T3": (0.6, 1.0), "T4": (-0.6, -1.0)}


def machine(mass: float, length: float, rotor: float, rate: float, noise: float, encoder: float) -> dict:
    """Recipe of a finger of two joints and four tendons whose torques and tensions follow from its weight.

    `mass`, `length`: those of a link over those of a finger. `rotor`: inertia over that of a link. `rate`: Hz.
    `noise`: of torques, tensions and excursions, over the largest of the trials. `encoder`: rad.
    """
    masses, lengths = mass * np.array([0.02, 0.012]), length * np.array([0.045, 0.03])
    levers = np.array([[lengths[0] / 2, lengths[0] + lengths[1] / 2], [0.0, lengths[1] / 2]])  # m, of joint and link
    weight = 9.81 * levers @ masses  # N m, of the straight finger at each joint
    arm = 0.008 * length
    pull = 3.0 * weight.max() / arm
    inertia = masses * lengths**2 / 12.0
    joints = [
        {
            "name": name,
            "axis": [0.0, 1.0, 0.0],
            "origin": [lengths[0] if k else 0.0, 0.0, 0.0],
            "limits": [-0.2, 1.5],
            "mass": masses[k],
            "com": [lengths[k] / 2, 0.0, 0.0],
            "inertia": np.diag(inertia[k] * np.array([0.1, 1.0, 1.0])).tolist(),
            "rotor_inertia": 4.0 * rotor * inertia[k],
        }
        for k, name in enumerate(JOINTS)
    ]
    tendons = [
        {
            "name": name,
            "crosses": [joint for joint, way in zip(JOINTS, ways, strict=True) if way],
            "excursion": {j: [way * arm, 0.1 * way * arm] for j, way in zip(JOINTS, ways, strict=True) if way},
        }
        for name, ways in TENDONS.items()
    ]
    terms = {
        "joints": {
            j: {"elastic": [-0.2 * w, 2.0 * w], "friction": [friction * w], "damping": 0.02 * w}
            for j, w, friction in zip(JOINTS, weight, (0.15, 0.03), strict=True)
        },
        "tendons": {
            t: {"constant": 0.015 * pull, "proportional": a}
            for t, a in zip(TENDONS, (0.01, 0.12, 0.08, 0.12), strict=True)
        },
    }
    steps = {"tensions": [0.4 * pull, 0.6 * pull, 0.8 * pull, pull]}
    trials = {
        "rate": rate,
        "id2": {"strokes": 2, "tension": 0.3 * pull},
        "id4": steps,
        "vd1": {"motions": 2, "duration": 8.0, "tension": 0.3 * pull},
        "vd2": steps,
        "vd3": {"rate": max(rate, 500.0)},
    }
    sizes = {
        "q": encoder,
        "tendon_force": noise * pull,
        "tendon_excursion": noise * arm,
        "joint_torque": noise * weight.max(),
        "fingertip_force": 0.3 * noise * pull,
    }
    sensors = {channel: {"std": std, "resolution": std, "coloured": 0.0} for channel, std in sizes.items()}
    finger = {
        "gravity": [0.0, 0.0, -9.81],
        "fingertip": [lengths[1], 0.0, 0.0],
        "joints": joints,
        "tendons": tendons,
    }
    return {"finger": finger, "terms": terms, "trials": trials, "sensors": sensors}


@pytest.mark.long
@pytest.mark.parametrize(
    ("mass", "length", "rotor", "rate", "noise", "encoder"),
    [(9.0, 2.8, 30.0, 200.0, 1e-3, 3e-4), (0.08, 0.25, 30.0, 1000.0, 1e-3, 5e-4)],
)
def test_a_machine_that_lacks_nothing_has_no_gap(mass, length, rotor, rate, noise, encoder):
    session = simulate(recipe_from(machine(mass, length, rotor, rate, noise, encoder)), seed=1)
    assert diagnose(session, quick=True).status is Status.NO_GAP
