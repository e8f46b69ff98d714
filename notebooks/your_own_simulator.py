# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Diagnose your own simulator
# A simulator is diagnosed by its predictions for the trials of a session: an HDF5 file in the layout that
# `jaxfinger predict` writes. Here the simulator is the fitted nominal model. Its tendons do not stretch and its joints
# have no Stribeck friction, as in most simulators of fingers.

# %%
from pathlib import Path

import jaxfinger as jf

session = jf.read(Path("datasets/demo-finger/session.h5"))
simulator = jf.identify(session).model

# %% [markdown]
# Predictions for every trial, and a diagnosis of the gap between them and the measurements.

# %%
predictions = jf.predict(simulator, session)
diagnosis = jf.diagnose(session, predictions=predictions, quick=True)
jf.plot.budget(diagnosis)
for cause in diagnosis.budget:
    print(f"{cause.effect} at {cause.sites}: probability {cause.probability:.2f}, share {cause.share:.2f}")

# %% [markdown]
# The diagnosis names the effects that the simulator lacks, and their sites.

# %%
named = {(cause.effect, site) for cause in diagnosis.budget for site in cause.sites}
assert {("tendon_stretch", ("T3",)), ("joint_stribeck", ("MCP",))} <= named
