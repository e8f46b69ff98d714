"""Warnings of implausible estimates: negative damping, inertia or friction, mass on its bound, loss above 100 %."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.data.signals.noise import HALF_95
from jaxfinger.identify.parameters import Parameter, describe, ravel
from jaxfinger.model import Model

# What a negative value of a parameter would mean, by group.
MEANING_IF_NEGATIVE = {
    "damping": "would drive the joint instead of damping it",
    "rotor_inertia": "is no inertia",
    "torque_friction": "would add to the drive's torque instead of taking a share of it",
    "mass": "is no mass",
}


def implausible(
    model: Model, covariance: Float[np.ndarray, "P P"], free: Int[np.ndarray, " p"], lightest: Float[np.ndarray, " p"]
) -> list[str]:
    """One sentence for each free parameter or law whose 95 % interval lies wholly beyond what a machine can have.

    `lightest`: lower bound of each free parameter. A mass on its bound is reported, since the trials ask for less.
    """
    parameters, values = describe(model), [float(v) for v in np.asarray(ravel(model))]
    std = [float(s) for s in np.sqrt(np.maximum(np.diag(covariance), 0.0))]
    out = []
    for i, floor in zip(free, lightest, strict=True):
        p = parameters[i]
        if p.group in MEANING_IF_NEGATIVE and values[i] + HALF_95 * std[i] < 0.0:
            out.append(f"{_with_interval(p, values[i], std[i])}: {MEANING_IF_NEGATIVE[p.group]}")
        elif p.group == "mass" and values[i] <= 1.0001 * floor:
            out.append(
                f"{_with_interval(p, values[i], std[i])}: the trials would have it lighter still, down to nothing or "
                "below; weigh the link, or look for what the model misses"
            )
    out += _negative_friction(model, covariance, free, parameters)
    return out + _excess_losses(values, std, free, parameters)


def name_bounded(ends: Mapping[str, str]) -> list[str]:
    """One sentence for all tendons that lose `none` of their tension in a fit, and one for those that lose `all`."""
    meanings = {
        "none": "there may be no friction, or the torques are larger than tension and moment arms make them",
        "all": "the torques do not follow the tension as the moment arms have it",
    }
    sentences = []
    for end, meaning in meanings.items():
        if names := [tendon for tendon, found in ends.items() if found == end]:
            sentences.append(
                f"the fit loses {end} of the tension of {', '.join(names)}, so friction there has no interval (± ?): "
                f"{meaning}; check sign, units and columns of tendon_force, tendon_excursion and joint_torque"
            )
    return sentences


def _with_interval(p: Parameter, value: float, std: float) -> str:
    known = f" ± {HALF_95 * std:.2g}" if np.isfinite(std) else " ± ?"
    return f"{p.name} is {value:.3g}{known} {p.units}".removesuffix(" 1")


def _negative_friction(model: Model, covariance, free, parameters) -> list[str]:
    """One sentence for each joint whose friction torque is negative somewhere in the joint's range."""
    out, finger = [], model.finger
    for i, joint in enumerate(finger.joint_names):
        at = [k for k in free if parameters[k].group == "friction" and parameters[k].joint == joint]
        low, high = finger.limits[i]
        if not at or not np.isfinite([low, high]).all() or not np.isfinite(covariance[at, at]).all():
            continue
        q = np.linspace(low, high, 61)
        A = q[:, None] ** np.array([parameters[k].power for k in at])
        F, std = _with_std(A, np.asarray(ravel(model))[at], covariance[np.ix_(at, at)])
        worst = int(np.argmin(F + HALF_95 * std))
        if F[worst] + HALF_95 * std[worst] < 0.0:
            unit, where = ("N", f"{q[worst]:.3g} m") if finger.prismatic[i] else ("N m", f"{np.degrees(q[worst]):.0f}°")
            out.append(
                f"friction of joint {joint} is {F[worst]:.3g} ± {HALF_95 * std[worst]:.2g} {unit} at {where}: it would "
                "push the joint on; record trials there, or give the recipe a lower degree"
            )
    return out


def _excess_losses(values: list[float], std: list[float], free, parameters: list[Parameter]) -> list[str]:
    """One sentence for each tendon that loses more than an increase of its tension, a₁ > 1."""
    return [
        f"{_with_interval(parameters[k], values[k], std[k])}: the tendon would lose more than is pulled"
        for k in free
        if parameters[k].term == "proportional" and values[k] - HALF_95 * std[k] > 1.0
    ]


def _with_std(A: np.ndarray, values: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return A @ values, np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", A, covariance, A), 0.0))
