"""`look` describes a recording and proposes a mapping that imports it."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from jaxfinger.cli import main
from jaxfinger.data import read_session
from jaxfinger.data.importing.by_mapping import import_session
from jaxfinger.data.importing.mapping import read_mapping
from jaxfinger.data.importing.proposal import proposal
from jaxfinger.data.importing.sources import load_recording
from jaxfinger.data.importing.survey import clocks_of, columns_of
from jaxfinger.data.units import TO_SI
from tests.data.conftest import GAPPED_MS, ONE_JOINT, make_finger

TIME = np.arange(400) / 100.0
SWEEP = 0.5 + 0.4 * np.sin(TIME)
CASES = Path(__file__).parents[1] / "cases"


@pytest.fixture
def log(tmp_path):
    """CSV file with a gap, in degrees, N mm and ms, which only its ranges show."""
    columns = [
        GAPPED_MS,
        40 + 30 * np.sin(GAPPED_MS / 1e3),
        80 * np.cos(GAPPED_MS / 1e3),
        600 * np.sin(GAPPED_MS / 1e2),
    ]
    path = tmp_path / "log.csv"
    np.savetxt(path, np.column_stack(columns), "%.6f", ",", header="t,enc,dq,tau", comments="")
    return path


def test_units_rates_and_gaps(log):
    recording = load_recording(log)
    seen = columns_of(recording)
    assert [(s.name, s.meaning, s.units) for s in seen] == [
        ("t", "time", "ms"),
        ("enc", "q", "deg"),
        ("dq", "", ""),
        ("tau", "joint_torque", "N mm"),
    ]
    (clock,) = clocks_of(recording, seen)
    assert (clock.rate, clock.gaps, clock.longest) == (pytest.approx(200.0), 1, pytest.approx(0.04))


def test_columns_without_a_value_are_no_channel(tmp_path):
    """Unless others of their family have values: then they keep the places of these."""
    path, rows = tmp_path / "log.csv", [f"{k / 100},{np.sin(k / 50):.5f},,,,0.1" for k in range(900)]
    path.write_text("\n".join(["t,q_1,pos_1,pos_2,tau_1,tau_2", *rows, ""]))
    said = proposal([load_recording(path)])
    assert "channels.q.J2" not in said
    assert 'channels.joint_torque.J2 = { from = "tau_2"' in said


@pytest.mark.parametrize("name", ["Load Cell1", "load_cell_2", "LoadCell"])
def test_a_load_cell_shows_a_tension(name, tmp_path):
    path = tmp_path / "log.csv"
    np.savetxt(path, np.column_stack([GAPPED_MS, 5 + np.sin(GAPPED_MS)]), "%.6f", ",", header=f"t,{name}", comments="")
    assert columns_of(load_recording(path))[1].meaning == "tendon_force"


def test_of_several_sets_of_torques_one_that_changes_is_read_and_the_others_are_named(tmp_path):
    """A robot's log has torques of sensors, of currents and of its own model, without a word on which is which."""
    path, torques = tmp_path / "log.csv", [np.sin(GAPPED_MS / 1e3), np.cos(GAPPED_MS / 1e3)]
    angles, dead = (
        [0.5 + 0.5 * np.sin(GAPPED_MS / 1e3), 0.5 + 0.5 * np.cos(GAPPED_MS / 1e3)],
        [0.0 * GAPPED_MS, 0.0 * GAPPED_MS],
    )
    names = "t,Position1,Position2,TorqueSm1,TorqueSm2,Torque1,Torque2,TorqueCur1,TorqueCur2"
    table = np.column_stack([GAPPED_MS, *angles, *dead, *torques, *torques])
    np.savetxt(path, table, "%.6f", ",", header=names, comments="")
    said = proposal([load_recording(path)], make_finger())
    assert 'channels.joint_torque.PIP = { from = "Torque2"' in said
    others = '"TorqueCur1" to "TorqueCur2" or "TorqueSm1" to "TorqueSm2"'
    assert f"# joint_torque could also be {others}: take what was measured" in said
    assert "in no channel yet" not in said


def test_a_log_without_angles_belongs_to_the_angles_of_its_time(tmp_path):
    """The torque sensor's logger runs on its own clock; two sweeps at other times are two trials."""
    for k, start in enumerate((0.0, 100.0), 1):
        time, cell = start + np.arange(1000) / 100, start + 0.002 + np.arange(2000) / 200
        angles = np.column_stack([time, 40 + 30 * np.sin(time)])
        np.savetxt(tmp_path / f"angle{k}.csv", angles, "%.6f", ",", header="stamp,angle_deg", comments="")
        torques = np.column_stack([cell, 5 * np.sin(cell)])
        np.savetxt(tmp_path / f"cell{k}.csv", torques, "%.6f", ",", header="time_s,torque_Nmm", comments="")
    files = [tmp_path / f"{name}{k}.csv" for name in ("cell", "angle") for k in (1, 2)]
    text = proposal([load_recording(path) for path in files])
    assert text.count("[trials.") == 2
    assert 'file = "cell1.csv", time = { from = "time_s" }' in text.split("[trials.")[1]
    assert 'file = "cell2.csv", time = { from = "time_s" }' in text.split("[trials.")[2]


def test_units_that_no_mapping_converts_are_said_and_not_guessed_anew(tmp_path, capsys):
    path = tmp_path / "log.csv"
    rows = np.column_stack([GAPPED_MS / 1e3, 0.5 + 0.4 * np.sin(GAPPED_MS / 1e3), 0.3 + 0.2 * np.sin(GAPPED_MS / 1e3)])
    np.savetxt(path, rows, "%.6f", ",", header="t [s],MCP angle [turns],T1 length [in]", comments="")
    seen = columns_of(load_recording(path))
    assert [(s.meaning, s.units, s.foreign) for s in seen[1:]] == [("q", "turn", ""), ("tendon_excursion", "", "in")]
    main(["look", str(path)])
    said = capsys.readouterr().out
    assert 'channels.q.J1 = { from = "MCP angle [turns]", units = "turn" }' in said
    assert (
        'channels.tendon_excursion.T1 = { from = "T1 length [in]", units = "?" }   # it states in: write `scale` too'
        in said
    )


def test_the_sign_of_a_tendons_own_length_is_said(tmp_path, capsys):
    """An excursion is positive where the tendon is pulled in, and its length falls then."""
    path = tmp_path / "log.csv"
    rows = np.column_stack(
        [GAPPED_MS / 1e3, 0.4 * np.sin(GAPPED_MS / 1e3), *(0.2 + 0.01 * np.sin(GAPPED_MS / 1e3) for _ in "12")]
    )
    header = "t [s],q1 [rad],Muscle Length 1 [m],excursion 2 [m]"
    np.savetxt(path, rows, "%.6f", ",", header=header, comments="")
    main(["look", str(path)])
    said = capsys.readouterr().out
    np.savetxt(path, rows, "%.6f", ",", header="t [s],q1 [rad],len_1 [m],excursion 2 [m]", comments="")
    main(["look", str(path)])
    assert 'from = "len_1 [m]", units = "m" }   # a length that falls' in capsys.readouterr().out
    length = '{ from = "Muscle Length 1 [m]", units = "m" }   # a length that falls as the tendon is pulled in needs'
    assert f"{length} scale = -1\n" in said
    assert '{ from = "excursion 2 [m]", units = "m" }\n' in said


def test_units_that_a_file_states_come_first():
    recording = load_recording(CASES / "csv-as-other-programs-write-it" / "scope.csv")
    assert {s.name: (s.units, s.stated) for s in columns_of(recording)}["tau"] == ("N m", True)


@pytest.mark.parametrize(
    "file",
    [
        "csv-as-other-programs-write-it/latin1.csv",
        "csv-as-other-programs-write-it/scope.csv",
        "csv-as-other-programs-write-it/heads.csv",
        "joint-states-of-two-publishers/log",
        "one-message-at-time-zero/log.mcap",
        "simulink-signal-of-two-columns/log.mat",
        "own-clock-in-ms/log.mat",
    ],
)
@pytest.mark.parametrize("finger", [None, make_finger()])
def test_what_is_proposed_parses(file, finger, tmp_path):
    (tmp_path / "m.toml").write_text(proposal([load_recording(CASES / file)], finger))
    mapping, _ = read_mapping(tmp_path / "m.toml")
    assert mapping.trials


def test_what_is_proposed_imports(log, tmp_path, capsys):
    (tmp_path / "finger.toml").write_text(ONE_JOINT[ONE_JOINT.index("[finger]") :])
    main(["look", str(log), "--finger", str(tmp_path / "finger.toml")])
    said = capsys.readouterr().out
    (tmp_path / "m.toml").write_text(said[said.index("# a mapping") :])
    main(["import", str(log), "--mapping", str(tmp_path / "m.toml"), "--output", str(tmp_path / "s.h5")])
    capsys.readouterr()
    main(["look", str(log), "--json"])
    assert json.loads(capsys.readouterr().out)[0]["columns"][1]["high"] == pytest.approx(70, abs=0.1)


def test_names_do_not_steer_the_terminal(tmp_path, capsys):
    path = tmp_path / "log.mcap"
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("s", "jsonschema", b"{}")
        channel = writer.register_channel("/[/]\x1b[31m", "json", schema)
        for i in range(5):
            writer.add_message(channel, log_time=i, publish_time=i, data=json.dumps({"[/]q": i}).encode())
        writer.finish()
    main(["look", str(path)])
    said = capsys.readouterr().out
    assert "\x1b" not in said
    assert "[/]q" in said


def test_variables_that_give_no_numbers_are_named(tmp_path, capsys):
    scipy.io.savemat(tmp_path / "log.mat", {"t": GAPPED_MS, "note": "text", "z": 1j * GAPPED_MS})
    main(["look", str(tmp_path / "log.mat")])
    said = capsys.readouterr().out
    assert "z is complex" in said
    assert "note is text" in said


@pytest.mark.parametrize(
    ("columns", "experiment"),
    [
        ({"F_A": 2.0, "F_B": 2.0, "A_mm": 1.0}, "ID.2"),
        ({"A_mm": 1.0, "B_mm": 1.0}, "ID.2"),
        ({"knob_Nmm": 1.0}, "ID.3-dynamic"),
    ],
)
def test_what_is_measured_of_a_swept_joint_says_which_experiment_it_is(tmp_path, columns, experiment):
    """Without torque, a swept joint means ID.2. A column F_… is a force."""
    swing = 40.0 - 40.0 * np.cos(GAPPED_MS / 1e3)
    table = np.column_stack([GAPPED_MS, swing, *(level + 0.1 * swing for level in columns.values())])
    np.savetxt(tmp_path / "log.csv", table, "%.6f", ",", header=",".join(["stamp_ms", "a_deg", *columns]), comments="")
    recording = load_recording(tmp_path / "log.csv")
    assert f'experiment = "{experiment}"' in proposal([recording])
    forces = [s.name for s in columns_of(recording) if s.meaning == "tendon_force"]
    assert forces == [name for name in columns if name.startswith("F_")]


def test_a_unit_is_guessed_from_all_recordings_of_a_column(tmp_path):
    """A joint held at 5 degrees in one recording is in degrees where another recording shows it at 80."""
    logs = []
    for name, angle in (("held", np.full(len(GAPPED_MS), 5.7)), ("moved", 40.0 - 40.0 * np.cos(GAPPED_MS / 1e3))):
        logs.append(tmp_path / f"{name}.csv")
        np.savetxt(logs[-1], np.column_stack([GAPPED_MS, angle]), "%.6f", ",", header="t,angle", comments="")
    recordings = [load_recording(log) for log in logs]
    assert columns_of(recordings[0])[1].units == "rad"
    assert columns_of(recordings[0], recordings)[1].units == "deg"
    assert 'units = "rad"' not in proposal(recordings)


def test_what_no_channel_reads_and_unclear_units_are_marked(tmp_path):
    """Tensions of a thousand may be in mN or gf, so no unit is guessed, and the proposal says so."""
    names = ("enc", "cell_A", "reaction")
    table = np.column_stack(
        [GAPPED_MS, 40 + 30 * np.sin(GAPPED_MS / 1e3), 600 + 600 * np.sin(GAPPED_MS / 1e3), GAPPED_MS]
    )
    np.savetxt(tmp_path / "log.csv", table, "%.6f", ",", header=f"t,{','.join(names)}", comments="")
    said = proposal([load_recording(tmp_path / "log.csv")])
    assert 'channels.tendon_force.T1 = { from = "cell_A", units = "?" }   # its size does not tell' in said
    assert '# in no channel yet: "reaction"' in said


@pytest.mark.parametrize(("unit", "newtons"), [("gf", 9.80665e-3), ("kgf", 9.80665)])
def test_cells_may_read_gram_force(unit, newtons):
    assert TO_SI[unit] == ("N", newtons, 0.0)


@pytest.mark.parametrize(
    ("set_point", "measured"),
    [("q_des", "q_meas"), ("Winkel_Soll [°]", "Winkel_Ist [°]"), ("target_pos", "actual_pos"), ("qDes", "q"),
     ("des.q", "q"), ("pos_sp", "pos"), ("goal.joint.position", "joint.position"), ("enc_nominal", "enc_offset"),
     ("SetPoint.q", "dataset.q"), ("set.angle", "set1.angle"), ("qset", "q_reflex"),
     ("/hand/goals.position", "/target/joint_states.position"), ("state.q_d", "state.q"),
     ("target_q_0", "actual_q_0"), ("PositionCmptd1", "Position1")],
)  # fmt: skip
def test_a_measured_column_wins_over_its_set_point(tmp_path, set_point, measured):
    """A torque's feedforward is a set-point as well."""
    path = tmp_path / "log.csv"
    angle = 40 + 30 * np.sin(GAPPED_MS / 1e3)
    table = np.column_stack([GAPPED_MS, angle, angle + 0.1, np.cos(GAPPED_MS / 1e3), np.cos(GAPPED_MS / 1e3)])
    header = f"t,{set_point},{measured},tau_ff,tau"
    np.savetxt(path, table, "%.6f", ",", header=header, comments="", encoding="utf-8")
    said = proposal([load_recording(path)])
    assert f'channels.q.J1 = {{ from = "{measured}"' in said
    assert 'channels.joint_torque.J1 = { from = "tau"' in said
    assert f'# set-points by their names, which are not measured: "{set_point}", "tau_ff"' in said


def test_a_set_point_alone_is_said(tmp_path):
    path = tmp_path / "log.csv"
    table = np.column_stack([GAPPED_MS, 40 + 30 * np.sin(GAPPED_MS / 1e3), np.cos(GAPPED_MS / 1e3)])
    np.savetxt(path, table, "%.6f", ",", header="t,q_soll,tau", comments="")
    said = proposal([load_recording(path)])
    assert "channels.q" not in said
    assert '# set-points by their names, which are not measured: "q_soll"' in said


def test_robots_that_name_their_angles_q_have_no_angles_in_their_speeds(tmp_path):
    """Several joints move, and no torque says that one of them is led."""
    angles = [0.5 * np.sin(GAPPED_MS / 1e3), 0.5 * np.cos(GAPPED_MS / 1e3)]
    names = ["t", "actual_q_0", "actual_q_1", "actual_qd_0", "actual_qdd_1", "state.dq_0"]
    path = tmp_path / "log.csv"
    np.savetxt(path, np.column_stack([GAPPED_MS, *angles, *angles, angles[0]]), header=" ".join(names), comments="")
    said = proposal([load_recording(path)])
    assert 'channels.q.J2 = { from = "actual_q_1"' in said
    assert "channels.q.J3" not in said
    assert "\njoint = " not in said


def test_a_switch_and_a_single_number_are_no_measurements(tmp_path):
    """A temperature in the units that its range shows is no temperature in K."""
    path = tmp_path / "log.json"
    steady = [20.0 + 0.1 * (k % 3) for k in range(len(GAPPED_MS))]
    angle = (40 + 30 * np.sin(GAPPED_MS / 1e3)).tolist()
    on = [True] * len(GAPPED_MS)
    log = {"length": 0.12, "t": GAPPED_MS.tolist(), "enc": angle, "torque_enable": on, "force_ok": on, "temp": steady}
    path.write_text(json.dumps(log))
    said = proposal([load_recording(path)])
    assert "joint_torque" not in said
    assert "tendon" not in said
    assert '# in no channel yet: "length", "torque_enable", "force_ok"' in said
    assert 'channels.temperature.temp = { from = "temp", units = "degC" }' in said


@pytest.mark.parametrize(("motor", "joint"), [("motor_pos [deg]", "joint_pos [deg]"), ("driveAngle", "linkAngle")])
def test_a_motors_angle_is_no_joints(tmp_path, motor, joint):
    path, angle = tmp_path / "log.csv", 0.6 + 0.5 * np.sin(GAPPED_MS / 1e3)
    table = np.column_stack([GAPPED_MS, 100.0 * angle, angle, 0.01 * angle])
    np.savetxt(path, table, "%.6f", ",", header=f"t,{motor},{joint},torque", comments="")
    said = proposal([load_recording(path)], make_finger())
    assert f'channels.q.MCP = {{ from = "{joint}"' in said
    assert "channels.q.PIP" not in said
    assert f'# in no channel yet: "{motor}"' in said


@pytest.mark.parametrize(
    ("columns", "first", "second"), [("q2,q1", "q1", "q2"), ("enc_1_deg,enc_0_deg", "enc_0_deg", "enc_1_deg")]
)
def test_joints_that_are_named_by_number_are_taken_in_its_order(tmp_path, columns, first, second):
    path = tmp_path / "log.csv"
    table = np.column_stack([GAPPED_MS, 20.0 + 0.0 * GAPPED_MS, 40.0 + 30.0 * np.sin(GAPPED_MS / 1e3)])
    np.savetxt(path, table, "%.6f", ",", header=f"t,{columns}", comments="")
    said = proposal([load_recording(path)], make_finger())
    assert f'channels.q.MCP = {{ from = "{first}"' in said
    assert f'channels.q.PIP = {{ from = "{second}"' in said
    assert 'joint = "MCP"' in said


@pytest.mark.parametrize(
    ("degrees", "units", "stated"),
    [("inDegrees=yes", "deg", True), ("inDegrees=no", "rad", True), ("DataType=double", "rad", False)],
)
def test_the_header_of_a_table_of_opensim_states_the_units_of_its_angles(degrees, units, stated, tmp_path):
    """Small angles could be in rad. Speeds, lengths and forces in the same table are in no such unit."""
    path = tmp_path / "ik.mot"
    head = f"Coordinates\nversion=1\nnRows=40\nnColumns=4\n{degrees}\n\nendheader\n"
    names = "time\t/jointset/knee/knee_angle/value\t/jointset/knee/knee_angle/speed\tsoleus_force\n"
    rows = "".join(f"{0.1 * k:.2f}\t{0.05 * k:.3f}\t{k}\t{k}\n" for k in range(40))
    path.write_text(head + names + rows)
    time, angle, speed, force = columns_of(load_recording(path))
    assert (time.meaning, time.units) == ("time", "s")
    assert (angle.meaning, angle.units, angle.stated) == ("q", units, stated)
    assert (speed.meaning, speed.units, force.units) == ("", "", "")
    assert f'from = "{angle.name}", units = "{units}"' in proposal([load_recording(path)])


def _franka(before: str, number: str) -> tuple[list[str], np.ndarray]:
    """Names and samples of some arrays of libfranka's state, as its own log and those of franka_ros have them."""
    time = np.arange(500) / 1e3
    wave = np.stack([np.sin((3.0 + k) * time) for k in range(2)], axis=1)
    arrays = ["q_d", "theta", "theta_d", "q", "dq", "dq_d", "dtheta", "tau_J_d", "tau_J", "dtau_J"]
    arrays += ["tau_ext_hat_filtered", "joint_contact", "joint_collision", "F_x_Cee"]
    names = [f"{before}{name}{number.format(k)}" for name in arrays for k in range(2)]
    return ["time", *names], np.column_stack([1e3 * time, *[wave + 0.01 * k for k in range(len(arrays))]])


@pytest.mark.parametrize(("before", "number"), [("state.", "[{}]"), ("field.", "{}")])
@pytest.mark.parametrize("finger", [None, make_finger()])
def test_an_elastic_robots_joints_are_read_and_not_its_motors_nor_what_is_desired(tmp_path, before, number, finger):
    path, (names, table) = tmp_path / "log.csv", _franka(before, number)
    np.savetxt(path, table, "%.6f", ",", header=", ".join(names), comments="")
    said = proposal([load_recording(path)], finger)
    read = re.findall(r'channels\.(\w+)\.\w+ = \{ from = "([^"]+)"', said)
    assert read == [
        (c, f"{before}{n}{number.format(k)}") for c, n in (("q", "q"), ("joint_torque", "tau_J")) for k in (0, 1)
    ]
    ends = " to ".join(f'"{before}tau_ext_hat_filtered{number.format(k)}"' for k in (0, 1))
    assert f"# joint_torque could also be {ends}: take what was measured" in said
    desired = ", ".join(f'"{before}{n}_d{number.format(k)}"' for n in ("q", "theta", "dq", "tau_J") for k in (0, 1))
    assert f"# set-points by their names, which are not measured: {desired}\n" in said


def test_theta_alone_is_a_joints_angle(tmp_path):
    table = np.column_stack([GAPPED_MS, np.sin(GAPPED_MS / 1e3), np.cos(GAPPED_MS / 1e3)])
    np.savetxt(tmp_path / "log.csv", table, "%.6f", ",", header="duration,theta,theta_d", comments="")
    said = proposal([load_recording(tmp_path / "log.csv")])
    assert 'time = { from = "duration", units = "ms" }' in said
    assert 'channels.q.J1 = { from = "theta", units = "rad" }' in said
    assert "channels.q.J2" not in said


@pytest.mark.parametrize(
    ("upper", "said"), [(90.0, 'units = "deg" }'), (1800.0, 'units = "?" }   # its size does not tell')]
)
def test_the_size_of_an_angle_does_not_tell_degrees_of_a_joint_that_turns_on(tmp_path, upper, said):
    finger = make_finger()
    finger = replace(finger, limits=np.radians([[-10.0, upper], [0.0, 90.0]]))
    table = np.column_stack([GAPPED_MS, 12.0 + 12.0 * np.sin(GAPPED_MS / 1e3), np.cos(GAPPED_MS / 1e3)])
    np.savetxt(tmp_path / "log.csv", table, "%.6f", ",", header="t,q1,q2", comments="")
    text = proposal([load_recording(tmp_path / "log.csv")], finger)
    assert f'channels.q.MCP = {{ from = "q1", {said}' in text
    assert f'channels.q.PIP = {{ from = "q2", {said}' in text


@pytest.mark.parametrize(
    ("size", "units"), [(0.05, "N m"), (3.0, "?"), (60.0, "N mm"), (300.0, "N mm")], ids=["0.05", "3", "60", "300"]
)
def test_the_finger_s_weight_tells_the_unit_of_a_torque(tmp_path, size, units):
    """The finger weighs 22 N mm on an arm as long as its reach."""
    table = np.column_stack([GAPPED_MS, np.cos(GAPPED_MS / 1e3), size * np.sin(GAPPED_MS / 1e3)])
    np.savetxt(tmp_path / "log.csv", table, "%.6f", ",", header="t,q_MCP,tau_MCP", comments="")
    recordings, arm = [load_recording(tmp_path / "log.csv")], replace(make_finger(), mass=np.array([200.0, 100.0]))
    said = proposal(recordings, make_finger())
    assert f'channels.joint_torque.MCP = {{ from = "tau_MCP", units = "{units}" }}' in said
    assert "# joint_torque reaches " in said
    assert 'channels.joint_torque.MCP = { from = "tau_MCP", units = "N m" }' in proposal(recordings, arm)


def test_units_that_no_size_tells_are_asked_for(tmp_path, capsys):
    """Encoders that count, as those of servos, are in no unit of angles."""
    log, mapping = tmp_path / "log.csv", tmp_path / "m.toml"
    table = np.column_stack([GAPPED_MS, 2048 + 600 * np.sin(GAPPED_MS / 1e3), 0.01 * np.cos(GAPPED_MS / 1e3)])
    np.savetxt(log, table, ["%.1f", "%.0f", "%.6f"], ",", header="Time(ms),Present Position,torque", comments="")
    (tmp_path / "finger.toml").write_text(ONE_JOINT[ONE_JOINT.index("[finger]") :])
    main(["look", str(log), "--finger", str(tmp_path / "finger.toml")])
    said = capsys.readouterr().out
    mapping.write_text(said[said.index("# a mapping") :])
    with pytest.raises(SystemExit):
        main(["import", str(log), "--mapping", str(mapping), "--output", str(tmp_path / "s.h5")])
    said = capsys.readouterr().err
    assert (
        "channels.q.MCP: has units that are still to be filled in; write one of rad, mrad, deg, gon, turn, and" in said
    )


def test_messages_that_ros2_topic_echo_wrote_are_proposed_and_imported(tmp_path, capsys):
    angle, torque = 0.5 + 0.4 * np.sin(GAPPED_MS / 1e3), 0.01 * np.cos(GAPPED_MS / 1e3)
    sec, beyond = (GAPPED_MS // 1e3).astype(int), (GAPPED_MS % 1e3 * 1e6).astype(int)
    rows = zip(sec, beyond, angle.tolist(), torque.tolist(), strict=True)
    log, mapping = tmp_path / "log.csv", tmp_path / "m.toml"
    log.write_text("".join(f"{1700000000 + s},{ns},,MCP,{q!r},,{tau!r}\n" for s, ns, q, tau in rows))
    (tmp_path / "finger.toml").write_text(ONE_JOINT[ONE_JOINT.index("[finger]") :])
    main(["look", str(log), "--finger", str(tmp_path / "finger.toml")])
    said = capsys.readouterr().out
    mapping.write_text(said[said.index("# a mapping") :])
    main(["import", str(log), "--mapping", str(mapping), "--output", str(tmp_path / "s.h5")])
    (trial,) = read_session(tmp_path / "s.h5")
    np.testing.assert_allclose(trial.time, (GAPPED_MS - GAPPED_MS[0]) / 1e3, atol=1e-6)
    np.testing.assert_array_equal(trial.q[:, 0], angle)
    np.testing.assert_array_equal(trial.joint_torque[:, 0], torque)


def test_arrays_with_joints_first_are_named(tmp_path):
    """The times lie in another structure, so that nothing beside the array says which way it lies."""
    scipy.io.savemat(tmp_path / "log.mat", {"clock": {"t": TIME}, "q": np.stack([SWEEP, SWEEP])})
    assert '# "q" is 2 by 400, joints first: transpose it, and save it again' in proposal(
        [load_recording(tmp_path / "log.mat")]
    )


def test_a_log_whose_clock_began_elsewhere_is_told_how_to_join_a_trial(tmp_path):
    logs = [tmp_path / "angles.csv", tmp_path / "forces.csv"]
    for path, start, name in zip(logs, (1.7e9, 0.0), ("angle [rad]", "force [N]"), strict=True):
        table = np.column_stack([start + TIME, SWEEP])
        np.savetxt(path, table, "%.6f", ",", header=f"stamp,{name}", comments="")
    said = proposal([load_recording(path) for path in logs])
    assert 'each with file = "forces.csv" and time =\n# { from = "stamp", offset = … }' in said
    mapping = tmp_path / "m.toml"
    mapping.write_text(
        ONE_JOINT + '[trials.a]\nexperiment = "VD.1"\ntime = "stamp"\nfile = "angles.csv"\n'
        'channels.q.MCP = "angle [rad]"\nchannels.tendon_force.T1 = { from = "force [N]", file = "forces.csv", '
        'time = { from = "stamp", offset = 1.7e9 } }\n'
    )
    trial = import_session(logs, mapping)["a"]
    assert trial.tendon_force is not None
    np.testing.assert_allclose(trial.tendon_force[:, 0], SWEEP, atol=1e-5)


@pytest.mark.parametrize(("bits", "unwraps"), [(32, True), (16, True), (31, False)])
def test_a_clock_that_wraps_after_its_bits_is_unwrapped(tmp_path, bits, unwraps):
    """Any other jump back begins another part."""
    ticks = (2**bits - 2000 + np.round(1e3 * TIME)) % 2**bits
    table = np.column_stack([ticks, SWEEP])
    np.savetxt(tmp_path / "log.csv", table, "%.6f", ",", header="t_ms,q", comments="")
    said = proposal([load_recording(tmp_path / "log.csv")])
    assert (f'time = {{ from = "t_ms", units = "ms", unwrap = {2**bits} }}' in said) == unwraps
    assert ("the time begins again" in said) != unwraps


def test_a_force_that_pushes_and_pulls_is_of_a_lever_and_no_tension(tmp_path):
    """Else it is read as the first tendon's tension, and the trial as an ID.2. The unit stays open, as the arm is."""
    rng = np.random.default_rng(0)

    def said(force, name="force_N", cell="tension_T1"):
        rows = zip(TIME, SWEEP, force, 2.0 + 0.1 * rng.standard_normal(400), strict=True)
        lines = [f"{t:.3f},{np.degrees(q):.4f},{f:.5f},{pull:.4f}" for t, q, f, pull in rows]
        path = tmp_path / "log.csv"
        path.write_text("\n".join([f"t,angle_MCP,{name},{cell}", *lines, ""]))
        return proposal([load_recording(path)])

    lever = said(3.0 * (SWEEP - 0.5) + 0.02 * rng.standard_normal(400))
    assert 'experiment = "ID.3-' in lever
    assert '{ from = "force_N", units = "?" }   # it pushes and pulls, as no tendon does' in lever
    slack = said(0.02 * rng.standard_normal(400))
    assert "joint_torque" not in slack
    assert "joint_torque" not in said(5.0 * (SWEEP - 0.02) ** 2 - 0.1)  # a tare that is off
    assert "joint_torque" not in said(3.0 * (SWEEP - 0.5), name="tension_T2")
