"""How the tests run: what is compiled or takes long is made once."""

import os
import shutil
import tempfile
from functools import partial

# Most programs of the tests run once or twice: compiled cheaply they take less than half of what XLA takes by itself.
CHEAP = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"


def pytest_configure(config):
    """In the first process, before anything imports JAX; the others start with its environment.

    Test processes share what they compile: each keeps it on disk for the others, in a folder of this run alone.
    """
    os.environ.setdefault("XLA_FLAGS", CHEAP)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line has it: two threads wait more than work
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = tempfile.mkdtemp(prefix="jaxfinger-tests-")
        config.add_cleanup(partial(shutil.rmtree, folder, ignore_errors=True))
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
