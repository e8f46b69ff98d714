"""Recordings of other tools are imported with their numbers intact, and mistakes in a mapping are named."""

import re
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from jaxfinger.data import check_file, read_session, smooth
from jaxfinger.data.findings import Report
from jaxfinger.data.importing.by_mapping import import_file
from jaxfinger.data.importing.matlab import load_mat
from jaxfinger.data.importing.proposal import proposal
from jaxfinger.data.importing.sources import load_recording
from jaxfinger.data.units import TO_SI
from jaxfinger.errors import UserError
from tests.data.conftest import ONE_JOINT

EMPS = Path(__file__).parents[3] / "datasets" / "emps"

MAPPING = (
    ONE_JOINT
    + """[trials.01-ID2]
experiment = "ID.2"
joint = "MCP"
time = "t"
[trials.01-ID2.channels]
q.MCP = { from = "enc", column = 1, units = "deg" }
tendon_force.T1 = [{ from = "volts", scale = "gain", offset = -0.5, units = "N" }, { from = "extra", units = "mN" }]
tendon_excursion.T1 = { from = "pull", units = "mm" }
temperature.motor = { from = "warm", units = "degC" }
"""
)
TIME = np.arange(500) / 100
ANGLE = 0.6 + 0.5 * np.sin(TIME)
RECORDED = {
    "t": TIME + 7.0,
    "enc": np.column_stack([0 * TIME, np.rad2deg(ANGLE)]),
    "volts": 0.25 + 0.01 * TIME,
    "extra": 100.0 + 0 * TIME,
    "pull": 8.0 * ANGLE,
    "warm": 20.0 + 0.1 * TIME,
    "gain": 10.0,
}


@pytest.fixture
def mapping(tmp_path):
    path = tmp_path / "map.toml"
    path.write_text(MAPPING)
    return path


def assert_imported(path):
    assert [f for f in check_file(path) if f.severity != "note"] == []
    session = read_session(path)
    trial = session["01-ID2"]
    np.testing.assert_allclose(trial.time, TIME, atol=1e-9)
    np.testing.assert_allclose(trial.q[:, 0], ANGLE, atol=1e-9)
    np.testing.assert_allclose(trial.tendon_force[:, 0], 10 * (0.25 + 0.01 * TIME) - 0.5 + 0.1, atol=1e-9)
    np.testing.assert_allclose(trial.tendon_excursion[:, 0], 0.008 * ANGLE, atol=1e-9)
    np.testing.assert_allclose(trial.temperature[:, 0], 293.15 + 0.1 * TIME, atol=1e-9)
    assert np.isnan(trial.tendon_force[:, 1]).all()
    assert session.specimen == "bench finger"


def test_matlab_version_5(mapping, tmp_path):
    scipy.io.savemat(tmp_path / "log.mat", {k: v[:, None] if np.ndim(v) == 1 else v for k, v in RECORDED.items()})
    import_file([tmp_path / "log.mat"], mapping, tmp_path / "out.h5")
    assert_imported(tmp_path / "out.h5")
    with pytest.raises(UserError, match="exists already"):
        import_file([tmp_path / "log.mat"], mapping, tmp_path / "out.h5")


def test_a_byte_that_crashes_the_reader_of_matlab_files_is_said(tmp_path):
    """A single wrong byte in a length crashes SciPy's reader."""
    raw = bytearray((Path(__file__).parents[1] / "cases" / "simulink-signal-of-two-columns" / "log.mat").read_bytes())
    raw[29337] = 50
    (tmp_path / "log.mat").write_bytes(raw)
    with pytest.raises(UserError, match=r"log\.mat: is damaged in its structure; save it in MATLAB again"):
        load_mat(tmp_path / "log.mat")


def test_matlab_version_7_3_with_a_structure(mapping, tmp_path):
    """Version 7.3 is HDF5 after a user block of 512 bytes, with transposed arrays, and groups as structures."""
    with h5py.File(tmp_path / "log.mat", "w", userblock_size=512) as file:
        for name, value in RECORDED.items():
            file[f"log/{name}"] = np.atleast_2d(np.transpose(value))
    text = MAPPING
    for name in RECORDED:
        text = text.replace(f'"{name}"', f'"log.{name}"')
    mapping.write_text(text)
    import_file([tmp_path / "log.mat"], mapping, tmp_path / "out.h5")
    assert_imported(tmp_path / "out.h5")


def write_apart(folder, columns, only=slice(None)):
    """Each group of columns in a file of its own, without names."""
    for name, values in columns.items():
        np.savetxt(folder / f"{name}.txt", values[only], "%.17g")
    return [folder / f"{name}.txt" for name in columns]


def test_files_of_the_same_samples_lie_side_by_side(tmp_path):
    text = MAPPING.replace("[trials.01-ID2]", '[trials.01-ID2]\nfile = ["t.txt", "enc.txt", "rest.txt"]')
    text = text.replace('"t"', '"t.column 0"').replace('"enc", column = 1', '"enc.column 1"').replace('"gain"', "10.0")
    for k, name in enumerate(("volts", "extra", "pull", "warm")):
        text = text.replace(f'from = "{name}"', f'from = "rest.column {k}"')
    (tmp_path / "map.toml").write_text(text)
    rest = np.column_stack([RECORDED[name] for name in ("volts", "extra", "pull", "warm")])
    columns = {"t": RECORDED["t"], "enc": RECORDED["enc"], "rest": rest}
    files = write_apart(tmp_path, columns)
    import_file(files, tmp_path / "map.toml", tmp_path / "out.h5")
    assert_imported(tmp_path / "out.h5")
    write_apart(tmp_path, {"rest": rest}, slice(1, None))
    with pytest.raises(UserError, match=r"trials.01-ID2.file: names files with different numbers .*rest 499.*`time`"):
        import_file(files, tmp_path / "map.toml", tmp_path / "other.h5")


def test_files_of_as_many_samples_as_one_without_a_clock_are_pointed_out(tmp_path):
    columns = {"t": RECORDED["t"], "enc": RECORDED["enc"]}
    said = proposal([load_recording(path) for path in write_apart(tmp_path, columns)])
    assert '# "t.txt", "enc.txt" hold 500 samples each.' in said
    assert 'file = ["t.txt", "enc.txt"]' in said


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_csv(mapping, tmp_path, delimiter):
    columns = [RECORDED[name] for name in ("t", "volts", "extra", "pull", "warm")] + [np.rad2deg(ANGLE)]
    lines = ["# logged", delimiter.join(("t", "volts", "extra", "pull", "warm", "enc"))]
    lines += [delimiter.join(repr(float(x)) for x in row) for row in zip(*columns, strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    text = MAPPING.replace(", column = 1", "").replace('scale = "gain"', "scale = 10.0")
    mapping.write_text(text)
    import_file([tmp_path / "log.csv"], mapping, tmp_path / "out.h5")
    assert_imported(tmp_path / "out.h5")


def test_sampling_rate_span_and_own_clock(mapping, tmp_path):
    recorded = RECORDED | {"slow_t": TIME[::5], "pull": 8.0 * (0.6 + 0.1 * TIME[::5])}
    scipy.io.savemat(tmp_path / "log.mat", recorded)
    text = MAPPING.replace('time = "t"', "rate_hz = 100.0\nspan = [1.0, 3.0]")
    mapping.write_text(text.replace('from = "pull"', 'from = "pull", time = "slow_t"'))
    trial = import_file([tmp_path / "log.mat"], mapping, tmp_path / "out.h5")["01-ID2"]
    np.testing.assert_allclose(trial.time, TIME[:200], atol=1e-9)
    np.testing.assert_allclose(trial.q[:, 0], ANGLE[100:300], atol=1e-9)
    np.testing.assert_allclose(trial.tendon_excursion[:, 0], 0.008 * (0.6 + 0.1 * TIME[100:300]), atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('time = "t"', 'tyme = "t"', r"line \d+: trials\.01-ID2\.tyme: is unknown \(did you mean 'time'\?\)"),
        (
            'from = "enc"',
            'from = "encoder"',
            r"'encoder' of log.mat, which the recording has not; it has enc, extra, gain",
        ),
        ('from = "enc"', 'from = "?"', r"is still to be filled in; name a variable of log.mat: enc, extra"),
        ('time = "t"', 'time = "?"', r"time: is still to be filled in; .* or write `rate_hz` in place of `time`: enc"),
        (", column = 1", "", "has 2 columns; choose one by `column`"),
        ('from = "pull"', 'from = "gain"', "has 1 samples where the trial's time has 500"),
        ('units = "deg"', 'units = "mm"', "units 'mm'; it must be one of rad, mrad, deg"),
        ('units = "mN"', 'units = "mN"\n', "not valid TOML"),
        ("q.MCP", "q.PIP", "column 'PIP'; it must be one of MCP"),
        ("tendon_excursion.T1", "excursion.T1", r"channels\.excursion: is unknown \(did you mean 'tendon_excursion'"),
        ('joint = "MCP"', "", "no attribute `joint`"),
        ('experiment = "ID.2"', 'experiment = "ID.9"', "ID.9"),
        (
            "gravity = [0.0, 0.0, -9.81]",
            "gravity = [0.0, -9.81]",
            r"line 4: finger\.gravity: must be a list of 3 numbers, not 2",
        ),
        ('crosses = ["MCP"]', 'crosses = ["DIP"]', r"tendons\[0\]\.crosses\[0\]: is 'DIP'; choose one of MCP"),
        ("mass = 0.02", "", r"line 6: finger\.joints\[0\]\.mass: is missing"),
        ('units = "deg"', 'units = "rad"', r"line \d+: trials\.01-ID2\.channels\.q: .*convert deg to rad"),
        ('joint = "MCP"', 'joint = "MCP"\ncomplete = "false"', "complete: must be true or false, not 'false'"),
        ('joint = "MCP"', 'joint = "MCP"\nmotion = 3', "motion: must be a string in quotes, not 3"),
        ('joint = "MCP"', 'joint = "MCP"\nsession_start = "12"', "session_start: must be a number, not '12'"),
        ("offset = -0.5", 'offset = "0.5"', r"line 26: .*tendon_force\.T1\[0\]\.offset: must be a number, not '0.5'"),
        ('specimen = "bench', 'source = 3\nspecimen = "bench', "line 2: source: must be a string in quotes, not 3"),
        ("trials.01-ID2", 'trials."a/b"', "line 20: trials.a/b: is no name for a trial; leave out slashes"),
        ('specimen = "bench', 'channels = [1]\nspecimen = "bench', r"line 2: channels: must be a table, not \[1\]"),
    ],
)
def test_a_mistake_in_the_mapping_is_named(mapping, tmp_path, old, new, words):
    assert old in MAPPING
    mapping.write_text(MAPPING.replace(old, new))
    scipy.io.savemat(tmp_path / "log.mat", RECORDED)
    with pytest.raises(UserError, match=words) as refused:
        import_file([tmp_path / "log.mat"], mapping, tmp_path / "out.h5")
    assert str(refused.value).startswith(str(mapping))
    assert not (tmp_path / "out.h5").exists()


@pytest.mark.parametrize(
    ("channel", "factor", "mapped", "said"),
    [
        ("t", 1e3, 'time = "t"', "time = { from = …, units = "),
        ("enc", 1.0, ', units = "deg" }', "`units = "),
        ("pull", 1.0, ', units = "mm" }', "`units = "),
        ("volts", 2e3, 'offset = -0.5, units = "N" }', "`units = "),
    ],
)
def test_what_is_said_of_wrong_units_mends_the_mapping(mapping, tmp_path, channel, factor, mapped, said):
    scipy.io.savemat(tmp_path / "log.mat", RECORDED | {channel: factor * RECORDED[channel]})
    left_out = mapped if channel == "t" else mapped.split("units")[0].rstrip(", ") + " }"
    mapping.write_text(MAPPING.replace(mapped, left_out))
    report = Report()
    with suppress(UserError):  # An error is in the report, too.
        import_file([tmp_path / "log.mat"], mapping, tmp_path / "out.h5", report=report)
    (told,) = {m.group(1) for f in report if (m := re.search(rf'{said}"(.*?)"', f.message))}
    mended = f'time = {{ from = "t", units = "{told}" }}' if channel == "t" else f'{left_out[:-2]}, units = "{told}" }}'
    mapping.write_text(MAPPING.replace(mapped, mended))
    report = Report()
    import_file([tmp_path / "log.mat"], mapping, tmp_path / "out.h5", overwrite=True, report=report)
    assert [f for f in report if f.severity != "note"] == []


@pytest.mark.parametrize(
    ("stated", "scale", "warned"),
    [("lbf", 1.0, 1), ("lbf", -1.0, 1), ("lbf", 4.448, 0), ("N", 1.0, 0), ("x", 1.0, 0), ("kgf·cm", 1.0, 1)],
)
def test_units_that_no_mapping_converts_need_a_scale(mapping, tmp_path, stated, scale, warned):
    rows = np.column_stack([TIME, 40 + 30 * np.sin(TIME), 2 + 0.01 * np.sin(TIME), 5 + 4 * np.sin(TIME)])
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header=f"t,enc,force [{stated}],pull", comments="")
    text = MAPPING.split("tendon_force")[0].replace(", column = 1", "")
    text += f'tendon_force.T1 = {{ from = "force [{stated}]", scale = {scale}, units = "N" }}\n'
    mapping.write_text(text + 'tendon_excursion.T1 = { from = "pull", units = "mm" }\n')
    report = Report()
    with suppress(UserError):  # A negative tension is an error too.
        import_file([tmp_path / "log.csv"], mapping, tmp_path / "out.h5", report=report)
    said = [
        f.message
        for f in report
        if f"the recording states {stated}, and the mapping reads N; write `scale`" in f.message
    ]
    assert len(said) == warned


@pytest.mark.parametrize(("units", "warned"), [("N", ['write units = "kgf"']), ("kgf", [])])
def test_a_tension_in_kg_is_read_in_kgf(mapping, tmp_path, units, warned):
    rows = np.column_stack([TIME, 40 + 30 * np.sin(TIME), 2 + 0.01 * np.sin(TIME), 5 + 4 * np.sin(TIME)])
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header="t,enc,force [kg],pull", comments="")
    text = MAPPING.split("tendon_force")[0].replace(", column = 1", "")
    text += f'tendon_force.T1 = {{ from = "force [kg]", units = "{units}" }}\n'
    mapping.write_text(text + 'tendon_excursion.T1 = { from = "pull", units = "mm" }\n')
    report = Report()
    session = import_file([tmp_path / "log.csv"], mapping, tmp_path / "out.h5", report=report)
    assert [f.message.split("; ")[-1] for f in report if "states kg" in f.message] == warned
    force = session["01-ID2"].tendon_force
    assert force is not None
    np.testing.assert_allclose(force[0, 0], 2.0 * TO_SI[units].factor, rtol=1e-6)


def test_a_clock_in_another_unit_than_the_recording_states_is_said(mapping, tmp_path):
    rows = np.column_stack([1e3 * TIME, 40 + 30 * np.sin(TIME), 2 + 0.01 * np.sin(TIME), 5 + 4 * np.sin(TIME)])
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header="t [ms],enc,force,pull", comments="")
    text = MAPPING.replace(", column = 1", "").replace('"t"', '"t [ms]"')
    for read, warned in ((text, True), (text.replace('"t [ms]"', '{ from = "t [ms]", units = "ms" }'), False)):
        mapping.write_text(read)
        report = Report()
        with suppress(UserError):  # An error is in the report, too.
            import_file([tmp_path / "log.csv"], mapping, tmp_path / "out.h5", overwrite=True, report=report)
        said = [f.message for f in report if "the recording states ms, and the mapping reads s" in f.message]
        assert bool(said) == warned


def test_encoder_counts_are_not_taken_for_degrees(mapping, tmp_path):
    scipy.io.savemat(tmp_path / "log.mat", RECORDED | {"enc": RECORDED["enc"] * 4096 / 360})
    mapping.write_text(MAPPING.replace(', units = "deg"', ""))
    with pytest.raises(UserError, match="more than a turn; convert counts to rad"):
        import_file([tmp_path / "log.mat"], mapping, tmp_path / "out.h5")


def test_recordings_that_are_not_there_are_said_before_any_is_read(mapping, tmp_path):
    (tmp_path / "logs").mkdir()
    for given, words in (("lag.mat", "lag.mat: does not exist"), ("logs", "is a folder, .*name the recordings in it")):
        with pytest.raises(UserError, match=words):
            import_file([tmp_path / given], mapping, tmp_path / "out.h5")


def test_a_recording_that_cannot_be_read(mapping, tmp_path):
    (tmp_path / "log.mat").write_bytes(b"not a recording")
    with pytest.raises(UserError, match="cannot be read"):
        import_file([tmp_path / "log.mat"], mapping, tmp_path / "out.h5")
    with pytest.raises(UserError, match="does not exist"):
        import_file([tmp_path / "none.mat"], mapping, tmp_path / "out.h5")


def emps_balance(path, mapping, out):
    session = import_file([path], mapping, out)
    assert [f for f in check_file(out) if f.severity == "error"] == []
    (trial,) = session
    _, velocity, acceleration = smooth(trial.time, trial.q[:, 0], 40.0)
    force = smooth(trial.time, trial.joint_torque[:, 0], 40.0)[0]
    ones = np.ones_like(force)
    regressor = np.column_stack([acceleration, velocity, np.sign(velocity), ones])[500:-500]
    return np.linalg.lstsq(regressor, force[500:-500], rcond=None)[0]


def test_the_servo_axis_gives_its_published_parameters(tmp_path):
    """Janot, Gautier, Brunot 2019: M 95.11 kg, Fv 203.5 N s/m, Fc 20.39 N, offset -3.16 N."""
    mass, viscous, coulomb, offset = emps_balance(EMPS / "DATA_EMPS.mat", EMPS / "emps.toml", tmp_path / "a.h5")
    assert mass == pytest.approx(95.11, rel=0.01)
    assert viscous == pytest.approx(203.5, rel=0.06)
    assert coulomb == pytest.approx(20.39, rel=0.03)
    assert offset == pytest.approx(-3.16, rel=0.05)


def test_the_pulses_are_within_the_control_signal(tmp_path):
    """The balance closes on vir alone in the disturbed recording (datasets/emps/README.md)."""
    mass, _, coulomb, offset = emps_balance(EMPS / "DATA_EMPS_PULSES.mat", EMPS / "emps-pulses.toml", tmp_path / "a.h5")
    assert mass == pytest.approx(95.11, rel=0.02)
    assert coulomb == pytest.approx(20.39, rel=0.03)
    assert offset == pytest.approx(-3.16, rel=0.06)
