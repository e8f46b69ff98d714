"""How the tests run: what is compiled or takes long is made once."""

import os
import shutil
import tempfile
from functools import partial

import pytest

# Most programs of the tests run once or twice: compiled cheaply they take less than half of what XLA takes by itself.
# Those that the package compiles with options of its own (`jaxfinger.compilation`) keep them.
CHEAP = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
COSTLY = ("diagnosis", "staged")  # fixtures: the tests that use one run in one process, which makes it once


def pytest_configure(config):
    """In the first process, before anything imports JAX; the others start with its environment.

    Test processes share what they compile: each keeps it on disk for the others, in a folder of this run alone.
    """
    os.environ.setdefault("XLA_FLAGS", CHEAP)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = tempfile.mkdtemp(prefix="jaxfinger-tests-")
        config.add_cleanup(partial(shutil.rmtree, folder, ignore_errors=True))
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """With several processes, each takes whole files, or all that share a costly fixture."""
    for item in items:
        costly = [name for name in COSTLY if name in item.fixturenames]
        item.add_marker(pytest.mark.xdist_group((costly or [item.nodeid.split("::")[0]])[0]))
