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
# refinement reads all trials at once. Here both see the same simulated sessions, whose truth is known.

# %%
import numpy as np

from jaxfinger.identify import identify, refine
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.synthetic import (
    SHORT,
    SpecimenPlant,
    clean_session,
    measure,
    nominal_model,
    recipe_from,
    study_finger,
)

specimen = study_finger()
recipe = recipe_from(
    {
        "cad": {"mass": 0.05, "com": 2e-3},  # a finger that was measured badly
        "trials": SHORT,
    }
)
clean = clean_session(recipe, SpecimenPlant(specimen), specimen.description)
truth = np.asarray(ravel(nominal_model(specimen)))

# %% [markdown]
# Ten sessions: new noise, new offsets, new errors of CAD each time.

# %%
errors, stated = {"stepwise": [], "joint": []}, {"stepwise": [], "joint": []}
for seed in range(10):
    session = measure(clean, seed)
    staged = identify(session)
    for name, fit in (("stepwise", staged), ("joint", refine(session, staged))):
        errors[name].append((np.asarray(ravel(fit.model)) - truth)[staged.estimated])
        stated[name].append(fit.std[staged.estimated])
errors = {k: np.array(v) for k, v in errors.items()}
stated = {k: np.array(v) for k, v in stated.items()}

# %% [markdown]
# Root mean square of the error over the stated standard deviation of the stepwise fit: 1 is what stepwise promises.
# Joint can only gain where stages share something, the links' weight above all: elastic torque and gravity are told
# apart by CAD, and the trials of ID.3 and ID.4 in other postures add to what CAD knows.

# %%
names = [describe(staged.model)[i].name for i in staged.estimated]
scale = np.mean(stated["stepwise"], axis=0)
print(f"{'parameter':28}" + "".join(f"{f'{k} {w}':>17}" for k in errors for w in ("bias", "RMS")))
for i, name in enumerate(names):
    row = [f(errors[k][:, i] / scale[i]) for k in errors for f in (np.mean, lambda e: np.sqrt(np.mean(e**2)))]
    print(f"{name:28}" + "".join(f"{v:17.2f}" for v in row))

# %% [markdown]
# The intervals: joint ones are never wider, and both hold what they promise.

# %%
narrower = np.mean(stated["joint"], axis=0) / scale
z = {k: errors[k] / stated[k] for k in errors}
print("median ratio of stated standard deviations, joint over stepwise:", np.median(narrower).round(3))
for k, values in z.items():
    print(f"{k}: {np.mean(np.abs(values) < 1.96):.1%} of the 95 % intervals hold the truth")
assert narrower.max() < 1.05
assert all(np.sqrt(np.mean(v**2)) < 1.5 for v in z.values())
