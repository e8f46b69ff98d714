"""Plan files: which experiments, in which order, how often. Every command is checked before anything moves."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from jaxfinger.data.toml import Document, Fault, NotEmpty, Place, one_of, parse_toml, read_toml, structure
from jaxfinger.errors import UserError, counted
from jaxfinger.rig.backend import CommandRefused, JointMove, Setup, TensionRamp
from jaxfinger.rig.channels import RigDescription
from jaxfinger.rig.protocols import (
    POSE_SHARE,
    PROTOCOLS,
    Common,
    Covered,
    Dwell,
    DynamicTorque,
    Protocol,
    Reached,
    Settled,
    StaticTorque,
    Step,
    Tare,
)
from jaxfinger.rig.safety import admit
from jaxfinger.rig.trips import time_to_cover

# Steps of one trial (commands, marks and waits). The paper's longest trial has a hundred. More than this is a mistake
# in the plan, and checking it would seem to hang.
MAX_STEPS = 100_000
RADIANS = 2.0  # rad, 115°: a finger's joint bends by no more. Postures beyond it are in degrees.
HAND_PASS_S = 4.0  # s, as the simulated operator takes: a range of 100° at 50 °/s


@dataclass(frozen=True)
class PlannedTrial:
    """One trial to record. Trials with the same `motion` repeat each other; `line` is its line in the plan file."""

    name: str
    experiment: str
    motion: str
    parameters: Common
    line: int

    @property
    def joint(self) -> str | None:
        """Name of the joint that is moved or instrumented, or None."""
        return getattr(self.parameters, "joint", None)

    @property
    def tendon(self) -> str | None:
        """Name of the tendon that is pulled, or None."""
        return getattr(self.parameters, "tendon", None)

    def protocol(self, rig: RigDescription) -> Protocol:
        """Steps of the experiment."""
        return PROTOCOLS[self.experiment][0](rig.finger, self.parameters)


@dataclass(frozen=True)
class Plan:
    """A plan file, read and checked. `text` is the file itself."""

    name: str
    operator: str
    trials: tuple[PlannedTrial, ...]
    text: str
    path: str


@dataclass(frozen=True)
class Estimate:
    """Duration in s, prompts, and highest tension in N that a trial's commands give."""

    name: str
    seconds: float
    prompts: tuple[str, ...]
    highest_tension: float


@dataclass(frozen=True)
class PlanTable:
    """Keys of `[plan]`."""

    name: str
    operator: str = ""


@dataclass(frozen=True)
class PlanFile:
    """Tables of a plan file. The keys of a `[[trial]]` depend on its experiment."""

    plan: PlanTable
    trial: Annotated[tuple[Mapping[str, Any], ...], NotEmpty()]


def read_plan(path: str | Path, rig: RigDescription) -> Plan:
    """Read a plan file and check every command that it will give against the limits of the rig file.

    Raises:
        UserError: the file cannot be read, or a key or command is wrong. The sentence gives the line.
    """
    return _plan(read_toml(path, "give the path of a plan file"), rig)


def parse_plan(text: str, rig: RigDescription, path: str | Path = "plan.toml") -> Plan:
    """Read a plan from text, as `read_plan` does; `path` names it in messages."""
    return _plan(parse_toml(text, path), rig)


def _plan(document: Document, rig: RigDescription) -> Plan:
    file, place = document.read(PlanFile), document.place
    trials = [t for i, table in enumerate(file.trial) for t in _trials(i, table, rig, place / "trial" / i)]
    named = tuple(
        PlannedTrial(f"{i:02d}-{t.motion.rsplit('-', 1)[0]}", t.experiment, t.motion, t.parameters, t.line)
        for i, t in enumerate(trials, 1)
    )
    for trial in {trial.line: trial for trial in reversed(named)}.values():  # one of each set of repeats
        try:
            for number, (step, seconds) in enumerate(timed(trial, rig)):
                if number == MAX_STEPS:
                    raise UserError(f"takes more than {MAX_STEPS} steps; shorten it")
                if isinstance(step, TensionRamp | JointMove) and seconds > Reached.timeout:
                    said = f"takes {seconds:.0f} s for one command, longer than {Reached.timeout:g} s"
                    raise UserError(f"{said}; see the unit of its rate or speed")
                if isinstance(step, Covered) and seconds > step.timeout:
                    said = f"to and fro by hand {counted(step.passes, 'time')} takes {seconds:g} s, longer than the"
                    raise UserError(f"{said} timeout of {step.timeout:g} s; give at least {seconds:g} s")
        except CommandRefused as error:
            mend = "change this [[trial]], or [limits] of the rig file"
            raise UserError(
                f"{document.path}, line {trial.line}: {trial.name}: {str(error).rstrip('.')}; {mend}."
            ) from error
        except UserError as error:
            raise UserError(f"{document.path}, line {trial.line}: {trial.name}: {error}") from error
    return Plan(file.plan.name, file.plan.operator, named, document.text, str(document.path))


def _trials(index: int, table: Mapping[str, Any], rig: RigDescription, place: Place) -> Iterator[PlannedTrial]:
    """Yield the repeats of one `[[trial]]`, without their final names."""
    if "experiment" not in table:
        place.fail("has no `experiment`; add a line 'experiment = …'")
    try:
        experiment = one_of(table["experiment"], tuple(PROTOCOLS))
    except Fault as fault:
        (place / "experiment").fail(fault.message)
    keys = {key: value for key, value in table.items() if key != "experiment"}
    parameters = structure(keys, PROTOCOLS[experiment][1], place)
    _check_parameters(experiment, parameters, rig, place)
    what = [experiment, *(str(getattr(parameters, key)) for key in ("tendon", "joint") if hasattr(parameters, key))]
    for _ in range(parameters.repeats):
        yield PlannedTrial("", experiment, f"{'-'.join(what)}-{index + 1}", parameters, place.line or 1)


def _check_parameters(experiment: str, parameters: Common, rig: RigDescription, place: Place) -> None:
    """Refuse parameters that do not fit the finger or the rig's channels. Raises UserError with the line."""
    finger, values = rig.finger, vars(parameters)
    for key, names in (("joint", finger.joint_names), ("tendon", finger.tendon_names)):
        if key in values:
            try:
                one_of(values[key], names)
            except Fault as fault:
                (place / key).fail(fault.message)
    if "levels" in values and (len(values["levels"]) < 2 or np.any(np.diff(values["levels"]) <= 0)):
        (place / "levels").fail("must be two or more rising tensions in N")
    if "range_deg" in values and values["range_deg"][0] >= values["range_deg"][1]:
        (place / "range_deg").fail("must be [lower, upper] with lower below upper")
    if isinstance(p := parameters, StaticTorque | DynamicTorque):
        span, (low, high) = p.range_deg[1] - p.range_deg[0], finger.limits[finger.joint_names.index(p.joint)]
        if isinstance(p, StaticTorque) and span < p.step_deg:
            (place / "range_deg").fail(f"spans {span:g}°, less than one step of {p.step_deg:g}°; give it in degrees")
        if span < (least := POSE_SHARE * np.degrees(high - low)):  # The encoder's check could not see such a motion.
            said = f"spans {span:g}°, less than {100 * POSE_SHARE:g} % of the range of {p.joint}"
            (place / "range_deg").fail(f"{said}; give it in degrees, and at least {least:.1f}° wide")
    if values.get("mean") and len(values["mean"]) != int(finger.active.sum()):
        (place / "mean").fail(f"must give one tension for each of the {int(finger.active.sum())} active tendons")
    posture = parameters.posture_deg
    if posture and len(posture) != finger.m:
        (place / "posture_deg").fail(f"has {len(posture)} angles; give one for each of the {finger.m} joints")
    if posture and _are_radians(posture, rig):
        given, meant = (", ".join(f"{a:g}" for a in angles) for angles in (posture, np.round(np.degrees(posture))))
        said = f"{given} are all within {RADIANS:g}° of straight, so these seem to be radians"
        (place / "posture_deg").fail(f"{said}; give it in degrees ({meant}), or 0 for each joint that is straight")
    at = np.degrees(list(parameters.posture(finger).values()))  # also where it is the default
    for joint, angle, (low, high) in zip(finger.joint_names, at, np.degrees(finger.limits), strict=True):
        if not low - 1e-9 <= angle <= high + 1e-9:
            (place / "posture_deg").fail(f"{angle:g}° for {joint} is outside its limits {low:.0f}° to {high:.0f}°")
    tendon, joint = values.get("tendon"), values.get("joint")
    if experiment == "ID.4" and not finger.crosses[finger.tendon_names.index(tendon), finger.joint_names.index(joint)]:
        (place / "joint").fail(f"{tendon} does not cross {joint}, so it gives no torque there; choose another joint")
    if experiment.startswith("ID.3") or experiment == "ID.4":
        needed = ("external_torque", "")
    else:
        needed = {"VD.2": ("fingertip_force", "x")}.get(experiment, ("excursion", finger.tendon_names[0]))
    if needed[0] not in {c.kind for c in rig.channels}:
        (place / "experiment").fail(f"{experiment} needs a channel of kind '{needed[0]}', which the rig file has not")


def _are_radians(posture: tuple[float, ...], rig: RigDescription) -> bool:
    """Whether angles given as degrees can only be meant in rad.

    All are within RADIANS, and within the limits if read as rad; and one is not 0. A fixture is set by eye, so nobody
    who means degrees loses anything by giving 0 for a finger that is straight but for a degree or two.
    """
    low, high = rig.finger.limits.T
    small = np.abs(posture) <= RADIANS
    return bool(np.all(small & (low <= posture) & (posture <= high)) and np.any(posture))


def commands(trial: PlannedTrial, rig: RigDescription) -> Iterator[Step]:
    """Yield every step of a trial, each command checked against the limits.

    The steps of a protocol do not depend on measurements, so those checked here are those of the run.

    Raises:
        CommandRefused: a command is beyond the limits.
    """
    for step in trial.protocol(rig):
        if isinstance(step, TensionRamp | JointMove):
            admit(step, rig)
        yield step


def timed(trial: PlannedTrial, rig: RigDescription) -> Iterator[tuple[Step, float]]:
    """Yield every step of a trial, as `commands` does, with the time in s that it takes on the controller.

    A joint moved by hand is taken to need HAND_PASS_S for each pass to and fro.
    """
    tension = dict.fromkeys(rig.finger.tendon_names, 0.0)
    angle = trial.parameters.posture(rig.finger)
    for step in commands(trial, rig):
        seconds = 0.0
        if isinstance(step, TensionRamp):
            seconds = max((abs(v - tension[k]) for k, v in step.targets.items()), default=0.0) / step.rate
            tension.update(step.targets)
        elif isinstance(step, JointMove):
            half = abs(step.target - angle[step.joint]) / 2.0  # The motor slows down as it speeds up.
            seconds = 2.0 * time_to_cover(half, step.speed, step.acceleration)
            angle[step.joint] = step.target
        elif isinstance(step, Dwell | Settled | Tare):
            seconds = step.seconds
        elif isinstance(step, Covered):
            seconds = HAND_PASS_S * step.passes
        yield step, seconds


def estimate(trial: PlannedTrial, rig: RigDescription) -> Estimate:
    """Estimate duration (without the operator's pauses), prompts and highest tension from the commands alone."""
    total, highest, prompts = 0.0, 0.0, []
    for step, seconds in timed(trial, rig):
        total += seconds
        if isinstance(step, TensionRamp):
            highest = max(highest, *step.targets.values())
        elif isinstance(step, Setup):
            prompts.append(step.prompt)
    return Estimate(trial.name, total, tuple(prompts), highest)
