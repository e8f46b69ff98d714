"""Curves are those of the model, with standard deviations from its covariance; figures are written whole."""

import re
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest

from jaxfinger.cli.tables import fit_to_read, print_fit
from jaxfinger.data import write_session
from jaxfinger.errors import UserError
from jaxfinger.identify import Fit, Recipe, StageReport
from jaxfinger.identify.fit_file import save_fit
from jaxfinger.identify.parameters import describe, ravel, with_flat
from jaxfinger.model import Finger
from jaxfinger.report.curves import curves, model_curves
from jaxfinger.report.identification import draw_identification
from jaxfinger.report.validation import draw_validation
from jaxfinger.synthetic import paper_finger, polynomial_finger, recipe_from, simulate, true_model
from tests.units import Scale

RECIPE = {
    "specimen": {"kind": "polynomial"},
    "trials": {
        "rate": 50.0,
        "experiments": ["ID.2", "ID.3-static", "ID.4", "VD.1", "VD.2"],
        "id2": {"repeats": 1, "postures": [[25, 35, 40]], "stroke_time": 2.0, "strokes": 2},
        "id3_static": {"repeats": 1, "postures": [[25, 30, 45]], "step": 20.0, "move": 0.4, "dwell": 0.5},
        "id4": {"repeats": 1, "postures": [[50, 30, 30]], "tensions": [4.0, 8.0]},
        "vd1": {"motions": 1, "duration": 5.0},
        "vd2": {"repeats": 1, "postures": [[10, 40, 35]], "tensions": [4.0, 10.0]},
    },
}


@pytest.fixture(scope="module")
def session():
    return simulate(recipe_from(RECIPE), seed=1)


@pytest.fixture(scope="module")
def fit(session) -> Fit:
    """A fit that holds the true model, with standard deviations of one per cent."""
    before = Fit.before(session, Recipe(), true_model(polynomial_finger(paper_finger())))
    groups = ("moment_arm", "elastic", "friction", "damping", "tendon_friction")
    chosen = [i for i, p in enumerate(describe(before.model)) if p.group in groups and p.determinable]
    flat = np.asarray(ravel(before.model))
    covariance = np.zeros_like(before.covariance)
    covariance[chosen, chosen] = (0.01 * flat[chosen]) ** 2
    return replace(before, covariance=covariance, estimated=np.array(chosen))


def test_curves_are_polynomials_with_their_spread(fit):
    found = curves(fit)
    names = [p.name for p in describe(fit.model)]
    value = dict(zip(names, np.asarray(ravel(fit.model)), strict=True))
    curve = found.moment_arm["T1", "PIP"]
    q = np.radians(curve.x)
    terms = np.array([1e3 * p * value[f"excursion T1 PIP^{p}"] * q ** (p - 1) for p in range(1, 5)])
    np.testing.assert_allclose(curve.y, terms.sum(axis=0), rtol=1e-9)
    np.testing.assert_allclose(curve.std, 0.01 * np.sqrt((terms**2).sum(axis=0)), rtol=1e-9)
    friction = found.joints["DIP"].friction
    terms = np.array([1e3 * value[f"friction torque DIP^{p}"] * np.radians(friction.x) ** p for p in range(3)])
    np.testing.assert_allclose(friction.y, terms.sum(axis=0), rtol=1e-9)
    np.testing.assert_allclose(friction.std, 0.01 * np.sqrt((terms**2).sum(axis=0)), rtol=1e-9)
    loss = found.tendon_friction["T3"]
    raw = value["tendon friction T3 a0"] + value["tendon friction T3 a1"] * loss.x
    np.testing.assert_allclose(loss.y, np.clip(raw, 0, loss.x), atol=1e-12)


def test_torque_and_friction_together_have_the_interval_of_their_sum(fit):
    """Of a joint that turns one way the trials show the sum of elastic torque and friction, and neither of them."""
    names = [p.name for p in describe(fit.model)]
    i, j = (names.index(f"{kind} torque MCP^0") for kind in ("elastic", "friction"))
    covariance = np.zeros_like(fit.covariance)
    covariance[np.ix_([i, j], [i, j])] = 1e-6 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    c = curves(replace(fit, covariance=covariance)).joints["MCP"]
    for curve, std in ((c.elastic, 1.0), (c.friction, 1.0), (c.forwards, 0.0), (c.backwards, 2.0)):
        np.testing.assert_allclose(curve.std, std, atol=1e-6)  # N mm
    np.testing.assert_allclose(c.forwards.y - c.backwards.y, 2.0 * c.friction.y, atol=1e-12)


def test_friction_that_differs_by_direction_moves_both_lines(fit):
    flat = np.array(ravel(fit.model))
    flat[[p.name for p in describe(fit.model)].index("friction torque by direction MCP")] = 2e-3
    c = curves(replace(fit, model=with_flat(fit.model, flat))).joints["MCP"]
    np.testing.assert_allclose((c.forwards.y + c.backwards.y) / 2.0, c.elastic.y + 2.0, rtol=1e-9)


def test_only_what_was_estimated_is_shown(fit):
    names = [p.name for p in describe(fit.model)]
    one = replace(fit, estimated=np.array([names.index("excursion T2 DIP^1")]))
    found = curves(one)
    assert list(found.moment_arm) == [("T2", "DIP")]
    assert not found.joints
    assert not found.tendon_friction


def test_figures_are_written_and_not_overwritten(fit, session, tmp_path):
    written = draw_identification(fit, session, tmp_path) + draw_validation(fit, session, tmp_path)
    assert [p.name for p in written] == [
        "moment-arms.svg",
        "joint-torque.svg",
        "tendon-friction.svg",
        "vd1.svg",
        "vd2.svg",
    ]
    for path, words in zip(
        written, (("T1", "DIP"), ("elastic",), ("tension lost (N)",), ("T4",), ("f_x",)), strict=True
    ):
        text = path.read_text()
        assert text.rstrip().endswith("</svg>")
        assert all(w in text for w in words)
    with pytest.raises(UserError, match=r"moment-arms\.svg: exists"):
        draw_identification(fit, session, tmp_path)


@pytest.mark.parametrize(("pull", "says"), [(1e-3, "at 10 mN"), (1.0, "at 10 N"), (1e3, "at 10 kN")])
def test_losses_are_said_at_the_highest_tension_that_was_measured(fit, session, pull, says, capsys):
    """And not at one that no trial of this machine comes near."""
    trials = {t.name: replace(t, tendon_force=pull * t.tendon_force) for t in session if t.tendon_force is not None}
    machine = replace(session, trials=trials)
    assert model_curves(fit, machine).tendon_friction["T3"].x[-1] == pytest.approx(10.0 * pull, rel=0.05)
    print_fit(fit_to_read(fit, machine), parameters=False)
    said = capsys.readouterr().out
    assert f"Tendon friction {says}" in said
    assert not re.search(r"± 0\.0+\s", said)


def test_curves_end_where_the_trials_of_the_fit_do(fit, session, capsys):
    """A polynomial says nothing beyond them; the limits of a joint may lie far outside."""
    wide = replace(session.finger, limits=20.0 * session.finger.limits)
    finger, seen = Finger.from_description(wide), replace(session, finger=wide)
    read = replace(
        fit,
        model=eqx.tree_at(lambda m: m.finger, fit.model, finger),
        stages=(StageReport("ID.3-dynamic", "fitted", trials=tuple(session.trials)),),
    )
    found = model_curves(read, seen)
    for i, joint in enumerate(finger.joint_names):
        arm = next(c for (_, j), c in found.moment_arm.items() if j == joint)
        for experiment, x in (("ID.3", found.joints[joint].elastic.x), ("ID.2", arm.x)):
            q = np.concatenate([t.q[:, i] for t in session.select(joint=joint) if t.experiment.startswith(experiment)])
            np.testing.assert_allclose([x[0], x[-1]], np.degrees([q.min(), q.max()]), atol=3.0)
    print_fit(fit_to_read(read, seen), parameters=False)
    (row,) = re.findall(r"^MCP +(\S+) to (\S+)° ", capsys.readouterr().out, re.M)
    np.testing.assert_allclose(np.array(row, float), found.joints["MCP"].elastic.x[[0, -1]], atol=0.5)
    outside = model_curves(replace(read, stages=()), seen).joints["MCP"].elastic.x
    np.testing.assert_allclose(outside[[0, -1]], np.degrees(wide.limits[0]))


def test_what_was_measured_lies_on_the_lines(fit, session):
    """Slopes of excursions, losses and torques, from a specimen that shares no code with the model."""
    found = curves(fit, session)
    assert found.arm_points
    for (tendon, joint), points in found.arm_points.items():
        line = found.moment_arm[tendon, joint]
        np.testing.assert_allclose(points.y, np.interp(points.x, line.x, line.y), atol=0.15)  # of up to 10 mm
    assert found.loss_points
    for tendon, points in found.loss_points.items():
        line = found.tendon_friction[tendon]
        np.testing.assert_allclose(points.y, np.interp(points.x, line.x, line.y), atol=0.25)
    ways = [(c, way, p) for c in found.joints.values() for way, p in ((1, c.flexing), (-1, c.extending)) if p]
    assert len(ways) >= 2
    for c, way, points in ways:
        curve = c.forwards if way > 0 else c.backwards
        line = np.interp(points.x, curve.x, curve.y)
        np.testing.assert_allclose(points.y, line, atol=0.6)


def test_as_many_losses_are_measured_of_a_machine_of_another_size(fit, session):
    """A machine a tenth as long and a thousandth as heavy, at the same pace."""
    scale = Scale(mass=1e-3, length=0.1)
    ours, theirs = (with_finger_of(s, fit.model) for s in (session, scale(session)))
    factors = [scale.of(p.units) for p in describe(ours)]
    its = curves(replace(fit, model=with_flat(theirs, np.asarray(ravel(ours)) * factors)), scale(session)).loss_points
    for tendon, points in curves(replace(fit, model=ours), session).loss_points.items():
        np.testing.assert_allclose(its[tendon].x, points.x * scale.force, rtol=1e-6)
        np.testing.assert_allclose(its[tendon].y, points.y * scale.force, rtol=1e-4)


def with_finger_of(session, model):
    return eqx.tree_at(lambda m: m.finger, model, Finger.from_description(session.finger))


def test_the_example_of_the_docs_runs(fit, session, tmp_path, monkeypatch):
    text = (Path(__file__).parents[2] / "docs" / "reading-the-page.md").read_text(encoding="utf-8")
    code = text.split("```python\n")[1].split("```")[0]
    write_session(session, tmp_path / "session.h5")
    save_fit(fit, tmp_path / "fit.json")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "reading-the-page.md", "exec"), {})
    assert (tmp_path / "moment-arms.png").stat().st_size > 5000
