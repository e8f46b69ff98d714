"""The tests are stricter than users: what an annotation says is checked, and nothing is promoted in silence."""

from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

from jaxfinger.identify.starts import surrogate


def test_shapes_are_checked():
    """Of a function that no other test calls a thousand times (`tests/strict.py`)."""
    with pytest.raises(TypeCheckError, match="noise"):
        surrogate(np.zeros(5), np.random.default_rng(0))


@pytest.mark.parametrize(
    ("other", "what"), [(jnp.zeros((2, 3)), "rank_promotion"), (jnp.zeros(3, int), "dtype promotion")]
)
def test_nothing_is_promoted(other, what):
    with ThreadPoolExecutor(1) as pool, pytest.raises((ValueError, TypeError), match=what):
        pool.submit(jnp.add, jnp.zeros(3), other).result()
