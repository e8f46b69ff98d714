# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Diagnose your own simulator
# Any simulator is diagnosed by its predictions of a session's trials: an HDF5 file in the layout that `jf.predict` writes.
# Here the «simulator» is the fitted model with the friction of tendon T3 left out.

# %%
import tempfile
from pathlib import Path

import equinox as eqx
import matplotlib.pyplot as plt
import numpy as np

import jaxfinger as jf

session = jf.read(Path("datasets/paper-finger/session.h5"))
fit = jf.identify(session)

# %% [markdown]
# The model is an `equinox.Module`: one field is changed, and the rest stays.

# %%
tendon = session.finger.tendon_names.index("T3")
frictionless = eqx.tree_at(
    lambda m: m.tendon_friction.loss, fit.model, fit.model.tendon_friction.loss.at[tendon].set(0.0)
)
