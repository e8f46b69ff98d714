"""Coverage of the stated intervals over 200 sessions of a finger whose truth the nominal model can express."""

import numpy as np
import pytest

from jaxfinger.identify import fit_many, identify
from jaxfinger.identify.parameters import ravel
from jaxfinger.synthetic import (
    SpecimenPlant,
    clean_session,
    measure,
    recipe_from,
    study_finger,
    true_model,
)

pytestmark = pytest.mark.long

SESSIONS = 200
RECIPE = {
    "trials": {
        "experiments": ["ID.2", "ID.3-static", "ID.3-dynamic", "ID.4"],
        "rate": 100.0,
        "id2": {"strokes": 2, "stroke_time": 4.0},
        "id3_static": {"step": 20.0, "move": 0.4, "dwell": 0.6},
        "id3_dynamic": {"cycles": 1, "speeds": [1.0, 2.0]},
        "id4": {"tensions": [4.0, 7.0, 10.0], "dwell": 0.6},
    }
}


def test_intervals_cover_the_truth_and_estimates_are_unbiased_and_efficient():
    specimen = study_finger()
    clean = clean_session(recipe_from(RECIPE), SpecimenPlant(specimen), specimen.description)
    truth = np.asarray(ravel(true_model(specimen)))
    sessions = [measure(clean, seed) for seed in range(SESSIONS)]
    # The rig's noise is estimated on another session.
    other = measure(clean, SESSIONS)
    template = identify(other)
    members = fit_many(sessions, template, other)
    assert not members.failed.any()

    free = template.estimated
    z = (members.values - truth)[:, free] / members.std[:, free]
    coverage = np.mean(np.abs(z) < 1.96)
    assert 0.93 < coverage < 0.97
    assert np.abs(z.mean(axis=0)).max() < 4 / np.sqrt(SESSIONS)
    # The stated standard deviation is the Cramér–Rao bound of the stage under the estimated noise.
    spread = members.values[:, free].std(axis=0, ddof=1) / members.std[:, free].mean(axis=0)
    assert spread.max() < 1.2
