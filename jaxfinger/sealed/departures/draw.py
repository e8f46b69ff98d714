"""Draw a departure for a specimen: its site, form and shape. Calibration sets its size."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations

import numpy as np

from jaxfinger.data import FingerDescription

from . import joint, sensor, tendon, unlisted
from .base import Departure

Names = tuple[str, ...]
Index = tuple[int, ...]

LISTED: dict[str, type[Departure]] = {
    kind.effect: kind
    for kind in (
        joint.Stribeck,
        joint.JointPresliding,
        joint.LoadFriction,
        joint.Hardening,
        joint.Relaxation,
        joint.Stop,
        joint.PassiveTendon,
        tendon.Stretch,
        tendon.Creep,
        tendon.Backlash,
        tendon.Coupling,
        tendon.Bowstring,
        tendon.Capstan,
        tendon.ViscousTendon,
        tendon.TendonPresliding,
        tendon.Saturating,
        tendon.Crosstalk,
        sensor.Payload,
        sensor.Tilt,
        joint.DriveInertia,
        sensor.TorqueScale,
        sensor.TorqueDrift,
        joint.TorqueRipple,
        joint.AsymmetricFriction,
        joint.TorqueFriction,
        joint.WarmingFriction,
        sensor.TensionScale,
        sensor.EncoderOffset,
        sensor.Eccentricity,
        sensor.ForceRotation,
        sensor.Delay,
    )
}
UNLISTED: dict[str, type[Departure]] = {
    kind.effect: kind
    for kind in (
        unlisted.MotorCogging,
        unlisted.SlackSag,
        unlisted.SidewaysYield,
        unlisted.StickSlip,
        unlisted.Saturation,
        unlisted.EncoderCrosstalk,
        unlisted.SumOfAngles,
        unlisted.BaseYield,
        unlisted.QuadraticDrag,
    )
}

AT_JOINT = (
    joint.Stribeck,
    joint.JointPresliding,
    joint.LoadFriction,
    joint.Hardening,
    joint.Relaxation,
    joint.Stop,
    joint.DriveInertia,
    joint.TorqueRipple,
    joint.AsymmetricFriction,
    joint.TorqueFriction,
    joint.WarmingFriction,
    sensor.Payload,
    sensor.EncoderOffset,
    sensor.Eccentricity,
    unlisted.QuadraticDrag,
)
AT_TENDON = (
    tendon.Stretch,
    tendon.Creep,
    tendon.Backlash,
    tendon.Bowstring,
    tendon.Capstan,
    tendon.ViscousTendon,
    tendon.TendonPresliding,
    tendon.Saturating,
    sensor.TensionScale,
    unlisted.MotorCogging,
    unlisted.SlackSag,
)
JOINT_PAIR = (joint.PassiveTendon, unlisted.EncoderCrosstalk, unlisted.SumOfAngles)
AT_SENSOR = {
    sensor.TorqueScale: "torque_sensor",
    sensor.TorqueDrift: "torque_sensor",
    unlisted.Saturation: "torque_sensor",
    sensor.ForceRotation: "fingertip",
    unlisted.SidewaysYield: "fingertip",
    unlisted.StickSlip: "fingertip",
    sensor.Tilt: "base",
    unlisted.BaseYield: "base",
}


def draw(
    effect: str,
    finger: FingerDescription,
    rng: np.random.Generator,
    speeds: Sequence[float] = (0.5, 1.0),
    foreign: bool = False,
) -> Departure | None:
    """Draw a departure of its start size, or None where the finger has no site for it.

    `speeds`: those of the dynamic sweeps, rad/s. `foreign`: use a form that no other split has, if there is one.
    """
    possible = sites(effect, finger)
    if not possible:
        return None
    return draw_at(effect, possible[int(rng.integers(len(possible)))], finger, rng, speeds, foreign)


def draw_at(
    effect: str,
    site: tuple[Names, Index],
    finger: FingerDescription,
    rng: np.random.Generator,
    speeds: Sequence[float],
    foreign: bool = False,
) -> Departure:
    """Draw the form and shape of a departure of its start size at a given site."""
    kind = {**LISTED, **UNLISTED}[effect]
    forms = kind.foreign if foreign and kind.foreign else kind.forms
    return kind(kind.start_size, *site, str(rng.choice(forms)), _shape(kind, finger, site[1], rng, speeds))


def sites(effect: str, finger: FingerDescription) -> list[tuple[Names, Index]]:
    """Sites where an effect can act on a finger: names as the diagnosis writes them, and indices."""
    kind = {**LISTED, **UNLISTED}[effect]
    joints, tendons = finger.joint_names, finger.tendon_names
    active = [int(k) for k in np.flatnonzero(finger.active)]
    if kind in AT_JOINT:
        return [((joints[j],), (j,)) for j in range(finger.m)]
    if kind in AT_TENDON:
        return [((tendons[k],), (k,)) for k in active]
    if kind is joint.PassiveTendon:
        pairs = [[int(j) for j in np.flatnonzero(finger.crosses[k])[:2]] for k in np.flatnonzero(~finger.active)]
        return [((joints[a], joints[b]), (a, b)) for a, b in pairs]
    if kind in JOINT_PAIR:
        return [((joints[a], joints[a + 1]), (a, a + 1)) for a in range(finger.m - 1)]
    if kind is tendon.Coupling:
        crossed = {k: [int(j) for j in np.flatnonzero(finger.crosses[k])] for k in active}
        return [((tendons[k],), (k, a, b)) for k in active for a, b in combinations(crossed[k], 2)]
    if kind is tendon.Crosstalk:
        return [
            ((tendons[a], tendons[b]), (a, b))
            for a, b in permutations(active, 2)
            if np.any(finger.crosses[a] & finger.crosses[b])
        ]
    if kind is sensor.Delay:
        return [((channel,), ()) for channel in sensor.Delay.FIELDS]
    return [((AT_SENSOR[kind],), ())]


def _shape(
    kind: type[Departure],
    finger: FingerDescription,
    index: tuple[int, ...],
    rng: np.random.Generator,
    speeds: Sequence[float],
):
    """Draw the shape of a departure: parameters other than the size, SI."""
    sign = float(rng.choice([-1.0, 1.0]))
    phase = float(rng.uniform(0, 2 * np.pi))
    if kind is joint.Stribeck:
        return {"v_s": float(rng.uniform(0.25, 0.9) * speeds[len(speeds) // 2])}
    if kind is joint.Hardening:
        return {"side": sign, "b": float(rng.uniform(4, 8)), "onset": float(rng.uniform(0.5, 0.7))}
    if kind is joint.Relaxation:
        return {"tau": float(np.exp(rng.uniform(np.log(0.4), np.log(8.0))))}
    if kind is joint.Stop:
        low, high = finger.limits[index[0]]
        depth = rng.uniform(0.14, 0.24) * (high - low)
        return {"side": sign, "angle": float(high - depth if sign > 0 else low + depth)}
    if kind is joint.PassiveTendon:
        return {
            "r_a": float(rng.uniform(4e-3, 7e-3)),
            "r_b": float(rng.uniform(4e-3, 6e-3)),
            "slack": float(rng.uniform(0, 1.5e-3)),
        }
    if kind is joint.TorqueRipple:
        return {"p": float(rng.integers(7, 22)), "phase": phase}
    if kind is tendon.Stretch:
        return {"toe": float(rng.uniform(2, 6))}
    if kind is tendon.Creep:
        return {"tau": float(np.exp(rng.uniform(np.log(1.0), np.log(10.0))))}
    if kind is sensor.Payload:
        last = finger.fingertip[0] if index[0] == finger.m - 1 else finger.origin[index[0] + 1, 0]
        return {"x": float(last * rng.uniform(0.5, 1.0)), "z": float(rng.uniform(-5e-3, 5e-3))}
    if kind is unlisted.MotorCogging:
        return {"pitch": float(rng.uniform(1e-3, 2.5e-3)), "phase": phase}
    if kind is joint.WarmingFriction:
        return {"tau": float(rng.uniform(250, 600))}
    if kind is unlisted.StickSlip:
        return {"pitch": float(rng.uniform(1.3, 2.7))}
    if kind is unlisted.Saturation:
        return {"ceiling": float(rng.uniform(0.018, 0.026))}
    if kind is unlisted.SumOfAngles:
        return {"p": float(rng.integers(5, 9)), "phase": phase}
    return {"sign": sign, "phase": phase, "polar": float(rng.uniform(0.2, np.pi - 0.2))}
