"""Environment of the tests: strict checks, cheap compilation, and a compilation cache shared by all processes.

JAX reads its environment when it is imported, which other conftests do, so everything is set here first. All processes
of a test run, and those that tests start, inherit the environment of the first.
"""

import atexit
import os
import shutil
import sys
import tempfile
from pathlib import Path
from pkgutil import iter_modules

from jaxtyping import install_import_hook

from tests import checks

# JAX must not promote ranks or types silently.
os.environ["JAX_NUMPY_RANK_PROMOTION"] = "raise"
os.environ["JAX_NUMPY_DTYPE_PROMOTION"] = "strict"
# Most programs of the tests run once or twice. With these options they compile in a third of the time.
CHEAP = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 "
    "--xla_cpu_experimental_ynn_fusion_type="
)
os.environ.setdefault("XLA_FLAGS", CHEAP)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line sets it: two threads mostly wait
# Hundreds of test processes import the same modules. Each writes byte code for the next, whatever the environment says.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# Test processes share compiled programs through a folder of this run.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="jaxfinger-tests-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)

# Annotations are checked at each call, except in the simulated controller and plant, which run at 1 kHz in plain
# Python: tests of the rig would take five times as long. `trips` is called for each sample, too.
ROOMS = ("cli", "data", "effects", "experiments", "gap", "identify", "model", "report", "sealed", "synthetic")
UNCHECKED = ("simulated", "trips")
RIG = [m.name for m in iter_modules([str(Path(__file__).parents[1] / "jaxfinger" / "rig")]) if m.name not in UNCHECKED]
install_import_hook([f"jaxfinger.{m}" for m in (*ROOMS, *(f"rig.{m}" for m in RIG))], f"{checks.__name__}.checked")
