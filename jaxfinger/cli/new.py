"""`jaxfinger new`: write a finger file and a mapping file to fill in."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from jaxfinger.cli.output import plain, refuse_output
from jaxfinger.errors import UserError, counted, listed

if TYPE_CHECKING:
    from jaxfinger.data.importing.recording import Recording
    from jaxfinger.data.session import FingerDescription

TENDONS = "T1, T2, T3, T4"  # in a template, or where recordings hold a tendon's columns


def new(
    finger: Path,
    mapping: Path,
    *recordings: Path,
    specimen: str | None = None,
    joints: str | None = None,
    tendons: str | None = None,
    robot: Path | None = None,
    tip: str | None = None,
    overwrite: bool = False,
) -> None:
    """Write a finger and a mapping to fill in: TOML with comments, which is read as it stands.

    On a terminal, asks for what is not given. With `--robot` the finger is complete.

    Parameters
    ----------
    finger
        The finger to write (TOML).
    mapping
        The mapping to write (TOML): which column of which recording is what.
    recordings
        The recordings that it is to read, one a trial: then the mapping is what `look` proposes for them.
    specimen
        Name of the finger.
    joints
        Names of the joints, base to tip, with commas between.
    tendons
        Names of the tendons, with commas between; `none` for a finger without, as for recordings of no tendon.
    robot
        A URDF or MJCF file to take the finger from: the named joints, by default all, and the tendons that cross them.
    tip
        The link or site of the robot that is the fingertip.
    overwrite
        Replace files that are already there.
    """
    for path in (finger, mapping):
        if path.suffix.lower() != ".toml":
            raise UserError(f"{path}: is to be a TOML file; give a name that ends in .toml")
        refuse_output(path, overwrite)
    if finger.resolve() == mapping.resolve():
        raise UserError(f"{finger}: is named twice; give one file for the finger, another for the mapping")
    from jaxfinger.data.atomic import atomic_path
    from jaxfinger.data.importing.sources import load_recording
    from jaxfinger.data.importing.templates import finger_template, mapping_template
    from jaxfinger.data.importing.variables import UNKNOWN

    loaded = [load_recording(path) for path in recordings]
    specimen = _asked("Name of the finger", specimen, "finger 1")
    if robot is not None:
        if tendons is not None:
            raise UserError(
                "new: a robot brings its own tendons; leave out --tendons, and add others in the finger's file"
            )
        described, finger_of_robot = _of_robot(robot, joints, tip or "")
        named, all_tendons = list(finger_of_robot.joint_names), finger_of_robot.tendon_names
        pulled = _last_joints(finger_of_robot)
    else:
        if tip is not None:
            raise UserError("new: --tip names a place of a robot; give its file with --robot")
        named = _names("joint", _asked("Joints, base to tip", joints, "MCP, PIP, DIP"))
        if not named:
            raise UserError("new: no joint is named; give --joints MCP,PIP,DIP, or so")
        seen = not loaded or _hold_tendons(loaded, named)
        if tendons is None and not seen:
            said = "no column is a tension or an excursion, so the finger has no tendons; if it has some, name them"
            print(plain(f"{listed([path.name for path in recordings])}: {said}: --tendons {TENDONS.replace(' ', '')}"))
        answer = _asked("Tendons, or none", tendons, TENDONS if seen else "none")
        all_tendons = [] if answer.strip() == "none" else _names("tendon", answer)
        described, pulled = finger_template(named, all_tendons), dict.fromkeys(all_tendons, named[-1])
    beside = _from(finger, mapping.parent)
    if loaded:
        mapped = _proposal(loaded, specimen, beside, described, finger)
    else:
        mapped = mapping_template(specimen, beside, named, pulled)
    for path, text in ((finger, described), (mapping, mapped)):
        with atomic_path(path, overwrite) as part:
            part.write_text(text, encoding="utf-8")
    count = f"{counted(len(named), 'joint')}, {counted(len(all_tendons), 'tendon')}"
    left = "replace its numbers by those of your finger" if robot is None else f"from {robot.name}"
    print(plain(f"{finger}: {count}; {left}"))
    todo = "correct what was guessed" if loaded else "name your recordings and their columns"
    if loaded and (unknown := mapped.count(f'"{UNKNOWN}"')):
        todo = f'fill in {unknown} "{UNKNOWN}", {todo}'
    print(plain(f"{mapping}: {todo}, then: jaxfinger import … --mapping {mapping}"))


def _of_robot(robot: Path, joints: str | None, tip: str) -> tuple[str, FingerDescription]:
    """Text of the finger's file, and the finger; prints what it cannot take over."""
    from jaxfinger.data.finger_file import finger_toml
    from jaxfinger.data.importing.robot import robot_finger
    from jaxfinger.data.importing.templates import robot_head, robot_terms

    found = robot_finger(robot, _names("joint", joints or ""), tip)
    for remark in found.remarks:
        print(plain(f"{robot}: {remark}"))
    return robot_head(robot.name) + finger_toml(found.finger) + robot_terms(found), found.finger


def _last_joints(finger: FingerDescription) -> dict[str, str]:
    """By active tendon, the last joint that it crosses."""
    rows = zip(finger.tendon_names, finger.active, finger.crosses, strict=True)
    return {name: finger.joint_names[max(crosses.nonzero()[0])] for name, active, crosses in rows if active}


def _hold_tendons(recordings: Sequence[Recording], joints: Sequence[str]) -> bool:
    """Whether a column of some recordings is a tension or an excursion."""
    from jaxfinger.data.importing.survey import columns_of

    tendons = _names("tendon", TENDONS)
    columns = (s for recording in recordings for s in columns_of(recording, recordings, joints, tendons))
    return any(s.meaning in ("tendon_force", "tendon_excursion") for s in columns)


def _proposal(recordings: Sequence[Recording], specimen: str, beside: str, described: str, finger: Path) -> str:
    """A mapping for the recordings, of the finger that the text `described` of the file `finger` describes."""
    from jaxfinger.data.finger_file import Finger, finger_from
    from jaxfinger.data.importing.proposal import proposal
    from jaxfinger.data.importing.templates import COLUMNS
    from jaxfinger.data.toml import parse_toml, quoted, structure

    document = parse_toml(described, finger)
    place = document.place / "finger"
    known = finger_from(structure(document.content["finger"], Finger, place), place)
    head = f"{COLUMNS}\nspecimen = {quoted(specimen)}\nfinger = {quoted(beside)}"
    return proposal(recordings, known, head)


def _asked(question: str, given: str | None, default: str) -> str:
    """The given text, else the answer on a terminal, else the default."""
    if given is not None or not (sys.stdin.isatty() and sys.stdout.isatty()):
        return default if given is None else given
    from rich.prompt import Prompt

    return Prompt.ask(question, default=default)


def _names(what: str, text: str) -> list[str]:
    """Names in a list with commas or semicolons; UserError where one occurs twice."""
    names = [name.strip() for name in re.split("[,;]", text) if name.strip()]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise UserError(f"new: the {what} {name} is named twice; give each its own name")
    return names


def _from(path: Path, folder: Path) -> str:
    """Path relative to the folder where it lies inside, else absolute."""
    try:
        return path.resolve().relative_to(folder.resolve()).as_posix()
    except ValueError:
        return str(path.resolve())
