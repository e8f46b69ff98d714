"""VD.2: slopes of the fingertip force against the tension of the pulled tendon, measured and predicted."""

from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.data import Session
from jaxfinger.experiments import Stack, predict, predict_compiled
from jaxfinger.identify.fit import Fit
from jaxfinger.model import Model


@dataclass(frozen=True)
class Slope:
    """Slope of the fingertip force along one axis against tension in VD.2, through the holds (the paper's Fig. 9)."""

    trial: str
    tendon: str
    axis: str
    measured: float  # N/N
    measured_std: float  # N/N, from the scatter of the holds about the model's curve; NaN for two holds
    predicted: float  # N/N
    predicted_std: float  # N/N, from the fit's covariance


def force_slopes(fit: Fit, model: Model, session: Session, stack: Stack) -> list[Slope]:
    """Slopes of the force along each axis against the tension of the pulled tendon, by regression over the holds."""
    x, measured = stack.batch.x, np.asarray(stack.batch.y["fingertip_force"])
    mask, tension = np.asarray(stack.batch.mask["fingertip_force"]), np.asarray(x.tension)
    lines = []
    for b, name in enumerate(stack.trials):
        if (tendon := session[name].tendon) is None:
            continue
        f = tension[session.finger.tendon_names.index(tendon), b]  # N
        for axis in range(3):
            counts = (mask[axis, b] > 0) & (stack.holds[b] >= 0)
            if counts.any() and np.ptp(f[counts]) > 0:
                centred = np.where(counts, f - f[counts].mean(), 0.0)
                lines.append((name, tendon, axis, b, f, centred / (centred @ f)))  # slope = weights · force
    if not lines:
        return []

    def slopes(m: Model):
        force = predict(m, x, ("fingertip_force",))["fingertip_force"]
        return jnp.stack([jnp.asarray(w) @ force[axis, b] for _, _, axis, b, _, w in lines])

    values, std = replace(fit, model=model).function(eqx.filter_jit(slopes))
    predicted = np.asarray(predict_compiled(model, x, ("fingertip_force",))["fingertip_force"])
    return [
        Slope(
            name,
            tendon,
            "xyz"[axis],
            float(w @ measured[axis, b]),
            _slope_std(f, measured[axis, b] - predicted[axis, b], w),
            float(values[k]),
            float(std[k]),
        )
        for k, (name, tendon, axis, b, f, w) in enumerate(lines)
    ]


def _slope_std(f: Float[np.ndarray, " T"], errors: Float[np.ndarray, " T"], weights: Float[np.ndarray, " T"]) -> float:
    """Standard deviation of a slope, from the scatter of the means of holds about the model's curve.

    NaN for two holds, through which a line goes without scatter.
    """
    counts = weights != 0
    levels, hold = np.unique(f[counts], return_inverse=True)  # within a hold the tension is constant, its mean
    if levels.size < 3:
        return float("nan")
    mean = np.bincount(hold, errors[counts]) / np.bincount(hold)
    centred = levels - levels.mean()
    rest = mean - mean.mean() - (centred @ mean) / (centred @ centred) * centred
    return float(np.sqrt(rest @ rest / (levels.size - 2) / (centred @ centred)))
