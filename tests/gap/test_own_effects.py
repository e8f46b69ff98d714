"""Faults of a user's own effects that show only in predictions of the session's trials are said."""

import jax.numpy as jnp
import pytest
from jaxtyping import Array, Float

from jaxfinger.effects import CATALOGUE, CatalogueEffect, amplitude
from jaxfinger.errors import UserError
from jaxfinger.gap import diagnose
from jaxfinger.gap.exact import Baseline
from jaxfinger.gap.formula import Parameters
from jaxfinger.gap.screening import read_parts
from jaxfinger.gap.signatures import variants

from .conftest import session_with


class Mine(CatalogueEffect):
    """An effect of a user's: subclasses differ in the torque that resists the joint."""

    ID = "mine"
    PLACE = "joint"
    b: Float[Array, ""] = amplitude("N m", 0.1, "torque")


class Logarithm(Mine):
    """NaN where a joint moves backwards."""

    def torque(self, x, memory, h):
        return h.at[self.index[0]].add(self.b * jnp.log(x.qd[self.index[0]]))


class Quotient(Mine):
    """Infinite where a joint is at rest."""

    def torque(self, x, memory, h):
        return h.at[self.index[0]].add(self.b / x.qd[self.index[0]])


class Offset(Mine):
    """At work at zero amplitude, too."""

    def torque(self, x, memory, h):
        return h.at[self.index[0]].add(self.b * x.qd[self.index[0]] + 1e-4 * x.q[self.index[0]])


class InPlaceOfAll(Mine):
    """Replaces the nominal torque."""

    def torque(self, x, memory, h):
        return h.at[self.index[0]].set(self.b * x.qd[self.index[0]])


class Everywhere(Mine):
    """Acts at all joints, whatever its site."""

    def torque(self, x, memory, h):
        return h + self.b * x.qd * jnp.abs(x.qd)


class Sound(Mine):
    """As it should be."""

    def torque(self, x, memory, h):
        return h.at[self.index[0]].add(self.b * jnp.abs(x.qd[self.index[0]]) * x.qd[self.index[0]])


class OfPairs(Mine):
    """Of its two tendons only one is seen: the other is slack in these trials."""

    PLACE = "tendon pair"

    def torque(self, x, memory, h):
        k, other = self.index
        return h.at[k % 3].add(self.b * jnp.abs(x.qd[k % 3]) * x.qd[k % 3] * (1.0 + x.tension[other]))


def read(problem, kind):
    items = variants({kind.ID: kind}, problem.nominal.finger, problem.scales)
    return list(read_parts(problem, items, Baseline.of(problem, Parameters()).columns))


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        (Logarithm, r"test_own_effects\.py: mine at MCP predicts NaN or infinity in joint_torque of ID\.3-static with"),
        (Quotient, r"mine at MCP predicts NaN or infinity in joint_torque of ID\.3-static with b = .*; keep every"),
        (Offset, r"mine at MCP changes joint_torque of ID\.3-\w+ at zero amplitude; let its amplitudes multiply"),
        (InPlaceOfAll, "at zero amplitude; let its amplitudes multiply"),
        (Everywhere, "mine does the same at MCP and at PIP; let it act at `self.index` alone"),
    ],
)  # fmt: skip
def test_a_fault_of_an_own_effect_is_said(planted, kind, says):
    with pytest.raises(UserError, match=says):
        read(planted, kind)


@pytest.mark.parametrize("kind", [Sound, OfPairs])
def test_a_sound_effect_is_read(planted, kind):
    assert len(read(planted, kind)) == 1


def test_an_own_effect_may_be_the_only_candidate():
    """One that the model's own parameters imitate leaves nothing to offer, which is no fault."""

    class Damping(Mine):
        """What the model has already."""

        def torque(self, x, memory, h):
            return h.at[self.index[0]].add(self.b * x.qd[self.index[0]])

    found = diagnose(session_with(), quick=True, effects={"mine": Damping}, without=tuple(sorted(CATALOGUE)))
    assert not found.candidates
    assert any(x.key.effect == "mine" for x in found.absorbed)
