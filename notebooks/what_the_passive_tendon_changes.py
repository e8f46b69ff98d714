# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # What the passive tendon changes
# T5 of the paper's finger runs over PIP and DIP, has no motor, and pulls only where the PIP is flexed much more than
# the DIP. The nominal model has no place for it: elastic torque depends on one joint's own angle.

# %%
import numpy as np

from jaxfinger.effects import CATALOGUE
from jaxfinger.identify import identify, refine
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.synthetic import clean_session, measure, recipe_from

recipe = recipe_from(
    {
        "specimen": {"kind": "paper", "passive_tendon": True},
        "trials": {
            "experiments": ["ID.3-static", "ID.3-dynamic"],
            "rate": 200.0,
            "id3_static": {"postures": [[30, 30, 10], [30, 70, 40]]},
            "id3_dynamic": {"cycles": 1, "speeds": [1.0]},
        },
    }
)
session = measure(clean_session(recipe), 0)
nominal = refine(session, identify(session))
print(f"χ² a row without it: {nominal.stages[-1].chi2_per_row:.2f}")

# %% [markdown]
# A ruler gives the tendon's path: moment arms of −4 mm at the PIP and 5 mm at the DIP, 3 mm of slack at zero. So
# ρ = 1.25, φ = 0.75 rad, and only the stiffness κ = k r² is left to find.

# %%
tendon = CATALOGUE["passive_tendon"].at(nominal.model.finger, ("PIP", "DIP"), kappa=0.0, rho=1.25, phi=0.75)
passive = refine(session, nominal.with_effect(tendon, free=("kappa",)))
index = next(i for i, p in enumerate(describe(passive.model)) if p.name.endswith("kappa"))
kappa, std = float(ravel(passive.model)[index]), float(passive.std[index])
print(f"χ² a row with it: {passive.stages[-1].chi2_per_row:.2f}")
print(f"κ = {kappa:.4f} ± {std:.4f} N m/rad; the specimen has {1500 * 4e-3**2:.4f}")

# %% [markdown]
# What it changes in the rest: the elastic torque of PIP and DIP no longer bends to stand in for it.

# %%
q = np.deg2rad(np.array([[30.0] * 8, [70.0] * 8, np.linspace(5, 75, 8)]))
for name, fit in (("nominal", nominal), ("with the tendon", passive)):
    torque = 1e3 * np.asarray(fit.model.joint_torque.elastic_torque(q))[2]
    print(f"{name:16} elastic torque of the DIP, N mm:", torque.round(1))
assert passive.stages[-1].chi2_per_row < 0.8 * nominal.stages[-1].chi2_per_row
assert abs(kappa / (1500 * 4e-3**2) - 1) < 0.1
