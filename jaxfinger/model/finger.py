"""The finger as ID.1 describes it: rigid chain, inertia, mounting, and which tendon crosses which joint."""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float


@runtime_checkable
class Description(Protocol):
    """Arrays of ID.1 under the format's names and units; `rotor_inertia` (m,), kg m², may be missing or None."""

    @property
    def gravity(self) -> Float[Array | np.ndarray, "3"]: ...

    @property
    def axis(self) -> Float[Array | np.ndarray, "m 3"]: ...

    @property
    def origin(self) -> Float[Array | np.ndarray, "m 3"]: ...

    @property
    def mass(self) -> Float[Array | np.ndarray, " m"]: ...

    @property
    def com(self) -> Float[Array | np.ndarray, "m 3"]: ...

    @property
    def inertia(self) -> Float[Array | np.ndarray, "m 3 3"]: ...

    @property
    def fingertip(self) -> Float[Array | np.ndarray, "3"]: ...

    @property
    def limits(self) -> Float[Array | np.ndarray, "m 2"]: ...

    @property
    def prismatic(self) -> tuple[bool, ...]: ...

    @property
    def joint_names(self) -> tuple[str, ...]: ...

    @property
    def tendon_names(self) -> tuple[str, ...]: ...

    @property
    def active(self) -> Bool[Array | np.ndarray, " n"]: ...

    @property
    def crosses(self) -> Bool[Array | np.ndarray, "n m"]: ...


class Finger(eqx.Module):
    """A serial chain of m joints, base to tip, moved by n tendons.

    Link i moves with joint i. Its frame lies at the joint and is parallel to its parent's frame at q = 0. A positive
    angle about `axis` is flexion or abduction; a prismatic joint moves along its axis. A rotor that is geared to joint
    i adds to `rotor_inertia[i, i]`, and one that turns with several joints also to their cross terms. Gyroscopic
    torques of rotors are neglected (Featherstone 2008, §9.6).
    """

    gravity: Float[Array, "3"]  # m/s², base frame
    axis: Float[Array, "m 3"]
    origin: Float[Array, "m 3"]  # m, in the parent link's frame
    mass: Float[Array, " m"]  # kg
    com: Float[Array, "m 3"]  # m, in the link frame
    gyration: Float[Array, "m 3 3"]  # m², inertia about the centre of mass divided by the mass
    rotor_inertia: Float[Array, "m m"]  # kg m², of geared rotors, reflected to the joints
    fingertip: Float[Array, "3"]  # m, in the last link's frame
    limits: tuple[tuple[float, float], ...] = eqx.field(static=True)  # rad, or m where prismatic
    prismatic: tuple[bool, ...] = eqx.field(static=True)
    joint_names: tuple[str, ...] = eqx.field(static=True)
    tendon_names: tuple[str, ...] = eqx.field(static=True)
    active: tuple[bool, ...] = eqx.field(static=True)  # whether an actuator pulls each tendon
    crosses: tuple[tuple[bool, ...], ...] = eqx.field(static=True)  # n rows of m: whether a tendon crosses a joint

    @classmethod
    def from_description(cls, d: Description) -> "Finger":
        """Finger from an object with the arrays of ID.1 under the format's names."""
        arrays = {
            k: np.asarray(getattr(d, k), dtype=float)
            for k in ("gravity", "axis", "origin", "mass", "com", "inertia", "fingertip")
        }
        arrays["gyration"] = arrays.pop("inertia") / arrays["mass"][:, None, None]
        rotors = getattr(d, "rotor_inertia", None)
        arrays["rotor_inertia"] = np.diag(np.zeros(len(d.joint_names)) if rotors is None else np.asarray(rotors, float))
        return cls(
            **jax.device_put(arrays),
            limits=tuple((float(a), float(b)) for a, b in d.limits),
            prismatic=tuple(bool(p) for p in d.prismatic),
            joint_names=tuple(d.joint_names),
            tendon_names=tuple(d.tendon_names),
            active=tuple(bool(a) for a in d.active),
            crosses=tuple(tuple(bool(c) for c in row) for row in d.crosses),
        )

    @property
    def inertia(self) -> Float[Array, "m 3 3 *T"]:
        """Inertia of the links about their centres of mass, kg m².

        It is proportional to the mass, as for a body of another density, so that it remains physically possible where a
        fit changes the mass.
        """
        return self.mass[:, None, None] * self.gyration

    @property
    def m(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def n(self) -> int:
        """Number of tendons, passive ones included."""
        return len(self.tendon_names)
