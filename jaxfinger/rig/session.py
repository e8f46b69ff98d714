"""Record a whole session: run the trials of a plan one after the other, then turn the log into the session file."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from jaxfinger.data.toml import parse_toml
from jaxfinger.errors import UserError, counted, listed
from jaxfinger.rig import convert, wal
from jaxfinger.rig.backend import Rig, TensionRamp
from jaxfinger.rig.channels import MIN_DYNAMIC_BANDWIDTH, Filter, RigDescription
from jaxfinger.rig.contract import DRIVES_ON, Trip
from jaxfinger.rig.course import Course, View
from jaxfinger.rig.operator import Nobody, Operator
from jaxfinger.rig.plan import Plan
from jaxfinger.rig.protocols import DYNAMIC, Protocol, Reached, Settled, Tare, slackened
from jaxfinger.rig.reader import Reader
from jaxfinger.rig.recorder import Recorder
from jaxfinger.rig.recover import read_log
from jaxfinger.rig.runner import Runner
from jaxfinger.rig.safety import Supervisor
from jaxfinger.rig.signals import Interrupts


@dataclass(frozen=True)
class Outcome:
    """Result of a run.

    `complete` names the trials that are complete, `cause` says why the run ended early (empty: it did not), `log` is
    the log to resume from (None: every trial is complete).
    """

    session: Path
    complete: tuple[str, ...]
    cause: str
    log: Path | None


def log_path(output: Path) -> Path:
    """Path of a session's log: beside the session."""
    return output.with_name(output.name + ".wal")


def refuse_filtered(plan: Plan, rig: RigDescription, filters: dict[str, Filter]) -> None:
    """Refuse dynamic experiments where a terminal's filter is slower than MIN_DYNAMIC_BANDWIDTH, or unknown.

    Raises:
        UserError: such a filter is on, the plan has a dynamic experiment, and the rig file does not allow it.
    """
    slow = [n for n, f in filters.items() if f.enabled and (f.bandwidth or 0.0) < MIN_DYNAMIC_BANDWIDTH]
    dynamic = [t.name for t in plan.trials if t.experiment in DYNAMIC]
    if slow and dynamic and not rig.allow_filtered:
        width = filters[slow[0]].bandwidth
        raise UserError(
            f"the terminal of '{slow[0]}' filters at {'an unknown bandwidth' if width is None else f'{width:g} Hz'} "
            f"({len(slow)} channels do), which spoils {dynamic[0]}; switch the filter off (CoE 0x8000:06) or set "
            f"allow_filtered = true in [rig]."
        )


def run(
    plan: Plan,
    rig: Rig,
    output: str | Path,
    resume: bool = False,
    operator: Operator | None = None,
    observe: Callable[[View], None] | None = None,
) -> Outcome:
    """Record a session: every trial of the plan that the log does not hold yet.

    The session file is written also where the run ends early; the log is then kept, to resume from. However the run
    ends, the finger is released: by the host where it can, otherwise by the controller, which gets no heartbeat.

    Raises:
        UserError: plan, rig and files do not fit together, and nothing was armed; or the session could not be written
            from the log.
    """
    output, operator = Path(output), operator or Nobody()
    path = log_path(output)
    log = _log_to_resume(plan, rig.description, path, output, resume)
    torn = path.stat().st_size - wal.sound_length(path) if log else 0
    with rig, Interrupts() as interrupts:
        filters = rig.filters()
        refuse_filtered(plan, rig.description, filters)
        head = convert.header(rig.description, plan.text, filters, rig.fingerprint())
        head["created"] = log.header["created"] if log else datetime.now(UTC).isoformat(timespec="milliseconds")
        recorder = Recorder(path, head, resume=log is not None)
        try:
            if log is not None:
                if torn:
                    said = f"{counted(torn, 'byte')} at the log's end were not whole and were cut off"
                    recorder.put(wal.EVENT, {"seq": log.last_seq or 0, "kind": "damage", "text": said})
                _close_killed_trial(log, rig, recorder)
            cause = _trials(plan, rig, recorder, operator, interrupts, observe, log)
        except UserError:
            recorder.close()
            if log is None and not recorder.trials:  # Nothing was recorded, so there is nothing to resume.
                path.unlink(missing_ok=True)
            raise
        finally:
            recorder.close()
    return _publish(plan, recorder, output, cause, resume)


def _publish(plan: Plan, recorder: Recorder, output: Path, cause: str, resume: bool) -> Outcome:
    """Write the session from the log that a run has left, and delete the log where every trial is complete.

    Raises:
        UserError: the log cannot be read, or the session cannot be written.
    """
    path, cause = recorder.path, cause or recorder.failure or ""
    if recorder.hangs:
        return Outcome(output, (), cause, path)
    try:
        log = read_log(path)
        for tag, value in recorder.unwritten:
            last = log.trials[-1] if log.trials else None
            if tag == wal.END and last is not None and (last.end is None or value.get("trial") == last.name):
                last.end = {**(last.end or {}), **value}
        whole = {r.start["planned"] for r in log.trials if r.complete}
        if not cause and (lacking := [t.name for t in plan.trials if t.name not in whole]):
            cause = "; ".join([f"the disk did not keep {listed(lacking)} whole", *map(str, log.damage)])
        convert.publish(log, output, overwrite=resume)
    except (UserError, KeyboardInterrupt) as error:
        said = str(error).rstrip(".") or f"{output}: interrupted while it was written"
        ended = f"{cause}; " if cause else ""
        if not path.exists():
            raise UserError(f"{ended}with {path} all that was recorded is lost.") from error
        mend = f"once that is mended, jaxfinger recover {path} --output {output} makes it"
        raise UserError(f"{ended}{said}; {mend}.") from error
    if not cause:
        path.unlink()
    return Outcome(output, tuple(r.name for r in log.trials if r.complete), cause, path if cause else None)


def _log_to_resume(plan: Plan, rig: RigDescription, path: Path, output: Path, resume: bool) -> convert.Log | None:
    """Return the log to resume, or None for a new session.

    Raises:
        UserError: the run would overwrite a session, or mix two.
    """
    if not resume:
        if output.exists():
            raise UserError(f"{output}: exists already and is not overwritten; choose another name.")
        if path.exists():
            raise UserError(
                f"{path}: a recording was interrupted here; go on with --resume, or rescue it with jaxfinger recover."
            )
        return None
    if not path.exists():
        raise UserError(f"{path}: there is no interrupted recording to resume; leave --resume out.")
    log = read_log(path)
    if log.header["plan"] != plan.text:
        raise UserError(
            f"{path}: was recorded with another plan than {plan.path}; resume with the plan it was begun with."
        )
    begun, now = (_meaning(head) for head in (log.header, convert.header(rig, plan.text, {}, {})))
    if differs := next((key for key in now if begun[key] != now[key]), None):
        raise UserError(
            f"{path}: was recorded with another rig file than {rig.path}: its {differs} differs; resume with the one "
            "it was begun with."
        )
    if output.exists():
        try:
            with h5py.File(output, "r") as file:
                created = file.attrs.get("created")
        except OSError:  # Damaged, or no session at all: the log does not say which, so it is not overwritten.
            created = None
        if created != log.header["created"]:
            raise UserError(
                f"{output}: is not the session that {path.name} belongs to, or is damaged; move it away, then resume."
            )
    return log


def _meaning(head: dict[str, Any]) -> dict[str, str]:
    """What gives samples their meaning in a log's header, each as text. Limits and times may change between runs."""
    channels = [[c[k] for k in ("name", "kind", "of", "slot", "unit", "scale", "offset")] for c in head["channels"]]
    parts = {
        "specimen": head["specimen"],
        "rig or backend": head["source"],
        "finger": head["finger"],
        "rate": head["rate_hz"],
        "list of channels": channels,
        "fingertip sensor": parse_toml(head["rig"], "rig.toml").content.get("fingertip_sensor"),
    }
    return {key: json.dumps(value) for key, value in parts.items()}


def _close_killed_trial(log: convert.Log, rig: Rig, recorder: Recorder) -> None:
    """Close the trial in which an earlier recorder died. Its missing samples are read from the controller's ring.

    Only a controller with the same fingerprint (program, boot number) still has them. No heartbeat is sent meanwhile:
    the watch does not run yet, and a finger that is still armed is to be released.
    """
    if not log.trials or log.trials[-1].end is not None:
        return
    seq = 0 if log.last_seq is None else log.last_seq + 1
    if log.last_seq is not None and rig.fingerprint() == log.header["fingerprint"]:
        head = rig.status().head
        rig.rewind(seq)
        # Only what follows the log without a gap, while the drives stay on: the ring may hold another recording.
        while seq < head and (block := rig.poll()) is not None and int(block.seq[0]) == seq:
            recorder.block(block)
            seq += int(np.argmin(np.append(np.isin(block.state, DRIVES_ON), False)))  # samples before the drives go off
        rig.rewind(rig.status().head)
    end = {"complete": False, "cause": "the recorder was killed", "trip": int(Trip.HOST), "seq": seq}
    recorder.put(wal.END, end)


def _zero_excursions(rig: RigDescription) -> Protocol:
    """Protocol that tares the tendon encoders: they read zero with the finger straight and 2 N on its tendons.

    2 N is the pretension of the paper's experiments (`MomentArms`). It takes out slack, so that every session's zero is
    the same. `Drives.arm` has had the finger fixed straight.
    """
    pretension = {n: 2.0 for n, active in zip(rig.finger.tendon_names, rig.finger.active, strict=True) if active}
    rate = min(10.0, rig.limits.tension_rate)
    yield TensionRamp(pretension, rate)
    yield Reached()
    yield Settled(pretension)
    yield Tare(("excursion",))
    yield from slackened(rig.finger, rate)


def _trials(
    plan: Plan,
    rig: Rig,
    recorder: Recorder,
    operator: Operator,
    interrupts: Interrupts,
    observe: Callable[[View], None] | None,
    log: convert.Log | None,
) -> str:
    """Record the trials that the log does not hold. Return why the run ended early, or an empty string.

    Raises:
        UserError: something was wrong before anything was armed.
    """
    earlier = log.trials if log else []
    done = {r.start["planned"] for r in earlier if r.complete}
    names = {r.name for r in earlier}
    ends = [r.start["session_start"] + sum(map(len, r.blocks)) / rig.description.rate_hz for r in earlier]
    begun = max(ends, default=0.0)
    left = [t for t in plan.trials if t.name not in done]
    reader = Reader(rig, recorder, Supervisor(rig.description))
    course = Course(rig, reader, operator, interrupts, observe)
    runner = Runner(course)
    try:
        course.watch.start()
        reader.start(lambda: course.watch.join("reader"))
        try:
            runner.drives.arm(plan.operator)
            runner.carry_out(_zero_excursions(rig.description), ("reference", 0, len(plan.trials)))
        except Exception as error:  # Of any kind: the finger may be armed.
            if course.drives_on or reader.violation is not None:
                return runner.abort(error)
            raise  # Nothing was armed.
        for trial in left:
            name, again = trial.name, 1
            while name in names:
                again += 1
                name = f"{trial.name}-{again}"
            if cause := runner.trial(trial, name, plan.trials.index(trial) + 1, len(plan.trials), begun):
                return f"{name}: {cause}"
        return runner.release()
    except KeyboardInterrupt:
        return runner.abort_interrupted()
    finally:
        course.watch.close()
        reader.close()
