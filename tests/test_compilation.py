"""Options with which programs are compiled, and the threads beside them."""

import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import jaxfinger as jf
from jaxfinger import compilation

DEMO = Path(__file__).parents[1] / "datasets" / "demo-finger" / "session.h5"

PROGRAM = """
import jax.numpy as jnp
from jaxfinger.compilation import quick_jit
turned = quick_jit(lambda R, x: (jnp.einsum("nij,nj->ni", R, x), jnp.sum(x * x, axis=-1)))
print(turned.lower(jnp.ones((40_000, 3, 3)), jnp.ones((40_000, 3))).compile().as_text())
"""


def test_sums_over_short_axes_are_xlas_own():
    """The options of the tests' own environment would hide those of the package."""
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    text = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
    ).stdout
    assert "ENTRY" in text
    assert "ynn_fusion" not in text


def test_options_that_this_version_of_xla_lacks_are_left_out(monkeypatch):
    """Versions of XLA drop options, and refuse to compile with one that they do not know."""
    monkeypatch.delenv("XLA_FLAGS")
    monkeypatch.setitem(compilation.QUICK, "xla_no_such_option", True)
    options = compilation.quick_options.__wrapped__()
    assert "xla_no_such_option" not in options
    assert options["xla_backend_optimization_level"] == 1


@pytest.mark.parametrize("work", ["identify", "diagnose"])
def test_numpy_has_one_thread_beside_xlas_while_a_fit_runs(work):
    """Both wait busily, and would take the processors from each other. Afterwards the caller has all threads again."""

    class Stop(Exception):
        pass

    def threads():
        return {lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"}

    def seen(message):
        assert threads() == {1}
        raise Stop

    session = jf.read(DEMO)
    import_module("jaxfinger.gap.diagnose")  # loads SciPy's linear algebra
    with threadpool_limits(limits=2, user_api="blas"):
        with pytest.raises(Stop):
            getattr(jf, work)(session, progress=seen)
        assert threads() == {2}
