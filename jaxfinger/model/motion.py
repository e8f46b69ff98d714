"""What drives the finger: measured, commanded or simulated; batch last, time the very last axis."""

import equinox as eqx
from jaxtyping import Array, Float


class Motion(eqx.Module):
    """The state and inputs of equation (1) at the same instants.

    Directions are the signs of q̇ and l̇: the protocol's where it is known, smooth where derivatives are needed.
    A tendon without tension measurement (passive, slack) carries zero. `held`: a fixture holds the joints, so that
    tendons move only when their loss is exceeded.
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
    # Of a recording: rad, what the encoder's noise turns an angle back by at rest; and s, the standard deviation of the
    # low-pass that all of it went through, 0 for none, where a sample is the mean of its interval.
    jitter: Float[Array, "m *T"] | None = None
    blur: Float[Array, "*T"] | None = None
    # Of samples that a simulation starts from: N, the tension that follows, at even instants, and s, for how long.
    tension_ahead: Float[Array, "L n *T"] | None = None
    horizon: Float[Array, "*T"] | None = None

    @property
    def simulated(self) -> bool:
        """Whether a simulation starts from every sample."""
        return self.horizon is not None
