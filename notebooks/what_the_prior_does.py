# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # What the prior does
# The torque that holds a joint is elastic torque plus gravity. Over the range of one joint the two look alike, so that
# what CAD says of the links decides how well either is known. A prior from other data does the same for everything.

# %%
from dataclasses import replace

import numpy as np

from jaxfinger.identify import identify, refine
from jaxfinger.identify.parameters import describe
from jaxfinger.synthetic import (
    SHORT,
    SpecimenPlant,
    clean_session,
    measure,
    recipe_from,
    study_finger,
)

specimen = study_finger()
recipe = recipe_from({"trials": SHORT})
clean = clean_session(recipe, SpecimenPlant(specimen), specimen.description)
session = measure(clean, 0)

# %% [markdown]
# One recording, three opinions of CAD about the link: exact, half a millimetre, five millimetres.

# %%
widths = {}
for com_std in (0.0, 5e-4, 5e-3):
    finger = replace(session.finger, mass_std=0.02 * session.finger.mass, com_std=np.full((1, 3), com_std))
    opinion = replace(session, finger=finger if com_std else session.finger)
    fit = refine(opinion, identify(opinion))
    widths[com_std] = {describe(fit.model)[i].group: fit.std[i] for i in fit.estimated[::-1]}
    print(f"CAD ±{1e3 * com_std:.1f} mm:", {k: f"{v:.1e}" for k, v in widths[com_std].items()})

# %% [markdown]
# The less CAD knows, the less is known of the elastic torque. Moment arms do not care: no weight enters ID.2.

# %%
elastic, arm = ([w[g] for w in widths.values()] for g in ("elastic", "moment_arm"))
assert elastic[0] < elastic[1] < elastic[2]
assert np.ptp(arm) < 0.05 * arm[0]

# %% [markdown]
# A second recording with the first fit as its prior: intervals shrink by √2. Refined on the first recording again,
# nothing may change, since its trials would be counted twice; the fit knows its own recording by its hash.

# %%
first = refine(session, identify(session))
again = refine(session, first)
second = refine(measure(clean, 1), replace(first, data_hash="another recording"))
free = first.estimated
print("the same recording again:", np.median(again.std[free] / first.std[free]).round(3))
print("another recording:       ", np.median(second.std[free] / first.std[free]).round(3))
assert abs(np.median(again.std[free] / first.std[free]) - 1) < 0.01
assert abs(np.median(second.std[free] / first.std[free]) - np.sqrt(0.5)) < 0.1
