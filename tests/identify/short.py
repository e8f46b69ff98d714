"""A short session of a specimen whose truth the nominal model can express, and that truth as a fit."""

from functools import cache

from jaxfinger.data import Session
from jaxfinger.identify import Fit, Recipe
from jaxfinger.synthetic import nominal_model, paper_finger, polynomial_finger, recipe_from, simulate

RECIPE = recipe_from(
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


@cache
def short_session() -> Session:
    """Every experiment, a quarter of a minute each."""
    return simulate(RECIPE, seed=5)


@cache
def truth_of_short_session() -> Fit:
    """The parameters that made it."""
    return Fit.before(short_session(), Recipe(), nominal_model(polynomial_finger(paper_finger())))
