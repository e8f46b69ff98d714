"""Equation (1) of the paper as pure functions of a parameter pytree and a motion.

Importing the package switches JAX to float64, which estimation needs.
"""

import jax

jax.config.update("jax_enable_x64", True)

from jaxfinger.model.dynamics import (  # noqa: E402
    Terms,
    changed_torque,
    contact_map,
    elastic_and_friction,
    excursion,
    external_torque,
    fingertip_force,
    joint_tension,
    resisting_change,
    terms_without_effects,
)
from jaxfinger.model.finger import Finger  # noqa: E402
from jaxfinger.model.joint_torque import JointTorque  # noqa: E402
from jaxfinger.model.memory import memories  # noqa: E402
from jaxfinger.model.model import Effect, Model, SharedFriction  # noqa: E402
from jaxfinger.model.moment_arm import MomentArm  # noqa: E402
from jaxfinger.model.motion import Motion  # noqa: E402
from jaxfinger.model.simulate import forward_dynamics, simulate, simulated_ahead, simulated_from  # noqa: E402
from jaxfinger.model.tendon_friction import TendonFriction  # noqa: E402

__all__ = [
    "Effect",
    "Finger",
    "JointTorque",
    "Model",
    "MomentArm",
    "Motion",
    "SharedFriction",
    "TendonFriction",
    "Terms",
    "changed_torque",
    "contact_map",
    "elastic_and_friction",
    "excursion",
    "external_torque",
    "fingertip_force",
    "forward_dynamics",
    "joint_tension",
    "memories",
    "resisting_change",
    "simulate",
    "simulated_ahead",
    "simulated_from",
    "terms_without_effects",
]
