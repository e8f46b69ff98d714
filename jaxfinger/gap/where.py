"""Places of the gap: trials, columns and regions of the motion where whitened residuals exceed the noise."""

import numpy as np

from jaxfinger.gap.problem import Problem, site
from jaxfinger.gap.result import Place

BINS = 6  # Quantile bins of a variable; a region is a run of them. Six are three thirds, each halved.
MIN_ROWS = 20  # Rows of a column in a trial. With fewer, single samples decide where its gap lies.
# Energy above the noise, in standard deviations of white noise's, from which a column of a trial stands out. Residuals
# are never quite white, and a rest of colour adds up to a few.
MIN_DEVIATIONS = 5.0
ROUNDING = 1e-9  # relative: a variable that varies by less is constant
MIN_REGION_SHARE = 0.5  # A region holds at least half of the gap of its trial and column.


def where(problem: Problem, most: int = 12) -> list[Place]:
    """Places of the gap: the `most` columns of trials with the largest energy above noise, each with its region.

    A region is the range of one variable that concentrates the column's gap best. `Place.share` is the region's share
    of the energy above noise in all places that stand out. Largest share first.
    """
    found, total = [], 0.0
    for e, rows in problem.rows.items():
        stack = problem.stacks[e]
        r2 = problem.r[rows.start : rows.start + rows.size] ** 2 - 1.0
        for number, c in enumerate(stack.experiment.channels):
            for column in np.unique(rows.column[rows.channel == number]):
                for b in np.unique(rows.trial):
                    pick = (rows.channel == number) & (rows.column == column) & (rows.trial == b)
                    energy, n = float(r2[pick].sum()), int(pick.sum())
                    if n < MIN_ROWS or energy < MIN_DEVIATIONS * np.sqrt(2.0 * n):  # the variance of χ²(n) is 2 n
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
    """Variable, lower and upper end of the region, and its share of the column's energy in the trial.

    Among all variables and runs of bins with MIN_REGION_SHARE of the energy, the one whose share of the energy exceeds
    its share of the samples most. The whole trial, as a range of time, where no run does.
    """
    x = problem.stacks[e].batch.x
    finger = problem.nominal.finger
    if c == "tendon_excursion":
        joint = next(i for i in range(finger.m) if finger.crosses[column][i])
        tendon = column
    else:
        joint = column if c == "joint_torque" else 0
        tendon = int(np.argmax(np.asarray(x.tension)[:, b].max(axis=-1))) if finger.n else None
    variables = {"time": np.asarray(x.time)[b]}
    if not problem.stacks[e].experiment.held:  # A held joint is moved by noise alone.
        variables |= {"q": np.asarray(x.q)[joint, b], "qd": np.asarray(x.qd)[joint, b]}
    if tendon is not None:
        variables["tendon_force"] = np.asarray(x.tension)[tendon, b]
    best = ("time", float(variables["time"][time].min()), float(variables["time"][time].max()), 1.0, 0.0)
    for name, values in variables.items():
        v = values[time]
        if np.ptp(v) <= ROUNDING * np.abs(v).max():
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
                if share >= MIN_REGION_SHARE and share - size > best[4]:
                    best = (name, float(edges[i]), float(edges[j + 1]), float(min(share, 1.0)), float(share - size))
    return best[:4]
