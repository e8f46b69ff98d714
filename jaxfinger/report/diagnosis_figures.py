"""The pictures of a diagnosis: where, which and how far at a glance, and the worst trial against time."""

from __future__ import annotations

import numpy as np

from jaxfinger.data.schema import channel_units, units_where
from jaxfinger.gap import Diagnosis
from jaxfinger.gap.where import site
from jaxfinger.identify.linearise import residuals_of
from jaxfinger.report.theme import COLOURS, grid, look

BLAME, QUIET, BEFORE, AFTER = COLOURS[2], "#b8c4d6", COLOURS[4], COLOURS[0]
LEADING = 6  # candidates in the picture
UNITS = {"m": (1e3, "mm"), "N m": (1e3, "N mm"), "rad": (180 / np.pi, "°"), "rad/s": (180 / np.pi, "°/s")}
SHORT = {"joint_torque": "torque", "tendon_excursion": "excursion", "fingertip_force": "fingertip force"}
VARIABLES = {"q": "rad", "qd": "rad/s", "tendon_force": "N", "time": "s"}


def people(units: str) -> tuple[float, str]:
    """Factor and name of the unit in which a person reads an SI unit."""
    return UNITS.get(units, (1.0, units))


def places(gap: dict) -> dict[tuple[str, str, str], float]:
    """Share of the gap by experiment, channel and site, largest first; of the places that `gap.json` lists."""
    shares: dict[tuple[str, str, str], float] = {}
    for p in gap["where"]:
        key = p["experiment"], p["channel"], p["site"]
        shares[key] = shares.get(key, 0.0) + p["share"]
    return dict(sorted(shares.items(), key=lambda kv: -kv[1]))


def probabilities(gap: dict, most: int = LEADING) -> list[tuple[str, float, bool]]:
    """Name, probability, and whether the verdict names it: the leading candidates, «none» and «unlisted»."""
    named = {(e["effect"], *e["site"]) for e in gap["verdict"]["effects"]}
    for members in gap["ambiguous_sets"][:1]:
        named |= {(e["effect"], *e["site"]) for e in members}
    rows = [
        (f"{c['effect']} · {'-'.join(c['site'])}", c["probability"], (c["effect"], *c["site"]) in named)
        for c in gap["candidates"][:most]
    ]
    status = gap["verdict"]["status"]
    rows.append(("none: no gap beyond noise", gap["none"], status == "no_gap"))
    rows.append(("unlisted: none that I know", gap["unlisted"], status == "unexplained"))
    return rows


@look()
def glance(gap: dict):
    """Three panels: share of the gap by place, probabilities, and rms before and after in units of the noise."""
    figure, ((where, which, far),) = grid(1, 3, 4.4, 3.4)
    _where(where, places(gap))
    _which(which, probabilities(gap))
    _how_far(far, gap["gap"])
    return figure


def _where(ax, shares: dict) -> None:
    ax.set_title("Where: share of the gap", loc="left", fontweight="bold")
    if not shares:
        ax.text(0.5, 0.5, "no place stands out\nof the noise", ha="center", va="center", transform=ax.transAxes)
        ax.set(xticks=[], yticks=[])
        return
    top = list(shares.items())[:8]
    labels = [f"{e} · {SHORT.get(c, c)} · {s}" for (e, c, s), _ in top]
    _bars(ax, labels, [v for _, v in top], [BLAME] + [QUIET] * (len(top) - 1))


def _which(ax, rows) -> None:
    ax.set_title("Which: probability", loc="left", fontweight="bold")
    _bars(ax, [name for name, _, _ in rows], [p for _, p, _ in rows], [BLAME if n else QUIET for _, _, n in rows])
    ax.axhline(len(rows) - 2.5, color="#888888", linewidth=0.6)


def _bars(ax, labels, values, colours) -> None:
    at = np.arange(len(labels))
    ax.barh(at, values, color=colours, height=0.7)
    for y, v in zip(at, values, strict=True):
        ax.text(v + 0.02, y, f"{100 * v:.0f} %", va="center", fontsize=8)
    ax.set(yticks=at, yticklabels=labels, xticks=[0, 0.5, 1], xlim=(0, 1.22), ylim=(len(labels) - 0.4, -0.6))
    ax.set_xticklabels(["0", "50 %", "100 %"])
    ax.grid(axis="y", visible=False)


def _how_far(ax, lines: list[dict]) -> None:
    """A log axis in units of the noise, since the channels have different units; the numbers stand beside it.

    A channel whose noise nothing shows, as that of a forward simulation without repeats, is in the page's table alone.
    """
    lines = [x for x in lines if x["noise"] > 0]
    ax.set_title("How far: rms on held-out trials", loc="left", fontweight="bold")
    for y, x in enumerate(lines):
        factor, unit = people(x["units"])
        before, after = x["before"] / x["noise"], x["after"] / x["noise"]
        ax.plot([before, after], [y, y], color="#999999", linewidth=1.2, zorder=1)
        ax.plot(before, y, "o", color="white", markeredgecolor=BEFORE, markeredgewidth=1.6, markersize=7)
        ax.plot(after, y, "o", color=AFTER, markersize=5)
        text = f"{factor * x['before']:.3g} → {factor * x['after']:.3g} {unit}"
        ax.text(1.02, y, text, transform=ax.get_yaxis_transform(), va="center", fontsize=8)
    ax.axvline(1.0, color="#444444", linewidth=0.9, linestyle="--")
    ax.set(
        yticks=range(len(lines)),
        yticklabels=[f"{x['experiment']} · {SHORT.get(x['channel'], x['channel'])}" for x in lines],
    )
    ratios = [x[k] / x["noise"] for x in lines for k in ("before", "after")]
    low, high = min([0.5, *(0.8 * r for r in ratios if r > 0)]), max([3.0, *(1.3 * r for r in ratios)])
    ax.set(xscale="log", xlim=(low, high), ylim=(max(len(lines), 1) - 0.4, -0.6), xlabel="rms / noise")
    steps = (1, 2, 5) if high < 50 * low else (1,)  # no room for more
    ticks = [t for k in range(-2, 6) for t in (s * 10.0**k for s in steps) if low <= t <= high]
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.set_xticks([], minor=True)
    ax.plot([], [], "o", color="white", markeredgecolor=BEFORE, label="before")
    ax.plot([], [], "o", color=AFTER, label="after")
    ax.plot([], [], "--", color="#444444", linewidth=0.9, label="noise")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3)


def worst(d: Diagnosis) -> tuple[str, str, int, int]:
    """Experiment, channel, column and trial (its index in the stack) with the most energy above noise."""
    best, most = None, -np.inf
    for e, rows in d.problem.rows.items():
        excess = d.problem.r[rows.start : rows.start + rows.size] ** 2 - 1.0
        key = np.stack([rows.channel, rows.column, rows.trial])
        kinds, which = np.unique(key, axis=1, return_inverse=True)
        if not kinds.size:
            continue
        energy = np.bincount(which.ravel(), excess)
        if energy.max() > most:
            most = energy.max()
            number, column, trial = kinds[:, energy.argmax()]
            best = e, d.problem.stacks[e].experiment.channels[number], int(column), int(trial)
    assert best is not None
    return best


@look()
def traces(d: Diagnosis):
    """What the model misses in the worst trial, before and after, and what moved meanwhile."""
    e, channel, column, b = worst(d)
    stack = d.problem.stacks[e]
    mask = np.asarray(stack.batch.mask[channel])[column, b] > 0
    x = stack.batch.x
    time = np.asarray(x.time)[b]
    seen = np.arange(time.size) <= np.flatnonzero(mask).max()  # the rest is padding
    tension = np.asarray(x.tension)[:, b][:, seen]
    taut = [k for k in range(len(tension)) if np.ptp(tension[k]) > 0]
    figure, axes = grid(3 if taut else 2, 1, 9.0, 1.6, sharex=True)
    missed, angle, *pull = (row[0] for row in axes)
    y = np.asarray(stack.batch.y[channel])[column, b]
    prismatic = d.problem.session.finger.prismatic
    factor, unit = people(channel_units(channel, prismatic))
    turn, angular = people(units_where("rad", prismatic))
    first = d.problem.simulator or d.nominal.model
    for model, colour, label in ((first, BEFORE, "before"), (d.augmented.model, AFTER, "after")):
        residual = residuals_of(model, stack.batch, (channel,))[channel][column, b]
        if channel == "tendon_excursion":  # its zero is free in every trial
            residual = residual - residual[mask].mean()
        missed.plot(
            time,
            np.where(mask, factor * residual, np.nan),
            ".-",
            color=colour,
            linewidth=0.9,
            markersize=1.5,
            label=label,
        )
    std = factor * float(d.problem.noise[e, channel].std[column])
    missed.axhspan(-std, std, color="#bbbbbb", alpha=0.5, linewidth=0, label="noise ±1σ")
    span = factor * float(np.ptp(y[mask]))
    what = f"{stack.trials[b]}: {SHORT.get(channel, channel)} {site(d.problem, channel, column)}, measured − predicted"
    spans = f" (the signal spans {span:.3g} {unit})" if span else ""  # the free finger's external torque is zero
    missed.set(ylabel=f"missed ({unit})", title=what + spans)
    for i, name in enumerate(d.problem.nominal.finger.joint_names):
        angle.plot(time[seen], turn * np.asarray(x.q)[i, b][seen], color=COLOURS[i % len(COLOURS)], label=name)
    angle.set(ylabel=f"q ({angular})")
    for ax in pull:
        for k in taut:
            name = d.problem.nominal.finger.tendon_names[k]
            ax.plot(time[seen], tension[k], color=COLOURS[k % len(COLOURS)], label=name)
        ax.set(ylabel="tension (N)")
    axes[-1][0].set(xlabel="time (s)")
    for ax in (missed, angle, *pull):
        if ax.get_legend_handles_labels()[0]:
            ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
