"""The closed form that is proposed for what no cause explains."""

import numpy as np
import pytest

from jaxfinger.gap.columns import Columns
from jaxfinger.gap.formula import Weights
from jaxfinger.gap.projector import Projector
from jaxfinger.gap.propose import _library_rows, propose
from jaxfinger.gap.smooth_laws import SmoothPart


@pytest.mark.parametrize(("rough", "low", "high"), [(0.0, 0.85, 1.0), (2.0, 0.3, 0.6)])
def test_its_share_is_that_of_all_that_is_left_and_not_of_what_smooth_laws_explain(planted, rough, low, high):
    """Half of the energy beyond the noise is a law; the rough rest has no law, and smooth laws explain none of it."""
    columns = Columns.of(planted)
    project = Projector(planted, columns, Weights.plain(columns))
    names, rows, there = _library_rows(planted, "joint_torque", 0)
    name = planted.session.finger.joint_names[0]
    law = project(rows)[names.index(f"sin(6 q_{name})")][: there.size] * there
    law *= np.sqrt(there.sum() * rough**2 if rough else 100.0 * there.sum()) / np.linalg.norm(law)
    residual = law + np.random.default_rng(1).normal(0.0, np.hypot(1.0, rough), there.size) * there
    smooth = float(law @ law)
    found = propose(planted, project, residual, [SmoothPart("ID.3-dynamic", "joint_torque", 0, smooth, {})])
    assert found is not None
    assert low < found.share <= high


def test_a_term_that_changes_nothing_is_passed_over(planted, monkeypatch):
    """As one of tension where the tendons are slack: its gain would be zero by zero."""
    project = Projector(planted, columns := Columns.of(planted), Weights.plain(columns))
    names, rows, there = _library_rows(planted, "joint_torque", 0)
    more = [*names, "nothing"], np.vstack([rows, np.zeros(there.size)]), there
    monkeypatch.setattr("jaxfinger.gap.propose._library_rows", lambda *of: more)
    residual = np.random.default_rng(2).standard_normal(there.size)
    with np.errstate(all="raise", under="ignore"):
        found = propose(planted, project, residual, [SmoothPart("ID.3-dynamic", "joint_torque", 0, 1.0, {})])
    assert found is None or "nothing" not in [name for _, name in found.terms]
