"""A session whose truth the nominal model can express, its staged fit and its joint refinement, made once."""

import numpy as np
import pytest

from jaxfinger.identify import identify, refine
from jaxfinger.identify.parameters import ravel
from jaxfinger.synthetic import clean_session, measure, nominal_model, paper_finger, polynomial_finger, recipe_from

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


@pytest.fixture(scope="session")
def clean():
    return clean_session(recipe_from(RECIPE))


@pytest.fixture(scope="session")
def session(clean):
    return measure(clean, 0)


@pytest.fixture(scope="session")
def truth():
    """The flat vector of the specimen's own parameters."""
    return np.asarray(ravel(nominal_model(polynomial_finger(paper_finger()))))


@pytest.fixture(scope="session")
def staged(session):
    return identify(session)


@pytest.fixture(scope="session")
def joint(session, staged):
    return refine(session, staged)
