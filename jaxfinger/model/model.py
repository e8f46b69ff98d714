"""The parameters of equation (1) in one pytree, and what an effect may change in it."""

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
    """Friction of something that turns with several joints: magnitude · direction · ways, on their torques."""

    ways: Float[Array, " m"]  # its speed is ways · q̇
    magnitude: Float[Array, "*T"]  # N m
    direction: Float[Array, "*T"]  # sign of its speed


class Effect(eqx.Module):
    """A physical effect that equation (1) leaves out: exactly absent at its zero value.

    A subclass overrides the hooks that it acts through and leaves the rest as they are. Every hook broadcasts over the
    batch axes at the end. An effect with memory says what drives it, its state at the first sample, and how that goes
    on to the next one; the states are driven along the motion, measured or simulated.
    """

    # Whether the memory turns corners within a sample of a fit, as friction does at a reversal.
    sharp: ClassVar[bool] = False

    @property
    def has_memory(self) -> bool:
        """Whether it has a state."""
        return type(self).next_memory is not Effect.next_memory

    # Sensors: what the finger did, from what the sensors said; and what a sensor says of what the finger does.
    def true_motion(self, x: Motion) -> Motion:
        """The motion behind the measured one."""
        return x

    def reading(self, channel: str, x: Motion, y: Float[Array, "channels *T"]) -> Float[Array, "channels *T"]:
        """What the sensor of `channel` (a dataset's name) reads of `y`."""
        return y

    # Memory.
    def drive(self, model: "Model", x: Motion) -> Drive:
        """What drives the state, at every sample of `x` at once."""
        return ()

    def initial_memory(self, drive: Drive) -> Memory:
        """State at the first sample."""
        return ()

    def next_memory(self, memory: Memory, before: Drive, drive: Drive) -> Memory:
        """State one sample on, where the drive goes from `before` to `drive`."""
        return memory

    # Terms of equation (1), in the order in which they are evaluated.
    def finger(self, finger: Finger) -> Finger:
        """Another rigid body or another mounting."""
        return finger

    def tension(self, x: Motion, memory: Memory, f: Float[Array, "n *T"]) -> Float[Array, "n *T"]:
        """Tension f that enters the tendon's path, N."""
        return f

    def directions(
        self, x: Motion, memory: Memory, joint: Float[Array, "m *T"], tendon: Float[Array, "n *T"]
    ) -> tuple[Float[Array, "m *T"], Float[Array, "n *T"]]:
        """Share of the friction that is built up, in [−1, 1], in place of the sign of the motion; affine in that sign,
        which the forward simulation solves for.
        """
        return joint, tendon

    def coupling(self, x: Motion, f: Float[Array, "n *T"], C: Float[Array, "n m *T"]) -> Float[Array, "n m *T"]:
        """Coupling matrix C, m/rad."""
        return C

    def loss(
        self, x: Motion, f: Float[Array, "n *T"], C: Float[Array, "n m *T"], loss: Float[Array, "n *T"]
    ) -> Float[Array, "n *T"]:
        """Tension lost by a sliding tendon, N, before it is bounded by the tension."""
        return loss

    def held_tension(
        self, x: Motion, memory: Memory, f: Float[Array, "n *T"], loss: Float[Array, "n *T"], f_j: Float[Array, "n *T"]
    ) -> Float[Array, "n *T"]:
        """Tension f_j at joints that a fixture holds, N."""
        return f_j

    def delivered(self, x: Motion, f_j: Float[Array, "n *T"]) -> Float[Array, "n *T"]:
        """Tension f_j past the tendons' friction, N."""
        return f_j

    def joint_friction(
        self, x: Motion, f_j: Float[Array, "n *T"], C: Float[Array, "n m *T"], F: Float[Array, "m *T"]
    ) -> Float[Array, "m *T"]:
        """Magnitude of the joints' friction torque, N m."""
        return F

    def torque_friction(self, mu: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """Share of its own torque that each joint's drive loses to friction."""
        return mu

    def shared_friction(self, x: Motion, memory: Memory) -> tuple[SharedFriction, ...]:
        """Friction that acts on several joints at once."""
        return ()

    def torque(self, x: Motion, memory: Memory, h: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """Torque h that resists the motion, on the left of (1), friction apart, N m."""
        return h

    def excursion(
        self, x: Motion, memory: Memory, f: Float[Array, "n *T"], l: Float[Array, "n *T"]
    ) -> Float[Array, "n *T"]:
        """Tendon excursion l, m."""
        return l


class Model(eqx.Module):
    """Every parameter of equation (1), each in one place, and the effects on top of it, in order."""

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
        """The rigid body alone: no moment arms, no joint torque, no tendon friction."""
        return cls(
            finger,
            MomentArm.zeros(finger.n, finger.m, moment_arm_degree, cross),
            JointTorque.zeros(finger.m, elastic_degree, friction_degree),
            TendonFriction.zeros(finger.n),
        )

    def true_motion(self, x: Motion) -> Motion:
        """The motion behind the measured one, as the effects have it."""
        for effect in self.effects:
            x = effect.true_motion(x)
        return x

    def reading(self, channel: str, x: Motion, y: Float[Array, "channels *T"]) -> Float[Array, "channels *T"]:
        """What the sensor of `channel` reads of `y`."""
        for effect in self.effects:
            y = effect.reading(channel, x, y)
        return y
