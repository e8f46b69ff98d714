"""Fabricated diagnoses, one of each kind, so that sentences and pages are tested without a search."""

from dataclasses import replace
from functools import cache

import numpy as np

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap.posterior import Posterior
from jaxfinger.gap.propose import Proposal
from jaxfinger.gap.result import (
    Absorbed,
    Candidate,
    Cause,
    Change,
    ChannelBudget,
    Closure,
    Diagnosis,
    ExperimentChannel,
    Key,
    Left,
    NextExperiment,
    NotJudged,
    Place,
    Posture,
    Reason,
    Relevance,
    Status,
    Unexplained,
    Value,
)
from jaxfinger.gap.verdict import consistent_with
from jaxfinger.identify import Fit, Recipe
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.report.curves import Curve, Curves
from jaxfinger.report.measured import Points
from jaxfinger.report.traces import Trace
from jaxfinger.synthetic import paper_finger, polynomial_finger, true_model

STRETCH, STRIBECK = Key("tendon_stretch", ("T3",)), Key("joint_stribeck", ("PIP",))
TORQUE, EXCURSION = ExperimentChannel("ID.4", "joint_torque"), ExperimentChannel("ID.4", "tendon_excursion")
PATH = ExperimentChannel("VD.1", "tendon_excursion")


@cache
def fits() -> tuple[Fit, Fit]:
    """A nominal fit with parameters known to 1 % and correlated with neighbours, and one in which T3 stretches."""
    finger = polynomial_finger(paper_finger())
    model = true_model(finger)
    size = ravel(model).size
    empty = Fit(model, np.zeros((size, size)), np.zeros(0, int), Recipe(), specimen="finger A", data="a.h5")
    chosen = [i for i, p in enumerate(describe(model)) if p.determinable and p.group in ("elastic", "tendon_friction")]
    flat = np.asarray(ravel(model))
    std = np.zeros(size)
    std[chosen] = 0.01 * np.abs(flat[chosen]) + 1e-6
    apart = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
    nominal = replace(
        empty,
        covariance=np.outer(std, std) * (-0.6) ** apart,
        estimated=np.array(chosen),
        created="2026-01-01T00:00:00",
        versions={"jaxfinger": "0.1.0"},
        data_hash="0" * 64,
    )
    stretch = CATALOGUE["tendon_stretch"].at(model.finger, ("T3",), compliance=9.1e-5)
    augmented = nominal.with_effect(stretch, ("compliance",))
    covariance = augmented.covariance.copy()
    for i in augmented.estimated[len(chosen) :]:
        covariance[i, i] = 1e-10
    return nominal, replace(augmented, covariance=covariance)


STRETCHES = Cause(
    "tendon_stretch",
    (("T3",),),
    0.995,
    0.96,
    (0.94, 0.98),
    {EXCURSION: 0.97, PATH: 0.95},
    (Value(("T3",), "compliance", 9.1e-5, 3e-6, "m/N"),),
)
RUBS = Cause(
    "joint_stribeck",
    (("PIP",),),
    0.93,
    0.41,
    (0.35, 0.47),
    {TORQUE: 0.41},
    (Value(("PIP",), "a", 0.52, 0.04, "1"), Value(("PIP",), "v_s", 0.11, 0.02, "rad/s")),
)
COUPLED = Cause(
    "moment_arm_coupling",
    tuple((f"T{k}",) for k in range(1, 6)),
    0.97,
    0.5,
    (0.4, 0.6),
    {EXCURSION: 0.5},
    tuple(
        Value((f"T{k}",), name, value, std, units)
        for k in range(1, 6)
        for name, value, std, units in (
            ("A", 1e-3 * k, 1e-5, "m/rad^2"),
            ("joint_a", 0.0, 0.0, "1"),
            ("joint_b", 1.0, 0.0, "1"),
        )
    ),
)
SMALL = Relevance("VD.1", "tendon_excursion", "m", 6e-6, 0.02, 3e-4, False)
LARGE = Relevance("ID.4", "joint_torque", "N m", 1.2e-3, 0.03, 0.04, False)
LINES = (
    Closure("ID.4", "joint_torque", "N m", 2e-4, 1.2e-3, 2.1e-4, 0.99, (0.97, 1.0), True),
    Closure("VD.1", "tendon_excursion", "m", 2e-5, 4.1e-4, 2.1e-5, 0.97, (0.94, 0.99), True),
    Closure("VD.3", "q", "rad", 0.0, 0.05, 0.01, 0.9, (0.8, 0.95), True),
)
BARS = (
    ChannelBudget("ID.4", "joint_torque", "PIP", "N m", 2e-4, 1.2e-3, (0.02, 0.62), 0.05),
    ChannelBudget("ID.4", "tendon_excursion", "T3", "m", 2e-5, 4.1e-4, (0.97, 0.0), 0.01),
    ChannelBudget("VD.1", "tendon_excursion", "T3", "m", 2e-5, 3.0e-5, (0.6, 0.55), 0.2),
)
TRIAL = NextExperiment(
    "ID.4",
    False,
    "PIP",
    "T3",
    (Posture("MCP", 0.4, 0.4, False, False), Posture("PIP", 0.1, 1.0, True, False)),
    15.0,
    True,
    True,
    None,
    False,
    2,
    7.1,
    ("tendon_stretch", "tendon_creep"),
)
CLOSED = Unexplained(0.03, (0.01, 0.05), (), None, None)
OPEN = Unexplained(
    0.3,
    (0.2, 0.4),
    ("tension", "q"),
    ExperimentChannel("ID.4", "joint_torque", "PIP"),
    Proposal("joint_torque", "PIP", ((1.2e-3, "sin(6 (q_PIP + q_DIP))"),), "N m", 0.8),
)


def _candidate(key: Key, probability: float) -> Candidate:
    return Candidate(key, probability, 0.9, (Value(key.site, "compliance", 9.1e-5, 3e-6, "m/N"),))


@cache
def explained() -> Diagnosis:
    """One cause, and every channel comes down to its noise."""
    nominal, augmented = fits()
    return Diagnosis(
        Status.EXPLAINED,
        (STRETCH,),
        "a.h5",
        "finger A",
        None,
        False,
        {},
        (STRETCHES,),
        CLOSED,
        tuple(replace(b, by_cause=b.by_cause[:1]) for b in BARS[1:]),
        (LARGE, SMALL),
        (),
        LINES,
        (
            Place("ID.4", "ID4-PIP-T3-1", "tendon_excursion", "T3", "tendon_force", 8.0, 12.0, 0.41),
            Place("ID.4", "ID4-PIP-T3-2", "joint_torque", "PIP", "q", 0.1, 0.5, 0.2),
        ),
        (_candidate(STRETCH, 0.995), _candidate(Key("tendon_creep", ("T3",)), 0.04), _candidate(STRIBECK, 2e-4)),
        0.001,
        0.02,
        (),
        None,
        (Absorbed(Key("tension_sensor_scale", ("T3",)), 0.995, (Value(("T3",), "gain", 0.0, 0.1, "1"),)),),
        (),
        (Left("ID.4", "joint_torque", "PIP", 20.0, {"q": 15.0}),),
        nominal,
        augmented,
        None,
    )


def every() -> dict[str, Diagnosis]:
    """Diagnoses by name: one of each status, and variations that need sentences of their own."""
    one = explained()
    two = replace(
        one,
        named=(STRETCH, STRIBECK),
        budget=(replace(STRETCHES, share=0.52, share_ci95=(0.5, 0.54)), RUBS),
        channels=BARS,
        candidates=(_candidate(STRETCH, 0.995), _candidate(STRIBECK, 0.93)),
    )
    nothing = replace(
        one,
        status=Status.NO_GAP,
        named=(),
        budget=(),
        channels=(),
        relevance=(),
        where=(),
        none=0.97,
        unlisted=0.01,
        closures=tuple(
            replace(
                x, before=1.01 * x.noise, after=1.01 * x.noise, closed=0.0, closed_ci95=(0.0, 0.0), resolvable=False
            )
            for x in LINES[:2]
        ),
        candidates=(_candidate(STRETCH, 0.02),),
        augmented=one.nominal,
        unexplained=Unexplained(0.0, (0.0, 0.0), (), None, None),
    )
    unknown = replace(
        one,
        status=Status.UNEXPLAINED,
        named=(),
        budget=(),
        unexplained=replace(OPEN, share=0.98, share_ci95=(0.9, 1.0)),
        channels=(replace(BARS[0], by_cause=(), unexplained=0.98),),
        candidates=(_candidate(STRETCH, 0.1),),
        unlisted=0.97,
        closures=tuple(replace(x, after=x.before, closed=0.0, closed_ci95=(-0.02, 0.03)) for x in LINES),
        augmented=one.nominal,
    )
    blind = NotJudged("ID.4", "joint_torque", Reason.NOTHING_COUNTS)
    rivals = (STRETCH, Key("tendon_creep", ("T3",)))
    return {
        "no_gap": nothing,
        "tolerated": replace(
            nothing, relevance=(replace(SMALL, tolerated=True),), tolerance={"tendon_excursion": 0.02}
        ),
        "explained": one,
        "two": two,
        "coupled": replace(
            one,
            named=COUPLED.keys,
            budget=(replace(COUPLED, share=0.97, share_ci95=(0.94, 0.99)),),
            candidates=tuple(_candidate(k, 0.97) for k in COUPLED.keys),
        ),
        "partly": replace(
            two,
            status=Status.PARTLY,
            budget=(replace(STRETCHES, share=0.32, share_ci95=(0.3, 0.34)), replace(RUBS, share=0.36)),
            unexplained=OPEN,
            unlisted=0.8,
            closures=(LINES[0], replace(LINES[1], after=3e-5), LINES[2]),
        ),
        "partly_ambiguous": replace(
            one,
            status=Status.PARTLY,
            named=(STRIBECK,),
            budget=(RUBS,),
            ambiguous_sets=(rivals,),
            unexplained=replace(OPEN, share=0.55, share_ci95=(0.5, 0.6), proposal=None),
            unlisted=0.02,
            candidates=(_candidate(STRIBECK, 0.93), _candidate(rivals[0], 0.5), _candidate(rivals[1], 0.47)),
        ),
        "still_open": replace(
            one,
            status=Status.PARTLY,
            unlisted=consistent_with(Status.PARTLY, Posterior({}, {}, 0.0, 0.02, (), ()), gaps=True)[1],
            closures=(LINES[0], replace(LINES[1], after=3.1e-5), LINES[2]),
        ),
        "ambiguous": replace(
            one,
            status=Status.AMBIGUOUS,
            ambiguous_sets=(rivals,),
            next_experiment=TRIAL,
            candidates=(_candidate(rivals[0], 0.62), _candidate(rivals[1], 0.36)),
        ),
        "unexplained": unknown,
        "not_judged": replace(nothing, status=Status.NOT_JUDGED, closures=(), not_judged=(blind,), none=0.5),
        "some_not_judged": replace(
            one, not_judged=(blind, replace(blind, experiment="ID.3-static", reason=Reason.FEW_SAMPLES))
        ),
        "diverged": replace(
            one, closures=(*LINES[:2], replace(LINES[2], diverged=True, after=1.8, closed=0.0, closed_ci95=(0.0, 0.0)))
        ),
        "against": replace(
            one,
            against="A-fit.json",
            named=(Key("changed_damping", ("MCP",)),),
            budget=(
                replace(
                    STRETCHES,
                    effect="changed_damping",
                    sites=(("MCP",),),
                    values=(Value(("MCP",), "change", 4e-3, 5e-4, "N m s/rad"),),
                ),
            ),
            candidates=(_candidate(Key("changed_damping", ("MCP",)), 0.995),),
            changes=(Change("damping MCP", "damping", "N m s/rad", 1.2e-2, 1e-3, 1.6e-2, 5e-4, 0.995),),
        ),
        "first_look": replace(one, quick=True),
    }


def trace() -> Trace:
    """One second of a torque that the nominal model misses by a sine and the augmented model predicts."""
    time = np.linspace(0.0, 4.0, 161)
    measured = 10.0 * np.sin(time) + np.random.default_rng(0).normal(0.0, 0.3, time.size)
    measured[40:44] = np.nan
    return Trace(
        "ID.4",
        "ID4-PIP-T3-1",
        "joint torque PIP",
        "N mm",
        time,
        measured,
        10.0 * np.sin(time) - 2.0 * np.sin(6 * time),
        10.0 * np.sin(time),
        0.6,
        True,
    )


def arms() -> Curves:
    """Moment arms about one joint that four tendons cross."""
    q = np.linspace(0.0, 90.0, 20)
    lines = {(f"T{k}", "MCP"): Curve(q, k + 0.05 * q, np.full(20, 0.2)) for k in range(1, 5)}
    return Curves(lines, {}, {}, {key: Points(c.x[::5], c.y[::5] + 0.1) for key, c in lines.items()})
