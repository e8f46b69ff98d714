"""The paper's experiments as protocols: generators of commands, waits and marks that the runner carries out.

A protocol begins unrecorded (posture, pretension, taring), yields `Start`, and is recorded from there to its end. The
runner then carries out `slackened`. It switches the drives off for every `Setup` but those of a finger that is moved by
hand, and on again afterwards, with all set-points of tension at zero. Plan files give angles in degrees, tensions in N,
times in s; commands are in SI.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from jaxfinger.data.session import FingerDescription
from jaxfinger.data.signals.motion import MIN_HOLD
from jaxfinger.data.toml import Fault, NotEmpty, Positive, Within
from jaxfinger.errors import counted
from jaxfinger.rig.backend import Command, JointMove, Setup, TensionRamp


@dataclass(frozen=True)
class Reached:
    """Wait until the controller has carried out the last command, at most `timeout` s."""

    timeout: float = 60.0


@dataclass(frozen=True)
class Dwell:
    """Wait `seconds` of device time."""

    seconds: float


@dataclass(frozen=True)
class Settled:
    """Wait until every named tension has stayed within `within` N of its value for `seconds`, at most `timeout` s."""

    tensions: dict[str, float]
    within: float = 0.3  # N: a tenth of tension_error_max of the example rig file
    seconds: float = 0.5
    timeout: float = 20.0


@dataclass(frozen=True)
class Covered:
    """Wait until each joint has been moved through `share` of its range `passes` times each way, for `timeout` s."""

    joints: tuple[str, ...]
    share: float
    passes: int
    timeout: float


@dataclass(frozen=True)
class Tare:
    """Take the mean of these kinds of channel over `seconds` as their zero. The sensors must be unloaded."""

    kinds: tuple[str, ...]
    seconds: float = 0.5


@dataclass(frozen=True)
class Mark:
    """Assign the samples from here on to a hold (−1: none) and to commanded directions (−1, 0, 1) by name."""

    hold: int = -1
    joint_direction: dict[str, int] = field(default_factory=dict)
    tendon_direction: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Start:
    """Record from here on. Excursions count for the `loaded` tendons; a slack tendon's encoder says nothing."""

    loaded: tuple[str, ...] = ()


# Of a joint's range: an encoder may differ by so much from the angle that the operator was asked for, or to which the
# external motor went. A fixture set by eye is nearer; an angle in another unit, or of another joint, seldom is.
POSE_SHARE = 0.1
# N, the lowest tension of a plan, at which the free finger of VD.3 also begins: tendons stay taut, and no joint is
# thrown. The controller takes less than 0.2 N for slack.
MIN_TARGET = 0.6
# Repeats or passes. A thousand of them give the noise's standard deviation to 2 % (1/√2000); more is a mistake.
Count = Annotated[int, Within(1, 1000)]
NotNegative = Annotated[float, Within(0.0)]
Taut = Annotated[float, Within(MIN_TARGET, unit="N")]
# Two hours, longer than the paper's whole session: more is a mistake, and the finger is armed all the while.
MAX_S = 7200.0
Seconds = Annotated[float, Within(0.0, MAX_S, "s")]
Recorded = Annotated[float, Within(MIN_HOLD, MAX_S, "s")]  # a shorter hold or recording gives no sample to a fit
Step = Command | Setup | Reached | Dwell | Settled | Covered | Tare | Mark | Start
Protocol = Iterator[Step]


@dataclass(frozen=True)
class Common:
    """Keys that every experiment has."""

    posture_deg: tuple[float, ...] = ()  # angles at which joints are fixed; empty: all at 20°
    tension_rate: NotNegative = 10.0  # N/s
    repeats: Count = 1

    def posture(self, finger: FingerDescription) -> dict[str, float]:
        """Angle of every joint in rad."""
        angles = self.posture_deg or (20.0,) * finger.m
        return dict(zip(finger.joint_names, np.radians(angles).tolist(), strict=True))


@dataclass(frozen=True)
class MomentArms(Common):
    """ID.2: a joint moved by hand through `share` of its range `passes` times, all tendons at `pretension` N."""

    joint: str = field(kw_only=True)
    pretension: Taut = 2.0  # N
    share: float = 0.8  # at most 0.85: hands must not run the joint into its stops
    passes: Count = 3
    timeout: Seconds = 120.0  # s for all passes

    def __post_init__(self):
        if not 0.1 <= self.share <= 0.85:
            said = "of the range must lie between 0.1 and 0.85: hands must not run the joint into its stops"
            raise Fault(said, "share")


@dataclass(frozen=True)
class StaticTorque(Common):
    """ID.3-static: a joint held every `step_deg` of `range_deg`, up and back. A hold begins `settle` s after the move
    and lasts `dwell` s.
    """

    joint: str = field(kw_only=True)
    range_deg: tuple[float, float] = (0.0, 70.0)
    step_deg: Annotated[float, Within(0.01, unit="deg")] = 10.0  # at least 0.01°: the encoder AA5048B resolves 0.02°
    speed_deg_s: NotNegative = 30.0
    acceleration_deg_s2: NotNegative = 600.0
    settle: Seconds = 0.2  # s
    dwell: Recorded = 0.5  # s


@dataclass(frozen=True)
class DynamicTorque(Common):
    """ID.3-dynamic: a joint driven to and fro through `range_deg` `passes` times at each of `speeds_deg_s`."""

    joint: str = field(kw_only=True)
    range_deg: tuple[float, float] = (10.0, 65.0)
    speeds_deg_s: Annotated[tuple[float, ...], NotEmpty()] = (28.6, 57.3, 85.9)  # 0.5, 1, 1.5 rad/s
    acceleration_deg_s2: NotNegative = 600.0  # reaches 1.5 rad/s in 0.14 s
    passes: Count = 2


@dataclass(frozen=True)
class TendonFriction(Common):
    """ID.4: one tendon pulled through `levels` N, and with `down` back; the torque sensor holds the joint."""

    joint: str = field(kw_only=True)
    tendon: str = field(kw_only=True)
    levels: tuple[Taut, ...] = (2.0, 4.0, 6.0, 8.0, 10.0)
    down: bool = True
    settle: Seconds = 0.3  # s before a hold
    dwell: Recorded = 0.5  # s of a hold


@dataclass(frozen=True)
class FreeExcursion(Common):
    """VD.1: all joints moved by hand for `seconds`, with all tendons at `pretension` N."""

    pretension: Taut = 2.0  # N
    seconds: Recorded = 20.0


@dataclass(frozen=True)
class FingertipForce(Common):
    """VD.2: fingertip on its force sensor, one tendon pulled through `levels` N, the others slack."""

    tendon: str = field(kw_only=True)
    levels: tuple[Taut, ...] = tuple(float(f) for f in range(4, 16))
    settle: Seconds = 0.3
    dwell: Recorded = 0.5


@dataclass(frozen=True)
class Trajectory(Common):
    """VD.3: the free finger under random tensions about `mean` N, with new targets every `interval` s.

    Targets lie within `amplitude` N of the mean; `seed` chooses them. The operator lets the finger go near
    `posture_deg`.
    """

    mean: tuple[Taut, ...] = ()  # N per active tendon; empty: 2 N each
    amplitude: NotNegative = 0.8  # N
    interval: Positive = 0.5  # s
    seconds: Recorded = 10.0
    seed: Annotated[int, Within(0)] = 0


def _all(finger: FingerDescription, tension: float) -> dict[str, float]:
    """One tension for every active tendon."""
    return {name: tension for name, active in zip(finger.tendon_names, finger.active, strict=True) if active}


def _angles(posture: dict[str, float]) -> str:
    return ", ".join(f"{name} {_degrees(angle)}" for name, angle in posture.items())


def _degrees(angle: float) -> str:
    """An angle in rad as people read it: in degrees, to a tenth where it is no whole one."""
    return f"{round(float(np.degrees(angle)), 1):g}°"


def swept(finger: FingerDescription, joint: str, share: float) -> tuple[float, float]:
    """Lower and upper end, rad, of the middle `share` of a joint's range."""
    low, high = finger.limits[finger.joint_names.index(joint)]
    margin = (1.0 - share) / 2.0 * (high - low)
    return float(low + margin), float(high - margin)


def _tension(targets: dict[str, float], rate: float) -> Protocol:
    """Ramp tensions and wait until the controller has done it."""
    yield TensionRamp(targets, rate)
    yield Reached()


def slackened(finger: FingerDescription, rate: float) -> Protocol:
    """Take the tension off all tendons. At one rate for all, so no difference between two of them grows meanwhile."""
    yield from _tension(_all(finger, 0.0), rate)


def _tared(finger: FingerDescription, posture: dict[str, float], kinds: tuple[str, ...], rate: float) -> Protocol:
    """Unload the sensors and tare them, the drives on as when they are read: the beginning of every trial with them."""
    yield Setup(f"Fix all joints: {_angles(posture)}. Uncouple the external motor, free the fingertip.", fixed=posture)
    yield from slackened(finger, rate)
    yield Dwell(0.3)
    yield Tare(kinds)


def moment_arms(finger: FingerDescription, p: MomentArms) -> Protocol:
    """ID.2: all tendons are pre-tensioned; the operator moves one joint through its range, the others are fixed."""
    posture = p.posture(finger)
    yield Setup(f"Fix all joints: {_angles(posture)}.", fixed=posture)
    pretension = _all(finger, p.pretension)
    yield from _tension(pretension, p.tension_rate)
    yield Settled(pretension)
    others = {name: angle for name, angle in posture.items() if name != p.joint}
    low, high = np.degrees(swept(finger, p.joint, p.share))
    far = f"from {math.floor(low)}° to {math.ceil(high)}° and back, {counted(p.passes, 'time')}"
    yield Setup(f"Hold {p.joint}, free it, and move it slowly by hand: {far}.", fixed=others, hand=(p.joint,))
    yield Start(loaded=tuple(pretension))
    yield Covered((p.joint,), p.share, p.passes, p.timeout)


def static_torque(finger: FingerDescription, p: StaticTorque) -> Protocol:
    """ID.3-static: tendons are slack; the external motor stops the joint at angles from extension to flexion and back.

    Friction must point the same way in all holds of one direction. So the first hold lies `approach` + 0.02 rad above
    the lower end and is reached from below, and the first hold on the way back lies 0.05 rad below the upper end.
    """
    posture = p.posture(finger)
    low, high = np.radians(p.range_deg)
    grid = np.linspace(low, high, max(2, round((p.range_deg[1] - p.range_deg[0]) / p.step_deg) + 1))
    yield from _tared(finger, posture, ("external_torque",), p.tension_rate)
    yield from _coupled(posture, p.joint, _motion(finger, posture, p.joint, p.range_deg, p.speed_deg_s))
    speed, acceleration = np.radians((p.speed_deg_s, p.acceleration_deg_s2)).tolist()
    approach = min(0.05, float(grid[1] - grid[0]) / 2)
    yield JointMove(p.joint, float(low), speed, acceleration)
    yield Reached()
    # This one gives friction its direction before the first hold.
    yield JointMove(p.joint, float(low) + approach, speed, acceleration)
    yield Reached()
    yield Start()
    up = [float(low) + approach + 0.02, *grid[1:].tolist()]
    hold = 0
    for direction, angles in ((+1, up), (-1, [float(high) - 0.05, *grid[-2::-1].tolist()])):
        for angle in angles:
            yield Mark(-1, {p.joint: direction})
            yield JointMove(p.joint, angle, speed, acceleration)
            yield Reached()
            yield Dwell(p.settle)
            yield Mark(hold, {p.joint: direction})
            yield Dwell(p.dwell)
            hold += 1


def dynamic_torque(finger: FingerDescription, p: DynamicTorque) -> Protocol:
    """ID.3-dynamic: tendons are slack; the external motor drives the joint to and fro at several speeds."""
    posture = p.posture(finger)
    low, high = np.radians(p.range_deg).tolist()
    acceleration = float(np.radians(p.acceleration_deg_s2))
    yield from _tared(finger, posture, ("external_torque",), p.tension_rate)
    yield from _coupled(posture, p.joint, _motion(finger, posture, p.joint, p.range_deg, max(p.speeds_deg_s)))
    yield JointMove(p.joint, low, float(np.radians(min(p.speeds_deg_s))), acceleration)
    yield Reached()
    yield Start()
    for speed in np.radians(p.speeds_deg_s).tolist():
        for target in (high, low) * p.passes:
            yield JointMove(p.joint, target, speed, acceleration)
            yield Reached()


def _coupled(posture: dict[str, float], joint: str, motion: str = "") -> Protocol:
    """Couple one joint to the external motor, the others fixed. `motion` says what the motor will do."""
    others = {name: angle for name, angle in posture.items() if name != joint}
    text = f"Couple the external motor to {joint}; the other joints stay fixed.{motion}"
    yield Setup(text, fixed=others, motor=joint)


def _motion(
    finger: FingerDescription, posture: dict[str, float], joint: str, range_deg: tuple[float, float], speed: float
) -> str:
    """Sentence, after a space, on what the external motor will do, so that a plan in a wrong unit is seen before Enter.

    It moves the joint from its posture and through `range_deg`, at up to `speed` (deg/s).
    """
    ends = (posture[joint], *np.radians(range_deg).tolist())
    low, high = min(ends), max(ends)
    share = (high - low) / float(np.ptp(finger.limits[finger.joint_names.index(joint)]))
    across = f"between {_degrees(low)} and {_degrees(high)}, {100 * share:.0f} % of its range"
    return f" The motor will move it {across}, at up to {speed:g}°/s."


def tendon_friction(finger: FingerDescription, p: TendonFriction) -> Protocol:
    """ID.4: the torque sensor holds the joint; one tendon is pulled in steps, the others are slack."""
    posture = p.posture(finger)
    yield from _tared(finger, posture, ("external_torque",), p.tension_rate)
    yield from _coupled(posture, p.joint)
    yield from _steps(p.tendon, p.levels, p.down, p.settle, p.dwell, p.tension_rate)


def fingertip_force(finger: FingerDescription, p: FingertipForce) -> Protocol:
    """VD.2: the fingertip rests on its force sensor; one tendon is pulled in steps, the others are slack."""
    posture = p.posture(finger)
    yield from _tared(finger, posture, ("fingertip_force",), p.tension_rate)
    text = f"Bring the force sensor to the fingertip at {_angles(posture)}; only the contact holds the finger."
    yield Setup(text, fixed=posture, contact=True)
    yield from _steps(p.tendon, p.levels, False, p.settle, p.dwell, p.tension_rate)


def _steps(tendon: str, levels: tuple[float, ...], down: bool, settle: float, dwell: float, rate: float) -> Protocol:
    """Record one tendon pulled through tensions, each with a hold.

    It begins at half the first level, so that the first hold is reached from below too.
    """
    first = levels[0]
    yield from _tension({tendon: first / 2}, rate)
    yield Start(loaded=(tendon,))
    back = levels[-2::-1] if down else ()
    for hold, (direction, level) in enumerate([(+1, v) for v in levels] + [(-1, v) for v in back]):
        yield Mark(-1, {}, {tendon: direction})
        yield from _tension({tendon: level}, rate)
        yield Dwell(settle)
        yield Mark(hold, {}, {tendon: direction})
        yield Dwell(dwell)


def free_excursion(finger: FingerDescription, p: FreeExcursion) -> Protocol:
    """VD.1: all joints are free and moved gently by hand; tendons are pre-tensioned."""
    posture, pretension = p.posture(finger), _all(finger, p.pretension)
    yield Setup(f"Fix all joints: {_angles(posture)}.", fixed=posture)
    yield from _tension(pretension, p.tension_rate)
    yield Settled(pretension)
    yield Setup("Hold the fingertip, remove all fixtures, and move the finger gently about.", hand=finger.joint_names)
    yield Start(loaded=tuple(pretension))
    yield Dwell(p.seconds)


def trajectory(finger: FingerDescription, p: Trajectory) -> Protocol:
    """VD.3: the tendons alone drive the free finger. No target is below MIN_TARGET, so that no tendon falls slack.

    The finger lies free before the drives are switched on, and every tendon is seen to be taut before it is moved.
    """
    posture, taut = p.posture(finger), _all(finger, MIN_TARGET)
    names = list(taut)
    mean = np.array(p.mean or (2.0,) * len(names))
    rng = np.random.default_rng(p.seed)

    def at_least_taut(tension: np.ndarray) -> dict[str, float]:
        return dict(zip(names, np.maximum(tension, MIN_TARGET).tolist(), strict=True))

    yield Setup(f"Remove all fixtures, and let the finger go near {_angles(posture)}.")
    yield from _tension(taut, p.tension_rate)
    yield Settled(taut)
    yield from _tension(at_least_taut(mean), p.tension_rate)
    yield Dwell(1.0)
    yield Start(loaded=tuple(names))
    for _ in range(round(p.seconds / p.interval)):
        yield TensionRamp(at_least_taut(mean + p.amplitude * rng.uniform(-1, 1, len(names))), p.tension_rate)
        yield Dwell(p.interval)


# Protocol of each experiment, and the class of its parameters.
PROTOCOLS = {
    "ID.2": (moment_arms, MomentArms),
    "ID.3-static": (static_torque, StaticTorque),
    "ID.3-dynamic": (dynamic_torque, DynamicTorque),
    "ID.4": (tendon_friction, TendonFriction),
    "VD.1": (free_excursion, FreeExcursion),
    "VD.2": (fingertip_force, FingertipForce),
    "VD.3": (trajectory, Trajectory),
}
DYNAMIC = ("ID.3-dynamic", "VD.1", "VD.3")  # experiments for which a terminal's filter is too slow
