"""Test processes share what they compile: each keeps it on disk for the others, in a folder of this run alone."""

import os
import shutil
import tempfile
from functools import partial


def pytest_configure(config):
    """In the first process, before anything imports JAX; the others start with its environment."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = tempfile.mkdtemp(prefix="jaxfinger-tests-")
        config.add_cleanup(partial(shutil.rmtree, folder, ignore_errors=True))
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
