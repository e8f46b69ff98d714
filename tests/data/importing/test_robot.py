"""Fingers from robots' descriptions, beside MuJoCo's own dynamics and tendons."""

import tomllib

import mujoco
import numpy as np
import pytest

from jaxfinger.cli import main
from jaxfinger.data import FingerDescription, read_session
from jaxfinger.data.checks.finger import check_finger
from jaxfinger.data.findings import Report
from jaxfinger.data.finger_file import finger_toml
from jaxfinger.data.importing.robot import robot_finger
from jaxfinger.errors import UserError
from jaxfinger.model import Finger
from jaxfinger.model.rigid_body import inverse_dynamics
from jaxfinger.synthetic.fingers import specimen_of
from jaxfinger.synthetic.recipe import read_session_recipe

INERTIAL = (
    '<inertial><origin xyz="{at}" rpy="0.3 -0.2 0.1"/><mass value="{mass}"/>'
    '<inertia ixx="{I}e-5" ixy="1e-6" ixz="0" iyy="{J}e-5" iyz="-1e-6" izz="{K}e-5"/></inertial>'
)
MESH = '<visual><geometry><mesh filename="package://nowhere/link.stl"/></geometry></visual>'


def link(name, mass=0.0, at="0.02 0.003 -0.004", inertia=(2, 4, 5)):
    body = INERTIAL.format(at=at, mass=mass, I=inertia[0], J=inertia[1], K=inertia[2]) if mass else ""
    return f'<link name="{name}">{body}{MESH}</link>'


def joint(name, parent, child, kind="revolute", xyz="0 0 0", rpy="0 0 0", axis="0 1 0", limits="-1.2 1.5"):
    low, high = limits.split()
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}" '
        f'rpy="{rpy}"/><axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="1" velocity="1"/></joint>'
    )


# A hand that leans, with two fingers. One has a joint that slides, frames that turn, and a sensor at its tip.
URDF = "".join(
    [
        '<robot name="hand">',
        link("base"),
        joint("lean", "base", "palm", "fixed", xyz="0 0 0.1", rpy="0.4 0.2 -0.3"),
        link("palm", 0.5),
        joint("spread", "palm", "root", xyz="0.05 0.01 0", rpy="0 0 0.7", axis="0 0 1"),
        link("root", 0.05),
        joint("flex", "root", "middle", xyz="0.04 0 0.01", rpy="1.1 0 0.2", axis="0.6 0.8 0"),
        link("middle", 0.03),
        joint("slide", "middle", "rod", "prismatic", xyz="0.03 0 0", axis="1 0 0", limits="0 0.02"),
        link("rod", 0.02),
        joint("mount", "rod", "sensor", "fixed", xyz="0.03 0 0.002", rpy="0 0.5 0"),
        link("sensor", 0.004),
        joint("grip", "rod", "hook", xyz="0.01 0 0"),
        link("hook", 0.006),
        joint("thumb", "palm", "thumb_link", "continuous", xyz="0 0.04 0"),
        link("thumb_link", 0.04),
        "</robot>",
    ]
)
MJCF = """<mujoco><compiler angle="radian"/><option gravity="0 0 -9.81"/><worldbody><body name="palm">
<geom type="box" size="0.02 0.01 0.01" mass="0.3"/><site name="a" pos="-0.02 0 -0.008"/><site name="b" pos="0 0 0.008"/>
<body name="first" pos="0.03 0 0"><joint name="abduction" axis="0 0 1" range="-0.3 0.3" armature="2e-6"/>
<joint name="mcp" axis="0 1 0" range="-0.2 1.4"/><geom type="capsule" fromto="0 0 0 0.04 0 0" size="0.006" mass="0.02"/>
<geom name="pulley" type="cylinder" size="0.006 0.01" euler="1.5708 0 0" mass="0.001"/>
<site name="side" pos="0 0 -0.02"/><site name="c" pos="0.02 0 -0.007"/><site name="d" pos="0.02 0 0.006"/>
<body name="second" pos="0.04 0 0"><joint name="pip" axis="0 1 0" range="0 1.5"/>
<geom type="capsule" fromto="0 0 0 0.03 0 0" size="0.005" mass="0.01"/><site name="e" pos="0.01 0 -0.006"/>
<site name="tip" pos="0.03 0 0"/></body></body></body></worldbody>
<tendon><spatial name="flexor"><site site="a"/><geom geom="pulley" sidesite="side"/><site site="c"/><site site="e"/>
</spatial><spatial name="extensor"><site site="b"/><site site="d"/></spatial><spatial name="none"><site site="a"/>
<site site="b"/></spatial><fixed name="coupling"><joint joint="mcp" coef="1"/><joint joint="pip" coef="-1"/></fixed>
</tendon><actuator><general tendon="flexor"/></actuator></mujoco>"""

PIP = 'name="pip" axis="0 1 0" range="0 1.5"'
BALL = MJCF.replace(PIP, 'name="pip" type="ball"').replace('<joint joint="pip" coef="-1"/>', "")


@pytest.fixture
def urdf(tmp_path):
    path = tmp_path / "hand.urdf"
    path.write_text(URDF)
    return path


@pytest.fixture
def mjcf(tmp_path):
    path = tmp_path / "hand.xml"
    path.write_text(MJCF)
    return path


def mujoco_torques(model, names, q, rate, acceleration) -> np.ndarray:
    """Torques (N, m) of the named joints by MuJoCo, all others standing."""
    at = [model.joint(name).qposadr[0] for name in names]
    of = [model.joint(name).dofadr[0] for name in names]
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data, out = mujoco.MjData(model), []
    for x, v, a in zip(q, rate, acceleration, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[at], data.qvel[of], data.qacc[of] = x, v, a
        mujoco.mj_inverse(model, data)
        out.append(data.qfrc_inverse[of].copy())
    return np.array(out)


def motion(finger: FingerDescription, rng):
    q = rng.uniform(*finger.limits.T, size=(20, finger.m))
    return q, rng.standard_normal(q.shape), 10.0 * rng.standard_normal(q.shape)


@pytest.mark.parametrize(
    "joints", [("spread", "flex", "slide"), ("slide", "spread"), ("spread", "flex", "slide", "grip")]
)
def test_a_urdf_has_the_dynamics_that_mujoco_gives_it(urdf, joints):
    """Also where a joint within the chain or beyond it is held."""
    finger = robot_finger(urdf, joints).finger
    bare = URDF.replace(MESH, "").replace("</robot>", '<mujoco><compiler fusestatic="false"/></mujoco></robot>')
    model = mujoco.MjModel.from_xml_string(bare)
    moved = motion(finger, np.random.default_rng(1))
    expected = mujoco_torques(model, finger.joint_names, *moved)
    found = inverse_dynamics(Finger.from_description(finger), *(x.T for x in moved)).T
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())


def test_an_mjcf_has_the_dynamics_that_mujoco_gives_it(mjcf):
    """Two joints of one body have a link of a millionth of it between them."""
    finger = robot_finger(mjcf).finger
    model = mujoco.MjModel.from_xml_path(str(mjcf))
    moved = motion(finger, np.random.default_rng(2))
    expected = mujoco_torques(model, finger.joint_names, *moved)
    found = inverse_dynamics(Finger.from_description(finger), *(x.T for x in moved)).T
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


SHAPES = """<asset><texture name="wood" type="2d" file="wood.png"/><material name="oak" texture="wood"/>
<mesh name="bone" file="bone.stl"/></asset>"""
BONE = '<geom type="mesh" mesh="bone"/><geom type="sphere" size="0.01" material="oak"/>'
WEIGHED = '<inertial mass="0.02" pos="0.02 0 0" diaginertia="1e-6 2e-6 2e-6"/>'


def skeleton(tmp_path, weighed: str, bones: str):
    path = tmp_path / "bones.xml"
    joint = '<joint name="mcp" axis="0 1 0" range="0 1.5"/>'
    path.write_text(
        f'<mujoco><compiler autolimits="true"/>{SHAPES if bones else ""}<worldbody>{bones}'
        f'<body name="first">{joint}{weighed}{bones}</body></worldbody></mujoco>'
    )
    return path


def test_an_mjcf_whose_meshes_and_pictures_are_not_there_has_the_links_that_it_states(tmp_path):
    found = robot_finger(skeleton(tmp_path, WEIGHED, BONE)).finger
    stated = robot_finger(skeleton(tmp_path, WEIGHED, "")).finger
    assert finger_toml(found) == finger_toml(stated)
    np.testing.assert_array_equal(found.mass, [0.02])


def test_a_mass_that_only_a_mesh_would_give_is_refused(tmp_path):
    with pytest.raises(UserError, match="link 'first' has its mass from the mesh 'bone', which is not there; put"):
        robot_finger(skeleton(tmp_path, "", BONE))


def test_tendons_pull_in_what_their_paths_say(mjcf):
    finger, _, remarks = robot_finger(mjcf)
    assert finger.joint_names == ("abduction", "mcp", "pip")
    assert finger.tendon_names == ("flexor", "extensor")
    assert finger.active.tolist() == [True, False]
    assert finger.rotor_inertia is not None
    np.testing.assert_allclose(finger.rotor_inertia, [2e-6, 0.0, 0.0])
    np.testing.assert_allclose(finger.fingertip, [0.03, 0.0, 0.0], atol=1e-12)
    model = mujoco.MjModel.from_xml_path(str(mjcf))
    data = mujoco.MjData(model)
    assert finger.excursion is not None
    for joint, q in (("mcp", 0.9), ("pip", 1.2)):
        lengths = []
        for angle in (q - 1e-4, q + 1e-4):
            data.qpos[:] = 0.0
            data.qpos[model.joint(joint).qposadr[0]] = angle
            mujoco.mj_forward(model, data)
            lengths.append(data.ten_length[:2].copy())
        powers = np.arange(1, 5) * q ** np.arange(4)
        arms = finger.excursion[:, finger.joint_names.index(joint)] @ powers
        np.testing.assert_allclose(arms, (lengths[0] - lengths[1]) / 2e-4, atol=2e-4)
    assert np.array_equal(finger.crosses[:, 1:], [[True, True], [True, False]])
    # The extensor runs straight over both axes of the first joint.
    assert [x.split(":")[0] for x in remarks if "cross_terms" in x] == ["extensor"]


SPRUNG = MJCF.replace(PIP, PIP + ' stiffness="0.02" springref="0.3" damping="1e-3" frictionloss="4e-3"').replace(
    '<spatial name="flexor">', '<spatial name="flexor" frictionloss="0.2">'
)


def passive_torque(model, q, rate) -> float:
    """Torque of the spring, the damper and the dry friction of pip, on the left of the equation of motion (1)."""
    data = mujoco.MjData(model)
    dof = model.joint("pip").dofadr[0]
    data.qpos[model.joint("pip").qposadr[0]], data.qvel[dof] = q, rate
    mujoco.mj_forward(model, data)
    dry = np.sign(rate) * model.dof_frictionloss[dof]
    return dry - data.qfrc_spring[dof] - data.qfrc_damper[dof]


def test_springs_damping_and_friction_of_a_robot_are_the_terms_of_its_simulation(tmp_path):
    """`jaxfinger simulate` reads them beside the finger."""
    path = tmp_path / "sprung.xml"
    path.write_text(SPRUNG)
    main(["new", f"{tmp_path}/f.toml", f"{tmp_path}/m.toml", "--robot", str(path)])
    finger = specimen_of(read_session_recipe(tmp_path / "f.toml").specimen)
    model = mujoco.MjModel.from_xml_path(str(path))
    for angle, rate in ((1.2, 0.7), (0.1, -2.0)):
        q = np.array([0.0, 0.0, angle])
        found = finger.elastic(q) + np.sign(rate) * finger.friction.magnitude(q) + rate * np.array(finger.damping)
        np.testing.assert_allclose(found, [0.0, 0.0, passive_torque(model, angle, rate)], rtol=1e-9, atol=1e-15)
    assert "[terms.joints.mcp]" not in (tmp_path / "f.toml").read_text()
    assert "[terms.tendons.flexor]\nconstant = 0.2\n" in (tmp_path / "f.toml").read_text()


def test_the_mapping_pulls_each_active_tendon_at_the_last_joint_that_it_crosses(tmp_path):
    path = tmp_path / "hand.xml"
    path.write_text(MJCF.replace("</actuator>", '<general tendon="extensor"/></actuator>'))
    main(["new", f"{tmp_path}/f.toml", f"{tmp_path}/m.toml", "--robot", str(path)])
    trials = tomllib.loads((tmp_path / "m.toml").read_text())["trials"].values()
    pulled = {trial["tendon"]: trial["joint"] for trial in trials if trial["experiment"] == "ID.4"}
    assert pulled == {"flexor": "pip", "extensor": "mcp"}


def test_what_terms_cannot_say_of_a_robot_is_named(tmp_path):
    path = tmp_path / "sprung.xml"
    path.write_text(SPRUNG.replace('name="extensor"', 'name="extensor" stiffness="300"'))
    said = [x for x in robot_finger(path).remarks if "spring" in x]
    assert said == ["extensor: a spring or damper along its path in the file is no part of a finger"]


def test_a_link_that_no_body_could_be_is_changed_and_named(tmp_path):
    """The inertias of vendors' files are rounded, zero for frames, and now and then impossible."""
    path = tmp_path / "hand.urdf"
    thin = '<inertia ixx="0" ixy="0" ixz="0" iyy="4e-5" iyz="0" izz="4e-5"/>'
    wrong = '<inertia ixx="2e-5" ixy="0" ixz="0" iyy="4e-5" iyz="0" izz="8e-5"/>'
    for given, named in ((thin, False), (wrong, True)):
        text = f'<robot name="x">{link("base")}{joint("j", "base", "rod")}<link name="rod"><inertial>'
        path.write_text(f'{text}<mass value="0.1"/>{given}</inertial></link></robot>')
        finger, _, remarks = robot_finger(path)
        assert any("rod: its inertia in the file is impossible" in x for x in remarks) == named
        small, middle, large = np.linalg.eigvalsh(finger.inertia[0])
        assert small > 0.0
        assert large <= (small + middle) * (1.0 + 1e-6)
        np.testing.assert_allclose([middle, large], [4e-5, 6e-5 if named else 4e-5], rtol=1e-3)


@pytest.mark.parametrize(
    ("joints", "tip", "says"),
    [
        ((), "", "has several chains; name the joints of one with --joints: spread,flex,slide,grip or thumb"),
        (("flexx",), "", "has no joint flexx (did you mean 'flex'?)"),
        (("spread", "thumb"), "", "spread, thumb do not lie on one way from base to tip"),
        (("spread", "flex", "slide"), "senser", "the last link has no senser (did you mean 'sensor'?)"),
    ],
)
def test_what_the_file_does_not_have_is_refused(urdf, joints, tip, says):
    with pytest.raises(UserError, match=r"hand\.urdf: ") as error:
        robot_finger(urdf, joints, tip)
    assert says in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x,y\n1,2\n", "is no XML"),
        ("<html></html>", "begins with <html>"),
        (
            URDF.replace("<link", '<xacro:macro xmlns:xacro="http://www.ros.org/wiki/xacro" name="f"/><link', 1),
            "still has macros",
        ),
        (f'<robot name="x">{link("base")}</robot>', "has no joint that moves"),
        (f'<robot name="x">{link("base")}{joint("j", "base", "tip")}{link("tip")}</robot>', "has no mass"),
        (URDF.replace('lower="0" upper="0.02"', 'lower="x" upper="1"'), "MuJoCo cannot read it"),
        (BALL, "pip is no hinge and no slide"),
        (
            MJCF.replace(PIP, 'name="pip" type="slide" axis="1 0 0"'),
            "pip slides without limits",
        ),
    ],
    ids=["no XML", "HTML", "xacro", "no joints", "no mass", "no number", "ball", "slide"],
)
def test_a_file_that_gives_no_finger_is_refused(tmp_path, text, says):
    path = tmp_path / "robot.xml"
    path.write_text(text)
    with pytest.raises(UserError, match=r"robot\.xml: ") as error:
        robot_finger(path)
    assert says in str(error.value)


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"gone\.urdf: cannot be read \(No such file"):
        robot_finger(tmp_path / "gone.urdf")


def test_joints_that_follow_others_or_have_no_limits_are_named(tmp_path, urdf):
    follow = MJCF.replace("<actuator>", '<equality><joint joint1="pip" joint2="mcp"/></equality><actuator>')
    path = tmp_path / "hand.xml"
    path.write_text(follow)
    assert any("pip: follows mcp in the file, and is held here" in x for x in robot_finger(path, ["mcp"]).remarks)
    assert any("pip: follows mcp in the file, and is a joint of its own here" in x for x in robot_finger(path).remarks)
    assert any("thumb: has no limits" in x for x in robot_finger(urdf, ["thumb"]).remarks)
    assert any("flex: held where the file has it" in x for x in robot_finger(urdf, ["spread", "slide"]).remarks)


@pytest.mark.parametrize(("limit", "degrees"), [("12.57", 721.0), ("7.94", 455.0), ("114.6", 6567.0), ("90", 5156.62)])
def test_limits_of_several_turns_are_written_in_whole_degrees_and_those_in_degrees_stay(tmp_path, limit, degrees):
    """The format takes the one for an arm's last joint, and refuses the other; of fractions only a person can tell."""
    text = joint("flex", "root", "middle", limits=f"-{limit} {limit}")
    text = "".join(['<robot name="arm">', link("root"), text, link("middle", 0.03), "</robot>"])
    path = tmp_path / "turns.urdf"
    path.write_text(text)
    finger, _, remarks = robot_finger(path)
    assert np.degrees(finger.limits[0]) == pytest.approx([-degrees, degrees], abs=0.01)
    (said,) = [remark for remark in remarks if "limits" in remark]
    turns = f"{float(limit) / np.pi:.3g} turns"
    assert (
        said
        == f"flex: the file's limits, read as rad, leave it {turns}; if they are degrees, write them as `limits_deg`"
    )
    check_finger(finger, report := Report())
    assert [f.place for f in report] == (["/finger/joints/limits"] if limit == "90" else [])


def test_new_writes_the_finger_of_a_robot_and_reads_logs_of_one_time(urdf, tmp_path, capsys):
    """Angles and torques lie in files of their own, as exports of topics do: one trial reads both."""
    time = np.arange(3000) / 100.0
    way = np.column_stack([0.5 - 0.4 * np.cos((1 + k / 7) * time) for k in range(3)]) * [1.0, 1.0, 0.01]
    torque = np.column_stack([0.1 * np.sin(time + k) for k in range(3)])
    names = ("spread", "flex", "slide")
    for what, values in (("position", way), ("effort", torque), ("velocity", np.gradient(way, 0.01, axis=0))):
        header = ",".join(["t", *(f"- {name}_{what}" for name in names)])
        table = np.column_stack([time, values])
        np.savetxt(tmp_path / f"hand_{what}.csv", table, delimiter=",", header=header, comments="")
    files = [f"{tmp_path}/hand_{what}.csv" for what in ("effort", "position", "velocity")]
    written = [f"{tmp_path}/f.toml", f"{tmp_path}/m.toml"]
    main(["new", *written, *files, "--robot", str(urdf), "--joints", ",".join(names)])
    assert "f.toml: 3 joints, 0 tendons; from hand.urdf" in capsys.readouterr().out.replace("\n", " ")
    main(["import", *files[:2], "--mapping", written[1], "-o", f"{tmp_path}/s.h5"])
    (trial,) = read_session(tmp_path / "s.h5")
    assert trial.joint is None
    np.testing.assert_allclose(trial.q, way, atol=1e-12)
    np.testing.assert_allclose(trial.joint_torque, torque, atol=1e-12)


@pytest.mark.parametrize("more", [["--robot", "hand.urdf", "--tendons", "T1"], ["--tip", "sensor"]])
def test_options_that_contradict_each_other_are_refused(urdf, tmp_path, more, capsys):
    more = [str(urdf) if x == "hand.urdf" else x for x in more]
    with pytest.raises(SystemExit) as stopped:
        main(["new", f"{tmp_path}/f.toml", f"{tmp_path}/m.toml", *more])
    assert stopped.value.code == 2
    assert not (tmp_path / "f.toml").exists()
