"""`jaxfinger new` writes a finger and a mapping that can be read unchanged."""

import numpy as np
import pytest

from jaxfinger.cli import main
from jaxfinger.data import check_file, read_session

NAMES = ("MCP", "P.IP")  # TOML must quote the second.


@pytest.fixture
def written(tmp_path):
    main(["new", f"{tmp_path}/finger.toml", f"{tmp_path}/mapping.toml", "--joints", "MCP,P.IP", "--tendons", "T1"])
    return tmp_path


def log(path, moved, pulled=False):
    """Write a recording with the template's names of columns, angles in degrees and lengths in mm."""
    rng, time = np.random.default_rng(len(str(path))), np.arange(600) / 50
    sweep = 40 - 30 * np.cos(time)
    angle = {name: sweep if name == moved and not pulled else 20 + 0.01 * rng.standard_normal(600) for name in NAMES}
    force = 2 + 4 * np.floor(time / 3) if pulled else np.full(600, 2.0)
    columns = {"time": time} | {f"angle {name}": values for name, values in angle.items()}
    columns |= {"force T1": force + 0.01 * rng.standard_normal(600), "torque": -0.005 * force + 1e-4 * sweep}
    columns |= {"length T1": 0.14 * angle["MCP"] + 0.1 * angle["P.IP"]}
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=",", header=",".join(columns), comments="")


def test_templates_import_once_the_files_are_there(written, capsys):
    trials = ("01-ID.2-MCP", "02-ID.2-P.IP", "03-ID.3-dynamic-MCP", "04-ID.3-dynamic-P.IP", "05-ID.4-T1-P.IP")
    for name in trials:
        log(written / f"{name}.csv", name.rsplit("-", 1)[1], pulled="ID.4" in name)
    files = [f"{written}/{name}.csv" for name in trials]
    main(["import", *files, "--mapping", f"{written}/mapping.toml", "-o", f"{written}/session.h5"])
    session = read_session(written / "session.h5")
    assert tuple(session.trials) == trials
    assert session.finger.joint_names == NAMES
    assert session.finger.tendon_names == ("T1",)
    assert not [f for f in check_file(written / "session.h5") if f.severity == "error"]
    np.testing.assert_allclose(session["01-ID.2-MCP"].q[:, 0].max(), np.radians(70), rtol=1e-3)
    example = "/finger/links: has the masses and centres of mass that `jaxfinger new` writes as an example"
    assert example in capsys.readouterr().err
    main(["check", f"{written}/session.h5"])
    assert example in capsys.readouterr().out
    finger = written / "finger.toml"
    finger.write_text(finger.read_text().replace("mass = 0.022 ", "mass = 0.0221"))
    main(["import", *files, "--mapping", f"{written}/mapping.toml", "-o", f"{written}/other.h5"])
    assert example not in capsys.readouterr().err


def test_nothing_is_overwritten_unless_asked_and_names_differ(written, capsys):
    before = (written / "finger.toml").read_text()
    files = ["new", f"{written}/finger.toml", f"{written}/other.toml"]
    for more, says in (([], "exists already"), (["--overwrite", "--joints", "A,A"], "the joint A is named twice")):
        with pytest.raises(SystemExit) as stopped:
            main(files + more)
        assert stopped.value.code == 2
        assert says in capsys.readouterr().err
        assert (written / "finger.toml").read_text() == before
        assert not (written / "other.toml").exists()


def foreign(path, moves=(), pulls=None, torque=False, stepped=False):
    """Write a log of another rig: names of its own, joints in the wrong order, in degrees, mm, ms and N mm."""
    rng, time = np.random.default_rng(len(str(path))), np.arange(1200) / 50
    way = np.interp(time % 2.0, [0, 0.6, 2.0], [0.0, 1.0, 1.0]) + time // 2.0 if stepped else 6 - 6 * np.cos(time)
    angle = {n: 20 + (5 * way if n in moves else 0) + 0.01 * rng.standard_normal(1200) for n in ("middle", "knuckle")}
    force = {n: (2 + 2 * np.floor(time / 4) if n == pulls else 2.0) + 0.01 * rng.standard_normal(1200) for n in "AB"}
    columns = {"stamp_ms": 1.7e12 + 1e3 * time} | {f"{n} angle (deg)": x for n, x in angle.items()}
    columns |= {f"cable {n} force [N]": x for n, x in force.items()}
    if torque:
        columns["bridge Nmm"] = 5 + 0.1 * way + 0.01 * rng.standard_normal(1200)
    else:
        columns |= {f"cable {n} travel [mm]": k * angle["middle"] for n, k in (("A", 0.1), ("B", -0.1))}
    np.savetxt(path, np.column_stack(list(columns.values())), delimiter=";", header=";".join(columns), comments="")


FOREIGN = {
    "01-paths": (dict(moves=["middle"]), ("ID.2", "middle", None)),
    "02-led": (dict(moves=["middle", "knuckle"]), ("VD.1", None, None)),
    "03-steps": (dict(moves=["knuckle"], torque=True, stepped=True), ("ID.3-static", "knuckle", None)),
    "04-sweep": (dict(moves=["middle"], torque=True), ("ID.3-dynamic", "middle", None)),
    "05-pull-Knuckle": (dict(pulls="B", torque=True), ("ID.4", "knuckle", "cable B")),
}


def test_recordings_are_read_and_what_moves_tells_what_they_are(tmp_path, capsys):
    """Each trial is one file, and only names are given: the guessed mapping can be imported unchanged."""
    for name, (how, _) in FOREIGN.items():
        foreign(tmp_path / f"{name}.csv", **how)
    files = [f"{tmp_path}/{name}.csv" for name in FOREIGN]
    written = [f"{tmp_path}/f.toml", f"{tmp_path}/m.toml"]
    main(["new", *written, *files, "--joints", "knuckle,middle", "--tendons", "cable A,cable B"])
    assert (tmp_path / "m.toml").read_text().count("knuckle angle (deg)") == 1  # shared
    main(["import", *files, "--mapping", written[1], "-o", f"{tmp_path}/s.h5"])
    session = read_session(tmp_path / "s.h5")
    for name, (_, said) in FOREIGN.items():
        found = session[name]
        assert (found.experiment, found.joint, found.tendon) == said
    np.testing.assert_allclose(session["04-sweep"].q[:, 1].max(), np.radians(80), atol=1e-3)
    np.testing.assert_allclose(session["04-sweep"].joint_torque[:, 1].max(), 6.2e-3, atol=1e-4)
    assert np.isnan(session["04-sweep"].joint_torque[:, 0]).all()


def test_which_joint_a_sensor_holds_is_not_guessed(tmp_path, capsys):
    foreign(tmp_path / "pull.csv", pulls="B", torque=True)
    written = [f"{tmp_path}/f.toml", f"{tmp_path}/m.toml"]
    main(["new", *written, f"{tmp_path}/pull.csv", "--joints", "knuckle,middle", "--tendons", "cable A,cable B"])
    assert 'fill in 2 "?"' in capsys.readouterr().out
    with pytest.raises(SystemExit) as stopped:
        main(["import", f"{tmp_path}/pull.csv", "--mapping", written[1], "-o", f"{tmp_path}/s.h5"])
    assert stopped.value.code == 2
    assert "'?'" in capsys.readouterr().err
    assert not (tmp_path / "s.h5").exists()


def test_names_may_be_separated_by_semicolons(tmp_path, capsys):
    main(["new", f"{tmp_path}/f.toml", f"{tmp_path}/m.toml", "--joints", "MCP; PIP", "--tendons", "T1;T2;T3"])
    assert "2 joints, 3 tendons" in capsys.readouterr().out


def test_a_finger_may_lack_tendons(tmp_path):
    main(["new", f"{tmp_path}/f.toml", f"{tmp_path}/m.toml", "--joints", "J", "--tendons", "none"])
    assert "tendons" not in (tmp_path / "f.toml").read_text()


@pytest.mark.parametrize(
    ("columns", "tendons"),
    [
        (("angle (deg)", "torque [N m]"), 0),  # an arm's, or a servo's
        (("position", "current [A]"), 0),
        (("angle (deg)", "T2 [N]"), 4),
        (("angle (deg)", "cable travel [mm]"), 4),
    ],
)
def test_recordings_of_no_tendon_are_of_a_finger_without(tmp_path, capsys, columns, tendons):
    """Unless tendons are named, which is said."""
    time = np.arange(600) / 50
    table = np.column_stack([time, *(10 + k - 8 * np.cos(time + k) for k in range(len(columns)))])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=",".join(("time", *columns)), comments="")
    asked = ["new", f"{tmp_path}/f.toml", f"{tmp_path}/m.toml", f"{tmp_path}/log.csv", "--joints", "J"]
    main(asked)
    told = capsys.readouterr().out
    assert f"1 joint, {tendons} tendons" in told
    assert (tmp_path / "f.toml").read_text().count("[[finger.tendons]]") == tendons
    says = "log.csv: no column is a tension or an excursion, so the finger has no tendons; if it has some, name them"
    assert (f"{says}: --tendons T1,T2,T3,T4" in told) == (not tendons)
    main([*asked, "--tendons", "A,B", "--overwrite"])
    told = capsys.readouterr().out
    assert "1 joint, 2 tendons" in told
    assert "no column" not in told


def test_show_of_a_session_says_that_it_is_no_fit(tmp_path, capsys):
    (tmp_path / "session.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(SystemExit) as stopped:
        main(["show", f"{tmp_path}/session.h5"])
    assert stopped.value.code == 2
    assert "is an HDF5 file and no fit" in capsys.readouterr().err
