"""How the tests run: strictly, and what is compiled or takes long is made once.

JAX reads its environment when it is imported, which other conftests do: all of it is set before. Processes of a test
run, and those that tests start, have that of the first.
"""

import atexit
import os
import shutil
import tempfile

from jaxtyping import install_import_hook

from tests import checks

# Equations say which ranks and types meet: nothing is promoted in silence.
os.environ["JAX_NUMPY_RANK_PROMOTION"] = "raise"
os.environ["JAX_NUMPY_DTYPE_PROMOTION"] = "strict"
# Most programs of the tests run once or twice: compiled cheaply, in one part, they take a third of what XLA takes by
# itself.
CHEAP = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true "
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
)
os.environ.setdefault("XLA_FLAGS", CHEAP)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line has it: two threads wait more than work
# Test processes share what they compile: each keeps it on disk for the others, in a folder of this run alone.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="jaxfinger-tests-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)

# Each annotation is checked when it is called. Not in the rig's room: with it the tests of recorder and supervisor take
# five times as long, and they race a clock.
ROOMS = ("cli", "data", "effects", "experiments", "gap", "identify", "model", "report", "sealed", "synthetic")
install_import_hook([f"jaxfinger.{room}" for room in ROOMS], f"{checks.__name__}.checked")
