"""A session compared with an earlier fit of the same finger: what has changed is named, and nothing else."""

from dataclasses import replace

import pytest

from jaxfinger.effects import CATALOGUE, CHANGED
from jaxfinger.errors import UserError
from jaxfinger.gap import Status, diagnose
from jaxfinger.gap.result import Key
from jaxfinger.identify import Recipe, identify
from jaxfinger.report.gap_json import as_gap_json
from jaxfinger.report.sentences import summary

from .conftest import PLANTED, RIVALS, TRUTH, session_with

WITHOUT = tuple(sorted(set(CATALOGUE) - {*RIVALS, "payload", "joint_friction_asymmetric"}))

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def earlier():
    return identify(session_with(seed=5))


def changed(effect, *site, **by):
    return CHANGED[effect], site, by


def beside(earlier, *effects):
    return diagnose(session_with(*effects, seed=8), without=WITHOUT, quick=True, against=earlier)


def values(cause):
    return {v.name: v for v in cause.values}


def test_nothing_has_changed(earlier):
    found = beside(earlier)
    assert found.status is Status.NO_GAP
    assert found.none > 0.9
    assert not found.changes
    tried = {CHANGED[c.key.effect].GROUP for c in found.candidates if c.key.effect in CHANGED}
    assert tried == {"elastic", "friction", "damping", "moment_arm", "mass", "com"}  # no trial of tendon friction


@pytest.mark.parametrize(
    ("truth", "group"),
    [
        (changed("changed_pretension", "PIP", tau=1e-3), "elastic"),
        (changed("changed_friction_level", "PIP", c0=1e-3), "friction"),
        (changed("changed_mass", "DIP", m=1e-3), "mass"),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_one_parameter_has_changed(earlier, truth, group):
    """The change is named with the parameter's value before and now."""
    found = beside(earlier, truth)
    assert found.status is Status.EXPLAINED
    assert found.named == (Key(truth[0].ID, truth[1]),)
    (by,) = truth[2].values()
    (cause,) = found.budget
    (value,) = cause.values
    assert value.value == pytest.approx(by, abs=4.0 * value.std)
    assert value.std < 0.1 * by
    (change,) = found.changes
    assert (change.group, change.probability) == (group, cause.probability)
    assert change.before_std > 0.0
    assert change.after - change.before == pytest.approx(by, abs=4.0 * value.std)
    assert change.name.lower() in summary(found).lower()


def test_an_effect_came_and_a_parameter_changed(earlier):
    """Both are named, each with its value, and `gap.json` holds them."""
    found = beside(earlier, PLANTED, changed("changed_damping", "MCP", d=3e-4))
    assert found.status is Status.EXPLAINED
    assert set(found.named) == {Key(*TRUTH), Key("changed_damping", ("MCP",))}
    by = {c.effect: values(c) for c in found.budget}
    assert by["joint_presliding"]["x0"].value == pytest.approx(0.1, rel=0.2)
    d = by["changed_damping"]["d"]
    assert d.value == pytest.approx(3e-4, abs=4.0 * d.std)
    assert [x.name for x in found.changes] == ["damping MCP"]
    written = as_gap_json(replace(found, against="a-fit.json"))
    assert written["schema"] == "jaxfinger-gap/2"
    assert written["against"] == "a-fit.json"
    damping = next(line for line in written["budget"] if line["effect"] == "changed_damping")
    assert damping["site"] == ["MCP"]
    assert damping["parameters"]["d"]["units"] == "N m s/rad"


def test_a_fit_that_cannot_be_compared_with_is_refused(earlier):
    session = replace(session_with(seed=8), file="b.h5")
    with_effect = earlier.with_effect(CATALOGUE["joint_presliding"].at(earlier.model.finger, ("PIP",)), ())
    with pytest.raises(UserError, match=r"b\.h5: the fit to compare it with holds effects"):
        diagnose(session, against=with_effect)
    other = replace(session, finger=replace(session.finger, joint_names=("A", "B", "C")))
    with pytest.raises(UserError, match=r"b\.h5: is of another finger than the fit"):
        diagnose(other, against=earlier)
    with pytest.raises(UserError, match="brings its own recipe"):
        diagnose(session, Recipe(name="mine"), against=earlier)
