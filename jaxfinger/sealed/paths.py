"""Paths of MuJoCo's spatial tendons, and the polynomials that fit them.

Between eyelets on neighbouring links the path depends on one angle, so the excursion is a sum over joints. A flexor
runs straight from eyelet to eyelet. Its excursion is 2R (cos α − cos(α + q/2)) for eyelets at equal distances R, and
its moment arm grows as it bowstrings. An extensor wraps a pulley on the joint: r q. Over a finger's range a polynomial
of fourth order misses the flexor by about 1e-5 R, a fiftieth of the excursion's noise. The specimens use these
polynomials, so that they lie in the nominal class.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no types.)
from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from jaxfinger.data import FingerDescription

from .plant import add_chain

DEGREE = 4


def spatial_lengths(
    finger: FingerDescription,
    arm: Float[np.ndarray, "n m"],
    alpha: Float[np.ndarray, "n m"],
    joint: int,
    q: Float[np.ndarray, " K"],
) -> Float[np.ndarray, "K n"]:
    """Path lengths, m, at angles q of one joint with the others at zero.

    `arm`: moment arms at q = 0, m, zero where a tendon does not cross. `alpha`: angles of the eyelets above the link,
    rad.
    """
    spec = mujoco.MjSpec()
    bodies = add_chain(spec, finger)
    for k, name in enumerate(finger.tendon_names):
        crossed = np.flatnonzero(arm[k])
        if not len(crossed):
            continue
        tendon = spec.add_tendon(name=name)
        for i in crossed:
            # A pull along −x at height h turns the joint by (h × −x)·axis: positive on the side axis × x.
            side = np.sign(arm[k, i]) * np.cross(finger.axis[i], [1.0, 0.0, 0.0])
            wraps = arm[k, i] < 0 and np.ptp(finger.limits[i]) > 1.0
            if wraps:  # Eyelets so low that the tendon touches the pulley over the whole range.
                height, along = 0.4 * abs(arm[k, i]), 2.5 * abs(arm[k, i])
            else:
                height, along = abs(arm[k, i]), abs(arm[k, i]) / np.tan(alpha[k, i])
            reach = np.array([along, 0.0, 0.0])
            label = f"{name}-{i}"
            bodies[i].add_site(name=f"{label}-in", pos=finger.origin[i] - reach + height * side)
            bodies[i + 1].add_site(name=f"{label}-out", pos=reach + height * side)
            tendon.wrap_site(f"{label}-in")
            if wraps:
                radius = abs(arm[k, i])
                ends = np.concatenate([-finger.axis[i], finger.axis[i]]) * radius
                bodies[i + 1].add_geom(
                    name=label, type=mujoco.mjtGeom.mjGEOM_CYLINDER, fromto=ends, size=[radius, 0, 0], mass=0.0
                )
                bodies[i].add_site(name=f"{label}-side", pos=finger.origin[i] + 2 * radius * side)
                tendon.wrap_geom(label, f"{label}-side")
            tendon.wrap_site(f"{label}-out")
    model = spec.compile()
    data = mujoco.MjData(model)
    present = [k for k in range(finger.n) if np.any(arm[k])]
    lengths = np.zeros((len(q), finger.n))
    for row, angle in zip(lengths, q, strict=True):
        data.qpos[:] = 0.0
        data.qpos[joint] = angle
        mujoco.mj_fwdPosition(model, data)
        row[present] = data.ten_length
    return lengths


def excursion_polynomials(
    finger: FingerDescription, arm: Float[np.ndarray, "n m"], alpha: Float[np.ndarray, "n m"]
) -> tuple[Float[np.ndarray, "n m 4"], float]:
    """Fit q, q², q³, q⁴ to the excursion (positive pulled in). Return coefficients, m/radᵖ, and largest misfit, m."""
    coefficients = np.zeros((finger.n, finger.m, DEGREE))
    misfit = 0.0
    for i in range(finger.m):
        q = np.linspace(finger.limits[i, 0], finger.limits[i, 1], 81)
        lengths = spatial_lengths(finger, arm, alpha, i, np.append(q, 0.0))
        excursion = lengths[-1] - lengths[:-1]
        basis = q[:, None] ** np.arange(1, DEGREE + 1)
        fit, *_ = np.linalg.lstsq(basis, excursion, rcond=None)
        coefficients[:, i] = np.where((arm[:, i] != 0)[:, None], fit.T, 0.0)
        misfit = max(misfit, float(np.abs(basis @ fit - excursion).max()))
    return coefficients, misfit
