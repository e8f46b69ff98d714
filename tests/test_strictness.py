"""The tests are stricter than users: annotations are checked, and nothing is promoted silently."""

from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Float, TypeCheckError, jaxtyped

from jaxfinger.data.signals.filtering import low_pass
from tests.checks import checked


def test_shapes_are_checked():
    with pytest.raises(TypeCheckError, match="x"):
        low_pass(np.arange(100.0), np.zeros((99, 2)), 0.1)


def test_what_is_returned_has_the_sizes_of_what_was_given():
    @jaxtyped(typechecker=checked)
    def differences(x: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
        return np.diff(x)

    with pytest.raises(TypeCheckError, match="the return value"):
        differences(np.zeros(3))


@pytest.mark.parametrize(("shape", "kind", "what"), [((2, 3), float, "rank_promotion"), (3, int, "dtype promotion")])
def test_nothing_is_promoted(shape, kind, what):
    with ThreadPoolExecutor(1) as pool, pytest.raises((ValueError, TypeError), match=what):
        pool.submit(jnp.add, jnp.zeros(3), jnp.zeros(shape, kind)).result()
