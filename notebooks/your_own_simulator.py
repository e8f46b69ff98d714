# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Diagnose your own simulator
# Any simulator is diagnosed by its predictions of a session's trials: an HDF5 file in the layout that
# `jaxfinger predict` writes. Here the «simulator» is the fitted model with the friction of its tendons left out.

# %%
from pathlib import Path

import equinox as eqx

import jaxfinger as jf

session = jf.read(Path("datasets/demo-finger/session.h5"))
fit = jf.identify(session)

# %% [markdown]
# The model is an `equinox.Module`: one field is changed, and the rest stays.

# %%
friction = fit.model.tendon_friction
frictionless = eqx.tree_at(lambda m: m.tendon_friction, fit.model, type(friction).zeros(len(friction.constant)))

# %% [markdown]
# What it predicts of every trial, and a diagnosis of the gap between that and the measurements.

# %%
predictions = jf.predict(frictionless, session)
diagnosis = jf.diagnose(session, predictions=predictions, quick=True)
jf.plot.budget(diagnosis)
for cause in diagnosis.budget:
    print(f"{cause.effect} at {cause.sites}: probability {cause.probability:.2f}, share {cause.share:.2f}")

# %% [markdown]
# The term that it lacks is a cause like any other.

# %%
assert any(cause.effect == "tendon_friction" for cause in diagnosis.budget)
