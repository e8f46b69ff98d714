"""Sealed cases: a session to diagnose, fresh trials, and the truth in another tree that nothing under test reads.

    ROOT/case-001/fit.h5, fresh.h5          TRUTH/case-001.json

A case is a function of (split, number). With the same libraries it is the same bit for bit. With others its effects are
the same; rounding differs, and the forward simulation of VD.3 amplifies the difference.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from jaxfinger.data import Session, Trial, write_session
from jaxfinger.data.schema import CHANNELS

from .closure import friction_known
from .departures import LISTED, UNLISTED, draw
from .departures.base import Departure
from .drive import desired_trajectory, simulate
from .laws import Finger
from .protocols import Plan, draw_style, session_plans
from .record import Motion, commanded, driven, read, record
from .sensors import STD, UNITS, Sensors, draw_sensors, measure
from .severity import CoarseTrial, NoiseFreeSession, by_channel, calibrate
from .specimens import LAYOUTS, Specimen, make_specimen

SCHEMA = "jaxfinger-sealed/2"
SPLITS = {"develop": 1, "fresh": 2, "foreign": 3}
MIXES = {"natural": (), "several": (1,)}  # Mixes, each with what it appends to a case's seed.
SEVERITIES = (2.0, 5.0, 10.0)  # rms in units of a hold's noise: hardly visible, visible, clear
KINDS_OF_TEN = ("listed", "listed", "double", "listed", "none", "listed", "listed", "unlisted", "listed", "unlisted")
SEVERAL_SEVERITIES = (5.0, 10.0)  # Range for several causes at once: none hides the others.
MINOR_SEVERITY = 2.5  # of an unlisted cause beside several listed ones: visible, and smaller than each of them
CREATED = "2026-01-15T10:00:00+00:00"


@dataclass(frozen=True)
class CaseSpec:
    """Kind, specimen and withheld effects of a case. Effects by id, each with a severity in units of a hold's noise."""

    kind: str  # none, listed, unlisted, double, several
    specimen: str
    effects: tuple[str, ...] = ()
    severities: tuple[float, ...] = ()


def case_specs(split: str, count: int, mix: str = "natural") -> list[CaseSpec]:
    """Specifications of the first `count` cases of a split.

    Mix `natural`: of every ten cases six have a listed effect, one has two of them, one or two have an unlisted effect,
    and one or two none. Listed effects come in turn, each severity equally often, on specimens that differ from round
    to round.
    Split `foreign` has only listed effects with a form that no other split has.
    Mix `several`: three to five listed effects of similar severity. Every other case also has a minor unlisted one.
    """
    if mix == "several":
        return _several(split, count)
    rng = np.random.default_rng([SPLITS[split], 7])
    effects = [e for e, kind in LISTED.items() if split != "foreign" or kind.foreign]
    listed, unlisted = _rounds(effects, SEVERITIES, rng), _rounds(list(UNLISTED), SEVERITIES[1:], rng)
    specimens = _rounds(["planar", *LAYOUTS], [1.0], rng)
    specs = []
    for i in range(count):
        specimen, _ = next(specimens)
        kind = KINDS_OF_TEN[i % 10] if i % 20 != 19 else "none"
        if kind == "none":
            specs.append(CaseSpec(kind, specimen))
        elif kind == "double":
            first, second = (
                str(e) for e in rng.choice([e for e in effects if e != "passive_tendon"], 2, replace=False)
            )
            specs.append(CaseSpec(kind, specimen, (first, second), (10.0, 5.0)))
        else:
            effect, severity = next(unlisted if kind == "unlisted" else listed)
            if effect == "passive_tendon" and not LAYOUTS[specimen].passive:
                specimen = "planar"
            specs.append(CaseSpec(kind, specimen, (effect,), (severity,)))
    return specs


def _several(split: str, count: int) -> list[CaseSpec]:
    rng = np.random.default_rng([SPLITS[split], 7, *MIXES["several"]])
    specimens = _rounds(["planar", *LAYOUTS], [1.0], rng)
    anywhere = [e for e in LISTED if e != "passive_tendon"]
    (lowest, highest), specs = SEVERAL_SEVERITIES, []
    for i in range(count):
        specimen, _ = next(specimens)
        effects = [str(e) for e in rng.choice(anywhere, int(rng.integers(3, 6)), replace=False)]
        sizes = np.exp(rng.uniform(np.log(lowest), np.log(highest), len(effects))).tolist()
        if i % 2:
            effects, sizes = [*effects, str(rng.choice(list(UNLISTED)))], [*sizes, MINOR_SEVERITY]
        specs.append(CaseSpec("several", specimen, tuple(effects), tuple(sizes)))
    return specs


def _rounds(items: list[str], severities: Sequence[float], rng: np.random.Generator) -> Iterator[tuple[str, float]]:
    """Yield all items round after round, each round in another order and each item with its next severity."""
    turn = 0
    while True:
        for i in rng.permutation(len(items)):
            yield items[i], severities[(i + turn) % len(severities)]
        turn += 1


def make_case(number: int, split: str, spec: CaseSpec, root: Path, truth_root: Path, mix: str = "natural") -> Path:
    """Write one case unless it is finished, and return its folder.

    The truth is written last: where its file exists, the case is finished.
    """
    name = f"case-{number:03d}"
    folder, truth_file = root / name, truth_root / f"{name}.json"
    if truth_file.exists() and (folder / "fit.h5").exists() and (folder / "fresh.h5").exists():
        return folder
    seed = [SPLITS[split], number, *MIXES[mix]]
    case = _draw(seed, split, spec)
    specimen, sensors, rng = case.noise_free.specimen, case.noise_free.sensors, case.rng
    finger = Finger(specimen, case.departures)
    zero = rng.normal(0, 1e-4, finger.n)
    # Simulated together, the trials cost little more than one.
    together = [p for p in (*case.plans, *case.later) if p.experiment == "VD.3"]
    motions = {
        p.seed: driven(r, p.rate)
        for p, r in zip(together, simulate(finger, case.noise_free.nominal, together), strict=True)
    }
    folder.mkdir(parents=True, exist_ok=True)
    truth_root.mkdir(parents=True, exist_ok=True)
    for file, plans in (("fit.h5", case.plans), ("fresh.h5", case.later)):
        trials = record_trials(finger, plans, motions, sensors, zero, rng)
        session = Session(
            specimen=f"sealed-{split}-{number:03d}",
            finger=specimen.cad,
            trials={t.name: t for t in trials},
            source="jaxfinger sealed plant (MuJoCo)",
            created=CREATED,
        )
        write_session(session, folder / file, overwrite=True)
    truth = {"schema": SCHEMA, "case": name, "split": split, "seed": seed} | _truth(spec, case)
    part = truth_file.with_suffix(".part")
    part.write_text(json.dumps(truth, indent=1))
    os.replace(part, truth_file)
    return folder


def _truth(spec: CaseSpec, case: _Case) -> dict:
    """Effects, noise and gap of a case for its truth."""
    sensors = case.noise_free.sensors
    closes = case.noise_free.closed_by(case.departures)
    return {
        "kind": spec.kind,
        "specimen": spec.specimen,
        "effects": [
            {
                "effect": d.effect,
                "listed": d.listed,
                "site": list(d.site),
                "form": d.form,
                "severity": target,
                "reached": reached,
                "seen_in": list(seen),
                "closes": share,
                "parameters": {"size": d.size, "units": d.units, **d.shape},
                "known": d.known(),
            }
            for d, target, reached, seen, share in zip(
                case.departures, spec.severities, case.reached, case.where, closes, strict=True
            )
        ],
        "noise": {c: {"std": sensors.std[c], "hold": sensors.hold_std(c), "units": UNITS[c]} for c in STD},
        "fresh": _fresh_gap(case.departures, case.noise_free, case.later),
    }


@dataclass(frozen=True)
class _Case:
    """Everything that a case's seed decides before the measurement. `rng` draws the noise next."""

    noise_free: NoiseFreeSession
    plans: list[Plan]
    later: list[Plan]
    departures: list[Departure]
    reached: list[float]
    where: list[tuple[str, str, str]]
    rng: np.random.Generator


def _draw(seed: Sequence[int], split: str, spec: CaseSpec) -> _Case:
    rng, foreign = np.random.default_rng(seed), split == "foreign"
    specimen = make_specimen(spec.specimen, rng)
    nominal, sensors, style = Finger(specimen), draw_sensors(rng), draw_style(rng, foreign)
    plans = with_trajectories(nominal, session_plans(specimen, style, rng), rng)
    later = with_trajectories(nominal, session_plans(specimen, style, rng, fresh=True), rng)
    noise_free = NoiseFreeSession(specimen, plans, sensors)
    return _Case(noise_free, plans, later, *_withheld(spec, specimen, noise_free, style.speeds, foreign, rng), rng)


def rebuild(truth: dict) -> tuple[NoiseFreeSession, list[Departure]]:
    """Rebuild the noise-free session and the departures of a case from its truth. Slack tendons do not count in it."""
    effects = truth["effects"]
    spec = CaseSpec(
        truth["kind"], truth["specimen"], tuple(e["effect"] for e in effects), tuple(e["severity"] for e in effects)
    )
    case = _draw(truth["seed"], truth["split"], spec)
    noise_free = NoiseFreeSession(case.noise_free.specimen, case.plans, case.noise_free.sensors, slack_counts=False)
    return noise_free, case.departures


def with_trajectories(nominal: Finger, plans: Sequence[Plan], rng: np.random.Generator) -> list[Plan]:
    """Give the VD.3 plans a trajectory. Repeats of a motion share it."""
    profiles = {}
    out = []
    for plan in plans:
        if plan.experiment == "VD.3":
            if plan.motion not in profiles:
                profiles[plan.motion] = desired_trajectory(nominal, plan, rng)
            plan = replace(plan, q=profiles[plan.motion])
        out.append(plan)
    return out


def _withheld(
    spec: CaseSpec,
    specimen: Specimen,
    noise_free: NoiseFreeSession,
    speeds: Sequence[float],
    foreign: bool,
    rng: np.random.Generator,
):
    """Draw the case's departures and calibrate their sizes, with the severities reached and where they are largest.

    A site where the effect cannot be seen is drawn again, up to three times.
    """
    chosen: list[Departure] = []
    reached, where = [], []
    for effect, target in zip(spec.effects, spec.severities, strict=True):
        best = None
        for _ in range(4):
            departure = draw(effect, specimen.finger, rng, speeds, foreign)
            assert departure is not None, f"{effect} has no site on {spec.specimen}"
            candidate = calibrate(noise_free, departure, target)
            if best is None or abs(np.log(candidate[1] / target)) < abs(np.log(best[1] / target)):
                best = candidate
            if best[1] > 0.7 * target:
                break
        assert best is not None
        chosen.append(best[0])
        reached.append(best[1])
        where.append((best[2][0], best[2][1], _column(specimen, best[2])))
    return chosen, reached, where


def _column(specimen: Specimen, label: tuple[str, str, int]) -> str:
    """Name of the joint, tendon or axis of a label (experiment, channel, column)."""
    return CHANNELS[label[1]].columns(specimen.finger)[label[2]]


def record_trials(
    finger: Finger,
    plans: Sequence[Plan],
    motions: Mapping[int, Motion],
    sensors: Sensors,
    zero: np.ndarray,
    rng: np.random.Generator,
) -> Iterator[Trial]:
    """Yield the measured trials of the plans. `motions`: the simulated motions by their plan's seed."""
    for plan in plans:
        motion = motions.get(plan.seed) or commanded(plan)
        yield measure(read(finger, record(finger, plan, motion)), finger.specimen, sensors, zero, rng)


def _fresh_gap(departures: Sequence[Departure], noise_free: NoiseFreeSession, plans: Sequence[Plan]):
    """Rows of the truth: rms on the fresh trials by experiment and channel, over the samples that `closure` counts.

    `before` is that of the refitted nominal model, `after` that with the true effects.
    """
    sensors = noise_free.sensors
    later = NoiseFreeSession(noise_free.specimen, plans, sensors)
    rows, labels = later.trace(departures)
    if departures:
        rows = rows - later.absorbed[0] @ noise_free.absorb(noise_free.trace(departures)[0])
    counts = np.concatenate([_judged(later, coarse) for coarse in later.trials])
    gap = by_channel(rows[counts], [(e, c, 0) for (e, c, _), judged in zip(labels, counts, strict=True) if judged])
    out = []
    for (experiment, channel, _), value in sorted(gap.items()):
        noise = sensors.std[channel]
        left = value * sensors.hold_std(channel)
        out.append(
            {
                "experiment": experiment,
                "channel": channel,
                "units": UNITS[channel],
                "noise": noise,
                "gap": left,
                "before": float(np.hypot(noise, left)),
                "after": noise,
            }
        )
    return out


def _judged(session: NoiseFreeSession, coarse: CoarseTrial) -> Bool[np.ndarray, " R"]:
    """Rows of a trial at samples where `closure` counts a prediction of its recording."""
    plan, motion, cad = coarse.plan, coarse.motion, session.specimen.finger
    none = np.zeros(len(motion.time), bool)
    held = sum(((motion.time >= begin) & (motion.time < end) for begin, end, _ in plan.holds), none)
    excursion = session.nominal.geometry(motion.q)[0]
    trial = Trial(
        plan.name, plan.experiment, motion.time, motion.q, motion.tension,
        tendon_excursion=excursion, hold=np.where(held, 0, -1),
    )  # fmt: skip
    known = np.broadcast_to(friction_known(trial, cad), motion.q.shape)
    every = np.ones(len(motion.time), bool)
    rows = session.rows(session.nominal, coarse, motion, True)
    return np.concatenate([known[:, k] if c == "joint_torque" else every for _, c, k, _ in rows])


def make_cases(
    split: str,
    count: int,
    root: Path,
    truth_root: Path,
    workers: int = 1,
    share: tuple[int, int] = (1, 1),
    progress: Callable[[int, int, str], None] | None = None,
    only: Iterable[int] | None = None,
    mix: str = "natural",
) -> list[int]:
    """Make the cases 1 … count of a split, or share (i, n) of them, with several processes; return their numbers.

    Finished cases are skipped: to resume a stopped run, call again. `progress` takes (done, total, name).
    """
    specs = case_specs(split, count, mix)
    wanted = set(only) if only is not None else None
    numbers = [
        i for i in range(1, count + 1) if i % share[1] == share[0] % share[1] and (wanted is None or i in wanted)
    ]
    if workers == 1:
        for done, i in enumerate(numbers, start=1):
            make_case(i, split, specs[i - 1], root, truth_root, mix)
            if progress:
                progress(done, len(numbers), f"case-{i:03d}")
        return numbers
    with ProcessPoolExecutor(workers) as pool:
        jobs = {pool.submit(make_case, i, split, specs[i - 1], root, truth_root, mix): i for i in numbers}
        for done, job in enumerate(as_completed(jobs), start=1):
            job.result()
            if progress:
                progress(done, len(numbers), f"case-{jobs[job]:03d}")
    return numbers
