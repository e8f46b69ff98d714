"""Where the gap lies: energy of the white residuals above noise, by trial, channel, site, and region of the motion."""

import numpy as np

from jaxfinger.gap.problem import Problem, site
from jaxfinger.gap.result import Place

BINS = 6


def where(problem: Problem, most: int = 12) -> list[Place]:
    """The places with the largest share of the gap, and the region of the motion that holds most of it."""
    found, total = [], 0.0
    for e, rows in problem.rows.items():
        stack = problem.stacks[e]
        r2 = problem.r[rows.start : rows.start + rows.size] ** 2 - 1.0
        for number, c in enumerate(stack.experiment.channels):
            for column in np.unique(rows.column[rows.channel == number]):
                for b in np.unique(rows.trial):
                    pick = (rows.channel == number) & (rows.column == column) & (rows.trial == b)
                    energy, n = float(r2[pick].sum()), int(pick.sum())
                    # Coloured remains of noise add up: five deviations of white noise are not much.
                    if n < 20 or energy < 5.0 * np.sqrt(2.0 * n):
                        continue
                    total += energy
                    found.append((energy, e, c, int(column), int(b), pick, r2[pick]))
    found.sort(key=lambda x: -x[0])
    places = []
    for energy, e, c, column, b, pick, values in found[:most]:
        variable, low, high, share = _region(problem, e, c, column, b, problem.rows[e].time[pick], values)
        places.append(
            Place(
                e, problem.stacks[e].trials[b], c, site(problem, c, column), variable, low, high, energy / total * share
            )
        )
    return sorted(places, key=lambda p: -p.share)


def _region(problem: Problem, e, c, column, b, time, energy):
    """The variable and the run of its bins that holds the gap in the smallest part of the trial."""
    x = problem.stacks[e].batch.x
    finger = problem.nominal.finger
    if c == "tendon_excursion":
        joint = next(i for i in range(finger.m) if finger.crosses[column][i])
        tendon = column
    else:
        joint = column if c == "joint_torque" else 0
        tendon = int(np.argmax(np.asarray(x.tension)[:, b].max(axis=-1))) if finger.n else None
    variables = {"time": np.asarray(x.time)[b]}
    if not problem.stacks[e].experiment.held:  # else only noise moves the joint
        variables |= {"q": np.asarray(x.q)[joint, b], "qd": np.asarray(x.qd)[joint, b]}
    if tendon is not None:
        variables["tendon_force"] = np.asarray(x.tension)[tendon, b]
    best = ("time", float(variables["time"][time].min()), float(variables["time"][time].max()), 1.0, 0.0)
    for name, values in variables.items():
        v = values[time]
        if np.ptp(v) < 1e-9:
            continue
        edges = np.unique(np.quantile(v, np.linspace(0, 1, BINS + 1)))
        if len(edges) < 3:
            continue
        index = np.clip(np.searchsorted(edges, v, side="right") - 1, 0, len(edges) - 2)
        part = np.bincount(index, energy, len(edges) - 1) / energy.sum()
        width = np.bincount(index, minlength=len(edges) - 1) / len(v)
        for i in range(len(part)):
            for j in range(i, len(part)):
                share, size = part[i : j + 1].sum(), width[i : j + 1].sum()
                if share >= 0.5 and share - size > best[4]:
                    best = (name, float(edges[i]), float(edges[j + 1]), float(min(share, 1.0)), float(share - size))
    return best[:4]
