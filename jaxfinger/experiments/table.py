"""Table of the format's experiments, with the differences between them that a prediction needs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from jaxfinger.data.signals.sizes import Sizes

MOST_HALVINGS = 2  # of a cut-off for noise: at a quarter of the protocol's, the filter still shows a sweep's reversals

Kind = Literal["path", "driven", "stepped", "held"]


@dataclass(frozen=True)
class Experiment:
    """One row of the format's table of experiments.

    `kind` is the kind of motion, which decides which samples are valid. Joints move along a `path`, where only
    excursions are read; they are `driven` by a motor or by tendons, where friction is known while they slide; they are
    `stepped` from hold to hold; or they are `held` by a fixture, which carries their friction, while tendons slip only
    where their loss is exceeded.

    For a fit, samples are averaged over blocks of 1/`rate`, and q̇ and q̈ come from a zero-phase low-pass at `cutoff`.
    Both sides of (1) are averaged and filtered alike. A higher cut-off would let the encoder's noise into q̈, which
    biases the inertia downwards.
    """

    name: str
    kind: Kind
    channels: tuple[str, ...]  # that the model predicts
    rate: float  # Hz
    cutoff: float  # Hz
    # Factor on the cut-off where the measured channel is not filtered: there the noise of q̈ biases no estimate.
    sharp_ratio: float = 4.0
    slack: bool = False  # whether the tendons are slack by protocol
    pace: float = 1.0  # duration of the motions over that of the protocol's, for which rate and cut-off hold

    def at(self, sizes: Sizes) -> Experiment:
        """Experiment with rate and cut-off for the pace and the noise of a session.

        The cut-off of sweeps is halved, at most twice, to about the frequency above which the torque of inertia is
        noisier than the measured torque (`Sizes.crossing`).
        """
        pace = sizes.pace if self.kind == "driven" else sizes.slow_pace
        excess = self.cutoff / pace / sizes.crossing if self.kind == "driven" and self.slack else 0.0
        scale = 0.5 ** min(round(math.log2(max(excess, 1.0))), MOST_HALVINGS) / pace
        return replace(self, rate=self.rate * scale, cutoff=self.cutoff * scale, pace=pace)

    @property
    def held(self) -> bool:
        """Whether a fixture holds the joints."""
        return self.kind == "held"

    @property
    def stepped(self) -> bool:
        """Whether a motor moves a joint from hold to hold."""
        return self.kind == "stepped"

    @property
    def rests(self) -> bool:
        """Whether most valid samples are holds."""
        return self.kind in ("stepped", "held")

    @property
    def unloaded(self) -> bool:
        """Whether tendons alone move the joints: no motor's torque acts, which is known without a sensor."""
        return self.kind == "driven" and not self.slack

    def predicted_as(self, channel: str) -> tuple[str, bool]:
        """What predicts a channel: its name, and whether equation (1) is solved for joints that a fixture holds.

        Excursions are predicted alike whether joints are held or not.
        """
        return channel, self.held and channel != "tendon_excursion"

    def cutoff_at(self, step: float, sharp: bool = False) -> float:
        """Cut-off, Hz, for a trial with a sample every `step` s."""
        return min(self.cutoff * (self.sharp_ratio if sharp else 1.0), highest_cutoff(step))


def highest_cutoff(step: float) -> float:
    """Highest cut-off, Hz, for a sample every `step` s: a fifth of the rate, so that 0.11 passes at half the rate."""
    return 0.2 / step


EXPERIMENTS = {
    e.name: e
    for e in (
        Experiment("ID.2", "path", ("tendon_excursion",), 20.0, 5.0),
        Experiment("ID.3-static", "stepped", ("joint_torque",), 20.0, 5.0, slack=True),
        Experiment("ID.3-dynamic", "driven", ("joint_torque",), 50.0, 10.0, sharp_ratio=3.0, slack=True),
        Experiment("ID.4", "held", ("joint_torque", "tendon_excursion"), 20.0, 5.0),
        Experiment("VD.1", "path", ("tendon_excursion",), 20.0, 5.0),
        Experiment("VD.2", "held", ("fingertip_force", "tendon_excursion"), 20.0, 5.0),
        Experiment("VD.3", "driven", ("joint_torque", "tendon_excursion"), 50.0, 10.0),
    )
}
