"""What each experiment of the format is, as data: the only differences between them that a prediction needs."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Experiment:
    """One row of the format's table of experiments.

    `rate` and `cutoff` say how a trial is reduced before a fit: slow experiments are averaged over blocks of 1/rate s,
    q̇ and q̈ come from a zero-phase low-pass at `cutoff`. Both sides of (1) are averaged and filtered alike. A higher
    cut-off lets the encoder's noise into q̈, and a fit takes that for less inertia.
    """

    name: str
    channels: tuple[str, ...]  # what the model predicts
    rate: float  # Hz
    cutoff: float  # Hz
    sharp: float = 4.0  # times the cut-off beside a measurement that is not filtered, where noise of q̈ biases nothing
    samples: str = "all"  # which ones count: `all`, `sliding` (friction is known), `holds` (and what is known between)
    held: bool = False  # a fixture holds the joints: they carry no friction, and tendons slip only past their loss
    slack: bool = False  # the tendons are slack by protocol

    @property
    def stepped(self) -> bool:
        """A motor moves a joint from hold to hold."""
        return self.samples == "holds" and not self.held

    def cutoff_at(self, step: float, sharp: bool = False) -> float:
        """Hz, of a trial with a sample every `step` s: a fifth of its rate at most."""
        return min(self.cutoff * (self.sharp if sharp else 1.0), 0.2 / step)


EXPERIMENTS = {
    e.name: e
    for e in (
        Experiment("ID.2", ("tendon_excursion",), 20.0, 5.0),
        Experiment("ID.3-static", ("joint_torque",), 20.0, 5.0, samples="holds", slack=True),
        Experiment("ID.3-dynamic", ("joint_torque",), 50.0, 10.0, sharp=3.0, samples="sliding", slack=True),
        Experiment("ID.4", ("joint_torque", "tendon_excursion"), 20.0, 5.0, samples="holds", held=True),
        Experiment("VD.1", ("tendon_excursion",), 20.0, 5.0),
        Experiment("VD.2", ("fingertip_force", "tendon_excursion"), 20.0, 5.0, samples="holds", held=True),
        Experiment("VD.3", ("joint_torque", "tendon_excursion"), 50.0, 10.0, samples="sliding"),
    )
}

SLACK = 0.2  # N: a tendon whose tension stays below this is slack, and carries neither tension nor friction
STILL = 0.05  # rad/s (or a tenth of the motion's speed): below this a joint keeps the direction that it had
MIN_JOINT_SPEED = 0.1  # rad/s (or a twentieth of the motion's): below it a joint may stick, its friction unknown
MIN_DRIVEN_SPEED = 0.02  # rad/s: likewise a joint that a motor moves, which does not stick: above the encoder's noise
MIN_TENDON_SPEED = 5e-4  # m/s: likewise a tendon
QUICK = 3.0  # times the cut-off: the filter whose speeds tell a slip
LOST = 0.5  # of a joint's speed: what the slower filter may lose of it; stick and slip lose 1 to 3 times it
ABOVE_NOISE = 15.0  # times the median loss, which is the encoder's noise: what it loses must be more to be a slip
AT_REST = 6.0  # times the median loss: an angle that turns back by less has not moved; twice that for single samples
ROUNDING = 1e-6  # rad/s: what it loses of a joint that stands still in a simulated file
COMPLIANCE = 5e-5  # m/N: a tendon that stretches as much may stand still at the joints while its motor moves
CLEAR = 0.03  # s: kept clear on either side of where a joint or tendon may stick: over two widths of the filter
BREAKAWAY = 0.06  # s: kept clear beside it after a joint that no motor moves has broken away
CLEAR_STEP = 0.01  # s: CLEAR where a motor moves the joint from hold to hold, and nothing measured is filtered
