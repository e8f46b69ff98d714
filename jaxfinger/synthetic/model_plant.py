"""A plant that is a model: a fit, or the nominal model with effects, recorded by the same simulated rig."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.compilation import quick_jit
from jaxfinger.errors import UserError
from jaxfinger.experiments.predict import predict_compiled
from jaxfinger.model import Model, Motion
from jaxfinger.model import simulate as simulate_forward
from jaxfinger.synthetic.plant import Channels, Plant
from jaxfinger.synthetic.protocols import TrialPlan

Array = np.ndarray
READINGS = 3  # steps by which an encoder's reading is found: its error changes little over an angle as small as itself
MIN_SAMPLES = 1024  # Trials are padded to a power of two, at least this, so that few lengths are compiled.


class ModelPlant:
    """A plant whose channels are a model's predictions. In prescribed trials the encoders read the planned motion.

    VD.3 is simulated forward under the tensions of `driver`, a plant with a controller. The model's motion departs from
    the driver's as far as the two plants differ.
    """

    def __init__(self, model: Model, driver: Plant | None = None):
        self.model = model
        self.driver = driver
        self.depends_on_session_time = bool(model.effects)

    def prescribed(self, plan: TrialPlan) -> Channels:
        """Return the channels of the plan's experiment, without noise."""
        channels = ("tendon_excursion",)
        if plan.experiment.startswith("ID.3"):
            channels = ("joint_torque",)
        elif plan.held:
            channels += ("fingertip_force",) if plan.experiment == "VD.2" else ("joint_torque",)
        samples = plan.time.size
        predicted = predict_compiled(self.model, self._motion(plan), channels)
        return {
            "q": plan.q,
            "tendon_force": plan.tension,
            **{name: np.asarray(value)[:, :samples] for name, value in predicted.items()},
        }

    def driven(self, plan: TrialPlan) -> Channels:
        """Return the channels of VD.3 under the driver's tensions, from rest at its first position.

        These tensions are what the load cells read. Sensors with errors read other tensions and angles than the true
        ones, by which the finger moves.

        Raises:
            UserError: there is no driver.
        """
        if self.driver is None:
            raise UserError(f"recipe: trial {plan.name} needs tensions that the model alone does not give; drop VD.3")
        driven = self.driver.driven(plan)
        cells = driven["tendon_force"]
        true, tension = self._true(plan, driven["q"], cells)
        start: Any = jnp.asarray(plan.session_start)  # As an array it is traced, so all trials share one compilation.
        q0 = jnp.asarray(true[:, 0])
        path, _ = _simulate(
            self.model, jnp.asarray(plan.time), jnp.asarray(tension), q0, jnp.zeros_like(q0), session_start=start
        )
        read = q = np.asarray(path)
        for _ in range(READINGS):
            read = read + (q - self._true(plan, read, cells)[0])
        excursion = predict_compiled(self.model, self._motion(plan, read, cells), ("tendon_excursion",))
        return {
            "q": read,
            "tendon_force": cells,
            "tendon_excursion": np.asarray(excursion["tendon_excursion"])[:, : plan.time.size],
        }

    def _true(
        self, plan: TrialPlan, q: Float[Array, "m N"], tension: Float[Array, "n N"]
    ) -> tuple[Float[Array, "m N"], Float[Array, "n N"]]:
        """True angles, rad, and tensions, N, where the sensors read `q` and `tension`."""
        x = _true_motion(self.model, self._motion(plan, q, tension))
        return np.asarray(x.q)[:, : plan.time.size], np.asarray(x.tension)[:, : plan.time.size]

    def _motion(
        self, plan: TrialPlan, q: Float[Array, "m N"] | None = None, tension: Float[Array, "n N"] | None = None
    ) -> Motion:
        """Return the plan's motion, or `q` and `tension` at its instants, as the model takes it.

        The last sample is repeated up to a power of two of samples.
        """
        q, tension = plan.q if q is None else q, plan.tension if tension is None else tension
        qd, qdd = (plan.qd, plan.qdd) if q is plan.q else _derivatives(plan.time, q)
        joint = np.sign(qd) if plan.joint_direction is None else 1.0 * plan.joint_direction
        sliding = np.sign(np.einsum("nmt,mt->nt", np.asarray(self.model.moment_arm.coupling(jnp.asarray(q))), qd))
        tendon = sliding if plan.tendon_direction is None else 1.0 * plan.tendon_direction
        motorised = np.zeros_like(q)
        if plan.joint is not None and plan.experiment != "ID.2":
            motorised[plan.joint] = 1.0
        padded = max(MIN_SAMPLES, 1 << (plan.time.size - 1).bit_length()) - plan.time.size

        def pad(x: Array):
            return jnp.asarray(np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, padded)], mode="edge"))

        return Motion(
            time=pad(plan.time),
            q=pad(q),
            qd=pad(qd),
            qdd=pad(qdd),
            tension=pad(tension),
            joint_direction=pad(joint),
            tendon_direction=pad(tendon),
            session_time=pad(plan.time + plan.session_start),
            motorised=pad(motorised),
            held=plan.held,
        )


_simulate = quick_jit(simulate_forward)
_true_motion = quick_jit(Model.true_motion)


def _derivatives(time: Float[Array, " N"], q: Float[Array, "m N"]) -> tuple[Float[Array, "m N"], Float[Array, "m N"]]:
    qd = np.gradient(q, time, axis=1)
    return qd, np.gradient(qd, time, axis=1)
