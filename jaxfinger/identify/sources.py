"""The experiments as a fit reads them: data, whitening filters, and the parameters that each depends on."""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from jaxfinger.compilation import side_by_side
from jaxfinger.experiments import Batch, Experiment, Stack
from jaxfinger.identify.linearise import (
    NO_REVERSALS,
    Filters,
    Reversals,
    White,
    residuals_by_tangent,
    tangent,
    white_tangent,
)
from jaxfinger.identify.noise import Noise
from jaxfinger.identify.parameters import Free, Parameter
from jaxfinger.identify.shooting import AHEAD
from jaxfinger.model import Model

# Groups on which the torque of a motor that moves a joint depends.
DRIVEN = ("elastic", "friction", "damping", "friction_by_direction", "torque_friction", "rotor_inertia")

# Groups of parameters on which each channel of each experiment depends.
_TORQUE = {*DRIVEN, "mass", "com"}
_HELD_TORQUE = {"elastic", "mass", "com", "moment_arm", "tendon_friction"}
DEPENDS = {
    ("ID.2", "tendon_excursion"): {"moment_arm"},
    ("ID.3-static", "joint_torque"): _TORQUE,
    ("ID.3-dynamic", "joint_torque"): _TORQUE,
    ("ID.4", "joint_torque"): _HELD_TORQUE,
    ("ID.4", "tendon_excursion"): {"moment_arm"},
    ("VD.1", "tendon_excursion"): {"moment_arm"},
    ("VD.2", "fingertip_force"): _HELD_TORQUE,
    ("VD.2", "tendon_excursion"): {"moment_arm"},
    ("VD.3", "joint_torque"): _TORQUE | _HELD_TORQUE,
    ("VD.3", "tendon_excursion"): {"moment_arm"},
    (AHEAD, "q"): _TORQUE | _HELD_TORQUE,
}


class Source(NamedTuple):
    """One experiment as a fit reads it: its data, its whitening filters, and the parameters that it depends on."""

    batch: Batch
    filters: Filters
    positions: Int[np.ndarray, " k"]  # of those parameters in the flat vector, ascending
    effects: bool = True  # whether its channels depend on the model's effects, if there are any
    affine: Int[np.ndarray, " a"] = np.zeros(0, int)  # positions in which its residuals are jointly affine
    weights: Float[np.ndarray, " B"] | None = None  # of its trials, 1 by default
    pace: float = 1.0  # duration of its motions over that of the protocol's
    reversals: Reversals = NO_REVERSALS

    def relevant_model(self, model: Model) -> Model:
        """Model without effects that the experiment does not depend on, so that they are not compiled."""
        return model if self.effects or not model.effects else eqx.tree_at(lambda m: m.effects, model, ())

    def seen(self, model: Model) -> tuple[Model, Free]:
        """`relevant_model`, and the parameters on which the residuals depend, as free ones."""
        relevant = self.relevant_model(model)
        return relevant, Free.at(relevant, self.positions)

    def parts(self, model: Model) -> set[str]:
        """Fields of the model on whose parameters the residuals depend."""
        return set(self.seen(model)[1].parts)

    def is_affine(self, model: Model, free: Int[np.ndarray, " p"]) -> bool:
        """Whether the residuals are affine in the free parameters, so that one linearisation is exact."""
        mine = np.intersect1d(self.positions, free)
        # With friction of its own torque a drive scales the sum of (1), which is then no longer affine.
        drives = np.any(np.asarray(model.joint_torque.torque_friction))
        return not self.relevant_model(model).effects and not drives and bool(np.isin(mine, self.affine).all())


def sources_of(
    stacks: dict[str, Stack],
    reads: dict[str, tuple[str, ...]],
    noise: dict[tuple[str, str], Noise],
    parameters: list[Parameter],
) -> dict[str, Source]:
    """Sources of a fit: every experiment read, with its whitening filters and the parameters that it depends on."""
    out = {}
    for e, channels in reads.items():
        groups = set().union(*(DEPENDS[e, c] for c in channels), {"effects"})
        positions = np.array([i for i, p in enumerate(parameters) if p.group in groups and p.determinable])
        groups_affine = set.intersection(*(_affine_groups(stacks[e].experiment, c) for c in channels))
        affine = np.array([i for i in positions if parameters[i].group in groups_affine], dtype=int)
        filters = {c: jax.device_put(noise[e, c].coefficients) for c in channels}
        out[e] = Source(stacks[e].batch, filters, positions, affine=affine, pace=stacks[e].experiment.pace)
    return out


def _affine_groups(experiment: Experiment, channel: str) -> set[str]:
    """Groups of parameters in which a channel is jointly affine, with all others fixed.

    A torque is affine where the tendons are slack, so that the clipped loss of tendon friction does not enter.
    """
    if channel == "tendon_excursion":
        return {"moment_arm"}
    return {"elastic", "friction", "damping", "friction_by_direction", "rotor_inertia"} if experiment.slack else set()


def white_tangents(model: Model, sources: dict[str, Source]) -> dict[str, White]:
    """White residuals and Jacobian of every experiment at the model, not compressed."""

    def one(s: Source) -> White:
        return white_tangent(tangent(*s.seen(model), s.batch, tuple(s.filters)), s.batch, s.filters, s.reversals)

    return dict(zip(sources, side_by_side(one, sources.values()), strict=True))


def residuals_each(
    model: Model, sources: dict[str, Source]
) -> dict[str, dict[str, Float[np.ndarray, "_columns _B _T"]]]:
    """Measured − predicted of every experiment by channel, in the channel's unit, also at samples whose mask is 0."""

    def one(s: Source):
        return residuals_by_tangent(*s.seen(model), s.batch, tuple(s.filters))

    return dict(zip(sources, side_by_side(one, sources.values()), strict=True))
