"""Templates of a finger file and a mapping file: TOML with comments that explain each key, valid as it stands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from jaxfinger.data.example import RADIUS, link_length, link_mass, link_middle
from jaxfinger.data.importing.robot import RobotFinger
from jaxfinger.data.toml import as_key, quoted


def finger_template(joints: Sequence[str], tendons: Sequence[str]) -> str:
    """Text of a `finger.toml` with example numbers, each with its meaning beside it."""
    text = """# The finger, as CAD, scale and ruler give it. Every number below is an example: replace it by your own.
# Frames: x along the straight finger to its tip, z out of the back of the hand, y = z × x. At zero angle all links lie
# along x. A positive angle flexes: about +y it carries the tip from +x toward -z.

[finger]
gravity = [0.0, 0.0, -9.81]     # m/s², in the frame of the base: how the finger is mounted
"""
    text += f"fingertip = [{link_length(len(joints) - 1)}, 0.0, 0.0]  # m, the contact point, from the last joint\n"
    for i, name in enumerate(joints):
        length, before = link_length(i), link_length(i - 1) if i else 0.0
        mass = link_mass(i)
        along = float(f"{mass * RADIUS**2 / 2:.2g}")
        across = float(f"{mass * (length**2 / 12 + RADIUS**2 / 4):.2g}")
        text += f"""
[[finger.joints]]               # joint {i + 1} of {len(joints)} from the base, and the link that moves with it
name = {quoted(name)}
axis = [0.0, 1.0, 0.0]          # of length 1; [0, 0, 1] for abduction
origin = [{before}, 0.0, 0.0]   # m, from the joint before it
limits_deg = [-10.0, 90.0]      # or limits = [-0.17, 1.57] in rad
mass = {mass}                   # kg
com = [{link_middle(i)}, 0.0, 0.0]  # m, the centre of mass, from this joint
inertia = [                     # kg m², about the centre of mass, in the link's frame
    [{along}, 0.0, 0.0],
    [0.0, {across}, 0.0],
    [0.0, 0.0, {across}],
]
# mass_std = {float(f"{0.05 * mass:.2g}")}  # how well they are known; give it to every joint, or to none
# com_std = [1e-3, 1e-3, 1e-3]
# rotor_inertia = 2e-6          # kg m², of a geared motor, reflected to the joint; every joint, 0 where none
"""
    crossed = ", ".join(quoted(name) for name in joints)
    for name in tendons:
        text += f"""
[[finger.tendons]]
name = {quoted(name)}
crosses = [{crossed}]  # the joints that it spans
active = true                   # false: a passive tendon, whose force and excursion are not measured
# excursion = {{ {as_key(joints[0])} = [0.008, 1e-3] }}  # m/rad, m/rad², of every joint crossed, where CAD knows them
"""
    return text


def robot_head(robot: str) -> str:
    """Comment above a finger that was read from a robot's description."""
    return f"""# The finger as {robot} describes it.
# All frames are parallel at zero angles, and the base lies at the first joint. Compare masses with a scale, and say how
# well they are known (`mass_std`, `com_std`): without that they are taken for exact. `gravity` is the file's: if the
# finger was mounted otherwise, correct it.

"""


def robot_terms(found: RobotFinger) -> str:
    """Text of `[terms]`: the springs, damping and friction of a robot; empty where it has none."""
    finger, terms = found.finger, found.terms
    text = ""
    for i, name in enumerate(finger.joint_names):
        rows = {"elastic": terms.elastic[i], "friction": terms.friction[i : i + 1], "damping": terms.damping[i]}
        text += _table(f"terms.joints.{as_key(name)}", rows)
    for k, name in enumerate(finger.tendon_names):
        text += _table(f"terms.tendons.{as_key(name)}", {"constant": terms.tendon_friction[k]})
    head = """
# Springs, damping and friction of the file, in N m and rad: `jaxfinger simulate` reads them, and `jaxfinger identify`
# does not. Compare them with what it finds.
"""
    return head + text if text else ""


def _table(name: str, rows: Mapping[str, np.ndarray | np.floating]) -> str:
    """A table of the rows that are not zero; empty if none is left."""
    lines = [f"{key} = {np.asarray(values).tolist()}" for key, values in rows.items() if np.any(values)]
    return "\n".join([f"\n[{name}]", *lines, ""]) if lines else ""


COLUMNS = """# Which column of which recording is what. Import with:
#     jaxfinger import RECORDING … --mapping THIS_FILE --output session.h5
# A column is { from = NAME, scale = 1.0, offset = 0.0, units = UNITS }: (column · scale + offset) in these units.
# Units: rad, mrad, deg, turn; m, cm, mm, um; N, mN, cN, kN, gf, kgf; N m, N cm, N mm; s, ms, us, ns, min, h, day.
# Leave out what was not measured.
"""


def mapping_template(specimen: str, finger: str, joints: Sequence[str], tendons: Mapping[str, str]) -> str:
    """Text of a `mapping.toml` for a rig without recordings: channels of all joints and tendons, and example trials.

    `tendons`: those that are pulled, each with the joint at which the torque sensor feels it.
    """
    trials = [(f"{joint}", "ID.2", joint, "") for joint in joints] if tendons else []
    trials += [(f"{joint}", "ID.3-dynamic", joint, "") for joint in joints]
    trials += [(f"{tendon}-{joint}", "ID.4", joint, tendon) for tendon, joint in tendons.items()]
    text = f"""{COLUMNS}
specimen = {quoted(specimen)}
finger = {quoted(finger)}

[channels]  # of all trials: joint angles, flexion positive"""
    for name in joints:
        text += f'\nq.{as_key(name)} = {{ from = {quoted(f"angle {name}")}, units = "deg" }}'
    if tendons:
        text += "\n# Tension, and the length of tendon pulled in: it grows when a flexor flexes its joint."
    for name in tendons:
        text += f'\ntendon_force.{as_key(name)} = {{ from = {quoted(f"force {name}")}, units = "N" }}'
    for name in tendons:
        text += f'\ntendon_excursion.{as_key(name)} = {{ from = {quoted(f"length {name}")}, units = "mm" }}'
    text += """

# One table a trial. Experiments: ID.2 (a joint moved slowly, tendons at 2 N), ID.3-static (a joint stepped by a motor),
# ID.3-dynamic (a joint swept by a motor at several speeds), ID.4 (a tendon pulled in steps, the joint held by the
# torque sensor), VD.1 (all joints moved by hand), VD.2 (fingertip against its sensor), VD.3 (the free finger, driven).
# Delete the trials that you have not recorded.
"""
    for number, (what, experiment, joint, tendon) in enumerate(trials, 1):
        name = f"{number:02d}-{experiment}-{what}"
        text += f"\n[trials.{as_key(name)}]\nfile = {quoted(f'{name}.csv')}\nexperiment = {quoted(experiment)}\n"
        text += f"joint = {quoted(joint)}\n"
        text += f"tendon = {quoted(tendon)}\n" if tendon else ""
        text += 'time = { from = "time", units = "s" }  # or rate_hz = 1000\n'
        if number == 1:
            text += (
                "# span = [0.0, 20.0]           # s from the recording's start, where it holds more than this trial\n"
            )
            text += "# complete = false             # of a recording that was cut short\n"
        if experiment != "ID.2":
            torque = '{ from = "torque", units = "N m" }'
            text += f"channels.joint_torque.{as_key(joint)} = {torque}  # of the external motor, flexion positive\n"
    return text
