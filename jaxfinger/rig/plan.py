"""Plan files: which experiments, in which order, how often. Checked command by command before anything moves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from jaxfinger.errors import UserError
from jaxfinger.rig.backend import JointMove, Setup, TensionRamp
from jaxfinger.rig.channels import RigDescription
from jaxfinger.rig.protocols import EXPERIMENTS, Common, Covered, Dwell, Protocol, Settled, Start, Tare
from jaxfinger.rig.safety import admit
from jaxfinger.rig.toml_file import Table, parse_toml, read_toml


@dataclass(frozen=True)
class PlannedTrial:
    """One recording to make: trials of the same `motion` are repeats of each other."""

    name: str
    experiment: str
    motion: str
    parameters: Common
    line: int

    @property
    def joint(self) -> str | None:
        """The joint that is moved or instrumented."""
        return getattr(self.parameters, "joint", None)

    @property
    def tendon(self) -> str | None:
        """The tendon that is pulled."""
        return getattr(self.parameters, "tendon", None)

    def protocol(self, rig: RigDescription) -> Protocol:
        """The steps of the experiment."""
        return EXPERIMENTS[self.experiment][0](rig.finger, self.parameters)


@dataclass(frozen=True)
class Plan:
    """A plan file, read."""

    name: str
    operator: str
    trials: tuple[PlannedTrial, ...]
    text: str
    path: str


@dataclass(frozen=True)
class Estimate:
    """What a trial will do, from its commands alone: seconds, prompts, and the highest tension."""

    name: str
    seconds: float
    prompts: tuple[str, ...]
    highest_tension: float


def read_plan(path: str | Path, rig: RigDescription) -> Plan:
    """Read a plan and check every command that it will give against the rig; raises UserError with the line."""
    return _plan(read_toml(path), rig)


def parse_plan(text: str, rig: RigDescription, path: str | Path = "plan.toml") -> Plan:
    """A plan that is already in memory."""
    return _plan(parse_toml(text, Path(path)), rig)


def _plan(file: Table, rig: RigDescription) -> Plan:
    head = file.table("plan")
    assert head is not None
    trials = [trial for table in file.tables("trial") for trial in _trials(table, rig)]
    named = tuple(
        PlannedTrial(f"{i:02d}-{t.motion.rsplit('-', 1)[0]}", t.experiment, t.motion, t.parameters, t.line)
        for i, t in enumerate(trials, 1)
    )
    plan = Plan(head.text_of("name"), head.text_of("operator", ""), named, file.text, str(file.path))
    head.finish()
    file.finish()
    for trial in named:
        try:
            for _ in commands(trial, rig):
                pass
        except UserError as error:
            raise UserError(f"{file.path.name}, line {trial.line}: {trial.name}: {error}") from error
    return plan


def _trials(table: Table, rig: RigDescription) -> Iterator[PlannedTrial]:
    experiment = table.text_of("experiment", choices=tuple(EXPERIMENTS))
    kind = EXPERIMENTS[experiment][1]
    values: dict[str, Any] = {}
    for item in fields(kind):
        default = item.default
        if item.name in ("joint", "tendon"):
            known = rig.finger.joint_names if item.name == "joint" else rig.finger.tendon_names
            values[item.name] = table.text_of(item.name, choices=known)
        elif item.name not in table.values:
            continue
        elif isinstance(default, tuple):
            length = len(default) if item.name == "range_deg" else rig.finger.m if item.name == "posture_deg" else None
            values[item.name] = tuple(table.vector(item.name, length=length))
        elif isinstance(default, bool):
            values[item.name] = table.flag(item.name)
        elif isinstance(default, int):
            values[item.name] = table.integer(item.name, low=0 if item.name == "seed" else 1)
        else:
            values[item.name] = table.number(item.name, low=0.0)
    table.finish()
    _sensible(table, experiment, values, rig)
    parameters = kind(**values)
    what = [experiment, *(values[k] for k in ("tendon", "joint") if k in values)]
    for _ in range(parameters.repeats):
        yield PlannedTrial("", experiment, f"{'-'.join(what)}-{table.index + 1}", parameters, table.line())


def _sensible(table: Table, experiment: str, values: dict[str, Any], rig: RigDescription) -> None:
    finger = rig.finger
    if "levels" in values and (
        len(values["levels"]) < 2 or np.any(np.diff(values["levels"]) <= 0) or values["levels"][0] <= 0
    ):
        table.fail("levels", "'levels' must be two or more rising tensions in N, above zero.")
    if "range_deg" in values and values["range_deg"][0] >= values["range_deg"][1]:
        table.fail("range_deg", "'range_deg' must be [lower, upper] with lower below upper.")
    if "share" in values and not 0.1 <= values["share"] <= 0.85:
        table.fail(
            "share", "'share' of the range must lie between 0.1 and 0.85: hands must not run the joint into its stops."
        )
    if "mean" in values and len(values["mean"]) != int(finger.active.sum()):
        table.fail("mean", f"'mean' must give one tension for each of the {int(finger.active.sum())} active tendons.")
    for joint, angle in zip(finger.joint_names, values.get("posture_deg", ()), strict=False):
        low, high = np.degrees(finger.limits[finger.joint_names.index(joint)])
        if not low <= angle <= high:
            table.fail("posture_deg", f"{angle:g}° for {joint} is outside its limits {low:.0f}° to {high:.0f}°.")
    tendon, joint = values.get("tendon"), values.get("joint")
    if experiment == "ID.4" and not finger.crosses[finger.tendon_names.index(tendon), finger.joint_names.index(joint)]:
        table.fail("joint", f"{tendon} does not cross {joint}, so it gives no torque there; choose another joint.")
    if experiment.startswith("ID.3") or experiment == "ID.4":
        needed = ("external_torque", "")
    else:
        needed = {"VD.2": ("fingertip_force", "x")}.get(experiment, ("excursion", finger.tendon_names[0]))
    kinds = {c.kind for c in rig.channels}
    if needed[0] not in kinds:
        table.fail("experiment", f"{experiment} needs a channel of kind '{needed[0]}', which the rig file has not.")


def commands(trial: PlannedTrial, rig: RigDescription) -> Iterator[Any]:
    """Every step of a trial, each command checked against the limits: protocols do not depend on measurements."""
    for step in trial.protocol(rig):
        if isinstance(step, TensionRamp | JointMove):
            admit(step, rig)
        yield step


def estimate(trial: PlannedTrial, rig: RigDescription) -> Estimate:
    """Duration without the operator's pauses, prompts and highest tension, from the commands alone."""
    seconds, highest, prompts = 0.0, 0.0, []
    tension = dict.fromkeys(rig.finger.tendon_names, 0.0)
    angle = trial.parameters.posture(rig.finger)
    for step in commands(trial, rig):
        if isinstance(step, TensionRamp):
            seconds += max((abs(v - tension[k]) for k, v in step.targets.items()), default=0.0) / step.rate
            tension.update(step.targets)
            highest = max(highest, *tension.values())
        elif isinstance(step, JointMove):
            seconds += abs(step.target - angle[step.joint]) / step.speed
            angle[step.joint] = step.target
        elif isinstance(step, Dwell | Settled | Tare):
            seconds += step.seconds
        elif isinstance(step, Covered):
            seconds += 4.0 * step.passes
        elif isinstance(step, Setup):
            prompts.append(step.text)
        elif isinstance(step, Start):
            continue
    return Estimate(trial.name, seconds, tuple(prompts), highest)
