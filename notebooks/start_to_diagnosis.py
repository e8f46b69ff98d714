# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # From a session file to a diagnosis
# The shipped session is that of a simulated finger with two known causes: tendon T3 stretches by 60 µm/N, and the
# friction of the MCP joint at rest is 1.9 times that in motion and falls over 20°/s (Stribeck).

# %%
from pathlib import Path

import jaxfinger as jf

session = jf.read(Path("datasets/demo-finger/session.h5"))
print(session)

# %% [markdown]
# ## Identify
# All stages with their χ² per row, which is 1 for noise alone.

# %%
fit = jf.identify(session)
for stage in fit.stages:
    print(f"{stage.name:14} {stage.status:10} χ² per row {stage.chi2_per_row:.2f}")

# %% [markdown]
# Moment arms and joint torques with their 95 % bands, and all parameters with their intervals.

# %%
jf.plot.moment_arms(fit, "MCP")
jf.plot.joint_torque(fit, "MCP")
jf.plot.intervals(fit)

# %% [markdown]
# ## Diagnose
# The budget has a bar for each channel. A coloured part is the share of the gap that opens again, on trials that no
# fit has read, if that cause is dropped.

# %%
diagnosis = jf.diagnose(session, quick=True)
jf.plot.budget(diagnosis)
for cause in diagnosis.budget:
    print(f"{cause.effect} at {cause.sites}: probability {cause.probability:.2f}, share {cause.share:.2f}")

# %% [markdown]
# The stretch is named, and its true value is inside the interval.

# %%
stretch = next(c for c in diagnosis.budget if c.effect == "tendon_stretch")
compliance = next(v for v in stretch.values if v.name == "compliance")
assert stretch.sites == (("T3",),)
assert abs(compliance.value - 60e-6) < 1.96 * compliance.std + 1e-6
