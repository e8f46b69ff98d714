"""Session files: written values are read back, and no file is overwritten or left half written."""

from dataclasses import fields, replace

import h5py
import numpy as np
import pytest

from jaxfinger.data import check_file, data_hash, read_predictions, read_session, write_predictions, write_session
from jaxfinger.data.findings import Report
from jaxfinger.data.schema import channel_units
from jaxfinger.errors import UserError


def assert_same(a, b):
    for field in fields(a):
        if field.name in ("trials", "file", "finger"):
            continue
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            np.testing.assert_array_equal(x, y)
        else:
            assert x == y, field.name


@pytest.fixture
def file(session, tmp_path):
    path = tmp_path / "session.h5"
    write_session(session, path)
    return path


def test_round_trip_is_exact(session, file):
    back = read_session(file)
    assert_same(back, session)
    assert_same(back.finger, session.finger)
    assert list(back.trials) == list(session.trials)
    for trial in session:
        assert_same(back[trial.name], trial)
    assert back.file == str(file)


def test_a_good_file_has_no_fault(file):
    assert [f for f in check_file(file) if f.severity != "note"] == []


def test_the_format_to_the_letter(file):
    with h5py.File(file) as opened:
        assert opened.attrs["format"] == "jaxfinger-dataset"
        assert opened.attrs["format_version"] == "1.1"
        units = {"q": "rad", "tendon_force": "N", "tendon_excursion": "m", "joint_torque": "N m", "hold": "1"}
        trial = opened["trials/04-ID.4-T1-MCP"]
        assert {name: trial[name].attrs["units"] for name in units} == units
        assert trial["time"].attrs["units"] == "s"
        assert trial["time"].dtype == np.float64
        assert opened["finger/links/inertia"].attrs["units"] == "kg m2"
        assert opened["finger/tendons/active"].dtype == bool
        assert trial.attrs["complete"].dtype == bool
        assert opened["finger/joints/rotor_inertia"].attrs["units"] == "kg m2"
        assert opened["finger/tendons/excursion"].attrs["units"] == "m/rad^p"
        warm = opened["trials/07-VD.3/temperature"]
        assert (warm.attrs["units"], list(warm.attrs["names"])) == ("K", ["motor T1", "motor T2"])
        assert "joint" not in opened["trials/08-ID.3-dynamic"].attrs
        # MATLAB before R2021b reads superblock 0 and object headers of version 1 only.
        assert opened.id.get_create_plist().get_version()[0] == 0


def test_named_trials_only(file):
    assert list(read_session(file, ["07-VD.3", "01-ID.2-MCP"]).trials) == ["01-ID.2-MCP", "07-VD.3"]
    with pytest.raises(UserError, match=r"no trial '99'; there are 01-ID"):
        read_session(file, ["99"])


def test_nothing_is_overwritten_unless_asked(session, file):
    before = data_hash(file)
    with pytest.raises(UserError, match="exists already"):
        write_session(session, file)
    assert data_hash(file) == before
    write_session(replace(session, specimen="other"), file, overwrite=True)
    assert read_session(file).specimen == "other"


def test_a_failed_write_leaves_the_old_file_and_no_litter(session, file):
    before = data_hash(file)
    bad = replace(session["07-VD.3"])
    object.__setattr__(bad, "tendon_force", np.zeros((3, 3)))  # The tests' type checks refuse it in the constructor.
    with pytest.raises(UserError, match=r"/trials/07-VD.3/tendon_force: has shape \(3, 3\); it must be \(900, 3\)"):
        write_session(replace(session, trials={bad.name: bad}), file, overwrite=True)
    with pytest.raises(UserError, match="is no channel"):
        write_predictions(file, session, {"07-VD.3": {"qq": np.zeros(900)}}, overwrite=True)
    assert data_hash(file) == before
    assert [p.name for p in file.parent.iterdir()] == [file.name]
    with pytest.raises(UserError, match="cannot be written"):
        write_session(session, file.parent / "nowhere" / "x.h5")


def test_order_of_the_session(session, tmp_path):
    late = replace(session["01-ID.2-MCP"], session_start=100.0)
    early = replace(session["07-VD.3"], session_start=3.0)
    write_session(replace(session, trials={t.name: t for t in (late, early)}), tmp_path / "a.h5")
    assert list(read_session(tmp_path / "a.h5").trials) == ["07-VD.3", "01-ID.2-MCP"]


def test_what_other_writers_do_is_read(session, file):
    """Other writers store strings as bytes, use float32, add groups and attributes, and leave optional parts out."""
    with h5py.File(file, "r+") as opened:
        opened.attrs["specimen"] = np.bytes_("fingers")
        opened.attrs["made_with"] = "something"
        opened.create_group("video/frames")
        trial = opened["trials/07-VD.3"]
        del trial["temperature"]
        trial["temperature"] = np.zeros(3)  # In version 1.0 the name has no meaning.
        opened.attrs["format_version"] = "1.0"
        single = trial["q"][()].astype(np.float32)
        del trial["q"]
        trial["q"] = single
        trial["q"].attrs["units"] = np.bytes_("rad")
        trial.attrs["experiment"] = np.array(["VD.3"], dtype=h5py.string_dtype())
        del opened["finger/links/mass_std"]
        names = opened["finger/tendons/name"][()]
        del opened["finger/tendons/name"]
        opened["finger/tendons/name"] = np.array(names, dtype="S4")
        active = opened["finger/tendons/active"][()]
        del opened["finger/tendons/active"]
        opened["finger/tendons/active"] = active.astype(np.uint8)
    back = read_session(file)
    assert back.specimen == "fingers"
    assert back["07-VD.3"].q.dtype == np.float64
    assert back.finger.mass_std is None
    assert back["07-VD.3"].temperature is None
    assert back.finger.tendon_names == session.finger.tendon_names
    np.testing.assert_array_equal(back.finger.active, session.finger.active)


def test_a_prismatic_axis_has_units_of_length_and_force(session, tmp_path):
    count = 200
    time = np.arange(count) / 100
    finger = replace(
        session.finger,
        **{
            name: getattr(session.finger, name)[:1]
            for name in ("axis", "origin", "limits", "rotor_inertia", "rotor_inertia_std", "mass", "com", "inertia")
        },
        joint_names=("axis",),
        tendon_names=(),
        active=np.zeros(0, bool),
        crosses=np.zeros((0, 1), bool),
        prismatic=(True,),
        mass_std=None,
        excursion=None,
        excursion_std=None,
    )
    sweep = 0.1 * np.sin(time)[:, None]
    trial = replace(
        session["03-ID.3-dynamic-MCP"], time=time, q=sweep, joint_torque=500 * sweep, joint="axis", tendon_force=None
    )
    free = replace(trial, name="free", experiment="VD.3", joint=None, tendon_force=np.zeros((count, 0)))
    trials = {t.name: t for t in (trial, free)}
    write_session(replace(session, finger=finger, trials=trials), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as opened:
        assert opened[f"trials/{trial.name}/q"].attrs["units"] == "m"
        assert opened[f"trials/{trial.name}/joint_torque"].attrs["units"] == "N"
        assert opened["finger/joints/limits"].attrs["units"] == "m"
        assert opened["finger/joints/rotor_inertia"].attrs["units"] == "kg"
    back = read_session(tmp_path / "a.h5")
    assert back.finger.prismatic == (True,)
    assert back.finger.n == 0
    assert check_file(tmp_path / "a.h5") == []


def test_predictions_describe_themselves(session, tmp_path):
    path = tmp_path / "pred.h5"
    q = session["07-VD.3"].q + 0.1
    torque = session["02-ID.3-static-PIP"].joint_torque
    write_predictions(path, session, {"07-VD.3": {"q": q}, "02-ID.3-static-PIP": {"joint_torque": torque}})
    back = read_predictions(path)
    np.testing.assert_array_equal(back["07-VD.3"]["q"], q)
    np.testing.assert_array_equal(back["07-VD.3"]["time"], session["07-VD.3"].time)
    np.testing.assert_array_equal(back["02-ID.3-static-PIP"]["joint_torque"], torque)
    with h5py.File(path) as opened:
        assert opened.attrs["specimen"] == session.specimen
        assert opened["trials/07-VD.3/q"].attrs["units"] == "rad"
        assert "finger/links/inertia" in opened
    with pytest.raises(UserError, match="holds predictions"):
        read_session(path)
    with pytest.raises(UserError, match="exists already"):
        write_predictions(path, session, {})
    with pytest.raises(UserError, match="not in the session"):
        write_predictions(tmp_path / "b.h5", session, {"99": {}})


def test_predictions_of_another_finger_are_refused(session, tmp_path):
    """Columns have no names of their own, so that joints in another order would be compared with each other."""
    finger = session.finger
    turned = replace(session, finger=replace(finger, joint_names=finger.joint_names[::-1]))
    write_predictions(tmp_path / "p.h5", turned, {"07-VD.3": {"q": session["07-VD.3"].q}})
    assert set(read_predictions(tmp_path / "p.h5", turned)) == {"07-VD.3"}
    told, wanted = (", ".join(names) for names in (finger.joint_names[::-1], finger.joint_names))
    with pytest.raises(
        UserError, match=rf"p\.h5: /finger/joints/name: names {told} where the session has {wanted}; give"
    ):
        read_predictions(tmp_path / "p.h5", session)


def test_recordings_in_place_of_predictions_are_doubted(session, tmp_path):
    path, report = tmp_path / "recorded.h5", Report()
    write_session(session, path)
    read_predictions(path, session, report)
    assert ["has no attribute `content` that says `predictions`" in x.message for x in report] == [True]


def test_a_column_of_a_finger_with_joints_of_both_kinds_has_the_units_of_its_joint():
    assert [channel_units("joint_torque", (True, False), k) for k in (0, 1)] == ["N", "N m"]
    assert [channel_units("q", (True, False), k) for k in (0, 1)] == ["m", "rad"]
    assert channel_units("tendon_force", (True,), 2) == "N"  # of the third tendon
    assert channel_units("joint_torque", (True, True)) == "N"
