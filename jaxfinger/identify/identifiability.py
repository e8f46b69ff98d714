"""Identifiability: combinations of parameters that the trials do not determine, remedies, and base parameters."""

from collections.abc import Collection
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse.csgraph import connected_components

from jaxfinger.data.signals.noise import HALF_95
from jaxfinger.identify.gauss_newton import MIN_RELATIVE_SINGULAR_VALUE
from jaxfinger.identify.parameters import Parameter
from jaxfinger.model import Finger, rigid_body

# A combination whose relative singular value is smaller is weak: its interval is more than 1000 times as wide as that
# of the best. Below `gauss_newton.MIN_RELATIVE_SINGULAR_VALUE` it is invisible.
MIN_SEEN_SINGULAR_VALUE = 1e-3
# Entries of a unit vector. Smaller ones hold less than 0.25 % of its square and are not shown, or less than 9 % and
# need no remedy.
MIN_SHOWN_ENTRY, MIN_ENTRY_OF_REMEDY = 0.05, 0.3
# Width of an interval over its width if another parameter were known, from which on the sentence names both. The other
# parameter then makes 99 % of its variance, and noise the rest.
MIN_WIDENING = 10.0
RANDOM_SAMPLES = 200  # of the motions of `base_parameters`: many times the ten parameters of a link
RANK_TOLERANCE = 1e-9  # relative, of a regressor's columns and singular values, far above rounding

# Experiment of the format that determines each group of parameters.
REMEDIES = {
    "moment_arm": "ID.2 of joint {joint} with tendon {tendon} taut",
    "elastic": "ID.3-static of joint {joint}",
    "friction": "ID.3-static of joint {joint}, every hold approached from both sides",
    "damping": "ID.3-dynamic of joint {joint} at two speeds or more",
    "friction_by_direction": "ID.3-dynamic of joint {joint} at two speeds or more, and ID.4 with the joint held",
    "torque_friction": "ID.3-dynamic of joint {joint} with another load, driving it and driven by it",
    "rotor_inertia": "ID.3-dynamic of joint {joint} with fast reversals",
    "tendon_friction": "ID.4 of tendon {tendon} at two tensions or more",
    "mass": "ID.3-dynamic of joint {joint} with fast reversals, or a better scale",
    "com": "ID.3-static of joint {joint} with the finger mounted otherwise, so that gravity differs",
}


@dataclass(frozen=True)
class Direction:
    """One right singular vector of the white Jacobian, whose columns are scaled to unit length."""

    singular_value: float  # relative to the largest
    shares: dict[str, float]  # entries of parameters that exceed `MIN_SHOWN_ENTRY`, largest first
    remedy: str  # experiments that would determine it; empty where the status is `seen`

    @property
    def status(self) -> str:
        """`seen`, `weak` or `invisible`."""
        if self.singular_value < MIN_RELATIVE_SINGULAR_VALUE:
            return "invisible"
        return "weak" if self.singular_value < MIN_SEEN_SINGULAR_VALUE else "seen"

    def __str__(self) -> str:
        names = " ".join(f"{c:+.2f}·[{name}]" for name, c in self.shares.items())
        return f"{self.status} ({self.singular_value:.1e}): {names}" + (f"; record {self.remedy}" * bool(self.remedy))


def directions(
    parameters: list[Parameter], free: Int[np.ndarray, " p"], information: Float[np.ndarray, "P P"]
) -> list[Direction]:
    """Singular vectors of the Jacobian J of the free parameters, weakest first.

    `information` is JᵀJ over the flat vector.
    """
    N = information[np.ix_(free, free)]
    norm = np.sqrt(np.diag(N))
    scale = np.where(norm > 0, 1.0 / np.where(norm > 0, norm, 1.0), 0.0)
    values, vectors = np.linalg.eigh(N * np.outer(scale, scale))
    values = np.sqrt(np.maximum(values, 0.0))
    out = []
    for value, v in zip(values / max(values[-1], 1e-300), vectors.T, strict=True):
        shares = _shares(parameters, free, v)
        out.append(
            Direction(
                float(value), shares, _remedy(parameters, _involved(free, v)) if value < MIN_SEEN_SINGULAR_VALUE else ""
            )
        )
    return out


def name_invisible(
    parameters: list[Parameter],
    free: Int[np.ndarray, " p"],
    invisible: Float[np.ndarray, "k p"],
    told: Collection[int] = (),
) -> list[str]:
    """Sentences on what is undetermined, each with a remedy; the rows of `invisible` are orthonormal.

    `told`: positions of parameters of which another sentence says why the trials do not show them by themselves.

    Of the space that these rows span any other basis is as good. So parameters that lie in it by themselves are named
    together. Others are named by combinations of those that trade off, in one sentence for each remedy; parameters that
    do not trade off with each other share no combination.
    """
    alone = np.sum(invisible**2, axis=0) > 1.0 - MIN_SHOWN_ENTRY**2
    sentences, combinations = [], {}
    untold = free[alone & ~np.isin(free, list(told))]
    if untold.size:
        names = ", ".join(parameters[i].name for i in untold)
        sentences.append(f"the trials do not show {names}; record {_remedy(parameters, untold)}")
    for v in _apart(np.where(alone, 0.0, invisible)):
        names = " ".join(f"{c:+.2f}·[{name}]" for name, c in _shares(parameters, free, v).items())
        combinations.setdefault(_mend(parameters, _involved(free, v)), []).append(names)
    for mend, names in combinations.items():
        sentences.append(
            f"the trials cannot see the combination{'s' * (len(names) > 1)} {', '.join(names)} "
            f"(in units of each parameter's own column); {mend}"
        )
    return sentences


def _mend(parameters: list[Parameter], positions: Int[np.ndarray, " k"]) -> str:
    """What to do about parameters that trade off. A finger without tendons has no ID.4 that could tell them apart."""
    remedy = _remedy(parameters, positions)
    if "ID.4" in remedy and not any(p.tendon for p in parameters):
        return "leave one of them out of the recipe, since only ID.4 tells them apart, which needs a tendon to pull"
    return f"record {remedy}"


def _apart(rows: Float[np.ndarray, "k p"]) -> Float[np.ndarray, "r p"]:
    """Basis of the space that orthonormal rows span, some columns set to zero, each vector in one group of entries.

    Entries are in one group where the projection onto that space carries one into the other, directly or by others.
    """
    projection = rows.T @ rows
    count, group = connected_components(np.abs(projection) > MIN_SHOWN_ENTRY**2)
    found = [np.zeros((0, len(group)))]
    for here in (group == k for k in range(count)):
        shares, vectors = np.linalg.eigh(np.where(np.outer(here, here), projection, 0.0))
        found.append(vectors.T[shares > 0.5])  # 0 or 1, but for what links groups by less than is shown
    return np.concatenate(found)


def name_traded(
    parameters: list[Parameter],
    values: Float[np.ndarray, " P"],
    covariance: Float[np.ndarray, "P P"],
    free: Int[np.ndarray, " p"],
) -> list[str]:
    """One sentence for each two laws of which the trials determine the sum alone, with a remedy.

    The intervals of their parameters then hold zero, and each would be `MIN_WIDENING` times as narrow if the other were
    known. Coefficients of one polynomial trade off in any trial of a short range, and say nothing of a law.
    """
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unsure = [i for i in free if np.isfinite(std[i]) and std[i] > 0.0 and abs(values[i]) < HALF_95 * std[i]]
    out: dict[tuple, str] = {}
    for k, i in enumerate(unsure):
        for j in unsure[:k]:
            a, b = parameters[j], parameters[i]
            laws = (a.group, a.joint, a.tendon), (b.group, b.joint, b.tendon)
            if laws[0] != laws[1] and (covariance[i, j] / std[i] / std[j]) ** 2 > 1.0 - MIN_WIDENING**-2:
                remedies = dict.fromkeys(_remedy(parameters, np.array([m])) for m in (j, i))
                said = f"the trials show {a.name} and {b.name} only together, so the interval of each is wide"
                out.setdefault(laws, f"{said}; record {', or '.join(remedies)}")
    return list(out.values())


def _shares(parameters, free, v) -> dict[str, float]:
    """Entries that are shown, the largest first and positive; those of one size in the order of the parameters."""
    order = [k for k in np.argsort(-np.abs(v).round(2), kind="stable") if abs(v[k]) > MIN_SHOWN_ENTRY]
    return {parameters[free[k]].name: float(v[k] * np.sign(v[order[0]])) for k in order}


def _involved(free, v) -> Int[np.ndarray, " k"]:
    """Positions of the parameters with the largest entries in a combination, the largest first."""
    return free[[k for k in np.argsort(-np.abs(v)) if abs(v[k]) > MIN_ENTRY_OF_REMEDY]]


def _remedy(parameters: list[Parameter], positions: Int[np.ndarray, " k"]) -> str:
    """Experiments that determine the parameters at these positions."""
    wanted = [
        REMEDIES[p.group].format(joint=p.joint or "by joint, two of them moved together", tendon=p.tendon)
        for p in (parameters[i] for i in positions)
        if p.group in REMEDIES
    ]
    whole = [text for text in dict.fromkeys(wanted) if not any(other.startswith(f"{text},") for other in wanted)]
    return " and ".join(whole) or "a trial that moves what it acts on"


@dataclass(frozen=True)
class BaseParameters:
    """Base parameters: the combinations of the links' inertial parameters that joint torques determine."""

    names: tuple[str, ...]  # ten for each link: m, m c (3), I about the joint (6)
    singular_values: Float[np.ndarray, " k"]  # of the regressor with columns of unit length, largest first
    combinations: Float[np.ndarray, "rank k"]  # orthonormal rows, in units of each column

    @property
    def rank(self) -> int:
        """Number of base parameters."""
        return len(self.combinations)


def base_parameters(finger: Finger) -> BaseParameters:
    """Base parameters of the chain, from the singular values of its regressor on random motions (Gautier 1991).

    The torque is linear in the parameters π: m, m c and the inertia about the joint of each link. A column of the
    regressor is the torque of one unit of one of them.
    """
    q, qd, qdd = np.random.default_rng(0).uniform(-1.5, 1.5, (3, finger.m, RANDOM_SAMPLES))

    def column(i: int, com: np.ndarray, inertia: np.ndarray) -> np.ndarray:
        """Torques of the chain where link i has a mass of 1 kg and all other links none."""
        values = [np.zeros_like(v) for v in (finger.mass, finger.com, finger.gyration)]
        for array, value in zip(values, (1.0, com, inertia), strict=True):
            array[i] = value
        lone = eqx.tree_at(lambda f: (f.mass, f.com, f.gyration), finger, tuple(jnp.asarray(v) for v in values))
        return np.asarray(rigid_body.inverse_dynamics(lone, q, qd, qdd)).ravel()

    names, columns, axes, none = [], [], np.eye(3), np.zeros((3, 3))
    for i, joint in enumerate(finger.joint_names):
        mass = column(i, np.zeros(3), none)
        # A mass at unit distance whose inertia about the joint is cancelled, less a mass at the joint, leaves m c.
        first = [column(i, e, np.outer(e, e) - np.eye(3)) - mass for e in axes]
        pairs = [(a, b) for a in range(3) for b in range(a, 3)]
        second = [column(i, np.zeros(3), _symmetric(a, b)) - mass for a, b in pairs]
        columns += [mass, *first, *second]
        labels = ["m", *(f"m c{a}" for a in "xyz"), *(f"I{'xyz'[a]}{'xyz'[b]}" for a, b in pairs)]
        names += [f"{label} {joint}" for label in labels]
    Y = np.stack(columns, axis=1)
    norm = np.linalg.norm(Y, axis=0)
    Y = Y / np.where(norm > RANK_TOLERANCE * norm.max(), norm, np.inf)
    _, s, Vt = np.linalg.svd(Y, full_matrices=False)
    return BaseParameters(tuple(names), s, Vt[s > RANK_TOLERANCE * s[0]])


def _symmetric(a: int, b: int) -> Float[np.ndarray, "3 3"]:
    unit = np.zeros((3, 3))
    unit[a, b] = unit[b, a] = 1.0
    return unit
