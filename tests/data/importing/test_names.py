"""What names of columns say: channel, joint or tendon, and units, also of columns that only words tell apart."""

import numpy as np
import pytest

from jaxfinger.data.importing.proposal import proposal
from jaxfinger.data.importing.recording import Recording, Variable
from jaxfinger.data.importing.survey import clocks_of, columns_of
from tests.data.conftest import make_finger

TIME = np.arange(1000) / 100.0
MOVED = 0.5 - 0.5 * np.cos(TIME)


def recording(tmp_path, columns, units=()):
    variables = {
        name: Variable(np.asarray(x, np.float64), units=dict(units).get(name, "")) for name, x in columns.items()
    }
    return Recording(tmp_path / "log.npz", variables)


def seen(tmp_path, columns, units=(), **names):
    return {s.name: (s.meaning, s.units) for s in columns_of(recording(tmp_path, columns, units), **names)}


@pytest.mark.parametrize(
    ("columns", "joints", "units"),
    [
        ({"mcp_angle": 80.0, "pip_angle": 60.0, "dip_angle": 5.0}, (), ["deg", "deg", "deg"]),
        ({"knuckleAngle": 80.0, "middleAngle": 60.0, "endAngle": 5.0}, (), ["deg", "deg", "deg"]),
        ({"knuckle_angle": 80.0, "end_angle": 5.0}, ("knuckle", "end"), ["deg", "deg"]),
        ({"knuckle_angle": 80.0, "end_angle": 5.0}, (), ["", ""]),
        ({"tau_raw": 900.0, "tau_bridge": 0.4}, (), ["", ""]),
        ({"angle": 80.0, "theta": 5.0}, (), ["deg", "rad"]),
    ],
    ids=["words", "capitals", "known joints", "half of them", "raw", "no word in common"],
)
def test_columns_that_one_word_tells_apart_have_one_unit(tmp_path, columns, joints, units):
    """A joint that is held at 5 degrees beside one at 80 is not at 5 rad; raw values may have a unit of their own."""
    found = seen(tmp_path, {name: size * MOVED for name, size in columns.items()}, joints=joints)
    assert [unit for _, unit in found.values()] == units


@pytest.mark.parametrize(
    ("name", "channel"),
    [
        ("log.q.knuckle", "q"), ("log.F.flexor", "tendon_force"), ("log.tau.knuckle", "joint_torque"),
        ("L_flexor", "tendon_excursion"), ("flexor len", "tendon_excursion"), ("speed.knuckle", ""), ("v_knuckle", ""),
        ("q_des.knuckle", ""), ("dQ", ""), ("pose.position.x", ""), ("force_x", "fingertip_force"),
        ("Kraft Fz", "fingertip_force"), ("f_x", "fingertip_force"), ("force", "tendon_force"), ("t flexor", ""),
    ],
)  # fmt: skip
def test_the_words_beside_or_before_a_joint_or_tendon_say_the_channel(tmp_path, name, channel):
    found = seen(tmp_path, {"enc": MOVED, name: 0.1 * TIME}, joints=("knuckle", "end"), tendons=("flexor", "extensor"))
    assert found[name][0] == channel


def test_a_joints_name_alone_is_its_angle_where_no_other_column_is(tmp_path):
    columns = {"time": TIME, "MCP": 80.0 * MOVED, "PIP": 5.0 * MOVED}
    assert [seen(tmp_path, columns)[name] for name in ("MCP", "PIP")] == [("q", "deg"), ("q", "deg")]
    said = proposal([recording(tmp_path, columns)], make_finger())
    assert 'channels.q.PIP = { from = "PIP", units = "deg" }' in said
    assert seen(tmp_path, columns | {"angle 1": MOVED})["MCP"] == ("", "")
    assert seen(tmp_path, columns, {"MCP": "rad/s"})["MCP"] == ("", "")
    assert seen(tmp_path, columns, joints=("knuckle",))["MCP"] == ("", "")


def test_a_force_in_g_or_kg_is_a_weight_and_an_acceleration_in_g_is_none(tmp_path):
    units = {"T1": "kg", "tension 2": "g", "acc_x": "g"}
    found = seen(tmp_path, dict.fromkeys(units, MOVED), units, tendons=("T1", "T2"))
    assert list(found.values()) == [("tendon_force", "kgf"), ("tendon_force", "gf"), ("", "")]


@pytest.mark.parametrize(
    ("name", "stated", "values", "units"),
    [
        ("epoch", "", 1.7698608e12 + 1e3 * TIME, "ms"),
        ("elapsed", "s", TIME, "s"),
        ("run [ms]", "ms", 1e3 * TIME, "ms"),
        ("time", "min", TIME / 60.0, "min"),
    ],
)
def test_a_clock_shows_by_its_units_where_no_name_says_so(tmp_path, name, stated, values, units):
    log = recording(tmp_path, {"enc": MOVED, name: values}, {name: stated})
    (clock,) = clocks_of(log, columns_of(log))
    assert (clock.name, clock.units, clock.rate) == (name, units, pytest.approx(100.0, rel=1e-3))
    late = recording(
        tmp_path, {"enc": MOVED, "latency": np.random.default_rng(0).uniform(size=1000)}, {"latency": "ms"}
    )
    assert clocks_of(late, columns_of(late)) == []
    assert seen(tmp_path, {"F_min": MOVED})["F_min"] == ("tendon_force", "")


@pytest.mark.parametrize(
    ("name", "channel"),
    [
        ("millis", "time"),
        ("Temps", "time"),
        ("Zeit", "time"),
        ("时间", "time"),
        ("ángulo", "q"),
        ("角度", "q"),
        ("Couple", "joint_torque"),
        ("トルク", "joint_torque"),
        ("Seilkraft", "tendon_force"),
    ],
)
def test_names_may_be_in_other_languages(tmp_path, name, channel):
    assert seen(tmp_path, {name: TIME})[name][0] == channel
