"""`jaxfinger record` and `jaxfinger recover`: run a plan on the rig, and rescue a recording that was killed."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NoReturn

from jaxfinger.cli.output import Output
from jaxfinger.errors import UserError, counted


def record(
    plan: Path, *, rig: Path, output: Output, dry_run: bool = False, resume: bool = False, yes: bool = False
) -> None:
    """Run the experiments of a plan on the rig and leave a session that `identify` takes as it is.

    Parameters
    ----------
    plan
        Plan file (TOML): which experiments, in which order, how often.
    rig
        Rig file (TOML): channels, calibration, limits, finger, backend.
    output
        Session file to write (HDF5). A log lies beside it while recording.
    dry_run
        Check plan and rig, say what would be done, and move nothing.
    resume
        Go on with an interrupted recording: trials that are complete are not repeated.
    yes
        Nobody is at the terminal: for simulated rigs, which prepare themselves.
    """
    from jaxfinger.rig import open_rig, read_plan, read_rig, run
    from jaxfinger.rig.live import LiveView
    from jaxfinger.rig.operator import AtTerminal, Nobody
    from jaxfinger.rig.session import log_path

    description = read_rig(rig)
    checked = read_plan(plan, description)
    if dry_run:
        _print_plan(checked, description)
        return
    view = LiveView(description)
    try:
        with ExitStack() as stack:
            stack.enter_context(_signals_as_interrupts())
            operator = Nobody() if yes else stack.enter_context(AtTerminal(view.say))
            stack.enter_context(view)
            outcome = run(checked, open_rig(description), output, resume=resume, operator=operator, observe=view)
        if outcome.cause:
            kept = f"{output} holds what was recorded, go on with --resume (the log is {outcome.log})"
            if not output.exists():
                kept = f"rescue what reached the disk with jaxfinger recover {outcome.log} --output {output}"
            raise UserError(f"{outcome.cause.rstrip('.')}; {kept}.")
        said = f"{output}: {counted(len(outcome.complete), 'trial')}, all complete"
    except UserError as error:
        if view.stalled:
            _leave(f"jaxfinger: {error}", 2)
        raise
    except KeyboardInterrupt:
        log = log_path(output)
        rescue = f"; rescue what reached the disk with jaxfinger recover {log} --output {output}"
        kept = rescue if log.exists() else ""
        said = f"the run was interrupted before its end was seen; see that tension is off{kept}."
        if view.stalled:
            _leave(f"jaxfinger: {said}", 2)
        raise UserError(said) from None
    if view.stalled:
        _leave(said, 0)
    print(said)


@contextmanager
def _signals_as_interrupts() -> Iterator[None]:
    """Treat SIGTERM, SIGHUP (a closed terminal) and SIGQUIT (Ctrl-\\) like Ctrl-C: the recording is kept."""
    main = threading.current_thread() is threading.main_thread()
    signals = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT) if main else ()
    handlers = [signal.signal(number, signal.default_int_handler) for number in signals]
    try:
        yield
    finally:
        for number, handler in zip(signals, handlers, strict=True):
            signal.signal(number, handler)


def _leave(sentence: str, code: int) -> NoReturn:
    """Exit although the terminal takes no output. Stderr may lead elsewhere, so the sentence has 1 s to be printed."""
    printing = threading.Thread(target=print, args=(sentence,), kwargs={"file": sys.stderr, "flush": True}, daemon=True)
    printing.start()
    printing.join(1.0)
    os._exit(code)


def recover(log: Path, *, output: Output, overwrite: bool = False) -> None:
    """Turn the log of a recording that was killed into a session.

    Parameters
    ----------
    log
        The log, which ends in .wal and lies beside the session.
    output
        Session file to write (HDF5).
    overwrite
        Replace a file that is already there.
    """
    from jaxfinger.rig import recover as rescue

    found = rescue(log, output, overwrite)
    cut = f", cut short: {', '.join(found.incomplete)}" if found.incomplete else ""
    torn = [f"{counted(found.torn_bytes, 'byte')} at the log's end were not whole"] if found.torn_bytes else []
    print("; ".join([f"{output}: {counted(len(found.trials), 'trial')}{cut}", *found.damage, *torn]))


def _print_plan(plan, description) -> None:
    from jaxfinger.rig import estimate

    total = 0.0
    for trial in plan.trials:
        found = estimate(trial, description)
        total += found.seconds
        print(f"{found.name}: {found.seconds:.0f} s, up to {found.highest_tension:g} N")
        for prompt in found.prompts:
            print(f"    {prompt}")
    count = counted(len(plan.trials), "trial")
    print(f"{count}, {total / 60:.1f} min without the operator's pauses; nothing was moved")
