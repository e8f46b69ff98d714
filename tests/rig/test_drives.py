"""What happens before the drives go on, and while a prompt has hands at the finger."""

import errno
import re

import pytest

from jaxfinger.errors import UserError
from jaxfinger.rig import drives, parse_plan, parse_rig, wal
from jaxfinger.rig.backend import ConnectionLost
from jaxfinger.rig.backends.simulated import SimulatedRig
from jaxfinger.rig.contract import Kind, Refusal, State, Trip
from jaxfinger.rig.course import Course
from jaxfinger.rig.drives import Drives
from jaxfinger.rig.operator import STOP_KEY, Nobody
from jaxfinger.rig.protocols import Settled
from jaxfinger.rig.reader import Reader
from jaxfinger.rig.recorder import Recorder
from jaxfinger.rig.runner import RELEASED, TENSION_NOT_SEEN_TO_FALL
from jaxfinger.rig.safety import Supervisor
from jaxfinger.rig.session import run
from jaxfinger.rig.signals import Interrupts
from jaxfinger.rig.simulated.controller import Controller
from jaxfinger.rig.watch import Watch
from tests.rig.conftest import Away, impatient, slot


def after_answer(person, words, act):
    """Let `act` happen right after a person has answered a prompt that holds `words`."""
    ask = person.ask

    def ask_and_act(text, keep_waiting):
        ask(text, keep_waiting)
        if words in text:
            act()

    person.ask = ask_and_act


def test_a_stop_key_at_a_prompt_is_no_answer_to_it(rig, tmp_path):
    """The watch may be 20 ms behind the key: the runner looks for itself before it sends the next command."""

    class Stopping(Nobody):
        def stop_request(self) -> str:
            return STOP_KEY

    machine = SimulatedRig(rig)
    machine.synchronous = False
    with machine:
        machine.stop(Trip.TENSION)
        recorder = Recorder(tmp_path / "session.h5.wal", {})
        course = Course(machine, Reader(machine, recorder, Supervisor(rig)), Stopping(), Interrupts())
        with pytest.raises(UserError, match="stop key"):
            Drives(course).arm("operator")
        assert machine.controller.state is State.TRIPPED  # The latch was not cleared.
        recorder.close()


def test_a_person_at_a_bench_that_prepares_nothing_itself(rig, record):
    """Every setup of the plan becomes a prompt. The run goes on once it is answered."""
    machine, prompts, wanted = SimulatedRig(rig), [], []
    by_itself = machine.prepare
    machine.prepare = lambda setup: bool(wanted.append(setup))

    class Person:
        def ask(self, text, keep_waiting):
            assert keep_waiting()
            prompts.append(text)
            by_itself(wanted[-1])
            machine._pause(1.0)

        def stop_request(self):
            return ""

    outcome = record(machine, operator=Person())
    assert outcome.cause == ""
    assert len(outcome.complete) == 2
    straight, *rest = prompts
    off, on = "The drives are off.", "Then hands off: Enter switches them on."
    assert (
        straight == f"{off} Fix the finger straight: all joints at 0°. It is 'simulated finger' on rig 'example'. {on}"
    )
    assert any(text.startswith("Hold DIP, free it, and move it slowly by hand") for text in rest)
    assert rest[-1] == f"{off} Couple the external motor to MCP; the other joints stay fixed. {on}"


def test_the_drives_are_off_while_hands_are_at_the_finger_unless_it_is_moved_by_hand(rig, record):
    """In every experiment. The simulated operator acts within the prompt, and the drives go on only after it."""
    trials = [
        'experiment = "ID.2"\njoint = "MCP"\npasses = 1',
        'experiment = "ID.3-static"\njoint = "MCP"\nstep_deg = 35.0',
        'experiment = "ID.4"\njoint = "MCP"\ntendon = "T3"\nlevels = [3.0, 6.0]',
        'experiment = "VD.3"\nmean = [4.0, 2.5, 3.0, 3.0]\nseconds = 1.0',
        'experiment = "VD.1"\nseconds = 1.0',
        'experiment = "VD.2"\ntendon = "T2"\nlevels = [4.0, 6.0]\nposture_deg = [10.0, 40.0, 35.0]',
        'experiment = "ID.3-dynamic"\njoint = "MCP"\npasses = 1',
    ]
    text = '[plan]\nname = "all"\noperator = "tester"\n' + "".join(f"[[trial]]\n{t}\n" for t in trials)
    machine, asked = SimulatedRig(rig), []
    by_itself = machine.prepare

    def prepare(setup):
        controller = machine.controller
        asked.append((bool(setup.hand), controller.state, controller.motor, max(controller.setpoint)))
        return by_itself(setup)

    machine.prepare = prepare
    assert record(machine, plan=parse_plan(text, rig)).cause == ""
    assert len(asked) == 14
    assert [hand for hand, *_ in asked].count(True) == 2
    for hand, state, motor, tension in asked:
        assert motor is None
        assert (state, tension) == ((State.ARMED, 2.0) if hand else (State.IDLE, 0.0))


def test_drives_that_come_on_while_hands_are_at_the_finger_stop_the_rig(rig, record):
    """From a panel of its own the controller can be told to arm. The prompt ends, and nothing else moves."""
    machine = SimulatedRig(rig)
    person = Away(machine, "nothing")

    def arm():
        machine.controller._obey(Kind.ARM, 0, 0.0, 0.0, [])
        machine._pause(0.2)

    after_answer(person, "Fix all joints", arm)
    outcome = record(machine, operator=person)
    assert "01-ID.2-DIP: the controller switched the drives on without being told to" in outcome.cause
    assert machine.controller.state is State.TRIPPED
    assert len(person.prompts) == 2


def test_a_joint_that_is_not_fixed_as_asked_is_asked_for_again(rig, record):
    """The PIP's angle is in radians, and the rig file says degrees."""
    wrong = re.sub(r'(kind = "joint_position"\nof = "PIP"\nslot = \d+\nunit = )"rad"', r'\1"deg"', rig.text)
    machine, prompts, wanted = SimulatedRig(parse_rig(wrong)), [], []
    by_itself, machine.prepare = machine.prepare, lambda setup: bool(wanted.append(setup))

    class Person:
        def ask(self, text, keep_waiting):
            prompts.append(text)
            by_itself(wanted[-1])
            machine._pause(1.0)

        def stop_request(self):
            return STOP_KEY if len(prompts) > 4 else ""

    outcome = record(machine, operator=Person())
    assert prompts[1].startswith("The drives are off. Fix all joints: MCP 20°, PIP 20°")
    assert prompts[2].startswith(
        "'joint_position PIP' reads 0.3°, not 20.0°; see the fixture, and unit, scale and offset"
    )
    assert outcome.complete == ()


def test_a_tension_in_another_unit_is_named(rig, record):
    """The load cell of T2 gives mN, and the rig file says N; the controller has its own calibration."""
    text = rig.text.replace(
        'of = "T2"\nslot = 1\nunit = "N"\nscale = 1.0', 'of = "T2"\nslot = 1\nunit = "N"\nscale = 1e-3'
    )
    outcome = record(SimulatedRig(parse_rig(text)))
    assert re.match(
        r"tensions settling took longer than 20 s: 'tension T2' reads 0\.00\d+ N, not 2 N; see its unit", outcome.cause
    )
    assert outcome.cause.endswith(RELEASED)


@pytest.mark.parametrize("late", [None, 0.4], ids=["never", "too late"])
def test_a_prompt_that_nobody_answers_in_time_releases_an_armed_finger(rig, record, late):
    """Nobody moves a motor for somebody who comes back later. The trial is repeated when the recording is resumed."""
    machine = SimulatedRig(impatient(rig))
    person = Away(machine, "Hold DIP, free it", late)
    outcome = record(machine, operator=person)
    assert outcome.cause == f"01-ID.2-DIP: nobody answered the prompt within 0.2 s (prompt_s of [rig]); {RELEASED}"
    said = r"The finger is armed, with (\d\.\d) N: without an answer within 0\.2 s it is released\."
    (newton,) = re.findall(said, person.prompts[-1])
    assert float(newton) == pytest.approx(2.0, abs=Settled.within)  # the largest of four pretensions, with their noise
    assert machine.controller.state is State.TRIPPED
    assert max(machine.controller.setpoint) == 0.0
    assert outcome.complete == ()
    assert record(SimulatedRig(rig), resume=True).complete == ("01-ID.2-DIP", "02-ID.4-T3-MCP")


def test_a_prompt_while_the_drives_are_off_may_wait(rig, record):
    machine = SimulatedRig(impatient(rig, 2.0))
    person = Away(machine, "Fix the finger straight", 2.5)
    assert record(machine, operator=person).cause == ""
    assert "is released" not in person.prompts[0]


def test_a_clock_that_jumps_while_the_drives_are_off_is_named_and_arms_nothing(rig, record):
    machine = SimulatedRig(rig)
    person = Away(machine, "nothing")

    def jump():
        machine.inject("clock-jump", amount=3600.0)
        machine._pause(0.3)

    after_answer(person, "Couple the external motor", jump)
    outcome = record(machine, operator=person)
    assert f"nothing was armed: {Trip.CLOCK.sentence}" in outcome.cause
    assert machine.controller.state is State.TRIPPED
    assert outcome.complete == ("01-ID.2-DIP",)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("nan", "nothing was armed: a channel is not a number or was flagged by its terminal (tension T1 = nan"),
        ("clock-frozen", "nothing was armed: the controller's clock jumps or runs at another rate than it should"),
        ("clock-rate", "nothing was armed: the controller's clock"),
        ("flag", "nothing was armed: a channel is not a number or was flagged"),
        ("stall", "wrote no sample"),
        ("ring", "the controller's ring holds 1 samples, but a host that may lag by 0.25 s needs 414"),
    ],
)
def test_what_is_wrong_before_arming_is_a_sentence_and_nothing_moves(rig, record, tmp_path, monkeypatch, fault, says):
    monkeypatch.setattr(drives, "QUIET_TIMEOUT_S", 0.3)
    controller = Controller()
    if fault == "ring":
        controller.tell_ring(1)
    else:
        controller.strike(fault, standing=True)
    with pytest.raises(UserError) as error:
        record(SimulatedRig(rig, controller))
    assert says in str(error.value)
    assert controller.state is State.IDLE
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("pull", [6.0, -6.0])
def test_a_tension_that_stands_with_the_drives_off_arms_nothing(rig, record, pull):
    """A load cell that is off by this would have the controller pull as much too hard, or too little."""
    controller = Controller()
    controller.strike("spike", controller.slots.tension[2], amount=pull, standing=True)
    with pytest.raises(
        UserError, match=r"nothing was armed: with the drives off 'tension T3' reads -?\d\.?\d* N; free"
    ):
        record(SimulatedRig(rig, controller))
    assert controller.state is State.IDLE


@pytest.mark.parametrize("words", ["Fix the finger straight", "Couple the external motor"])
def test_a_disk_that_fills_while_the_drives_are_off_arms_nothing(rig, record, tmp_path, monkeypatch, words):
    """Nothing is written during a prompt, so that only a frame of its own shows it before the motors may move."""
    machine, written, armed = SimulatedRig(rig), wal.LogWriter.write, []
    person = Away(machine, "nothing")
    arm = machine.arm

    def full(log, tag, payload):
        if any(words in prompt for prompt in person.prompts):
            raise OSError(errno.ENOSPC, "No space left on device")
        written(log, tag, payload)

    def count():
        armed.append(person.prompts[-1])
        return arm()

    monkeypatch.setattr(wal.LogWriter, "write", full)
    machine.arm = count
    says = r"nothing was armed: session.h5.wal cannot be written: No space left on device; make room on the disk"
    if words.startswith("Fix"):
        with pytest.raises(UserError, match=says):
            record(machine, operator=person)
        assert list(tmp_path.iterdir()) == []
    else:
        assert re.search(says, record(machine, operator=person).cause)
    assert not any(words in prompt for prompt in armed)


def test_an_enter_from_before_the_program_was_suspended_arms_nothing(rig, record, monkeypatch):
    """Ctrl-Z right after Enter: at fg the motors may not move without a new prompt."""
    machine, armed = SimulatedRig(rig), []
    person, arm = Away(machine, "nothing"), machine.arm

    def count():
        armed.append(person.prompts[-1])
        return arm()

    def suspended(watch, since):
        return 3.0 if person.prompts and "Couple the external motor" in person.prompts[-1] else 0.0

    machine.arm = count
    monkeypatch.setattr(Watch, "suspended_s", suspended)
    outcome = record(machine, operator=person)
    said = "nothing was armed: the program was suspended for 3.0 s (Ctrl-Z) meanwhile"
    assert outcome.cause == f"02-ID.4-T3-MCP: {said}; {RELEASED}"
    assert not any("Couple the external motor" in prompt for prompt in armed)


def test_no_prompt_has_hands_at_a_finger_that_a_tendon_pulls(rig, record):
    """The controller is idle, but a tendon is caught in its drive: the first prompt must not come."""
    controller = Controller()
    controller.strike("spike", controller.slots.tension[2], amount=6.0, standing=True)
    machine = SimulatedRig(rig, controller)
    person = Away(machine, "nothing")
    with pytest.raises(UserError, match="with the drives off 'tension T3' reads"):
        record(machine, operator=person)
    assert person.prompts == []


def test_a_load_cell_that_is_off_by_little_arms(rig, record):
    controller = Controller()
    controller.strike("spike", controller.slots.tension[2], amount=0.2, standing=True)
    assert record(SimulatedRig(rig, controller)).cause == ""


class Handy(Away):
    """A person who looks at the finger `looks` times with a tendon pulling by `pull` N, and then presses Enter.

    At the alarm the tendon still pulls at the first Enter, and is free at the second. `states` are the controller's.
    """

    def __init__(self, machine, pull, looks):
        super().__init__(machine, "nothing")
        self.pull, self.looks, self.states, self.armed, self.given_way = pull, looks, [], [], False

    def ask(self, text, keep_waiting):
        controller, first = self.machine.controller, "Couple the external motor" in text and not self.states
        if first:
            self.machine.inject("spike", slot(self.machine, "tension", "T3"), amount=self.pull)
            self.given_way = not all(keep_waiting() for _ in range(self.looks))
            self.states.append(controller.state)
            if abs(self.pull) < 2.0:
                super().ask(text, keep_waiting)
            self.prompts.append(text)
        elif "HANDS AWAY" in text:
            self.states.append(controller.state)
            self.armed.append(self.states[-1] is State.TRIPPED and controller._obey(Kind.ARM, 0, 0.0, 0.0, []))
            self.prompts.append(text)
            if len(self.armed) > 1:
                controller.faults.clear()
            assert all(keep_waiting() for _ in range(4))
        else:
            super().ask(text, keep_waiting)


def test_a_hand_that_pulls_a_tendon_right_after_enter_is_asked_away(rig, record):
    """The drives are still off. Nothing is armed, the same prompt comes again, and no trial is lost."""
    machine = SimulatedRig(rig)
    person, armed, arm = Away(machine, "nothing"), [], machine.arm

    def touch():
        if not person.pulled:
            person.pulled = True
            machine.inject("spike", slot(machine, "tension", "T3"), amount=6.0)

    def count():
        armed.append(bool(machine.controller.faults))
        return arm()

    person.pulled, machine.arm = False, count
    after_answer(person, "Couple the external motor", touch)
    ask = person.ask

    def let_go(text, keep_waiting):
        if "HANDS AWAY" in text:
            machine.controller.faults.clear()
            assert all(keep_waiting() for _ in range(4))
        ask(text, keep_waiting)

    person.ask = let_go
    outcome = record(machine, operator=person)
    assert outcome.cause == ""
    assert outcome.complete == ("01-ID.2-DIP", "02-ID.4-T3-MCP")
    at = next(i for i, text in enumerate(person.prompts) if "HANDS AWAY" in text)
    assert person.prompts[at + 1] == person.prompts[at - 1]
    assert not any(armed)


@pytest.mark.parametrize("pull", [6.0, -6.0])
@pytest.mark.parametrize("looks", [1, 20], ids=["Enter at once", "no Enter"])
def test_a_tendon_that_begins_to_pull_while_hands_are_at_the_finger(rig, record, looks, pull):
    """The prompt ends by itself, and the controller is latched until nothing pulls and somebody agrees."""
    machine = SimulatedRig(rig)
    person = Handy(machine, pull, looks)
    outcome = record(machine, operator=person)
    assert person.given_way == (looks > 1)
    assert person.states == [State.IDLE, State.TRIPPED, State.TRIPPED]
    assert person.armed == [Refusal.STATE] * 2
    at = next(i for i, text in enumerate(person.prompts) if "HANDS AWAY" in text)
    says = r"HANDS AWAY FROM THE FINGER: 'tension T3' reads -?[56]\.?\d* N, and the drives are off\. .* switch them off"
    assert re.match(says, person.prompts[at])
    assert "HANDS AWAY" in person.prompts[at + 1]  # An Enter while it pulls is none.
    assert person.prompts[at + 2] == person.prompts[at - 1]  # Nothing is armed before hands are off again.
    assert outcome.cause == ""
    assert outcome.complete == ("01-ID.2-DIP", "02-ID.4-T3-MCP")


def test_a_controller_that_does_not_answer_its_stop_at_a_finger_that_a_tendon_pulls(rig, short, tmp_path):
    """The operator is told all the same, in the view even before the stop is waited for; and nothing is armed."""
    machine, views = SimulatedRig(rig), []
    person = Handy(machine, 6.0, 20)
    seen = []

    def silent(cause):
        machine._unheeded = cause
        seen.append(views[-1].doing)
        raise ConnectionLost("no answer.")

    machine.stop = silent
    outcome = run(short, machine, tmp_path / "s.h5", operator=person, observe=views.append)
    assert re.match(r"HANDS AWAY FROM THE FINGER: 'tension T3' reads", seen[0])
    assert "The controller DOES NOT ANSWER." in person.prompts[-1]
    assert "RESET gave way to a stop" in outcome.cause
    assert outcome.complete == ("01-ID.2-DIP",)


def test_the_stop_key_at_a_finger_that_a_tendon_pulls(rig, record):
    machine = SimulatedRig(rig)
    person = Handy(machine, 6.0, 20)
    person.stop_request = lambda: STOP_KEY if person.armed else ""
    outcome = record(machine, operator=person)
    assert outcome.cause == f"02-ID.4-T3-MCP: the operator pressed the stop key; {TENSION_NOT_SEEN_TO_FALL}"
    assert machine.controller.state is State.TRIPPED


def test_a_hand_that_tugs_a_tendon_stops_nothing(rig, record):
    """By little for long, or by much for a moment; and the hand that moves a finger under its pretension."""
    machine = SimulatedRig(rig)
    person = Handy(machine, 1.5, 20)
    ask = person.ask

    def ask_and_jerk(text, keep_waiting):
        if "Fix all joints" in text:
            machine.inject("spike", slot(machine, "tension", "T1"), amount=8.0)
            assert keep_waiting()
            machine.controller.faults.clear()
            assert keep_waiting()
        if "Hold DIP" in text:
            assert all(keep_waiting() for _ in range(20))
        ask(text, keep_waiting)

    person.ask = ask_and_jerk
    assert record(machine, operator=person).cause == ""
    assert not any("HANDS AWAY" in text for text in person.prompts)
