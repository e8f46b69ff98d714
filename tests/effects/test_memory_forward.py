"""Effects with memory, simulated forward: the closed forms of a Dahl spring and of a Maxwell branch."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.model import simulate
from tests.model.test_simulate import DT, slider

F, X0 = 2.0, 0.05  # N, m
run = eqx.filter_jit(simulate)


def pushed(name: str, push: float, friction: float = F, **values: float) -> tuple[np.ndarray, np.ndarray]:
    """q, m, and q̇, m/s, of 1 kg on a rail with 20 N s/m, from rest, for 12 s."""
    model = slider(friction, 20.0)
    effect = CATALOGUE[name].at(model.finger, (model.finger.joint_names[0],), **values)
    model = eqx.tree_at(lambda m: m.effects, model, (effect,), is_leaf=lambda v: isinstance(v, tuple))
    time = np.arange(12001) * DT
    still = np.zeros((1, time.size))
    q, qd = run(model, time, still, jnp.zeros(1), jnp.zeros(1), jnp.full((1, time.size), push))
    return np.asarray(q[0]), np.asarray(qd[0])


def test_below_its_limit_it_gives_way_until_friction_carries_the_push():
    q, qd = pushed("joint_presliding", 1.2, a=1.0, x0=X0)
    np.testing.assert_allclose(q[-1], -X0 * np.log(1 - 1.2 / F), rtol=2e-3)  # F (1 − exp(−x/x₀)) = push
    assert abs(qd[-1]) < 1e-4


def test_above_its_limit_it_slides_against_the_whole_friction():
    _, qd = pushed("joint_presliding", 5.0, a=1.0, x0=X0)
    np.testing.assert_allclose(qd[-1], (5.0 - F) / 20.0, rtol=1e-3)


@pytest.mark.parametrize(("push", "moves"), [(0.9, False), (1.1, True)])
def test_the_share_that_builds_up_at_once_sticks(push, moves):
    """Half of the friction is Coulomb's: it holds 1 N by itself, and no more."""
    q, _ = pushed("joint_presliding", push, a=0.5, x0=X0)
    assert (abs(q[-1]) > 1e-4) == moves


def test_a_branch_that_relaxes_drags_like_a_damper():
    """At a steady speed ż = q̇ − z/T leaves z = T q̇, and the push carries (c + k T) q̇."""
    _, qd = pushed("elastic_relaxation", 5.0, friction=0.0, stiffness=100.0, T=0.3)
    np.testing.assert_allclose(qd[-1], 5.0 / (20.0 + 100.0 * 0.3), rtol=2e-3)
