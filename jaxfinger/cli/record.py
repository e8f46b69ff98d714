"""`jaxfinger record` and `jaxfinger recover`: run a plan on the rig, and rescue a recording that was killed."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from jaxfinger.cli.output import Output
from jaxfinger.errors import UserError


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

    description = read_rig(rig)
    checked = read_plan(plan, description)
    if dry_run:
        _print_plan(checked, description)
        return
    with ExitStack() as stack:
        view = LiveView(description)
        operator = Nobody() if yes else stack.enter_context(AtTerminal(view.say))
        stack.enter_context(view)
        outcome = run(checked, open_rig(description), output, resume=resume, operator=operator, observe=view)
    if outcome.cause:
        raise UserError(
            f"{outcome.cause.rstrip('.')}; {output} holds what was recorded, go on with --resume "
            f"(the log is {outcome.log})."
        )
    print(f"{output}: {len(outcome.complete)} trials, all complete")


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
    torn = f"; {found.torn_bytes} bytes at the log's end were not whole" if found.torn_bytes else ""
    print(f"{output}: {len(found.trials)} trials{cut}{torn}")


def _print_plan(plan, description) -> None:
    from jaxfinger.rig import estimate

    total = 0.0
    for trial in plan.trials:
        found = estimate(trial, description)
        total += found.seconds
        print(f"{found.name}: {found.seconds:.0f} s, up to {found.highest_tension:g} N")
        for prompt in found.prompts:
            print(f"    {prompt}")
    print(f"{len(plan.trials)} trials, {total / 60:.1f} min without the operator's pauses; nothing was moved")
