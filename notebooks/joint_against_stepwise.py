# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Joint against stepwise
# The staged fits pass their errors on: what ID.3 makes of the links' masses, ID.4 takes for granted. The joint
# refinement reads all trials at once. Both fit the same session here; `benchmarks/joint.py`
# repeats it on a hundred, and `benchmarks/coverage.py` on two hundred, with the truth beside them.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import jaxfinger as jf

session = jf.read(Path("datasets/paper-finger/session.h5"))
staged = jf.identify(session)
joint = jf.refine(session, staged)

# %% [markdown]
# Both as intervals. Joint can only gain where stages share something, the links' weight above all: CAD tells elastic
# torque from gravity, and the trials of ID.3 and ID.4 in other postures add to what CAD knows.

# %%
jf.plot.intervals(staged)
jf.plot.intervals(joint)

# %% [markdown]
# How much narrower the joint intervals are, and how far apart the two estimates lie in standard deviations.

# %%
common = np.intersect1d(staged.estimated, joint.estimated)
ratio = joint.std[common] / staged.std[common]
figure, axes = plt.subplots()
axes.hist(ratio[np.isfinite(ratio)], bins=20)
axes.set(xlabel="standard deviation, joint over stepwise", ylabel="parameters")
print("median ratio of standard deviations:", np.nanmedian(ratio).round(3))
assert np.nanmedian(ratio) < 1.02
