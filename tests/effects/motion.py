"""The finger of the effects' tests and its motions: free with reversals, and held while tension rises and falls."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxfinger.effects import CatalogueEffect, Scales
from jaxfinger.experiments import Batch, predict
from jaxfinger.model import Model, Motion
from jaxfinger.synthetic import paper_finger, polynomial_finger, true_model

MODEL: Model = true_model(polynomial_finger(paper_finger()))


def with_effects(*effects: CatalogueEffect) -> Model:
    return eqx.tree_at(lambda m: m.effects, MODEL, effects, is_leaf=lambda v: isinstance(v, tuple))


def motion(T: int = 60, rate: float = 100.0, held: bool = False) -> Motion:
    """A motion of T samples at `rate` Hz: joints go through their ranges at different rates, tensions likewise."""
    time = np.arange(T) / rate
    limits = np.asarray(MODEL.finger.limits)
    turns = 2 * np.pi * (1.5 + 0.7 * np.arange(MODEL.finger.m))[:, None]
    middle, half = limits.mean(axis=1)[:, None], 0.48 * np.ptp(limits, axis=1)[:, None]
    q = middle + half * np.sin(turns * time)
    qd = half * turns * np.cos(turns * time)
    k = np.arange(MODEL.finger.n)[:, None]
    tension = (6 + 4 * np.sin(2 * np.pi * (1 + 0.4 * k) * time + k)) * np.asarray(MODEL.finger.active, float)[:, None]
    if held:
        q, qd = np.repeat(q[:, 5:6], T, axis=1), 0 * qd
    rates = np.einsum("nmt,mt->nt", np.asarray(MODEL.moment_arm.coupling(jnp.asarray(q))), qd)
    x = Motion(
        *(jnp.asarray(a) for a in (time, q, qd, -(turns**2) * (q - middle) * (not held), tension)),
        jnp.asarray(np.sign(qd)),
        jnp.asarray(np.sign(rates)),
        jnp.asarray(time + 100.0),
        jnp.ones_like(jnp.asarray(q)),
    )
    return replace(x, held=held)


# The motions, each with the channels that the nominal model predicts for it.
MOTIONS = [
    (x, predict(MODEL, x, channels))
    for x, channels in ((motion(), ("joint_torque", "tendon_excursion")), (motion(held=True), ("fingertip_force",)))
]

SCALES = Scales.of(MODEL.finger, [Batch(x, y, jax.tree.map(jnp.ones_like, y)) for x, y in MOTIONS])
