"""Faults in session files: the checker names each with its place, and the reader refuses it without a traceback."""

import re
import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest

from jaxfinger.data import Session, check_file, read_session, write_session
from jaxfinger.data.checks.finger import check_finger
from jaxfinger.data.checks.session import check_session
from jaxfinger.data.findings import Report
from jaxfinger.errors import UserError
from tests.units import Scale


@pytest.fixture(scope="module")
def good(session, tmp_path_factory):
    path = tmp_path_factory.mktemp("good") / "session.h5"
    write_session(session, path)
    return path


@pytest.fixture
def file(good, tmp_path):
    path = tmp_path / "bad.h5"
    shutil.copyfile(good, path)
    return path


def put(group, name, change):
    """Replace a dataset by a changed copy with the same attributes."""
    old = group[name]
    value, attributes = change(old[()]), dict(old.attrs)
    del group[name]
    group[name] = value
    group[name].attrs.update(attributes)


def at(index, value):
    def change(x):
        x = x.copy()
        x[index] = value
        return x

    return change


def values(name, change):
    return lambda f: put(f, name, change)


def attribute(place, key, value):
    def change(f):
        if value is None:
            del f[place].attrs[key]
        else:
            f[place].attrs[key] = value

    return change


def remove(name):
    return lambda f: f.pop(name)


ID2, STATIC, ID4, VD3 = (f"trials/{n}" for n in ("01-ID.2-MCP", "02-ID.3-static-PIP", "04-ID.4-T1-MCP", "07-VD.3"))
ERRORS = {
    "no format": (attribute("/", "format", None), "/", "is not a dataset file"),
    "other format": (attribute("/", "format", "images"), "/", "'images'"),
    "version 2": (attribute("/", "format_version", "2.0"), "/", "format_version '2.0'"),
    "no finger": (remove("finger"), "/finger", "is missing"),
    "no trials": (remove("trials"), "/trials", "is missing"),
    "no gravity": (attribute("finger", "gravity", None), "/finger", "gravity"),
    "gravity in g": (attribute("finger", "gravity", [0, 0, -1.0]), "/finger", "about 9.81"),
    "gravity in mm": (attribute("finger", "gravity", [0, 0, -9810.0]), "/finger", "about 9.81"),
    "gravity a word": (attribute("finger", "gravity", "down"), "/finger", "gravity"),
    "axis twice as long": (values("finger/joints/axis", lambda x: 2 * x), "/finger/joints/axis", "2 long"),
    "limits reversed": (values("finger/joints/limits", lambda x: x[:, ::-1]), "/finger/joints/limits", "swap"),
    "limits in degrees": (values("finger/joints/limits", np.rad2deg), "/finger/joints/limits", "degrees"),
    "lengths in mm": (values("finger/joints/origin", lambda x: 1e3 * x), "/finger/joints/origin", "mm or cm to m"),
    "mass zero": (values("finger/links/mass", at(0, 0.0)), "/finger/links/mass", "positive"),
    "mass NaN": (values("finger/links/mass", at(0, np.nan)), "/finger/links/mass", "not finite"),
    "inertia skew": (values("finger/links/inertia", at((0, 0, 1), 1e-6)), "/finger/links/inertia", "symmetric"),
    "inertia negative": (values("finger/links/inertia", at((0, 0, 0), -1e-6)), "/finger/links/inertia", "positive"),
    "inertia impossible": (values("finger/links/inertia", at((0, 1, 1), 9e-6)), "/finger/links/inertia", "the sum"),
    "inertia in kg mm2": (values("finger/links/inertia", lambda x: 1e6 * x), "/finger/links/inertia", "gyration"),
    "names repeat": (values("finger/joints/name", at(1, "MCP")), "/finger/joints/name", "2 times"),
    "crosses misshapen": (values("finger/tendons/crosses", lambda x: x.T), "/finger/tendons/crosses", "shape"),
    "active too short": (values("finger/tendons/active", lambda x: x[:2]), "/finger/tendons/active", "shape"),
    "tendon across nothing": (values("finger/tendons/crosses", at(1, False)), "/finger/tendons/crosses", "T2"),
    "units missing": (attribute(f"{ID2}/q", "units", None), f"/{ID2}/q", "no `units`"),
    "units degrees": (attribute(f"{ID2}/q", "units", "deg"), f"/{ID2}/q", "must be 'rad'"),
    "units mm": (attribute("finger/links/com", "units", "mm"), "/finger/links/com", "must be 'm'"),
    "rotor pulls": (values("finger/joints/rotor_inertia", at(0, -1e-6)), "/finger/joints/rotor_inertia", "negative"),
    "rotor's spread alone": (remove("finger/joints/rotor_inertia"), "/finger/joints/rotor_inertia", "missing beside"),
    "arms in mm": (values("finger/tendons/excursion", lambda x: 1e3 * x), "/finger/tendons/excursion", "mm to m"),
    "arm half known": (values("finger/tendons/excursion", at((0, 0, 1), np.nan)), "/finger/tendons/excursion", "T1"),
    "arm elsewhere": (
        values("finger/tendons/excursion", at((1, 1, 0), 0.01)),
        "/finger/tendons/excursion",
        "not cross",
    ),
    "several joints, one moves": (
        values("trials/08-ID.3-dynamic/joint_torque", at((slice(None), 0), np.nan)),
        "/trials/08-ID.3-dynamic",
        "no attribute `joint`",
    ),
    "experiment unknown": (attribute(ID2, "experiment", "ID.7"), f"/{ID2}", "'ID.7'"),
    "experiment absent": (attribute(ID2, "experiment", None), f"/{ID2}", "experiment"),
    "joint absent": (attribute(ID2, "joint", None), f"/{ID2}", "no attribute `joint`"),
    "joint unknown": (attribute(ID2, "joint", "DIP"), f"/{ID2}", "'DIP'"),
    "tendon absent": (attribute(ID4, "tendon", None), f"/{ID4}", "no attribute `tendon`"),
    "tendon unknown": (attribute(ID4, "tendon", "T9"), f"/{ID4}", "'T9'"),
    "tendon passive": (attribute(ID4, "tendon", "T3"), f"/{ID4}", "passive"),
    "tendon elsewhere": (lambda f: f[ID4].attrs.update(tendon="T2", joint="PIP"), f"/{ID4}", "not cross"),
    "time missing": (remove(f"{ID2}/time"), f"/{ID2}/time", "is missing"),
    "time backwards": (values(f"{ID2}/time", lambda t: t[::-1]), f"/{ID2}/time", "backwards"),
    "time repeats": (values(f"{ID2}/time", lambda t: np.round(t, 1)), f"/{ID2}/time", "repeats"),
    "time NaN": (values(f"{ID2}/time", at(5, np.nan)), f"/{ID2}/time", "sample 5"),
    "q missing": (remove(f"{ID2}/q"), f"/{ID2}/q", "is missing"),
    "q one column": (values(f"{ID2}/q", lambda q: q[:, 0]), f"/{ID2}/q", "shape (900,)"),
    "q too short": (values(f"{ID2}/q", lambda q: q[:-1]), f"/{ID2}/q", "shape (899, 2)"),
    "q transposed": (values(f"{ID2}/q", lambda q: q.T), f"/{ID2}/q", "shape (2, 900)"),
    "q with a hole": (values(f"{ID2}/q", at((slice(100, 110), 0), np.nan)), f"/{ID2}/q", "column MCP is NaN in 10"),
    "q infinite": (values(f"{ID2}/q", at((3, 1), np.inf)), f"/{ID2}/q", "infinite"),
    "q words": (values(f"{ID2}/q", lambda q: np.full(q.shape, b"x")), f"/{ID2}/q", "numbers"),
    "q degrees": (values(f"{ID2}/q", np.rad2deg), f"/{ID2}/q", "convert deg to rad"),
    "joint still": (values(f"{ID2}/q", at((slice(None), 0), 0.3)), f"/{ID2}/q", "MCP never moves"),
    "all joints still": (values(f"{VD3}/q", lambda q: 0 * q), f"/{VD3}/q", "no joint moves"),
    "excursion in mm": (values(f"{ID2}/tendon_excursion", lambda x: 1e3 * x), f"/{ID2}/tendon_excursion", "mm to m"),
    "excursion in cm": (values(f"{ID2}/tendon_excursion", lambda x: 1e2 * x), f"/{ID2}/tendon_excursion", "cm to m"),
    "hole in excursion": (
        values(f"{ID2}/tendon_excursion", at((7, 1), np.nan)),
        f"/{ID2}/tendon_excursion",
        "column T2 is NaN in 1",
    ),
    "torque in N mm": (values(f"{STATIC}/joint_torque", lambda x: 1e3 * x), f"/{STATIC}/joint_torque", "N mm"),
    "tension pushes": (values(f"{VD3}/tendon_force", lambda x: -x), f"/{VD3}/tendon_force", "cannot push"),
    "tension missing": (remove(f"{VD3}/tendon_force"), f"/{VD3}/tendon_force", "is missing"),
    "direction of 2": (values(f"{STATIC}/joint_direction", at((0, 0), 2)), f"/{STATIC}/joint_direction", "-1, 0 or 1"),
    "hold of -2": (values(f"{STATIC}/hold", at(0, -2)), f"/{STATIC}/hold", "index"),
    "no samples": (
        lambda f: [put(f[VD3], name, lambda x: x[:0]) for name in list(f[VD3])],
        f"/{VD3}/time",
        "no sample",
    ),
    "the same recording twice": (
        lambda f: f.copy(f[ID2], f["trials"], "99-again"),
        "/trials/99-again",
        "the same recording as trial 01-ID.2-MCP",
    ),
    "trial is a dataset": (lambda f: f.create_dataset("trials/x", data=1.0), "/trials/x", "must be a group"),
}


@pytest.mark.parametrize("fault", ERRORS)
def test_each_fault_is_named_and_refused(file, fault, monkeypatch):
    monkeypatch.setattr("jaxfinger.data.opening.survives", lambda path: True)  # These files are whole; forks cost time.
    change, place, words = ERRORS[fault]
    with h5py.File(file, "r+") as opened:
        change(opened)
    errors = [f for f in check_file(file) if f.severity == "error"]
    assert any(f.place == place and words in f.message for f in errors), errors
    with pytest.raises(UserError) as refused:
        read_session(file)
    assert str(refused.value).startswith(f"{file}: {place.removesuffix('/')}")
    assert "\n" not in str(refused.value)


def test_all_faults_are_reported_at_once(file):
    for fault in ("mass zero", "limits reversed", "joint unknown", "q with a hole", "tension pushes", "time repeats"):
        with h5py.File(file, "r+") as opened:
            ERRORS[fault][0](opened)
    places = {f.place for f in check_file(file) if f.severity == "error"}
    assert places >= {
        "/finger/links/mass",
        "/finger/joints/limits",
        f"/{ID2}",
        f"/{ID2}/q",
        f"/{VD3}/tendon_force",
        f"/{ID2}/time",
    }


def test_a_measured_channel_that_is_missing_is_an_error_but_the_rest_is_read(file, session):
    with h5py.File(file, "r+") as opened:
        del opened[f"{ID2}/tendon_excursion"]
    (error,) = [f for f in check_file(file) if f.severity == "error"]
    assert error.place == f"/{ID2}/tendon_excursion"
    assert len(read_session(file)) == len(session)


def test_temperatures_in_degrees_celsius_are_said(file):
    assert not any(f.place == f"/{VD3}/temperature" for f in check_file(file))
    with h5py.File(file, "r+") as opened:
        put(opened[VD3], "temperature", lambda x: x - 273.15)
    said = [f.message for f in check_file(file) if f.place == f"/{VD3}/temperature"]
    assert [m.split(" stays")[0] for m in said] == ["column motor T1", "column motor T2"]
    assert all("273.15" in m for m in said)


def test_a_tension_that_is_not_measured_where_tendons_pull_is_said(file):
    with h5py.File(file, "r+") as opened:
        put(opened[VD3], "tendon_force", at((slice(None), 0), np.nan))
    said = [f.message for f in check_file(file) if f.place == f"/{VD3}/tendon_force"]
    assert any("column T1 is not measured (NaN), and the tendon is taken for slack" in m for m in said), said


def test_a_tare_error_of_slack_tendons_is_no_wrong_sign(session, tmp_path):
    """Their tensions are zero by protocol. A session of such trials alone has no other tension to compare them with."""
    trials = {t.name: t for t in session if t.experiment.startswith("ID.3")}
    off = {n: replace(t, tendon_force=np.full((len(t.time), session.finger.n), -0.03)) for n, t in trials.items()}
    write_session(replace(session, trials=off), tmp_path / "s.h5")
    found = [f for f in check_file(tmp_path / "s.h5") if "tendon_force" in f.place and "T1" in f.message]
    assert found
    assert all(f.severity == "warning" and "check the tare" in f.message for f in found), found


@pytest.mark.parametrize("size", [0.05, 1.0, 60.0])
def test_lengths_are_in_other_units_for_their_machine(session, size):
    """A boom of 3 m is one in m; whatever the size of a machine, its lengths in cm would make it lighter than air."""
    machine = Scale(mass=size**3, length=size, time=size**0.5)(session).finger

    def faults(**changes):
        report = Report()
        check_finger(replace(machine, **changes), report)
        return [str(f) for f in report if f.severity == "error"]

    assert faults() == []
    for factor in (1e2, 1e3):
        (said, *_) = faults(origin=factor * machine.origin, fingertip=factor * machine.fingertip)
        assert "convert mm or cm to m" in said
        (said, *_) = faults(excursion=factor * machine.excursion)
        assert "convert mm to m" in said
    (said, *_) = faults(inertia=1e6 * machine.inertia)
    assert "convert to kg m2" in said


@pytest.mark.parametrize(("factor", "words"), [(1.0, ""), (1000.0, "convert ms to s"), (1 / 60, "not in minutes")])
def test_times_in_another_unit_are_said_by_the_motion(session, tmp_path, factor, words):
    trials = {t.name: replace(t, time=factor * t.time) for t in session}
    write_session(replace(session, trials=trials), tmp_path / "s.h5")
    said = [f.message for f in check_file(tmp_path / "s.h5") if f.message.startswith("joints move")]
    assert [words in m for m in said] == [True] * bool(words)


def test_a_slow_machine_needs_no_more_samples(session):
    """A crane that moves 30 times as slowly, with a sample every 0.3 s, shows its motions as well as a finger."""
    trials = {t.name: replace(t, time=30.0 * t.time, session_start=None) for t in session}
    assert not [text for text in said_of(replace(session, trials=trials)) if "has a sample every" in text]
    pulled = {n: t for n, t in trials.items() if t.experiment == "ID.4"}
    assert [text for text in said_of(replace(session, trials=pulled)) if "has a sample every 0.3 s" in text]


@pytest.mark.parametrize("least", [True, False])
def test_a_clipped_force_is_said(file, least):
    """Neither a quantised force nor one that is zero while its tendon is slack is clipped."""
    noise = 0.05 * np.random.default_rng(0).standard_normal(900)
    pull = np.clip(5.0 + 6.0 * np.sin(np.arange(900) / 90.0), 0.0, None)
    for force, clipped in (
        (np.round(pull, 2), False),
        (np.round(pull + noise, 1).clip(0.0), False),
        (np.clip(pull + noise, 1.5, None) if least else np.clip(pull + noise, None, 8.0), True),
    ):
        with h5py.File(file, "r+") as opened:
            put(opened[ID4], "tendon_force", at((slice(None), 0), force))
        said = [f.message for f in check_file(file) if f.place == f"/{ID4}/tendon_force"]
        assert any("column T1 is clipped: it stays at " + ("1.5" if least else "8") in m for m in said) == clipped, said


@pytest.mark.parametrize("channel", ["q", "tendon_excursion"])
def test_a_number_for_a_missing_value_is_said(file, channel):
    """It is not taken for an encoder that wraps."""
    with h5py.File(file, "r+") as opened:
        put(opened[ID2], channel, at((slice(200, 230, 3), 0), 174.5))
    name = "MCP" if channel == "q" else "T1"
    said = [f.message for f in check_file(file) if f.place == f"/{ID2}/{channel}"]
    words = f"column {name} is 174.5 in 10 samples, first at 2 s, far from all others"
    assert any(words in m and "`where` in a mapping" in m for m in said), said
    assert not any("wraps" in m for m in said)


def test_a_slack_tendons_excursion_may_be_nan(file):
    with h5py.File(file, "r+") as opened:
        put(opened[ID2], "tendon_force", at((slice(0, 50), 0), 0.01))
        put(opened[ID2], "tendon_excursion", at((slice(0, 50), 0), np.nan))
    assert not [f for f in check_file(file) if f.severity == "error"]


def test_a_trial_cut_short_is_read_and_one_without_samples_left_out(file, session):
    with h5py.File(file, "r+") as opened:
        opened[VD3].attrs["complete"] = False
        for name in list(opened[VD3]):
            put(opened[VD3], name, lambda x: x[:0])
    back = read_session(file)
    assert not back["06-VD.2-T1"].complete
    assert set(session.trials) - set(back.trials) == {"07-VD.3"}
    assert any(f.severity == "warning" and "left out" in f.message for f in check_file(file))


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "empty"), (b"time,q\n0,1\n", "not an HDF5 file"), (None, "truncated")],
)
def test_files_that_are_no_sessions(good, tmp_path, content, words):
    path = tmp_path / "x.h5"
    raw = good.read_bytes()
    path.write_bytes(raw[: len(raw) // 2] if content is None else content)
    with pytest.raises(UserError, match=words):
        read_session(path)


def test_no_file_and_a_folder(tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        read_session(tmp_path / "none.h5")
    with pytest.raises(UserError, match="is a folder"):
        read_session(tmp_path)


@pytest.mark.parametrize("seed", range(24))
def test_a_damaged_file_is_a_session_or_one_sentence(good, tmp_path, seed):
    rng = np.random.default_rng(seed)
    raw = bytearray(good.read_bytes())
    if seed % 4 == 0:
        raw = raw[: rng.integers(len(raw))]
    else:
        where = rng.integers(min(len(raw), 40_000), size=rng.integers(1, 12))
        for i in where:
            raw[i] = rng.integers(256)
    path = tmp_path / "x.h5"
    path.write_bytes(raw)
    check_file(path)
    try:
        outcome = read_session(path)
    except UserError as error:
        outcome = error
    assert isinstance(outcome, Session) or "\n" not in str(outcome)


@pytest.mark.parametrize(("seconds", "said"), [(0.6, True), (1.2, False)])
def test_steps_too_short_to_show_as_holds_are_said(session, tmp_path, seconds, said):
    """The rest before the first step is a hold, and tells nothing of friction that grows with the tension."""
    trial = session["04-ID.4-T1-MCP"]
    step, force = trial.time // seconds, trial.tendon_force.copy()
    force[:, 0] = (
        1.0 + np.minimum(step, 6.0) + np.where(step < 6.0, np.clip(trial.time % seconds / 0.2 - 1.0, -1, 0), 0)
    )
    stepped = replace(trial, tendon_force=force, hold=None, tendon_direction=None)
    write_session(replace(session, trials={trial.name: stepped}), tmp_path / "s.h5")
    messages = [str(f) for f in check_file(tmp_path / "s.h5")]
    assert any("neither in two holds of 0.6 s" in m for m in messages) == said


@pytest.mark.parametrize(("seconds", "said"), [(0.3, True), (3.0, False)])
def test_a_tendon_that_is_pulled_too_fast_for_its_friction_is_said(session, tmp_path, seconds, said):
    trial = session["04-ID.4-T1-MCP"]
    force = trial.tendon_force.copy()
    force[:, 0] = 5.0 + 4.0 * np.abs((trial.time / seconds + 1.0) % 2.0 - 1.0)
    ramped = replace(trial, tendon_force=force, hold=None, tendon_direction=None)
    write_session(replace(session, trials={trial.name: ramped}), tmp_path / "s.h5")
    messages = [str(f) for f in check_file(tmp_path / "s.h5")]
    assert any("next to nothing of the trial is judged" in m for m in messages) == said


def said_of(session) -> list[str]:
    report = Report()
    check_session(session, report)
    return [str(finding) for finding in report if finding.severity != "note"]


@pytest.mark.parametrize("size", [0.1, 1.0, 4.0, 20.0])
def test_torques_excursions_and_tensions_are_large_for_their_machine(session, size):
    """A small arm's springs hold it with more than 5 N m; in N mm the torques of a tiny finger are less."""
    machine = Scale(mass=0.9 * size**3, length=size, time=size**0.5)(session)
    if size == 4.0:  # less than 2 kg, with springs
        machine = raised(machine, "joint_torque", 5.0)
        assert machine.finger.mass.sum() < 2.0
        assert max(np.nanmax(t.joint_torque) for t in machine if t.joint_torque is not None) > 5.0
    assert not [text for text in said_of(machine) if "too large" in text or "exceeds" in text]
    for channel, fault, mend in (
        ("joint_torque", "too large", "convert N mm to N m"),
        ("tendon_excursion", "too large", "convert mm to m"),
        ("tendon_force", "exceeds 5000 times the weight", "convert mN to N"),
    ):
        said = [text for text in said_of(raised(machine, channel, 1e3)) if fault in text]
        assert said
        assert all(mend in text for text in said)


def test_torques_that_tendons_can_give_are_plausible_however_light_the_links(session):
    """Forceps of a gram bear the pull of their cables."""
    finger = session.finger
    light = replace(session, finger=replace(finger, mass=finger.mass / 500.0, inertia=finger.inertia / 500.0))
    assert not [text for text in said_of(light) if "too large" in text]
    assert any("convert N mm to N m" in text for text in said_of(raised(light, "joint_torque", 1e3)))


def raised(session: Session, channel: str, factor: float) -> Session:
    """The session with all values of a channel multiplied."""
    trials = {t.name: t if (x := getattr(t, channel)) is None else replace(t, **{channel: factor * x}) for t in session}
    return replace(session, trials=trials)


def test_slack_tendons_that_read_tension_are_said(session):
    """A tare that is wrong on all tendons at once, which their pulls cannot show."""
    trials = {t.name: t if t.tendon_force is None else replace(t, tendon_force=t.tendon_force + 0.6) for t in session}
    (said,) = [text for text in said_of(replace(session, trials=trials)) if "tare" in text]
    assert "/trials/02-ID.3-static-PIP/tendon_force: stays above 0.5" in said
    assert "N in T1, T2, though ID.3-static leaves tendons slack; check the tare, or let the tendons go" in said
    assert not [text for text in said_of(session) if "tare" in text]


@pytest.mark.parametrize(("held", "stepped"), [(9.0, 0.0), (0.0, 1.5), (2.0, 6.0)], ids=["held", "stepped", "both"])
@pytest.mark.parametrize("trial", ["02-ID.3-static-PIP", "07-VD.3"])
def test_tendons_that_are_pulled_where_they_are_to_be_slack_are_said(session, trial, held, stepped):
    """By a motor that holds one, or one that follows the joint's steps. Tensions of other experiments are no fault."""
    old = session[trial]
    force = old.tendon_force.copy()
    force[:, 1] += held + stepped * (old.time > 0.3 * old.time[-1])
    changed = replace(session, trials={**session.trials, trial: replace(old, tendon_force=force)})
    found = [text for text in said_of(changed) if "leaves tendons slack" in text]
    if trial == "07-VD.3":
        assert found == []
        return
    (said,) = found
    place, reached, rest = re.split(r" reaches (\S+) N in ", said)
    assert place == f"warning: /trials/{trial}/tendon_force:"
    assert float(reached) == pytest.approx(held + stepped, abs=0.05)
    assert rest.startswith("T2, though ID.3-static leaves tendons slack, and what they pull is taken for a torque")
    assert rest.endswith("; let them go, and record the trial again")


def test_pulls_without_a_slack_tendon_have_a_note(session):
    """Where no ID.3 records tensions, a zero that is wrong on all tendons looks like a pretension."""

    def noted(tare):
        report = Report()
        pull = session["04-ID.4-T1-MCP"]
        trials = {pull.name: replace(pull, tendon_force=pull.tendon_force + tare)}
        check_session(replace(session, trials=trials), report)
        return [str(f) for f in report if "no tendon reads less" in f.message]

    assert noted(0.0) == []
    (said,) = noted(2.5)
    assert said.startswith("note: /trials: no tendon reads less than 2.47 N in ID.4; check the tare if one was ever")


def test_excursions_of_slack_tendons_are_said(session):
    trial = session["01-ID.2-MCP"]
    slack = replace(
        session, trials={**session.trials, trial.name: replace(trial, tendon_force=trial.tendon_force - 2.0)}
    )
    (said,) = [text for text in said_of(slack) if "no tension" in text]
    assert "/trials/01-ID.2-MCP/tendon_force: shows no tension in T1, T2" in said


def test_trials_that_overlap_are_said_once(session):
    """Starts in minutes: the trials of 9 s would begin 1 s after each other."""

    def started(apart):
        trials = {t.name: replace(t, session_start=apart * k) for k, t in enumerate(session)}
        return [text for text in said_of(replace(session, trials=trials)) if "begins before" in text]

    (said,) = started(1.0)
    assert "02-ID.3-static-PIP begins before 01-ID.2-MCP has ended, and likewise 6 other trials" in said
    assert started(9.0) == []


def test_times_that_no_sensor_has_are_said(session):
    trials = {t.name: replace(t, time=t.time / 86400.0) for t in session}
    assert any(
        "has a sample every 1.16e-07 s, as no sensor has; correct the units" in x
        for x in said_of(replace(session, trials=trials))
    )
