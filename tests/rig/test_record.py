"""The parts that a person sees: commands, live view, keys, a recording played back."""

import io
import os
import pty
import termios
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from jaxfinger.cli.record import record, recover
from jaxfinger.data import read_session
from jaxfinger.errors import UserError
from jaxfinger.rig import Supervisor, open_rig, operator, parse_plan, parse_rig, read_plan, read_rig, run
from jaxfinger.rig.backend import CommandRefused, EndOfReplay, Setup, TensionRamp
from jaxfinger.rig.backends.simulated import SimulatedRig
from jaxfinger.rig.contract import Trip
from jaxfinger.rig.course import View
from jaxfinger.rig.live import LiveView
from jaxfinger.rig.operator import READ_S, SUSPENDED_S, TERMINAL_GONE, AtTerminal, Nobody
from jaxfinger.rig.simulated.examples import plan_toml, rig_toml
from tests.rig.conftest import SHORT

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture
def files(tmp_path):
    (tmp_path / "rig.toml").write_text(rig_toml())
    (tmp_path / "plan.toml").write_text(SHORT)
    return tmp_path


def test_a_dry_run_says_what_would_be_done_and_writes_nothing(files, capsys):
    before = sorted(files.iterdir())
    record(files / "plan.toml", rig=files / "rig.toml", output=files / "s.h5", dry_run=True)
    said = capsys.readouterr().out
    assert "02-ID.4-T3-MCP" in said
    assert "up to 6 N" in said
    assert "Couple the external motor to MCP" in said
    assert "nothing was moved" in said
    assert sorted(files.iterdir()) == before


def test_record_from_the_command_line(files, capsys):
    record(files / "plan.toml", rig=files / "rig.toml", output=files / "s.h5", yes=True)
    assert "2 trials, all complete" in capsys.readouterr().out
    assert len(read_session(files / "s.h5")) == 2
    with pytest.raises(UserError, match="exists already"):
        record(files / "plan.toml", rig=files / "rig.toml", output=files / "s.h5", yes=True)


def test_without_a_terminal_nobody_can_stop_it(files):
    with pytest.raises(UserError, match="stop key needs a terminal"):
        record(files / "plan.toml", rig=files / "rig.toml", output=files / "s.h5")
    assert not (files / "s.h5").exists()


def test_recover_from_the_command_line(files, capsys, monkeypatch):
    monkeypatch.setattr(SimulatedRig, "filters", lambda self: (_ for _ in ()).throw(UserError("no filters")))
    with pytest.raises(UserError, match="no filters"):
        record(files / "plan.toml", rig=files / "rig.toml", output=files / "s.h5", yes=True)
    monkeypatch.undo()
    rig = parse_rig(rig_toml())

    class Died(BaseException):
        pass

    def die(view):
        if view.number == 2 and view.recording:
            raise Died

    with pytest.raises(Died):
        run(parse_plan(SHORT, rig), SimulatedRig(rig), files / "s.h5", observe=die)
    recover(files / "s.h5.wal", output=files / "rescued.h5")
    assert "2 trials, cut short: 02-ID.4-T3-MCP" in capsys.readouterr().out
    with pytest.raises(UserError, match="not overwritten"):
        recover(files / "s.h5.wal", output=files / "rescued.h5")


def test_the_documents_examples_are_good():
    rig = read_rig(DOCS / "rig-example.toml")
    assert rig.backend == "ads"
    plan = read_plan(DOCS / "plan-example.toml", rig)
    assert {t.experiment for t in plan.trials} == {t.experiment for t in parse_plan(plan_toml(), rig).trials}


def test_the_live_view_shows_tension_and_angle(rig, quiet_block):
    text = io.StringIO()
    view = LiveView(rig, Console(file=text, force_terminal=True, width=100, color_system=None))
    with view:
        view(View("02-ID.4-T3-MCP", 2, 9, "moving", quiet_block(), 7, True, 0.04))
    shown = text.getvalue()
    head = "● 2/9 02-ID.4-T3-MCP: moving, 7 samples lost, 40 ms behind the rig"
    for part in (head, "T3", "2.00 N", "MCP", "20.1 °", "N mm"):
        assert part in shown


def test_the_live_view_shows_a_channel_that_is_no_number(rig, quiet_block):
    text, block = io.StringIO(), quiet_block()
    block.x[7, rig.index("tension", "T3")] = block.x[:, rig.index("tension", "T4")] = np.nan
    console = Console(file=text, width=100)
    console.print(LiveView(rig, console).draw(View("02-ID.4-T3-MCP", 2, 9, "moving", block, 0, True)))
    assert text.getvalue().count("nan N") == 2


def test_outside_a_terminal_it_is_a_line_a_trial(rig, quiet_block):
    text = io.StringIO()
    with LiveView(rig, Console(file=text, width=100)) as view:
        for _ in range(3):
            view(View("a", 1, 2, "moving", quiet_block(), 0, True))
        view(View("b", 2, 2, "moving", quiet_block(), 0, True))
    assert text.getvalue().splitlines() == ["1/2 a", "2/2 b"]


@pytest.mark.parametrize("key", ["q", "Q", " ", "\x1b"])
def test_keys_at_the_terminal(key, monkeypatch):
    monkeypatch.setattr(operator, "READ_S", 0.0)
    said = []
    person = AtTerminal(said.append)
    answered = threading.Thread(target=person.ask, args=("Fix the joints.", lambda: True))
    answered.start()
    while not said:
        pass
    person.key("x")
    assert answered.is_alive()
    person.key("\n")
    answered.join(20)
    assert not answered.is_alive()
    assert not person.stop_request()
    person.key(key)
    assert person.stop_request()
    person.ask("again", lambda: True)  # Returns at once: the rig is being stopped.
    AtTerminal(said.append).ask("dead", lambda: False)


def test_an_enter_that_is_held_down_answers_no_prompt(monkeypatch):
    """Something lies on the keyboard. The key repeats faster than anybody reads."""
    monkeypatch.setattr(operator, "READ_S", 0.2)
    person, until = AtTerminal(lambda text: None), time.monotonic() + 0.6

    def repeat() -> bool:
        person.key("\n")
        return time.monotonic() < until

    person.ask("Hands off: the drives are about to be switched on.", repeat)
    assert time.monotonic() >= until


@pytest.mark.parametrize("shown", [False, True])
def test_enter_answers_no_prompt_that_nobody_can_have_read(shown):
    """The prompt waits for a terminal that takes no output, or has been on the screen for an instant."""
    printed, looks = threading.Event(), iter([True, True, False])
    if shown:
        printed.set()
    person = AtTerminal(lambda text: printed)

    def press() -> bool:
        person.key("\n")
        return next(looks)

    person.ask("Hands off: the drives are about to be switched on.", press)
    assert next(looks, None) is None  # It went on asking until the rig had to be stopped.


def test_the_stop_key_works_after_the_program_was_suspended():
    """The shell has put the terminal back to lines, where a key waits for Enter."""
    ours, theirs = pty.openpty()
    person = AtTerminal()
    person._keys = theirs
    assert not person.stop_request()
    lines = termios.tcgetattr(theirs)
    lines[3] |= termios.ICANON
    termios.tcsetattr(theirs, termios.TCSANOW, lines)
    assert not person.stop_request()
    os.write(ours, b"q")
    assert person.stop_request()
    os.close(ours)
    os.close(theirs)


@pytest.mark.parametrize("shell", [True, False], ids=["Ctrl-Z and fg", "SIGSTOP and SIGCONT"])
def test_an_enter_from_while_the_program_was_suspended_answers_no_prompt(shell):
    """It was meant for the shell, and the prompt may have left the screen: it is printed again, and asks again."""
    ours, theirs = pty.openpty()
    said, begun, suspended = [], time.monotonic(), threading.Event()
    person = AtTerminal(said.append)
    person._keys = theirs

    def look() -> bool:
        if time.monotonic() - begun > READ_S + 0.2 and not suspended.is_set():
            suspended.set()
            if shell:
                lines = termios.tcgetattr(theirs)
                lines[3] |= termios.ICANON
                termios.tcsetattr(theirs, termios.TCSANOW, lines)
            else:
                time.sleep(SUSPENDED_S + 0.1)
            os.write(ours, b"\n\n")
        return len(said) < 2

    person.ask("Hands off: the drives are about to be switched on.", look)
    assert said == said[:1] * 2
    os.close(ours)
    os.close(theirs)


def test_a_terminal_that_is_gone_is_a_stop():
    """A terminal that is gone has no stop key."""
    ours, theirs = os.pipe()
    person = AtTerminal()
    person._keys = ours
    assert not person.stop_request()
    os.close(theirs)
    assert person.stop_request() == TERMINAL_GONE
    os.close(ours)


def test_an_enter_from_before_the_prompt_does_not_answer_it():
    """The second of two Enters on the command line waits in the terminal; "Hands off" must not take it for its own."""
    ours, theirs = os.pipe()
    said, person = [], AtTerminal()
    person._say, person._keys = said.append, ours
    os.write(theirs, b"\n")
    looks = iter([True, True, True, False])
    person.ask("Hands off: the drives are about to be switched on.", lambda: next(looks))
    assert next(looks, None) is None  # It went on asking until the rig had to be stopped.
    os.write(theirs, b"q\n")
    person.ask("again", lambda: True)
    assert person.stop_request()  # A stop key counts, whenever it was pressed.
    os.close(ours)
    os.close(theirs)


def test_a_session_that_cannot_be_written_stays_in_its_log(files, rig, monkeypatch):
    def full(log, output, overwrite):
        raise UserError(f"{output}: cannot be written (No space left on device)")

    monkeypatch.setattr("jaxfinger.rig.convert.publish", full)
    says = r"No space left.*; once that is mended, jaxfinger recover .*s\.h5\.wal --output .*s\.h5 makes it"
    with pytest.raises(UserError, match=says):
        run(parse_plan(SHORT, rig), SimulatedRig(rig), files / "s.h5")
    monkeypatch.undo()
    recover(files / "s.h5.wal", output=files / "s.h5")
    assert all(trial.complete for trial in read_session(files / "s.h5"))


def test_ctrl_c_while_the_session_is_written_is_a_sentence(files, monkeypatch):
    def interrupted(log, output, overwrite):
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxfinger.rig.convert.publish", interrupted)
    with pytest.raises(
        UserError, match=r"s\.h5: interrupted while it was written; once .* jaxfinger recover .*s\.h5\.wal --output"
    ):
        record(files / "plan.toml", rig=files / "rig.toml", output=files / "s.h5", yes=True)
    assert (files / "s.h5.wal").exists()


def test_ctrl_c_of_which_the_run_knows_nothing_is_a_sentence(files, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxfinger.rig.run", interrupted)
    with pytest.raises(UserError, match="the run was interrupted before its end was seen; see that tension is off"):
        record(files / "plan.toml", rig=files / "rig.toml", output=files / "s.h5", yes=True)


def test_a_bench_cannot_prepare_itself(rig, tmp_path, monkeypatch):
    """--yes is refused before arming on a rig that a person must prepare."""
    machine = SimulatedRig(rig)
    monkeypatch.setattr(machine, "_has_bench", lambda: False)
    with pytest.raises(UserError, match="run without --yes"):
        run(parse_plan(SHORT, rig), machine, tmp_path / "s.h5", operator=Nobody())
    assert machine.controller.acknowledged == 0
    assert not machine.prepare(Setup("x"))


def test_a_recording_played_back(files, rig):
    record(files / "plan.toml", rig=files / "rig.toml", output=files / "s.h5", yes=True)
    (files / "replay.toml").write_text(rig_toml("replay", {"file": "s.h5", "trial": "02-ID.4-T3-MCP"}))
    trial = read_session(files / "s.h5")["02-ID.4-T3-MCP"]
    with open_rig(read_rig(files / "replay.toml")) as replay:
        assert "fingertip_force x" not in [c.name for c in replay.description.channels]
        column = replay.description.index("tension", "T3")
        tension, found = play(replay, column)
        assert found == []
        np.testing.assert_array_equal(np.concatenate(tension), trial.tendon_force[:, 2])
        for refused in (replay.arm, lambda: replay.command(TensionRamp({"T1": 1.0}, 1.0))):
            with pytest.raises(CommandRefused):
                refused()
    tight = rig_toml("replay", {"file": "s.h5", "trial": "02-ID.4-T3-MCP"}).replace(
        "tension_max = 18.0", "tension_max = 5.0"
    )
    (files / "replay.toml").write_text(tight)
    with open_rig(read_rig(files / "replay.toml")) as replay:
        _, found = play(replay, 0)
        assert found[0].trip is Trip.TENSION
        assert trial.tendon_force[found[0].seq, 2] > 5.0


def play(replay, column):
    """Play to the end. Return the blocks of a column, and the violations."""
    supervisor, values, found = Supervisor(replay.description), [], []
    while True:
        try:
            block = replay.read_block(1.0)
        except EndOfReplay:
            return values, found
        found += supervisor.check(block)
        values.append(block.x[:, column])


class Broken(io.StringIO):
    """A stream that takes no more than its first writes."""

    def __init__(self, writes: int = 0):
        super().__init__()
        self.left = writes

    def write(self, text):
        self.left -= 1
        if self.left < 0:
            raise OSError(5, "Input/output error")
        return super().write(text)


@pytest.mark.parametrize("broken", ["drawing", "terminal", "stream"])
def test_a_live_view_that_fails_is_said_and_prompts_are_still_printed(rig, quiet_block, monkeypatch, capsys, broken):
    stream = io.StringIO() if broken == "drawing" else Broken()
    terminal = broken != "stream"
    view = LiveView(rig, Console(file=stream, force_terminal=terminal, width=100, color_system=None))
    if broken == "drawing":
        monkeypatch.setattr(view, "draw", lambda view: 1 / 0)
    with view:
        view(View("02-ID.4-T3-MCP", 2, 9, "moving", quiet_block(), 0, True))
        view.say("before")
        while not view.failure:
            time.sleep(0.01)
        assert view.say("Hands off: [the drives] are about to be switched on.").wait(20)
        view(View("03-VD.1", 3, 9, "waiting", quiet_block(), 0, True))
    said = capsys.readouterr().err.splitlines()
    assert said[0].startswith("the live view has failed (")
    assert said[0].endswith("; recording and stop key do not depend on it.")
    assert "Hands off: [the drives] are about to be switched on." in said
    assert said[-1] == "3/9 03-VD.1"
    assert not view.stalled


def test_a_terminal_and_stderr_that_are_both_gone_do_not_end_the_recording(rig, short, tmp_path, monkeypatch):
    """Nobody can be told. A prompt counts as unread, so no motor moves for it, and the run goes on without a view."""
    monkeypatch.setattr("sys.stderr", Broken())
    with LiveView(rig, Console(file=Broken(), width=100)) as view:
        view.say("to a terminal that breaks")
        while not view.failure:
            time.sleep(0.01)
        assert run(short, SimulatedRig(rig), tmp_path / "s.h5", observe=view).cause == ""
        assert not view.say("Hands off.").wait(0.3)
