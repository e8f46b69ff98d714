"""How functions are compiled: what runs a few times only must compile cheaply."""

import equinox as eqx

# XLA's fusion emitters take half as long again, or more, to compile these scalar formulas, which then run no faster.
QUICK = {"xla_cpu_use_fusion_emitters": False}

# For a fit's iterations, and for a handful of calls. The overloads of equinox leave the options of jit out.
quick_jit = eqx.filter_jit(compiler_options=QUICK)  # type: ignore[call-overload]
once_jit = eqx.filter_jit(compiler_options=QUICK | {"xla_backend_optimization_level": 0})  # type: ignore[call-overload]
