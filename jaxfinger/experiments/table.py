"""What each experiment of the format is, as data: the only differences between them that a prediction needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

Kind = Literal["path", "driven", "stepped", "held"]


@dataclass(frozen=True)
class Experiment:
    """One row of the format's table of experiments.

    `kind` says how its joints move, and so which samples count: along a `path`, where only excursions are read;
    `driven` by a motor or by tendons, where friction is known as long as they slide; `stepped` from hold to hold;
    `held` by a fixture, so that joints carry no friction, and tendons slip only past their loss.

    `rate` and `cutoff` say how a trial is reduced before a fit: slow experiments are averaged over blocks of 1/rate s,
    q̇ and q̈ come from a zero-phase low-pass at `cutoff`. Both sides of (1) are averaged and filtered alike. A higher
    cut-off lets the encoder's noise into q̈, and a fit takes that for less inertia.
    """

    name: str
    kind: Kind
    channels: tuple[str, ...]  # what the model predicts
    rate: float  # Hz
    cutoff: float  # Hz
    sharp: float = 4.0  # times the cut-off beside a measurement that is not filtered, where noise of q̈ biases nothing
    slack: bool = False  # the tendons are slack by protocol
    pace: float = 1.0  # times as long as the protocol's that the motions take, for which rate and cut-off are

    def at(self, pace: float) -> Experiment:
        """The experiment of a session of another pace (`data.sizes`)."""
        return replace(self, rate=self.rate / pace, cutoff=self.cutoff / pace, pace=pace)

    @property
    def held(self) -> bool:
        """A fixture holds the joints."""
        return self.kind == "held"

    @property
    def stepped(self) -> bool:
        """A motor moves a joint from hold to hold."""
        return self.kind == "stepped"

    @property
    def rests(self) -> bool:
        """It is read at holds above all."""
        return self.kind in ("stepped", "held")

    def cutoff_at(self, step: float, sharp: bool = False) -> float:
        """Hz, of a trial with a sample every `step` s: a fifth of its rate at most."""
        return min(self.cutoff * (self.sharp if sharp else 1.0), 0.2 / step)


EXPERIMENTS = {
    e.name: e
    for e in (
        Experiment("ID.2", "path", ("tendon_excursion",), 20.0, 5.0),
        Experiment("ID.3-static", "stepped", ("joint_torque",), 20.0, 5.0, slack=True),
        Experiment("ID.3-dynamic", "driven", ("joint_torque",), 50.0, 10.0, sharp=3.0, slack=True),
        Experiment("ID.4", "held", ("joint_torque", "tendon_excursion"), 20.0, 5.0),
        Experiment("VD.1", "path", ("tendon_excursion",), 20.0, 5.0),
        Experiment("VD.2", "held", ("fingertip_force", "tendon_excursion"), 20.0, 5.0),
        Experiment("VD.3", "driven", ("joint_torque", "tendon_excursion"), 50.0, 10.0),
    )
}
