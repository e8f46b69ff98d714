"""Options with which programs are compiled."""

import os
import subprocess
import sys

PROGRAM = """
import jax.numpy as jnp
from jaxfinger.compilation import quick_jit
turned = quick_jit(lambda R, x: (jnp.einsum("nij,nj->ni", R, x), jnp.sum(x * x, axis=-1)))
print(turned.lower(jnp.ones((40_000, 3, 3)), jnp.ones((40_000, 3))).compile().compiled.as_text())
"""


def test_sums_over_short_axes_are_xlas_own():
    """The options of the tests' own environment would hide those of the package."""
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    text = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
    ).stdout
    assert "ENTRY" in text
    assert "ynn_fusion" not in text
