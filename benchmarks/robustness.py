"""Verdicts on one session, as it is and after each of the mishaps that happen to real files.

    python benchmarks/robustness.py SESSION.h5 --expect tendon_stretch:T3   # or none, or unexplained
    python benchmarks/robustness.py SESSION.h5 --expect none --only "half the rate" --only "0.5 % spikes"

A mishap changes the recording and not the finger. A row is right if the first named cause is the expected one. For
`none` the right verdict is «no gap», for a cause that the catalogue lacks it is «unexplained».
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxfinger.data import Session, Trial, read_session, write_session
from jaxfinger.sealed.run import Command

CHANNELS = ("q", "tendon_force", "tendon_excursion", "joint_torque", "fingertip_force")
SAMPLED = ("time", *CHANNELS, "joint_direction", "tendon_direction", "hold")
SEED = 0
STATUS = {"none": "no_gap", "unexplained": "unexplained"}  # right verdicts without a cause to name
DIAGNOSE = Command(f"{sys.executable} -m jaxfinger diagnose {{fit}} -o {{out}}")


def each(session: Session, change: Callable[[Trial, np.random.Generator], Trial]) -> Session:
    """Change every trial of a session, each with its own stream of random numbers."""
    streams = np.random.default_rng(SEED).spawn(len(session))
    return replace(session, trials={t.name: change(t, rng) for t, rng in zip(session, streams, strict=True)})


def where(trial: Trial, samples) -> Trial:
    """Keep some samples of a trial."""
    kept = {c: getattr(trial, c)[samples] for c in SAMPLED if getattr(trial, c) is not None}
    return replace(trial, **kept)


def thinned(step: int) -> Callable[[Session], Session]:
    """Keep every `step`-th sample."""
    return lambda session: each(session, lambda t, rng: where(t, slice(None, None, step)))


def measured(trial: Trial, change: Callable[[np.ndarray], np.ndarray], channels=CHANNELS) -> Trial:
    """Change the channels of a trial."""
    return replace(trial, **{c: change(getattr(trial, c)) for c in channels if getattr(trial, c) is not None})


def spiked(share: float) -> Callable[[Session], Session]:
    """Put spikes on a share of the samples of every channel."""

    def change(trial, rng):
        def throw(x):
            far = 0.5 * np.fmax.reduce(np.abs(x), axis=0) * rng.choice([-1.0, 1.0], x.shape)
            return np.where(rng.random(x.shape) < share, x + far, x)

        return measured(trial, throw)

    return lambda session: each(session, change)


def noisier(factor: float, channel: str) -> Callable[[Session], Session]:
    """Add white noise to a channel until its noise is `factor` times as large."""

    def change(trial, rng):
        def add(x):
            own = (
                1.4826 * np.median(np.abs(np.diff(x, axis=0)), axis=0) / np.sqrt(2.0)
            )  # NaN in columns that are not measured
            return x + np.sqrt(factor**2 - 1.0) * own * rng.standard_normal(x.shape)

        return measured(trial, add, (channel,))

    return lambda session: each(session, change)


def jittered(share: float) -> Callable[[Session], Session]:
    """Sample at times off the regular grid, as the file's times state."""

    def change(trial, rng):
        step = float(np.median(np.diff(trial.time)))
        time = trial.time + share * step * rng.uniform(-1.0, 1.0, trial.time.size)

        def at(x):
            return np.stack([np.interp(time, trial.time, column) for column in x.T], axis=1)

        return replace(measured(trial, at), time=time)

    return lambda session: each(session, change)


def first_of_each_motion(session: Session) -> Session:
    """Remove repeats of motions."""
    seen: dict = {}
    for trial in session:
        seen.setdefault(trial.motion or trial.name, trial.name)
    return session.with_trials(seen.values())


def one_posture(session: Session) -> Session:
    """Keep one trial of each experiment, joint and tendon."""
    seen: dict = {}
    for trial in session:
        seen.setdefault((trial.experiment, trial.joint, trial.tendon), trial.name)
    return session.with_trials(seen.values())


def without(experiment: str) -> Callable[[Session], Session]:
    """Remove an experiment."""
    return lambda session: session.with_trials([t.name for t in session if t.experiment != experiment])


def cut_short(session: Session) -> Session:
    """End the last trial of each experiment at 60 % of its length."""
    last = {t.experiment: t.name for t in session}

    def change(trial, rng):
        if last[trial.experiment] != trial.name:
            return trial
        return replace(where(trial, slice(None, int(0.6 * trial.time.size))), complete=False)

    return each(session, change)


def dead_column(session: Session) -> Session:
    """Remove the excursion of the last tendon from VD.3, as a dead encoder does."""

    def change(trial, rng):
        if trial.experiment != "VD.3" or trial.tendon_excursion is None:
            return trial
        excursion = trial.tendon_excursion.copy()
        excursion[:, np.flatnonzero(session.finger.active)[-1]] = np.nan
        return replace(trial, tendon_excursion=excursion)

    return each(session, change)


def unmarked(session: Session) -> Session:
    """Remove commanded directions, holds, motions and start times, which are then derived from the channels."""
    absent = {"joint_direction": None, "tendon_direction": None, "hold": None, "session_start": None, "motion": None}
    return each(session, lambda t, rng: replace(t, **absent))


def renamed(session: Session) -> Session:
    """Rename joints and tendons, in another alphabetical order."""
    finger = session.finger
    joints = {name: f"{'ZYXWV'[k % 5]}{k}" for k, name in enumerate(finger.joint_names)}
    tendons = {name: f"{'sragh'[k % 5]}{k}" for k, name in enumerate(finger.tendon_names)}
    other = replace(finger, joint_names=tuple(joints.values()), tendon_names=tuple(tendons.values()))
    new = each(
        session,
        lambda t, rng: replace(t, joint=joints.get(t.joint or ""), tendon=tendons.get(t.tendon or "")),
    )
    return replace(new, finger=other)


MISHAPS: dict[str, Callable[[Session], Session]] = {
    "as it is": lambda session: session,
    "half the rate": thinned(2),
    "a quarter of the rate": thinned(4),
    "jittered samples": jittered(0.3),
    "0.5 % spikes": spiked(0.005),
    "torque twice as noisy": noisier(2.0, "joint_torque"),
    "excursion twice as noisy": noisier(2.0, "tendon_excursion"),
    "no repeats": first_of_each_motion,
    "one posture each": one_posture,
    "trials cut short": cut_short,
    "a dead encoder in VD.3": dead_column,
    "nothing marked": unmarked,
    "other names": renamed,
    **{f"without {e}": without(e) for e in ("ID.2", "ID.3-static", "ID.3-dynamic", "ID.4", "VD.1", "VD.2", "VD.3")},
}


def verdict(session: Session, folder: Path) -> dict:
    """Verdict of `jaxfinger diagnose` in its own process. The summary of a failure is its last line."""
    write_session(session, folder / "session.h5")
    try:
        DIAGNOSE(folder / "session.h5", folder / "out")
    except RuntimeError as error:
        return {"status": "failed", "effects": [], "summary": str(error).splitlines()[-1]}
    return json.loads((folder / "out" / "gap.json").read_text(encoding="utf-8"))["verdict"]


def expected_in(changed: Session, session: Session, expect: str) -> str:
    """Expected cause in the changed session's names of joints and tendons."""
    effect, _, site = expect.partition(":")
    ours, theirs = session.finger, changed.finger
    names = dict(zip((*ours.joint_names, *ours.tendon_names), (*theirs.joint_names, *theirs.tendon_names), strict=True))
    return f"{effect}:{'-'.join(names.get(s, s) for s in site.split('-'))}" if site else expect


def main() -> None:
    """Print a row for each mishap."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("session", type=Path)
    parser.add_argument("--expect", required=True, help="effect:site of the truth, none, or unexplained")
    parser.add_argument("--only", action="append", choices=list(MISHAPS), help="this mishap (may be repeated)")
    options = parser.parse_args()
    session = read_session(options.session)
    wanted, right = options.only or list(MISHAPS), 0
    for name in wanted:
        changed = MISHAPS[name](session)
        begun = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            found = verdict(changed, Path(folder))
        seconds = time.perf_counter() - begun
        named = [f"{e['effect']}:{'-'.join(e['site'])}" for e in found["effects"]]
        if options.expect in STATUS:
            ok = found["status"] == STATUS[options.expect]
        else:
            ok = named[:1] == [expected_in(changed, session, options.expect)]
        right += ok
        said = f"{found['status']}: {', '.join(named) or found['summary'][:100]}"
        print(f"{'right' if ok else 'WRONG'}  {name:26s} {seconds:4.0f} s  {said}", flush=True)
    print(f"{right} of {len(wanted)} right")


if __name__ == "__main__":
    main()
