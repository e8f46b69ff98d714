"""The finger of a rig file: written there as ID.1 gives it, or taken from an earlier session."""

from __future__ import annotations

import numpy as np

from jaxfinger.data.session import FingerDescription
from jaxfinger.rig.toml_file import Table


def read_finger(file: Table) -> FingerDescription:
    """`[finger]` with `from = "session.h5"`, or `[[finger.joint]]` and `[[finger.tendon]]`; SI units, limits in deg."""
    table = file.table("finger")
    assert table is not None
    if (source := table.get("from", None)) is not None:
        from jaxfinger.data import read_session

        table.finish()
        return read_session(file.path.parent / str(source)).finger
    joints, tendons = table.tables("joint"), table.tables("tendon")
    names = tuple(j.text_of("name") for j in joints)
    m, n = len(joints), len(tendons)
    axis = np.array([j.vector("axis", [0.0, 1.0, 0.0], 3) for j in joints])
    for j, a in zip(joints, axis, strict=True):
        if abs(np.linalg.norm(a) - 1) > 1e-6:
            j.fail("axis", "'axis' must have length 1.")
    limits = np.radians([j.vector("limits_deg", length=2) for j in joints])
    for j, (low, high) in zip(joints, limits, strict=True):
        if low >= high:
            j.fail("limits_deg", "'limits_deg' must be [lower, upper] with lower below upper.")
    inertia = np.zeros((m, 3, 3))
    for i, j in enumerate(joints):
        xx, yy, zz, xy, xz, yz = j.vector("inertia", length=6)  # as CAD prints them, about the centre of mass
        inertia[i] = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
        if np.linalg.eigvalsh(inertia[i])[0] <= 0:
            j.fail("inertia", "'inertia' (xx, yy, zz, xy, xz, yz) must be positive definite.")
    crosses = np.zeros((n, m), bool)
    for k, t in enumerate(tendons):
        for joint in t.names("crosses"):
            if joint not in names:
                t.fail("crosses", f"'{joint}' is no joint of the finger ({', '.join(names)}).")
            crosses[k, names.index(joint)] = True
    finger = FingerDescription(
        gravity=np.array(table.vector("gravity", [0.0, 0.0, -9.81], 3)),
        joint_names=names,
        axis=axis,
        origin=np.array([j.vector("origin", length=3) for j in joints]),
        limits=limits,
        mass=np.array([j.number("mass", low=1e-6, unit="kg") for j in joints]),
        com=np.array([j.vector("com", length=3) for j in joints]),
        inertia=inertia,
        fingertip=np.array(table.vector("fingertip", length=3)),
        tendon_names=tuple(t.text_of("name") for t in tendons),
        active=np.array([t.flag("active", True) for t in tendons]),
        crosses=crosses,
    )
    for sub in (table, *joints, *tendons):
        sub.finish()
    for key, names_ in (("joint", finger.joint_names), ("tendon", finger.tendon_names)):
        if len(set(names_)) != len(names_):
            table.fail(None, f"two {key}s have the same name; names must differ.")
    return finger


def finger_toml(finger: FingerDescription) -> str:
    """The finger as text of a rig file, the inverse of `read_finger`."""

    def vector(values) -> str:
        return "[" + ", ".join(repr(float(v)) for v in values) + "]"

    lines = ["[finger]", f"gravity = {vector(finger.gravity)}", f"fingertip = {vector(finger.fingertip)}"]
    for i, name in enumerate(finger.joint_names):
        tensor = finger.inertia[i]
        lines += [
            "",
            "[[finger.joint]]",
            f'name = "{name}"',
            f"axis = {vector(finger.axis[i])}",
            f"origin = {vector(finger.origin[i])}",
            f"limits_deg = {vector(np.degrees(finger.limits[i]))}",
            f"mass = {float(finger.mass[i])!r}",
            f"com = {vector(finger.com[i])}",
            f"inertia = {vector([*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]])}  # xx yy zz xy xz yz",
        ]
    for k, name in enumerate(finger.tendon_names):
        crossed = ", ".join(f'"{j}"' for j, c in zip(finger.joint_names, finger.crosses[k], strict=True) if c)
        lines += ["", "[[finger.tendon]]", f'name = "{name}"', f"active = {str(bool(finger.active[k])).lower()}"]
        lines += [f"crosses = [{crossed}]"]
    return "\n".join(lines) + "\n"
