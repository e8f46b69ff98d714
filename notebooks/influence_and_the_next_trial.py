# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # The influence of trials, and which trial comes next
# A fit is only as good as the trials behind it. Two questions: which trial, sensor or value of CAD determines a
# parameter; and which trial would decide between causes that the recordings leave open.

# %%
from pathlib import Path

import equinox as eqx
import numpy as np

import jaxfinger as jf
from jaxfinger.effects import CATALOGUE
from jaxfinger.gap.result import Key
from jaxfinger.report import sentences
from jaxfinger.synthetic import ModelPlant, paper_finger, polynomial_finger, recipe_from, simulate, true_model

session = jf.read(Path("datasets/demo-finger/session.h5"))
fit = jf.identify(session)

# %% [markdown]
# ## Influence
# The influence is a derivative of the fit, or for a trial that is left out one step from the fit; nothing is fitted
# again. A row is a trial without which the fit is made, a sensor that reads 1 % more, or a value of CAD that is one
# standard deviation larger. The area of a square is the change of the parameter in its own standard deviations.

# %%
found = jf.sensitivity(fit, session)
jf.plot.influence(found["trials"], fit)
jf.plot.influence({kind: found[kind] for kind in ("sensors", "cad")}, fit)

# %% [markdown]
# The trial with the largest finite influence, and the change in a real refit without it.

# %%
shifts = np.nan_to_num(
    found["trials"].shifts(fit), posinf=0.0
)  # infinite where no other trial determines the parameter
k, j = np.unravel_index(np.argmax(np.abs(shifts)), shifts.shape)
trial, row = found["trials"].names[k], fit.table()[j]
rest = jf.identify(session.with_trials([t.name for t in session if t.name != trial]))
moved = {r["name"]: r["value"] for r in rest.table()}[row["name"]] - row["value"]
print(f"{row['name']} without {trial}: {moved / row['std']:+.1f} standard deviations; predicted {shifts[k, j]:+.1f}")
assert abs(moved - shifts[k, j] * row["std"]) < 0.2 * abs(moved)

# %% [markdown]
# ## The next trial
# A slip of tendon couples the PIP of a finger to its DIP. In the recordings only the PIP moves, and the other joints
# rest in one posture. The diagnosis cannot tell which neighbour the PIP is coupled to, and says so.

# %%
model = true_model(polynomial_finger(paper_finger()))
coupling = CATALOGUE["passive_tendon"].at(model.finger, ("PIP", "DIP"), kappa=0.01, rho=1.0, phi=0.0)
plant = ModelPlant(eqx.tree_at(lambda m: m.effects, model, (coupling,), is_leaf=lambda v: isinstance(v, tuple)))


def recorded(*postures):
    """A session of trials of the PIP in postures of MCP, PIP and DIP, deg."""
    trials = {"rate": 100.0, "experiments": ["ID.2", "ID.3-static", "ID.3-dynamic"]}
    trials["id2"] = {"repeats": 2, "postures": [[25, 35, 40]], "stroke_time": 2.0, "strokes": 2}
    trials["id3_static"] = {"repeats": 2, "postures": list(postures), "move": 0.4, "dwell": 0.4}
    trials["id3_dynamic"] = {"repeats": 2, "postures": list(postures), "cycles": 1}
    recipe = recipe_from({"specimen": {"kind": "polynomial"}, "cad": {"mass": 0.01, "com": 2e-4}, "trials": trials})
    whole = simulate(recipe, seed=3, plant=plant)
    return whole.with_trials([t.name for t in whole if t.joint == "PIP"])


others = tuple(set(CATALOGUE) - {"passive_tendon", "elastic_hardening", "joint_stop"})  # left out to save time
diagnosis = jf.diagnose(recorded([25, 30, 45]), without=others)
print(sentences.summary(diagnosis))

# %% [markdown]
# It names the trial that would decide, and where to hold the other joints. With that trial the cause is known.

# %%
step = diagnosis.next_experiment
assert step is not None
print(f"{step.experiment}: {sentences.next_trial(step)}")
at = {p.joint: float(np.degrees(p.low)) for p in step.postures if not p.moves}
settled = jf.diagnose(recorded([25, 30, 45], [at["MCP"], 30, at["DIP"]]), without=others)
print(sentences.summary(settled))
assert settled.named == (Key("passive_tendon", ("PIP", "DIP")),)
