"""The commands as a person types them, each in a process of its own: exit codes, messages, files."""

import os
import pty
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from jaxfinger.data import read_session
from jaxfinger.rig.contract import State, Trip
from jaxfinger.rig.matrix import END_S, OFF_S, STOP_S
from jaxfinger.rig.runner import RELEASED
from jaxfinger.rig.session import log_path
from jaxfinger.rig.simulated import standin
from jaxfinger.rig.simulated.examples import rig_toml
from tests.rig.conftest import SHORT
from tests.rig.wire import ATTEMPTS, CALM, PLAN, STALL_S, stalls

QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
LONG = '[plan]\nname = "long"\noperator = "tester"\n[[trial]]\nexperiment = "VD.1"\nseconds = 5000.0\n'


@pytest.fixture(scope="module")
def controller():
    with standin.running(speed=0) as where:
        yield where


@pytest.fixture
def bench(controller, tmp_path):
    """A folder with a plan and a rig file for the stand-in."""
    address = {"net_id": standin.NET_ID, "ip": controller, "port": 851, "reconnect_s": 20}
    (tmp_path / "rig.toml").write_text(rig_toml("ads", address, stale_s=5.0, poll_s=0.002))
    (tmp_path / "plan.toml").write_text(SHORT)
    return tmp_path


def said(errors: str) -> str:
    """Return jaxfinger's own lines of stderr. AdsLib writes dated lines, such as when a connection closes."""
    dated = r"\d{4}-\d\d-\d\dT[\d:+]+ (Info|Warning): "
    return "".join(line for line in errors.splitlines(keepends=True) if not re.match(dated, line))


def command(*words) -> list[str]:
    return [sys.executable, "-m", "jaxfinger", *map(str, words)]


def jaxfinger(*words) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*words), capture_output=True, text=True, timeout=120, check=False)


def record_in(folder: Path, *more) -> list[str]:
    rig, output = folder / "rig.toml", folder / "session.h5"
    return command("record", folder / "plan.toml", "--rig", rig, "-o", output, *more)


@contextmanager
def recording(*words, **streams):
    """Start a recorder that takes Ctrl-C, even where this test run ignores it, and end it with its test."""

    def takes_interrupts():
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    process = subprocess.Popen(record_in(*words), preexec_fn=takes_interrupts, **streams)
    with process:
        try:
            yield process
        finally:
            process.kill()


def wait_for_log(process: subprocess.Popen, folder: Path, size: int) -> Path:
    path = log_path(folder / "session.h5")
    while not (path.exists() and path.stat().st_size > size):
        assert process.poll() is None, "the recorder ended by itself"
        time.sleep(0.01)
    return path


def test_record_leaves_a_session_that_check_finds_sound(bench):
    done = subprocess.run(record_in(bench, "--yes"), capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, said(done.stderr)) == (0, "")
    output = bench / "session.h5"
    steps = ["0/2 reference", "1/2 01-ID.2-DIP", "2/2 02-ID.4-T3-MCP"]
    assert done.stdout.splitlines() == [*steps, f"{output}: 2 trials, all complete"]
    assert sorted(p.name for p in bench.iterdir()) == ["plan.toml", "rig.toml", "session.h5"]
    assert jaxfinger("check", output).returncode == 0
    again = subprocess.run(record_in(bench, "--yes"), capture_output=True, text=True, timeout=120, check=False)
    assert again.returncode == 2
    assert again.stderr == f"jaxfinger: {output}: exists already and is not overwritten; choose another name.\n"


def test_recover_after_a_kill(bench):
    (bench / "plan.toml").write_text(LONG)
    with recording(bench, "--yes", stdout=subprocess.DEVNULL) as process:
        log = wait_for_log(process, bench, 300_000)
        process.kill()
    done = jaxfinger("recover", log, "--output", bench / "rescued.h5")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"{bench / 'rescued.h5'}: 1 trial, cut short: 01-VD.1")
    assert len(read_session(bench / "rescued.h5")["01-VD.1"].time) > 1000
    twice = jaxfinger("recover", log, "--output", bench / "rescued.h5")
    assert twice.returncode == 2
    assert "exists already" in twice.stderr
    none = jaxfinger("recover", bench / "plan.toml", "--output", bench / "none.h5")
    assert none.returncode == 2
    assert none.stderr.endswith("plan.toml: not a recording log of jaxfinger; give the file that ends in .wal.\n")


@pytest.mark.parametrize("moment", ["trial", "reference"])
def test_control_c_ends_the_run_with_a_sentence(bench, moment):
    """The moment `reference` lies before the first trial, while tendons are pre-tensioned to tare their encoders."""
    (bench / "plan.toml").write_text(LONG)
    with recording(bench, "--yes", stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        wait_for_log(process, bench, 300_000 if moment == "trial" else 100)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=120)
    output, sentence = bench / "session.h5", said(errors.decode())
    assert process.returncode == 2
    assert sentence.count("\n") == 1
    assert f"the run was interrupted; {RELEASED}; {output} holds what was recorded, go on with --resume" in sentence
    session = read_session(output)
    assert [t.complete for t in session] == ([False] if moment == "trial" else [])


MISTAKES = {
    "unknown channel": (
        "rig.toml",
        'kind = "external_torque"',
        'kind = "torque"',
        "].kind: is 'torque'; choose one of ",
    ),
    "wrong unit": (
        "rig.toml",
        'unit = "N m"',
        'unit = "kg"',
        "is 'kg', no unit for external_torque ('external_torque')",
    ),
    "missing limit": ("rig.toml", "temperature_max = 70.0", "", "limits.temperature_max: is missing; add a line"),
    "too high": ("plan.toml", "levels = [3.0, 6.0]", "levels = [3.0, 19.0]", "02-ID.4-T3-MCP: 19 N for T3 is outside"),
    "unknown joint": (
        "plan.toml",
        'joint = "DIP"',
        'joint = "DPI"',
        "joint: is 'DPI' (did you mean 'DIP'?); choose one of MCP, PIP, DIP",
    ),
}
HEADERS = {"missing limit": "[limits]", "too high": "[[trial]]"}  # line that is named where the mistake itself has none


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence_with_its_line_and_nothing_moves(bench, mistake):
    """The rig file has an address at which nothing listens, so the rig cannot even have been asked."""
    name, good, bad, says = MISTAKES[mistake]
    rig = bench / "rig.toml"
    rig.write_text(rig.read_text().replace("127.0.0.1:", "127.0.0.2:"))
    text = (bench / name).read_text()
    assert good in text
    (bench / name).write_text(text.replace(good, bad, 1))
    done = subprocess.run(record_in(bench, "--yes"), capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"jaxfinger: {bench / name}, line ")
    assert done.stderr.count("\n") == 1
    assert says in done.stderr
    line = (bench / name).read_text().splitlines()[int(done.stderr.split("line ")[1].split(":")[0]) - 1]
    assert line.startswith(HEADERS.get(mistake, bad))
    assert sorted(p.name for p in bench.iterdir()) == ["plan.toml", "rig.toml"]


def test_what_is_missing_on_the_command_line_is_said():
    done = jaxfinger("record", "plan.toml")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr + done.stdout
    assert "--rig" in done.stderr + done.stdout
    absent = jaxfinger("record", "none.toml", "--rig", "none.toml", "-o", "x.h5")
    assert absent.returncode == 2
    assert absent.stderr.startswith("jaxfinger: none.toml: cannot be read")


def test_the_recorder_starts_without_jax_and_the_heavy_parts_of_scipy():
    heavy = "{'jax', 'matplotlib', 'scipy.signal', 'scipy.stats', 'scipy.interpolate'}"
    script = f"import sys, jaxfinger.rig; print({heavy} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


@contextmanager
def real_rig(folder, fault=(), **deadlines):
    """Start a stand-in in real time with its watchdog of 0.25 s; write a plan that holds 8 N."""
    with standin.started(faults=fault) as machine:
        address = {"net_id": standin.NET_ID, "ip": machine.where, "port": 851, "reconnect_s": 3}
        (folder / "rig.toml").write_text(rig_toml("ads", address, **{**CALM, **deadlines}))
        (folder / "plan.toml").write_text(PLAN)
        yield machine


def wait_for_tension(machine, process):
    """Wait until the finger is armed and its tendons are under tension."""
    deadline = time.monotonic() + 60.0
    while not (machine.report()["state"] == State.ARMED and machine.report()["off_seq"] < 0):
        assert process.poll() is None, "the recorder ended by itself"
        assert time.monotonic() < deadline
        time.sleep(0.02)


def let_go(machine, head):
    """Return the trip, and the seconds of the stand-in's clock from sample `head` to the stop and to no tension."""
    deadline = time.monotonic() + 10.0
    while (report := machine.report())["off_seq"] < 0 and time.monotonic() < deadline:
        time.sleep(0.02)
    return report["trip"], (report["trip_seq"] - head) * 1e-3, (report["off_seq"] - head) * 1e-3


def until_the_machine_keeps_up(attempt):
    """Repeat an attempt that failed while the machine itself stood still for longer than STALL_S."""
    for left in reversed(range(ATTEMPTS)):
        quiet, worst = threading.Event(), [0.0]
        threading.Thread(target=stalls, args=(quiet, worst), daemon=True).start()
        try:
            attempt()
            return
        except AssertionError:
            if max(worst) < STALL_S or not left:
                raise
        finally:
            quiet.set()


@pytest.mark.parametrize("terminal", ["Ctrl-S", pytest.param("nobody reads", marks=pytest.mark.long)])
def test_the_stop_key_at_a_terminal_that_takes_no_output(tmp_path, terminal):
    """On a real pseudo-terminal the stop key releases the finger as always, and the run ends."""

    def attempt():
        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        ours, theirs = pty.openpty()
        try:
            with (
                real_rig(folder) as machine,
                recording(folder, stdin=theirs, stdout=theirs, stderr=subprocess.PIPE) as process,
            ):
                if terminal == "nobody reads":
                    fill(theirs)
                else:
                    os.write(ours, b"\x13")
                wait_for_tension(machine, process)
                head, pressed = machine.report()["head"], time.monotonic()
                os.write(ours, b"q")
                trip, stopped, off = let_go(machine, head)
                _, errors = process.communicate(timeout=60)
                ended = time.monotonic() - pressed
        finally:
            os.close(ours)
            os.close(theirs)
        assert trip == Trip.OPERATOR
        assert stopped <= STOP_S
        assert off <= OFF_S
        assert ended <= END_S
        assert process.returncode == 2
        assert "the operator pressed the stop key" in errors.decode()
        assert not any(trial.complete for trial in read_session(folder / "session.h5"))

    until_the_machine_keeps_up(attempt)


def fill(terminal: int) -> None:
    """Write until the terminal takes no more output."""
    os.set_blocking(terminal, False)
    try:
        while True:
            os.write(terminal, b"." * 1024)
    except BlockingIOError:
        pass
    finally:
        os.set_blocking(terminal, True)


@pytest.mark.parametrize("end", [signal.SIGSTOP, signal.SIGKILL, pytest.param(signal.SIGHUP, marks=pytest.mark.long)])
def test_a_host_that_is_stopped_or_killed_holds_no_tension(tmp_path, end):
    """The host is stopped as by a debugger, killed, or loses its terminal. The finger is released all the same."""

    def attempt():
        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        with real_rig(folder) as machine, recording(folder, "--yes", **QUIET) as process:
            wait_for_tension(machine, process)
            head = machine.report()["head"]
            process.send_signal(end)
            trip, stopped, off = let_go(machine, head)
            assert trip == (Trip.OPERATOR if end == signal.SIGHUP else Trip.HEARTBEAT)
            assert stopped <= STOP_S
            assert off <= OFF_S

    until_the_machine_keeps_up(attempt)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("watchdog=3600", "controller.heartbeat_s: may be 0.25 on the controller, which runs 3600; mend stLimits"),
        ("clock-rate=0.01", "nothing was armed: the controller's clock"),
    ],
)
def test_what_is_wrong_before_arming_is_one_sentence_and_nothing_moves(tmp_path, fault, says):
    with real_rig(tmp_path, [fault], clock_offset_s=0.1) as machine:
        done = subprocess.run(record_in(tmp_path, "--yes"), capture_output=True, text=True, timeout=120, check=False)
        report = machine.report()
    assert done.returncode == 2
    assert says in done.stderr
    assert said(done.stderr).count("\n") == 1
    assert (report["off_seq"], report["trip"]) == (0, 0)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["plan.toml", "rig.toml"]


@pytest.mark.parametrize("lag_s", [3.0, pytest.param(1.0, marks=pytest.mark.long)], ids=["trip", "lag"])
def test_a_program_that_was_suspended_with_the_drives_on_says_so(tmp_path, lag_s):
    """What the host finds when it goes on, a trip or its own lag, only follows from that."""

    def attempt():
        folder = Path(tempfile.mkdtemp(dir=tmp_path))
        with (
            real_rig(folder, lag_s=lag_s) as machine,
            recording(folder, "--yes", stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process,
        ):
            wait_for_tension(machine, process)
            process.send_signal(signal.SIGSTOP)
            head = machine.report()["head"]
            assert let_go(machine, head)[0] == Trip.HEARTBEAT
            while machine.report()["head"] < head + 2000:
                time.sleep(0.05)
            process.send_signal(signal.SIGCONT)
            _, errors = process.communicate(timeout=60)
        assert re.search(
            rf"the program was suspended for \d\.\d s \(Ctrl-Z\) with the drives on; the controller's watchdog stopped "
            rf"them, since it got no heartbeat; {RELEASED}; .* go on with --resume",
            said(errors.decode()),
        )

    until_the_machine_keeps_up(attempt)
