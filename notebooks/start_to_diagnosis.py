# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # From a session file to a diagnosis
# A shipped session of a simulated finger whose answer is known: tendon T3 stretches by 60 µm/N, and the friction of the
# MCP joint is 0.9 higher at rest than in motion, falling over 20°/s (Stribeck).

# %%
from pathlib import Path

import jaxfinger as jf

session = jf.read(Path("datasets/demo-finger/session.h5"))
print(session)

# %% [markdown]
# ## Identify
# All stages, each with its χ² per row: 1 is what the noise alone gives.

# %%
fit = jf.identify(session)
for stage in fit.stages:
    print(f"{stage.name:14} {stage.status:10} χ² per row {stage.chi2_per_row:.2f}")

# %% [markdown]
# Moment arms and joint torques with their 95 % bands, and all parameters as intervals.

# %%
jf.plot.moment_arms(fit, "MCP")
jf.plot.joint_torque(fit, "MCP")
jf.plot.intervals(fit)

# %% [markdown]
# ## Diagnose
# The budget: a bar a channel. Each colour is what is lost when that cause alone is dropped, on trials that no fit saw.

# %%
diagnosis = jf.diagnose(session, quick=True)
jf.plot.budget(diagnosis)
for cause in diagnosis.budget:
    print(f"{cause.effect} at {cause.sites}: probability {cause.probability:.2f}, share {cause.share:.2f}")

# %% [markdown]
# The truth is among what is named, and its value inside the interval.

# %%
stretch = next(c for c in diagnosis.budget if c.effect == "tendon_stretch")
compliance = next(v for v in stretch.values if v.name == "compliance")
assert stretch.sites == (("T3",),)
assert abs(compliance.value - 60e-6) < 1.96 * compliance.std + 1e-6
