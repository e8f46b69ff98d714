"""Values that JSON cannot hold become ones that it can."""

import json
from pathlib import Path

import numpy as np

from jaxfinger.jsonable import jsonable


def test_numbers_that_are_not_finite_are_null_at_any_depth():
    value = {"std": [np.inf, (1.0, -np.inf)], Path("a.h5"): {"seen": np.float64("nan"), "n": 3, "file": Path("b.h5")}}
    text = json.dumps(jsonable(value), allow_nan=False)
    assert json.loads(text) == {"std": [None, [1.0, None]], "a.h5": {"seen": None, "n": 3, "file": "b.h5"}}
