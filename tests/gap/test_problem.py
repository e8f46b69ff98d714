"""The gap is what the nominal model misses, not what nobody recorded an experiment for."""

import numpy as np

from jaxfinger.gap.augment import nominal_fit
from jaxfinger.gap.problem import build
from jaxfinger.identify import Recipe
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.synthetic import SpecimenPlant, nominal_model, recipe_from, simulate, study_finger


def test_damping_without_its_own_experiment_is_refitted_on_driven_motion():
    specimen = study_finger()
    recipe = recipe_from(
        {
            "specimen": {"kind": "random", "joints": 1},
            "trials": {
                "experiments": ["ID.2", "ID.3-static", "ID.4", "VD.3"],
                "rate": 200.0,
                "id2": {"strokes": 2, "stroke_time": 3.0},
                "id3_static": {"step": 20.0},
                "vd3": {"repeats": 2, "motions": 2, "duration": 8.0, "centre": 0.4, "amplitude": 0.3},
            },
        }
    )
    session = simulate(recipe, seed=0, plant=SpecimenPlant(specimen))
    problem = build(session, Recipe())
    damping = [i for i, p in enumerate(describe(problem.nominal)) if p.group == "damping"]
    assert not set(damping) & set(problem.fit.estimated)  # the stages say so, and leave it at zero
    assert set(damping) <= set(problem.free)
    fit, truth = nominal_fit(problem), np.asarray(ravel(nominal_model(specimen)))
    error = np.asarray(ravel(fit.model))[damping] - truth[damping]
    assert np.all(np.abs(error) < 4.0 * fit.std[damping])
    assert np.all(truth[damping] > 3.0 * fit.std[damping])  # it shows clearly
