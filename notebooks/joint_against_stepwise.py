# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Joint against stepwise
# Staged fits pass their errors on: ID.4 takes the links' masses from ID.3. The joint refinement reads all trials at
# once. Here both fit the same session. `benchmarks/joint.py` repeats this on a hundred sessions and
# `benchmarks/coverage.py` on two hundred, and compare with the true parameters.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import jaxfinger as jf

session = jf.read(Path("datasets/paper-finger/session.h5"))
staged = jf.identify(session)
joint = jf.refine(session, staged)

# %% [markdown]
# Parameters of both fits with their intervals. The joint fit gains only where stages share parameters, above all the
# links' weight: CAD separates elastic torque from gravity, and the trials of ID.3 and ID.4 in other postures add to it.

# %%
jf.plot.intervals(staged)
jf.plot.intervals(joint)

# %% [markdown]
# Widths of the joint intervals relative to the stepwise ones.

# %%
common = np.intersect1d(staged.estimated, joint.estimated)
ratio = joint.std[common] / staged.std[common]
figure, axes = plt.subplots()
axes.hist(ratio[np.isfinite(ratio)], bins=20)
axes.set(xlabel="standard deviation, joint over stepwise", ylabel="parameters")
print("median ratio of standard deviations:", np.nanmedian(ratio).round(3))
assert np.nanmedian(ratio) < 1.02
