"""Environment of the tests: strict checks, cheap compilation, and a compilation cache shared by all processes.

JAX reads its environment when it is imported, which other conftests do, so everything is set here first. All processes
of a test run, and those that tests start, inherit the environment of the first.
"""

import atexit
import os
import shutil
import tempfile

from jaxtyping import install_import_hook

from tests import checks

# JAX must not promote ranks or types silently.
os.environ["JAX_NUMPY_RANK_PROMOTION"] = "raise"
os.environ["JAX_NUMPY_DTYPE_PROMOTION"] = "strict"
# Most programs of the tests run once or twice. With these options they compile in a third of the time.
CHEAP = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)
os.environ.setdefault("XLA_FLAGS", CHEAP)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line sets it: two threads mostly wait
# Test processes share compiled programs through a folder of this run.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="jaxfinger-tests-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)

# Annotations are checked at each call, except in the rig: there its tests would take five times as long, and those of
# recorder and supervisor are timed.
ROOMS = ("cli", "data", "effects", "experiments", "gap", "identify", "model", "report", "sealed", "synthetic")
install_import_hook([f"jaxfinger.{room}" for room in ROOMS], f"{checks.__name__}.checked")
