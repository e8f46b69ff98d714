"""Closed form for what no known effect explains: a few terms of a physical library, found by sparse regression.

Orthogonal matching pursuit (Pati, Rezaiifar and Krishnaprasad 1993) selects the terms on white rows, off the nominal
parameters. The library holds terms that laws of friction, elasticity and transmission are made of. The true law may
have none of them, so the closed form is a proposal for a person to look at, and no verdict.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxfinger.data.schema import channel_units
from jaxfinger.gap.problem import Problem, site
from jaxfinger.gap.projector import Projector
from jaxfinger.gap.signatures import whitened
from jaxfinger.gap.smooth_laws import LENGTHS, PULL, SPEEDS, TIMES, SmoothPart, concerned, since_reversal

MAX_TERMS = 3  # A formula of more terms is no law that a person could recognise.
MIN_GAIN_SHARE = 0.1  # Share of the energy that smooth laws explain which every further term must explain.
MIN_UNABSORBED = 0.05  # Share of a term's norm that nominal parameters must leave, lest its coefficient be arbitrary.
HARMONICS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16)  # periods a turn


@dataclass(frozen=True)
class Proposal:
    """Formula Σ aₖ termₖ for one column of one channel in all experiments."""

    channel: str
    site: str
    terms: tuple[tuple[float, str], ...]  # coefficient in the channel's unit (angles rad, forces N), and term
    units: str
    share: float  # of the energy beyond the noise that the causes leave in the column

    @property
    def formula(self) -> str:
        """Formula for people, every coefficient with the channel's unit."""
        body = " ".join(f"{a:+.3g} {self.units} · {text}" for a, text in self.terms)
        return f"{self.channel} {self.site} ≈ {body.lstrip('+')}"


def propose(
    problem: Problem, project: Projector, residual: Float[np.ndarray, " N"], left: Sequence[SmoothPart]
) -> Proposal | None:
    """Propose a formula for the column where smooth laws explain most of a residual; None if no term is worth it.

    Args:
        project: projection off the nominal parameters.
        residual: white residual that the causes leave.
        left: what smooth laws explain of it in every column; one at least.
    """
    by_column: dict[tuple[str, int], float] = {}
    for x in left:
        by_column[x.channel, x.column] = by_column.get((x.channel, x.column), 0.0) + max(x.energy, 0.0)
    (channel, column), most = max(by_column.items(), key=lambda kv: kv[1])
    names, rows, there = _library_rows(problem, channel, column)
    Z, r = project(rows), project.residual(residual)
    own = r[: there.size][there]  # Rows of the prior stand behind those of the trials.
    missed = max(float(own @ own) - own.size, most)  # White noise has an energy of one a row.
    norm = np.linalg.norm(Z, axis=1)
    usable = norm > MIN_UNABSORBED * np.linalg.norm(rows, axis=1)
    found: list[int] = []
    coefficients, rest, energy = np.empty(0), r, 0.0
    while len(found) < MAX_TERMS:
        gain = np.where(usable, (Z @ rest) ** 2 / np.maximum(norm**2, 1e-300), 0.0)
        gain[found] = 0.0
        trial = [*found, int(np.argmax(gain))]
        a = np.linalg.lstsq(Z[trial].T, r, rcond=1e-10)[0]
        explained = float(r @ r - np.sum((r - a @ Z[trial]) ** 2))
        if explained - energy < MIN_GAIN_SHARE * most:
            break
        found, coefficients, rest, energy = trial, a, r - a @ Z[trial], explained
    if not found:
        return None
    named = tuple((float(v), names[i]) for v, i in zip(coefficients, found, strict=True))
    units = channel_units(channel, problem.session.finger.prismatic, column)
    return Proposal(channel, site(problem, channel, column), named, units, min(1.0, energy / missed))


def _library_rows(
    problem: Problem, channel: str, column: int
) -> tuple[list[str], Float[np.ndarray, "terms N"], Bool[np.ndarray, " N"]]:
    """Terms of the library, their white rows in every experiment that reads the channel, and a mask of these rows."""
    found: dict[str, np.ndarray] = {}
    there = np.zeros(problem.r.size, bool)
    for e, rows in problem.rows.items():
        channels = problem.stacks[e].experiment.channels
        if channel not in channels:
            continue
        pick = np.flatnonzero((rows.channel == channels.index(channel)) & (rows.column == column))
        there[rows.start + pick] = True
        library = terms(problem, e, channel, column)
        raw = np.zeros((len(library), len(problem.stacks[e].batch.y[channel]), *library[0][1].shape))
        raw[:, column] = np.stack([values for _, values in library])
        for (name, _), white in zip(library, whitened(raw, problem, rows, pick, channel), strict=True):
            found.setdefault(name, np.zeros(problem.r.size))[rows.start + pick] = white
    return list(found), np.stack(list(found.values())), there


def terms(problem: Problem, experiment: str, channel: str, column: int) -> list[tuple[str, Float[np.ndarray, "B T"]]]:
    """Library of one column: terms and their values."""
    x, finger, scales = problem.stacks[experiment].batch.x, problem.nominal.finger, problem.scales
    q, qd, f, s = (np.asarray(a) for a in (x.q, x.qd, x.tension, x.joint_direction))
    time = np.asarray(x.time)
    names, tendons = finger.joint_names, finger.tendon_names
    own, taut = concerned(finger, channel, column)
    out: list[tuple[str, np.ndarray]] = [("t", time)]
    out += [(f"exp(−t/{tau:g} s)", np.exp(-time / tau)) for tau in _rounded(TIMES, scales.trial)]
    for i in own:
        a, v, d = f"q_{names[i]}", f"q̇_{names[i]}", f"sign q̇_{names[i]}"
        out += [(f"{a}^{p}" if p > 1 else a, q[i] ** p) for p in (1, 2, 3, 4)]
        out += [(f"{v}|{v}|", qd[i] * np.abs(qd[i])), (f"{v}³", qd[i] ** 3), (f"{a} {v}", q[i] * qd[i])]
        out += [(d, s[i]), (f"{a} {d}", q[i] * s[i])]
        speeds, lengths = _rounded(SPEEDS, scales.speed[i]), _rounded(LENGTHS, scales.angle[i])
        out += [(f"exp(−|{v}|/{w:g}) {d}", np.exp(-np.abs(qd[i]) / w) * s[i]) for w in speeds]
        travelled = since_reversal(q[i])
        out += [(f"exp(−|Δ{a}|/{w:g}) {d}", np.exp(-np.abs(travelled) / w) * s[i]) for w in lengths]
        out += _harmonics(a, q[i])
        for j in range(finger.m):
            if j != i:
                b = f"q_{names[j]}"
                out += [(f"{a} {b}", q[i] * q[j]), (f"{a} {b}²", q[i] * q[j] ** 2), (b, q[j]), (f"{b}²", q[j] ** 2)]
                out += [(f"q̇_{names[j]}", qd[j])]
                out += _harmonics(f"({a} + {b})", q[i] + q[j]) + _harmonics(f"({a} − {b})", q[i] - q[j])
    for k in taut:
        if f[k].any():
            b = f"f_{tendons[k]}"
            pulled = since_reversal(f[k])
            out += [(b, f[k]), (f"{b}²", f[k] ** 2), (f"√{b}", np.sqrt(np.maximum(f[k], 0.0)))]
            (w,) = _rounded((PULL,), scales.tension[k])
            out += [(f"exp(−|Δ{b}|/{w:g} N) sign Δ{b}", np.exp(-np.abs(pulled) / w) * np.sign(pulled))]
            for i in own:
                a = f"q_{names[i]}"
                out += [(f"{b} {a}", f[k] * q[i]), (f"{b} {a}²", f[k] * q[i] ** 2), (f"{b}² {a}", f[k] ** 2 * q[i])]
                out += [(f"{b} sign q̇_{names[i]}", f[k] * s[i])]
    return [(text, np.broadcast_to(values, time.shape)) for text, values in out]


def _harmonics(name: str, angle: Float[np.ndarray, "B T"]) -> list[tuple[str, Float[np.ndarray, "B T"]]]:
    """Sines and cosines of multiples of an angle; the name of a sum stands in parentheses."""
    out = []
    for p in HARMONICS:
        argument = f"{p} {name}" if p > 1 else name[1:-1] if name.startswith("(") else name
        out += [(f"sin({argument})", np.sin(p * angle)), (f"cos({argument})", np.cos(p * angle))]
    return out


def _rounded(shares: tuple[float, ...], scale: float) -> list[float]:
    """Shares of a scale, to two digits, as the formula shows them."""
    return [float(f"{share * scale:.2g}") for share in shares]
