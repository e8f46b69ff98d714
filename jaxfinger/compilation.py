"""How functions are compiled: most run a few times only, so that compiling them must be cheap."""

import equinox as eqx

# XLA's fusion emitters take half as long again, or more, to compile these scalar formulas, which then run no faster.
QUICK = {"xla_cpu_use_fusion_emitters": False}

# The overloads of equinox leave the options of jit out.
quick_jit = eqx.filter_jit(compiler_options=QUICK)  # type: ignore[call-overload]
once_jit = eqx.filter_jit(compiler_options=QUICK | {"xla_backend_optimization_level": 0})  # type: ignore[call-overload]
