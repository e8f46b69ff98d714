"""What no machine can be, said: a joint that drives itself, a mass of nothing, a tendon that gains tension."""

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.identify.parameters import Parameter, describe, ravel
from jaxfinger.model import Model

SURE = 1.96  # standard deviations, a 95 % interval: within it a number of the wrong sign may be nothing
# By group: what it means where it is negative.
NEGATIVE = {
    "damping": "would drive the joint instead of damping it",
    "rotor_inertia": "is no inertia",
    "torque_friction": "would add to the drive's torque instead of taking a share of it",
    "mass": "is no mass",
}


def implausible(
    model: Model, covariance: Float[np.ndarray, "P P"], free: Int[np.ndarray, " p"], lightest: Float[np.ndarray, " p"]
) -> list[str]:
    """One sentence for each free parameter or law that no machine can have, beyond its 95 % interval.

    `lightest`: the least that each free parameter may be; at that floor the trials want less.
    """
    parameters, values = describe(model), [float(v) for v in np.asarray(ravel(model))]
    std = [float(s) for s in np.sqrt(np.maximum(np.diag(covariance), 0.0))]
    out = []
    for i, floor in zip(free, lightest, strict=True):
        p = parameters[i]
        if p.group in NEGATIVE and values[i] + SURE * std[i] < 0.0:
            out.append(f"{_said(p, values[i], std[i])}: {NEGATIVE[p.group]}")
        elif p.group == "mass" and values[i] <= 1.0001 * floor:
            out.append(
                f"{_said(p, values[i], std[i])}: the trials would have it lighter still, down to nothing or below; "
                "weigh the link, or look for what the model misses"
            )
    out += _friction(model, covariance, free, parameters)
    return out + _losses(values, std, free, parameters)


def _said(p: Parameter, value: float, std: float) -> str:
    known = f" ± {SURE * std:.2g}" if np.isfinite(std) else " ± ?"
    return f"{p.name} is {value:.3g}{known} {p.units}"


def _friction(model: Model, covariance, free, parameters) -> list[str]:
    """Joints whose friction is below nothing somewhere in their range."""
    out, finger = [], model.finger
    for i, joint in enumerate(finger.joint_names):
        at = [k for k in free if parameters[k].group == "friction" and parameters[k].joint == joint]
        low, high = finger.limits[i]
        if not at or not np.isfinite([low, high]).all() or not np.isfinite(covariance[at, at]).all():
            continue
        q = np.linspace(low, high, 61)
        A = q[:, None] ** np.array([parameters[k].power for k in at])
        F, std = _with_std(A, np.asarray(ravel(model))[at], covariance[np.ix_(at, at)])
        worst = int(np.argmin(F + SURE * std))
        if F[worst] + SURE * std[worst] < 0.0:
            unit, where = ("N", f"{q[worst]:.3g} m") if finger.prismatic[i] else ("N m", f"{np.degrees(q[worst]):.0f}°")
            out.append(
                f"friction of joint {joint} is {F[worst]:.3g} ± {SURE * std[worst]:.2g} {unit} at {where}: it would "
                "push the joint on; record trials there, or give the recipe a lower degree"
            )
    return out


def _losses(values: list[float], std: list[float], free, parameters: list[Parameter]) -> list[str]:
    """Tendons that lose more than all of a growing tension."""
    return [
        f"{_said(parameters[k], values[k], std[k])}: the tendon would lose more than is pulled"
        for k in free
        if parameters[k].term == "proportional" and values[k] - SURE * std[k] > 1.0
    ]


def _with_std(A: np.ndarray, values: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return A @ values, np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", A, covariance, A), 0.0))
