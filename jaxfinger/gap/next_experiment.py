"""What next: the trial of the format that would separate the members of an ambiguous set best.

Expected discrimination of i from j in a trial: half the energy of i's signature there that j and the nominal
parameters, refitted to the whole file, cannot imitate, at the sizes that the file suggests (T-optimality, Atkinson &
Fedorov 1975).
The file's own trials are the short list; a repeat of the best one, further out where the difference lies,
is the suggestion.
"""

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from jaxfinger.gap.evidence import Projector
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.refine import Refined

# Separating trials that no trial of the file resembles, by pairs that imitate each other exactly in the usual protocol.
KNOWN = {
    frozenset({"tension_sensor_scale", "tendon_friction_saturating"}): (
        "ID.4",
        "pull the tendon in steps up and down again: a gain is the same both ways, friction is not",
    ),
    frozenset({"payload", "gravity_tilt"}): (
        "ID.3-static",
        "mount the finger at another angle and step all joints again",
    ),
    frozenset({"torque_sensor_scale", "payload"}): (
        "ID.3-static",
        "hang a known weight on the link and step the joint again",
    ),
}


@dataclass(frozen=True)
class NextExperiment:
    """`next_experiment` of gap.json."""

    experiment: str
    description: str
    separates: tuple[str, ...]


def next_experiment(problem: Problem, members: list[Refined]) -> NextExperiment | None:
    """For the refitted members of an ambiguous set."""
    if len(members) < 2:
        return None
    ids = tuple(dict.fromkeys(m.keys[0][0] for m in members))
    power = np.zeros(problem.r.size)
    for a, b in permutations(members, 2):
        imitator = Projector(problem, b.columns)
        power += 0.5 * imitator(a.change[None])[0, : problem.r.size] ** 2
    if len(ids) > 1 and (known := KNOWN.get(frozenset(ids[:2]))):
        return NextExperiment(known[0], known[1], ids)
    trials = np.bincount(problem.trial_of_row, power, len(problem.trial_names))
    name = problem.trial_names[int(np.argmax(trials))]
    trial = problem.session[name]
    what = trial.experiment
    place = f" of joint {trial.joint}" if trial.joint else f" of tendon {trial.tendon}" if trial.tendon else ""
    rows = problem.trial_of_row == int(np.argmax(trials))
    e = problem.rows[what]
    inside = np.flatnonzero(rows[e.start : e.start + e.size])
    x = problem.stacks[what].batch.x
    b, time = int(e.trial[inside[0]]), e.time[inside]
    weight = power[e.start : e.start + e.size][inside] + 1e-12
    posture = ", ".join(
        f"{n} {np.degrees(np.average(np.asarray(x.q)[i, b, time], weights=weight)):.0f}°"
        for i, n in enumerate(problem.nominal.finger.joint_names)
    )
    speed = np.average(np.abs(np.asarray(x.qd)[:, b, time]).max(axis=0), weights=weight)
    tension = np.average(np.asarray(x.tension)[:, b, time].max(axis=0), weights=weight)
    detail = {
        "ID.3-dynamic": f"at speeds from {0.3 * speed:.2g} to {3 * max(speed, 0.1):.2g} rad/s",
        "VD.3": f"at speeds around {max(speed, 0.1):.2g} rad/s and tensions around {tension:.1f} N",
        "ID.4": f"with steps up to {1.5 * tension:.0f} N and down again",
        "VD.2": f"with steps up to {1.5 * tension:.0f} N",
    }.get(what, "over the whole range, both ways")
    return NextExperiment(
        what,
        f"repeat {what}{place} near {posture}, {detail}; there the fitted models differ most (as in trial {name})",
        ids,
    )
