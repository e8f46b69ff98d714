"""Every effect of the catalogue is absent at zero and differentiable there, and is written and read at every site."""

import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.effects import (
    CATALOGUE,
    CHANGED,
    NOMINAL_TERMS,
    Scales,
    from_dict,
    load,
    nominal_terms,
    own_effects,
    shape,
    to_dict,
)
from jaxfinger.errors import UserError
from jaxfinger.experiments import EXPERIMENTS, Batch, affected_channels, change, predict, refuse_broken
from jaxfinger.identify.parameters import describe, units_at
from jaxfinger.model import (
    excursion,
    external_torque,
    memories,
    resisting_change,
    simulate,
    terms_without_effects,
)
from jaxfinger.model.dynamics import resisting, terms
from jaxfinger.report.causes import first_sentence
from tests.effects.motion import MODEL, MOTIONS, SCALES, with_effects

EVERY = CATALOGUE | NOMINAL_TERMS | CHANGED
FINGER = MODEL.finger
DOCUMENT = Path(__file__).parents[2] / "docs" / "add-an-effect.md"
CHEAP = {"xla_backend_optimization_level": 0}


def plausible(kind, site, shape, size=1.0):
    return kind.at(FINGER, site, **shape, **{n: size * unit for n, unit in kind.sizes(SCALES, site).items()})


def written(effect):
    return to_dict(effect, units_at(FINGER, type(effect), effect.site))


def value_and_slope(effect, x, channels):
    """Channels, and their derivative as all amplitudes grow together, each by its plausible size.

    Nothing is jitted: the effects then share the compiled operations.
    """
    sizes = effect.sizes(SCALES, effect.site)
    amplitudes = {n: (getattr(effect, n), jnp.asarray(unit)) for n, unit in sizes.items()}

    def along(*values):
        here = eqx.tree_at(lambda e: [getattr(e, n) for n in amplitudes], effect, list(values))
        return predict(with_effects(here), x, channels)

    return jax.jvp(along, *zip(*amplitudes.values(), strict=True))


@pytest.mark.parametrize("name", EVERY)
def test_absent_at_zero_and_differentiable_there(name):
    kind = EVERY[name]
    site = kind.sites(FINGER)[0]
    shown = {c for channels in affected_channels(kind, FINGER).values() for c in channels}
    largest = 0.0
    for x, nominal in MOTIONS:
        y, slope = value_and_slope(kind.at(FINGER, site, **kind.shapes(FINGER, site, SCALES)[0]), x, tuple(nominal))
        for channel in nominal:
            np.testing.assert_allclose(y[channel], nominal[channel], rtol=1e-11, atol=1e-14, err_msg=channel)
            assert np.isfinite(slope[channel]).all(), channel
            changes = float(np.abs(slope[channel]).max())
            assert channel in shown or changes == 0.0
            largest = max(largest, changes)
    assert largest > 1e-6  # N m, m or N, at a plausible size


@pytest.mark.parametrize("name", EVERY)
def test_every_site_and_shape(name):
    kind = EVERY[name]
    sites = kind.sites(FINGER)
    assert sites
    for experiment, channels in affected_channels(kind, FINGER).items():
        assert set(channels) <= set(EXPERIMENTS[experiment].channels)
    seen = set()
    for site in sites:
        for shapes in kind.shapes(FINGER, site, SCALES):
            effect = plausible(kind, site, shapes)
            seen.add((effect.site, *effect.values().items()))
            assert set(effect.values()) == set(kind.parameters()) == set(kind.units())
            read = from_dict(FINGER, written(effect))
            assert eqx.tree_equal(read, effect)
    assert len(seen) == sum(len(kind.shapes(FINGER, s, SCALES)) for s in sites)


@pytest.mark.parametrize("name", EVERY)
def test_every_form_has_words_of_its_own(name):
    """People read them in place of the numbers of shapes that do not move."""
    kind, site = EVERY[name], EVERY[name].sites(FINGER)[0]
    chosen = [n for n, p in kind.shape_parameters().items() if p.moves == "not"]
    forms = {tuple(s[n] for n in chosen): kind.form(FINGER, s) for s in kind.shapes(FINGER, site, SCALES)}
    assert len({*map(tuple, forms.values())}) == len(forms)


@pytest.mark.parametrize("given", [dict(says=("a", "b")), dict(moves="not", says=("a",))])
def test_words_are_for_each_value_of_a_shape_that_does_not_move(given):
    with pytest.raises(ValueError, match="one text for each of its values"):
        shape("1", (0.0, 1.0), **given)


def test_no_prediction_calls_lapack():
    """Predictions run side by side, and two that call LAPACK can deadlock. One model holds all effects."""
    model = with_effects(*(plausible(kind, kind.sites(FINGER)[0], {}) for kind in EVERY.values()))
    for x, nominal in MOTIONS:
        lowered = jax.jit(lambda model, x=x, channels=tuple(nominal): predict(model, x, channels)).lower(model)
        assert "lapack" not in lowered.as_text()


@pytest.mark.parametrize("name", EVERY)
def test_what_an_effect_leaves_alone_need_not_be_computed_again(name):
    """Torque and excursion computed from known nominal terms equal those computed from scratch."""
    kind = EVERY[name]
    effect = plausible(kind, kind.sites(FINGER)[0], kind.shapes(FINGER, kind.sites(FINGER)[0], SCALES)[0])
    model = with_effects(effect)
    for x, _ in MOTIONS:
        if model.true_motion(x) is not x:
            continue
        plain = terms_without_effects(MODEL, x)
        expected = resisting(terms(model, x, memories(model, x))) - resisting(plain)
        np.testing.assert_allclose(resisting_change(model, x, plain), expected, atol=1e-14)
        np.testing.assert_allclose(external_torque(model, x, nominal=plain), external_torque(model, x), atol=1e-14)
        np.testing.assert_array_equal(excursion(model, x, excursion(MODEL, x)), excursion(model, x))


@pytest.mark.parametrize("name", EVERY)
def test_the_change_of_a_torque_is_what_predictions_differ_by(name):
    """Also where the drives lose a share of their torque."""
    kind = EVERY[name]
    effect = plausible(kind, kind.sites(FINGER)[0], kind.shapes(FINGER, kind.sites(FINGER)[0], SCALES)[0])
    losses = jnp.array([0.1, 0.3, 0.2])
    before, after = (
        eqx.tree_at(lambda m: m.joint_torque.torque_friction, m, losses) for m in (MODEL, with_effects(effect))
    )
    for x, _ in MOTIONS:
        y0, y = (predict(m, x, ("joint_torque",))["joint_torque"] for m in (before, after))
        found = change("joint_torque", effect, before, x, y0, terms_without_effects(before, x), None)
        np.testing.assert_allclose(found, y - y0, atol=1e-13)


def test_where_a_joint_slides_its_effects_have_units_of_lengths_and_forces():
    first, *others = FINGER.joint_names
    finger = replace(FINGER, prismatic=(True, *(False for _ in others)))
    coulomb = NOMINAL_TERMS["joint_coulomb"]
    assert units_at(finger, coulomb, (first,)) == {"c0": "N", "c1": "N/m", "c2": "N/m^2"}
    assert units_at(finger, coulomb, (others[0],)) == {"c0": "N m", "c1": "N m/rad", "c2": "N m/rad^2"}
    axis = replace(FINGER, prismatic=(True,) * FINGER.m)
    for kind in EVERY.values():
        for unit in units_at(axis, kind, kind.sites(axis)[0]).values():
            assert kind.ID in ("gravity_tilt", "force_sensor_rotation") or ("rad" not in unit and "N m" not in unit)
    assert set(units_at(axis, CATALOGUE["gravity_tilt"], ("base",)).values()) == {"rad"}


def test_ripple_of_a_sliding_joint_is_looked_for_by_periods_of_its_range():
    """So that the pitch of a screw is found, whatever the length is measured in."""
    slides = replace(FINGER, prismatic=(True, False, False))
    for metre in (1.0, 1e3):
        limits = ((0.0, 0.25 * metre), *FINGER.limits[1:])
        scales = Scales.of(replace(slides, limits=limits))
        p = np.array(CATALOGUE["torque_ripple"].worth_trying(scales, ("MCP",))["p"])
        assert (p.min(), p.max()) == pytest.approx((4 * 2 * np.pi / (0.25 * metre), 32 * 2 * np.pi / (0.25 * metre)))
        assert CATALOGUE["torque_ripple"].worth_trying(scales, ("PIP",))["p"][0] == 4.0


def test_the_catalogue_is_the_published_one():
    published = """joint_stribeck joint_presliding joint_load_friction elastic_hardening elastic_relaxation joint_stop
        passive_tendon tendon_stretch tendon_creep tendon_backlash moment_arm_coupling moment_arm_bowstring
        tendon_friction_capstan tendon_friction_viscous tendon_friction_presliding tendon_friction_saturating
        tendon_crosstalk payload gravity_tilt drive_inertia torque_sensor_scale torque_sensor_drift torque_ripple
        tension_sensor_scale encoder_offset encoder_eccentricity force_sensor_rotation channel_delay
        joint_offset joint_friction_asymmetric joint_torque_friction joint_friction_warmup joint_coupling
        joint_backlash"""
    assert set(CATALOGUE) == set(published.split())
    assert set(NOMINAL_TERMS) == {"joint_elastic", "joint_coulomb", "joint_damping", "tendon_friction", "gravity"}


def test_a_term_that_a_recipe_left_out_has_the_recipes_degree():
    constant = nominal_terms(0, 0)["joint_coulomb"]
    site = constant.sites(FINGER)[0]
    effect = constant.at(FINGER, site, c0=0.01)
    assert effect.values() == {"c0": pytest.approx(0.01)}
    assert from_dict(FINGER, written(effect)).values() == {"c0": pytest.approx(0.01), "c1": 0.0, "c2": 0.0}
    moving = [p for p in describe(with_effects(effect)) if p.group == "effects" and p.determinable]
    assert [p.name.split()[-1] for p in moving] == ["c0"]
    assert nominal_terms(2, 2) == NOMINAL_TERMS
    assert (
        nominal_terms(0, 1)["joint_coulomb"] is nominal_terms(2, 1)["joint_coulomb"]
    )  # One class, so that it compiles once.


def test_all_effects_together_simulate_forward():
    """With all effects in one finger its motion stays finite and differs from the nominal one."""
    effects = []
    for kind in CATALOGUE.values():
        site = kind.sites(FINGER)[-1]
        effects.append(plausible(kind, site, kind.shapes(FINGER, site, SCALES)[0], 0.5))
    T = 60
    time = jnp.arange(T, dtype=float) * 1e-3
    tension = jnp.multiply.outer(jnp.asarray(FINGER.active, float), 2.0 + 40.0 * time)
    q0 = jnp.asarray(FINGER.limits).mean(axis=1)
    run = eqx.filter_jit(simulate, compiler_options=CHEAP)
    q, qd = run(with_effects(*effects), time, tension, q0, jnp.zeros(FINGER.m))
    assert np.isfinite(q).all()
    assert np.isfinite(qd).all()
    nominal, _ = run(MODEL, time, tension, q0, jnp.zeros(FINGER.m))
    assert np.abs(q - nominal).max() > 1e-4


def test_the_documented_example_loads_and_acts(tmp_path):
    text = DOCUMENT.read_text(encoding="utf-8")
    path = tmp_path / "drag.py"
    path.write_text(text.split("```python\n")[1].split("```")[0], encoding="utf-8")
    own = load(path)
    assert set(own) == {"joint_drag"}
    effect = own["joint_drag"].at(FINGER, ("PIP",), b=3e-4)
    (x, nominal), _ = MOTIONS
    y = predict(with_effects(effect), x, tuple(nominal))
    qd = np.asarray(x.qd)
    added = np.zeros_like(qd)
    added[1] = 3e-4 * np.abs(qd[1]) * qd[1]
    np.testing.assert_allclose(y["joint_torque"] - nominal["joint_torque"], added, atol=1e-15)
    assert eqx.tree_equal(from_dict(FINGER, written(effect), own), effect)
    with pytest.raises(UserError, match="not in the catalogue"):
        from_dict(FINGER, written(effect))


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("x = 1\n", "defines no effect"),
        ("import nothing_of_that_name\n", "cannot be loaded"),
        (None, "not a Python file"),
    ],
)
def test_a_file_without_effects_is_refused(tmp_path, content, complaint):
    path = tmp_path / "mine.py"
    if content is not None:
        path.write_text(content)
    with pytest.raises(UserError, match=complaint):
        load(path)


@pytest.mark.parametrize(
    ("there", "here", "complaint"),
    [
        ('"joint_drag"', '"Joint drag"', "has the ID 'Joint drag'; use small letters"),
        ('"torque/speed/speed"', '"torque/velocity"', "'torque/velocity' is no product of scales"),
        ('"torque/speed/speed"', '"torque / speed"', "'torque / speed' is no product of scales"),  # would multiply
        ("0.01,", "-0.01,", "above zero, where -0.01 stands"),
        ('"joint"', '"joints"', r"JointDrag has the PLACE 'joints' \(did you mean 'joint'\?\)"),
        (
            '    b: Float[Array, ""] = amplitude("N m s2/rad2", 0.01, "torque/speed/speed")',
            "    b = 0.1",
            "no amplitude",
        ),
    ],
)
def test_a_mistake_in_the_documented_example_is_said(tmp_path, there, here, complaint):
    code = DOCUMENT.read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]
    assert there in code
    path = tmp_path / "drag.py"
    path.write_text(code.replace(there, here), encoding="utf-8")
    with pytest.raises(UserError, match=complaint):
        load(path)


DRAG = DOCUMENT.read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]


@pytest.mark.parametrize(
    ("copy", "complaint"),
    [
        (DRAG.replace("JointDrag", "Other"), 'JointDrag and Other have the same ID joint_drag; give each its own'),
        ("class Other(JointDrag):\n    pass\n", "Other has no ID of its own and would be passed over; give it one"),
    ],
)  # fmt: skip
def test_a_second_effect_is_not_passed_over(tmp_path, copy, complaint):
    path = tmp_path / "drag.py"
    path.write_text(f"{DRAG}\n{copy}")
    with pytest.raises(UserError, match=complaint):
        load(path)


@pytest.mark.parametrize("name", CATALOGUE)
def test_other_values_make_the_effect_that_has_them(name):
    """Whether an effect has them from the start or afterwards, in arrays of NumPy."""
    kind = CATALOGUE[name]
    site = kind.sites(FINGER)[-1]
    there, values = kind.at(FINGER, site), dict.fromkeys(kind.parameters(), 0.25)
    found, expected = there.with_values(**values), kind.at(FINGER, site, **values)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert isinstance(a, np.ndarray)
        np.testing.assert_array_equal(a, b)


def test_an_unknown_parameter_is_refused():
    with pytest.raises(TypeError, match="no parameter"):
        CATALOGUE["payload"].at(FINGER, ("MCP",), weight=1.0)


@pytest.mark.parametrize("name", EVERY)
def test_every_effect_says_what_happens_what_it_looks_like_and_what_to_change(name):
    kind = EVERY[name]
    said = [kind.HAPPENS, kind.LOOKS, kind.CHANGE, kind.__doc__]
    assert all(len(text.split()) > 4 for text in said)
    assert len(set(said)) == 4


def test_the_same_machine_in_other_units_has_the_same_catalogue():
    """Scales follow units: here masses and torques times 0.001, lengths times 10, times times 2."""
    x, y = MOTIONS[0]
    force = 1e-3 / 10.0
    unit = {"mass": 1e-3, "torque": 1e-3, "length": 10.0, "time": 2.0}
    other = replace(
        x,
        time=2.0 * x.time,
        session_time=2.0 * x.session_time,
        qd=x.qd / 2.0,
        qdd=x.qdd / 4.0,
        tension=force * x.tension,
    )
    torques = {"joint_torque": 1e-3 * y["joint_torque"], "tendon_excursion": 10.0 * y["tendon_excursion"]}
    lengths = {n: 10.0 * getattr(FINGER, n) for n in ("origin", "com", "fingertip")}
    finger = replace(FINGER, mass=1e-3 * FINGER.mass, **lengths)
    ones = jax.tree.map(jnp.ones_like, torques)
    before, after = Scales.of(FINGER, [Batch(x, y, ones)]), Scales.of(finger, [Batch(other, torques, ones)])
    exponents = {
        "torque": {"torque": 1}, "angle": {}, "turn": {}, "mass": {"mass": 1},
        "speed": {"time": -1}, "acceleration": {"time": -2},
        "tension": {"torque": 1, "length": -1}, "excursion": {"length": 1}, "pull": {"length": 1, "time": -1},
        "length": {"length": 1}, "trial": {"time": 1}, "session": {"time": 1},
    }  # fmt: skip
    for name, powers in exponents.items():
        factor = np.prod([unit[u] ** p for u, p in powers.items()])
        np.testing.assert_allclose(getattr(after, name), factor * getattr(before, name), rtol=1e-12, err_msg=name)


def test_a_joint_that_stiffens_at_both_ends_does_so_alike():
    """Its torque is that of a spring at each end: it is odd about the middle of the range, and resists either way."""
    kind, site = CATALOGUE["elastic_hardening"], FINGER.joint_names[:1]
    low, high = np.asarray(FINGER.limits[0])
    q = jnp.linspace(low, high, 9)
    x = SimpleNamespace(q=q[None])
    torque = {
        end: np.asarray(kind.at(FINGER, site, tau_end=0.1, width=0.2, end=end).torque(x, None, jnp.zeros((1, 9)))[0])
        for end in (1.0, -1.0, 0.0)
    }
    np.testing.assert_allclose(torque[0.0], torque[1.0] + torque[-1.0], rtol=1e-12)
    np.testing.assert_allclose(torque[0.0], -torque[0.0][::-1], atol=1e-15)
    np.testing.assert_allclose([torque[1.0][-1], torque[-1.0][0]], [0.1, -0.1], rtol=1e-12)
    assert np.all(np.diff(torque[0.0]) > 0.0)


def test_a_scale_is_a_product_at_its_site():
    first, second = FINGER.joint_names[:2]
    assert SCALES("torque/speed", (first,)) == pytest.approx(SCALES.torque[0] / SCALES.speed[0])
    assert SCALES("1/tension", (FINGER.tendon_names[1],)) == pytest.approx(1.0 / SCALES.tension[1])
    assert SCALES("torque", (first, second)) == pytest.approx(SCALES.torque[:2].min())
    assert SCALES("torque", ("base",)) == pytest.approx(SCALES.torque.max())
    assert SCALES("1", (first,)) == 1.0


@pytest.mark.parametrize("name", ["payload", "changed_mass", "changed_com"])
@pytest.mark.parametrize("end", [0, 1])
def test_an_effect_on_a_link_leaves_it_a_body_at_all_that_its_bounds_allow(name, end):
    """Its mass stays positive, and no moment of inertia exceeds the sum of the other two (triangle inequality)."""
    kind, site = EVERY[name], FINGER.joint_names[1:2]
    for shapes in kind.shapes(FINGER, site, SCALES):
        effect = plausible(kind, site, shapes, 50.0)
        most = {n: ends[end] for n, ends in effect.bounds(SCALES).items() if np.isfinite(ends[end])}
        finger = replace(effect, **{n: jnp.asarray(v) for n, v in most.items()}).finger(FINGER)
        assert finger.mass[1] > 0.0
        moments = np.linalg.eigvalsh(finger.gyration[1])
        assert moments[2] <= moments[:2].sum() * (1.0 + 1e-9)


@pytest.mark.parametrize(
    ("right", "wrong", "complaint"),
    [
        ('"joint_drag"', '"joint_stop"', "which the catalogue has"),
        ("    CHANGE:", "    ALTER:", "JointDrag has no CHANGE"),
        ("def torque", "def torqe", r"changes no channel at any size.*did you mean 'torque'"),
        ("jnp.abs(x.qd[i])", "jnp.abs(x.speed[i])", r"drag.py, line \d+: joint_drag fails in a prediction: .*speed"),
        ('"joint"', '"knuckle"', r"drag.py, line \d+: joint_drag fails in a prediction"),
    ],
)
def test_an_effect_that_cannot_work_is_refused_in_a_sentence(tmp_path, right, wrong, complaint):
    path = tmp_path / "drag.py"
    assert right in DRAG
    path.write_text(DRAG.replace(right, wrong, 1))
    with pytest.raises(UserError, match=complaint):
        refuse_broken(next(iter(load(path).values())), FINGER)


def test_classes_are_checked_as_a_file_is(tmp_path):
    path = tmp_path / "drag.py"
    path.write_text(DRAG)
    (drag,) = load(path).values()
    assert own_effects(path).keys() == own_effects({"joint_drag": drag}).keys() == {"joint_drag"}
    assert own_effects(None) == {}
    with pytest.raises(UserError, match="JointDrag has the ID joint_drag, not drag"):
        own_effects({"drag": drag})
    with pytest.raises(UserError, match="which the catalogue has"):
        own_effects({"joint_damping": type("Mine", (drag,), {"ID": "joint_damping"})})


def test_an_effect_that_was_typed_into_a_notebook_is_refused_in_a_sentence(tmp_path, monkeypatch):
    """Its module has no file."""
    path = tmp_path / "drag.py"
    path.write_text(DRAG.replace("jnp.abs", "jnp.nothing"))
    (drag,) = load(path).values()
    monkeypatch.setattr(drag, "__module__", "__main__")
    monkeypatch.setitem(sys.modules, "__main__", ModuleType("__main__"))
    with pytest.raises(UserError, match="__main__: joint_drag fails in a prediction"):
        refuse_broken(drag, FINGER)


# Letters that stand for these names in a formula.
LETTERS = {"mu": "μ", "epsilon": "ε", "kappa": "κ", "rho": "ρ", "phi": "φ", "tau": "τ", "tau_end": "τ_end"}
LETTERS |= {"delta": "δ", "x0": "x₀", "f0": "f₀"}


@pytest.mark.parametrize("kind", CATALOGUE.values(), ids=CATALOGUE)
def test_the_formula_of_an_effect_names_its_parameters(kind):
    """The page prints formula and values together, so that a reader must find each value's place in the formula."""
    moves = [n for n, p in kind.shape_parameters().items() if p.moves != "not"]
    symbols = [LETTERS.get(n, n) for n in (*kind.amplitudes(), *moves)]
    formula = first_sentence(kind)
    assert [s for s in symbols if not re.search(rf"(?<![a-z]){re.escape(s)}(?![a-z])", formula)] == []
