"""State and inputs of the finger along a motion, measured, commanded or simulated; time is the last axis."""

import equinox as eqx
from jaxtyping import Array, Float


class Motion(eqx.Module):
    """The state and inputs of equation (1) at the same instants.

    Directions are the signs of q̇ and l̇, by the protocol or from the measured motion; values between −1 and 1 are block
    means or low-passed signs. The tension of a tendon without measurement (passive or slack) is zero. `held`: a fixture
    holds the joints, so that tendons slip only where their loss is exceeded.
    """

    time: Float[Array, "*T"]  # s, from the trial's start
    q: Float[Array, "m *T"]  # rad
    qd: Float[Array, "m *T"]  # rad/s
    qdd: Float[Array, "m *T"]  # rad/s²
    tension: Float[Array, "n *T"]  # N, at the actuator
    joint_direction: Float[Array, "m *T"]
    tendon_direction: Float[Array, "n *T"]
    session_time: Float[Array, "*T"]  # s, from the session's start
    motorised: Float[Array, "m *T"]  # 1 where the external motor is coupled to the joint
    held: bool = eqx.field(static=True, default=False)
    temperature: Float[Array, "m *T"] | None = None  # K, of each joint, where it is measured
    # Recordings only.
    jitter: Float[Array, "m *T"] | None = None  # rad, largest reversal of an angle by the encoder's noise alone
    blur: Float[Array, "*T"] | None = None  # s, standard deviation of the low-pass before averaging; 0 for none
    block: Float[Array, "*T"] | None = None  # s, length of the block that is averaged
    # Starts of simulations only.
    tension_ahead: Float[Array, "L n *T"] | None = None  # N, at L even instants from the start to the horizon
    horizon: Float[Array, "*T"] | None = None  # s, duration of the simulation

    @property
    def simulated(self) -> bool:
        """Whether every sample is the start of a simulation."""
        return self.horizon is not None
