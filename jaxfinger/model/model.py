"""The parameters of equation (1) in one pytree, and the hooks through which effects change the equation."""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from jaxfinger.model.finger import Finger
from jaxfinger.model.joint_torque import JointTorque
from jaxfinger.model.moment_arm import MomentArm
from jaxfinger.model.motion import Motion
from jaxfinger.model.tendon_friction import TendonFriction

Drive = Any
Memory = Any


class SharedFriction(NamedTuple):
    """Friction that acts on several joints, such as that of a motor geared to them.

    Its torque on the joints is ways · magnitude · direction.
    """

    ways: Float[Array, " m"]  # gear ratios: its speed is ways · q̇
    magnitude: Float[Array, "*T"]  # N m
    direction: Float[Array, "*T"]  # sign of its speed


class Effect(eqx.Module):
    """Physical effect that equation (1) leaves out; at zero amplitude the equation is exactly the nominal one.

    A subclass overrides the hooks through which it acts; the defaults change nothing. Every hook broadcasts over
    batch axes, which are last. An effect with memory defines the drive of its state, the state at the first sample, and
    the step to the next one; states are integrated along measured and simulated motions.
    """

    # Whether the state changes abruptly within a sample of a fit, as friction does at a reversal.
    sharp: ClassVar[bool] = False

    @property
    def has_memory(self) -> bool:
        """Whether the effect has a state."""
        return type(self).next_memory is not Effect.next_memory

    # Sensors: the true motion from the measured one, and the reading of a sensor from the true channel.
    def true_motion(self, x: Motion) -> Motion:
        """True motion, given the measured one."""
        return x

    def reading(self, channel: str, x: Motion, y: Float[Array, "channels *T"]) -> Float[Array, "channels *T"]:
        """Reading of the sensor of `channel` (a dataset's name), given its true value `y`."""
        return y

    # Memory.
    def drive(self, model: "Model", x: Motion) -> Drive:
        """Inputs of the state, at every sample of `x` at once."""
        return ()

    def initial_memory(self, drive: Drive) -> Memory:
        """State at the first sample."""
        return ()

    def next_memory(self, memory: Memory, before: Drive, drive: Drive) -> Memory:
        """State at the next sample, while the drive changes from `before` to `drive`."""
        return memory

    # Terms of equation (1), in the order in which they are evaluated, then the excursion.
    def finger(self, finger: Finger) -> Finger:
        """Finger with a changed rigid body or mounting."""
        return finger

    def tension(self, x: Motion, memory: Memory, f: Float[Array, "n *T"]) -> Float[Array, "n *T"]:
        """Tension f that enters the tendon's path, N."""
        return f

    def directions(
        self, x: Motion, memory: Memory, joint: Float[Array, "m *T"], tendon: Float[Array, "n *T"]
    ) -> tuple[Float[Array, "m *T"], Float[Array, "n *T"]]:
        """Directions of joint and tendon friction in [−1, 1], the built-up share, given the signs of motion.

        The result must be affine in the signs, since the forward simulation solves for them.
        """
        return joint, tendon

    def coupling(self, x: Motion, f: Float[Array, "n *T"], C: Float[Array, "n m *T"]) -> Float[Array, "n m *T"]:
        """Coupling matrix C, m/rad."""
        return C

    def loss(
        self, x: Motion, f: Float[Array, "n *T"], C: Float[Array, "n m *T"], loss: Float[Array, "n *T"]
    ) -> Float[Array, "n *T"]:
        """Tension lost by a sliding tendon, N, before it is clipped to [0, f_t]."""
        return loss

    def held_tension(
        self, x: Motion, memory: Memory, f: Float[Array, "n *T"], loss: Float[Array, "n *T"], f_j: Float[Array, "n *T"]
    ) -> Float[Array, "n *T"]:
        """Tension f_j at joints that a fixture holds, N."""
        return f_j

    def delivered(self, x: Motion, f_j: Float[Array, "n *T"]) -> Float[Array, "n *T"]:
        """Tension f_j past the tendons' friction, N."""
        return f_j

    def torque(self, x: Motion, memory: Memory, h: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """Torque h on the left of (1) without friction, N m."""
        return h

    def joint_friction(
        self, x: Motion, f_j: Float[Array, "n *T"], C: Float[Array, "n m *T"], F: Float[Array, "m *T"]
    ) -> Float[Array, "m *T"]:
        """Magnitude of the joints' friction torque, N m."""
        return F

    def shared_friction(self, x: Motion, memory: Memory) -> tuple[SharedFriction, ...]:
        """Friction that acts on several joints at once."""
        return ()

    def torque_friction(self, mu: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """Share μ of its own torque that each joint's drive loses to friction."""
        return mu

    def excursion(
        self, x: Motion, memory: Memory, f: Float[Array, "n *T"], l: Float[Array, "n *T"]
    ) -> Float[Array, "n *T"]:
        """Tendon excursion l, m."""
        return l


class Model(eqx.Module):
    """Parameters of equation (1), each in one place, and the effects that change it, in order."""

    finger: Finger
    moment_arm: MomentArm
    joint_torque: JointTorque
    tendon_friction: TendonFriction
    effects: tuple[Effect, ...] = ()

    @classmethod
    def zeros(
        cls,
        finger: Finger,
        *,
        moment_arm_degree: int = 4,
        cross: bool = False,
        elastic_degree: int = 2,
        friction_degree: int = 2,
    ) -> "Model":
        """Model of the rigid body alone, with zero moment arms, joint torques and tendon friction.

        `cross`: whether the excursion has terms of two joints (`MomentArm.zeros`).
        """
        return cls(
            finger,
            MomentArm.zeros(finger.n, finger.m, moment_arm_degree, cross),
            JointTorque.zeros(finger.m, elastic_degree, friction_degree),
            TendonFriction.zeros(finger.n),
        )

    def true_motion(self, x: Motion) -> Motion:
        """True motion, given the measured one, by the effects in order."""
        for effect in self.effects:
            x = effect.true_motion(x)
        return x

    def reading(self, channel: str, x: Motion, y: Float[Array, "channels *T"]) -> Float[Array, "channels *T"]:
        """Reading of the sensor of `channel`, given its true value `y`, by the effects in order."""
        for effect in self.effects:
            y = effect.reading(channel, x, y)
        return y
