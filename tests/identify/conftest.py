"""Fixtures: sessions whose truth the nominal model can express, a staged fit and its joint refinement."""

import numpy as np
import pytest

from jaxfinger.identify import Fit, Recipe, identify, refine
from jaxfinger.identify.parameters import ravel
from jaxfinger.synthetic import (
    clean_session,
    measure,
    paper_finger,
    polynomial_finger,
    recipe_from,
    simulate,
    true_model,
)

RECIPE = {
    "specimen": {"kind": "polynomial"},
    "cad": {"mass": 0.01, "com": 2e-4},
    "trials": {
        "rate": 100.0,
        "experiments": ["ID.2", "ID.3-static", "ID.3-dynamic", "ID.4"],
        "id2": {"repeats": 2, "postures": [[25, 35, 40], [50, 55, 50]], "stroke_time": 2.0, "strokes": 2},
        "id3_static": {"repeats": 2, "postures": [[25, 30, 45], [40, 45, 30]], "move": 0.4, "dwell": 0.4},
        "id3_dynamic": {"repeats": 2, "postures": [[25, 30, 45], [40, 45, 30]], "cycles": 1},
        "id4": {"repeats": 2, "postures": [[50, 30, 30], [25, 60, 50]], "move": 0.2, "dwell": 0.4},
    },
    "sensors": {"clock_jitter": 0.0},
}
# All experiments, a quarter of a minute each.
SHORT_RECIPE = recipe_from(
    {
        "specimen": {"kind": "polynomial"},
        "trials": {
            "rate": 100.0,
            "id2": {"postures": [[25, 35, 40]], "stroke_time": 2.0, "strokes": 1, "repeats": 1},
            "id3_static": {"postures": [[25, 30, 45]], "step": 20.0, "move": 0.4, "dwell": 0.5, "repeats": 1},
            "id3_dynamic": {"postures": [[25, 30, 45]], "speeds": [1.0], "cycles": 1, "repeats": 1},
            "id4": {"postures": [[50, 30, 30]], "tensions": [4.0, 8.0], "move": 0.3, "dwell": 0.5, "repeats": 1},
            "vd1": {"motions": 1, "duration": 6.0},
            "vd2": {"postures": [[10, 40, 35]], "tensions": [4.0, 7.0, 10.0, 13.0], "dwell": 0.5, "repeats": 1},
            "vd3": {"motions": 1, "duration": 2.0, "rate": 500.0},
        },
        "sensors": {"clock_jitter": 0.0},
    }
)


@pytest.fixture(scope="session")
def clean():
    return clean_session(recipe_from(RECIPE))


@pytest.fixture(scope="session")
def session(clean):
    return measure(clean, 0)


@pytest.fixture(scope="session")
def truth():
    """Flat vector of the specimen's true parameters."""
    return np.asarray(ravel(true_model(polynomial_finger(paper_finger()))))


@pytest.fixture(scope="session")
def staged(session):
    return identify(session)


@pytest.fixture(scope="session")
def joint(session, staged):
    return refine(session, staged)


@pytest.fixture(scope="session")
def short():
    """A session of every experiment whose truth the nominal model can express."""
    return simulate(SHORT_RECIPE, seed=5)


@pytest.fixture(scope="session")
def short_truth(short):
    """True parameters of `short` as a fit."""
    return Fit.before(short, Recipe(), true_model(polynomial_finger(paper_finger())))
