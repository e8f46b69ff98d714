"""`kill -9` of the recorder at random moments: the log always gives a readable session."""

import os
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from jaxfinger.data import read_session
from jaxfinger.rig import recover, wal
from jaxfinger.rig.session import log_path
from jaxfinger.rig.simulated import standin
from jaxfinger.rig.simulated.examples import rig_toml
from tests.rig.conftest import serious

SAYS = "recorder.txt"  # output of the recorders
PLAN = '[plan]\nname = "p"\noperator = "t"\n[[trial]]\nexperiment = "VD.1"\nseconds = 2000.0\n'
RECORD = """
import sys
from pathlib import Path
from jaxfinger.cli.record import record
record(Path(sys.argv[1]), rig=Path(sys.argv[2]), output=Path(sys.argv[3]), yes=True, resume=len(sys.argv) > 4)
"""


@pytest.fixture(scope="module")
def controller():
    with standin.running(speed=0) as where:
        yield where


def recorder(folder, where, *more):
    address = {"net_id": standin.NET_ID, "ip": where, "port": 851, "reconnect_s": 20}
    (folder / "rig.toml").write_text(rig_toml("ads", address, stale_s=5.0, poll_s=0.002))
    (folder / "plan.toml").write_text(PLAN)
    files = [str(folder / name) for name in ("plan.toml", "rig.toml", "session.h5")]
    with open(folder / SAYS, "a") as says:
        return subprocess.Popen([sys.executable, "-c", RECORD, *files, *more], stdout=says, stderr=says)


def wait_for(condition, process, says):
    while not condition():
        assert process.poll() is None, f"the recorder ended by itself: {says.read_text()}"
        time.sleep(0.01)


def kill_at(folder, where, size, *more, trial="01-VD.1"):
    """Run a recorder until its log has `size` bytes from the start of a trial on, then kill it."""
    path = log_path(folder / "session.h5")
    process = recorder(folder, where, *more)

    def recorded() -> bool:
        at = path.read_bytes().find(b'"name":"' + trial.encode() + b'"') if path.exists() else -1
        return at >= 0 and path.stat().st_size >= at + size

    try:
        wait_for(recorded, process, folder / SAYS)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    return path


@pytest.mark.long
def test_killed_at_random_moments(controller, tmp_path):
    rng = random.Random(7)
    for k in range(2):
        folder = tmp_path / str(k)
        folder.mkdir()
        path = kill_at(folder, controller, rng.randint(20_000, 300_000))
        found = recover(path, folder / "rescued.h5")
        assert found.trials == found.incomplete == ("01-VD.1",)
        assert not serious(folder / "rescued.h5")
        trial = read_session(folder / "rescued.h5")["01-VD.1"]
        np.testing.assert_allclose(np.diff(trial.time), 1e-3, atol=1e-9)
        # Each random cut of the log stands for a recorder that died within a write.
        image = path.read_bytes()
        whole = len(trial.time)
        for _ in range(12):
            cut = rng.randint(len(image) // 2, len(image))
            (folder / "cut.wal").write_bytes(image[:cut])
            recover(folder / "cut.wal", folder / "cut.h5", overwrite=True)
            part = read_session(folder / "cut.h5")["01-VD.1"]
            assert len(part.time) <= whole
            np.testing.assert_array_equal(part.q, trial.q[: len(part.time)])


def test_a_restarted_recorder_resumes_from_the_ring_without_a_gap(controller, tmp_path):
    path = kill_at(tmp_path, controller, 200_000)
    before = [f.block for f in wal.read_log(path) if f.tag == wal.DATA][-1]
    kill_at(tmp_path, controller, 100_000, "--resume", trial="01-VD.1-2")
    frames = list(wal.read_log(path))
    ends = [i for i, f in enumerate(frames) if f.tag == wal.END]
    assert len(ends) == 1
    assert frames[ends[0]].json["cause"] == "the recorder was killed"
    seq = np.concatenate([f.block.seq.astype(np.int64) for f in frames[: ends[0]] if f.tag == wal.DATA])
    np.testing.assert_array_equal(np.diff(seq), 1)
    assert seq[-1] >= int(before.seq[-1])
    recover(path, tmp_path / "rescued.h5")
    assert list(read_session(tmp_path / "rescued.h5").trials) == ["01-VD.1", "01-VD.1-2"]


def test_a_kill_while_publishing_leaves_no_half_file(tmp_path, controller):
    path = kill_at(tmp_path, controller, 400_000)
    script = "import sys; from jaxfinger.rig import recover; recover(sys.argv[1], sys.argv[2], True)"
    for delay in (0.0, 0.02, 0.05):
        process = subprocess.Popen([sys.executable, "-c", script, str(path), str(tmp_path / "out.h5")])
        begun = False
        while process.poll() is None and not begun:
            begun = any(tmp_path.glob(".out.h5*"))
            time.sleep(0.002)
        time.sleep(delay)
        process.kill()
        process.wait()
        if (tmp_path / "out.h5").exists():
            assert len(read_session(tmp_path / "out.h5")) == 1
    recover(path, tmp_path / "out.h5", overwrite=True)
    assert len(read_session(tmp_path / "out.h5")) == 1
