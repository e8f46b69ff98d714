"""The features that bound what nobody knows."""

from dataclasses import replace
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
import pytest

from jaxfinger.data import read_session
from jaxfinger.effects import Scales
from jaxfinger.gap.problem import build
from jaxfinger.gap.signatures import whitened
from jaxfinger.gap.smooth_laws import concerned, features, measured_columns, orthonormal_basis, white_features
from jaxfinger.identify import Recipe
from jaxfinger.model import Motion

SHIPPED = Path(__file__).parents[2] / "datasets" / "paper-finger" / "session.h5"


def quicker_and_pulled_harder(problem, time: float, force: float):
    """The problem of a machine whose motions take `time` times as long, under `force` times the tensions."""

    def moved(x: Motion) -> Motion:
        return replace(
            x,
            time=x.time * time,
            session_time=x.session_time * time,
            qd=x.qd / time,
            qdd=x.qdd / time**2,
            tension=x.tension * force,
        )

    stacks = {e: replace(s, batch=replace(s.batch, x=moved(s.batch.x))) for e, s in problem.stacks.items()}
    return replace(problem, stacks=stacks, scales=Scales.of(problem.nominal.finger, [s.batch for s in stacks.values()]))


@pytest.mark.parametrize(("time", "force"), [(0.1, 1.0), (1.0, 50.0), (20.0, 1e-2)])
def test_they_are_those_of_the_same_laws_on_a_quicker_or_stronger_machine(planted, time, force):
    other = quicker_and_pulled_harder(planted, time, force)
    for e, c, k, _ in measured_columns(planted):
        mine, theirs = features(planted, e, c, k), features(other, e, c, k)
        for variable, members in mine.items():
            for a, b in zip(members, theirs[variable], strict=True):
                np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9, err_msg=f"{e} {c} {k} {variable}")


def drawn_laws(a, b, rng, count=6):
    """Smooth laws of two variables, or of one for both, drawn at random: sigmoids of sums, products of sigmoids."""
    for _ in range(count):
        (u, v), (c, d) = 1.5 * rng.standard_normal(2), 0.5 * rng.standard_normal(2)
        yield np.tanh(u * a + v * b + c)
        yield np.tanh(u * a + c) * np.tanh(v * b + d)


def missed(problem, e, c, k, pick, laws):
    """Share of the energy of each law of a column that neither features nor nominal parameters explain."""
    explained = np.vstack([*white_features(problem, e, c, k, pick).values()])
    J = problem.J[problem.rows[e].start + pick].T
    Q = orthonormal_basis(explained[np.any(explained, axis=1)])
    off = J - (J @ Q) @ Q.T
    U, s, _ = np.linalg.svd(off.T, full_matrices=False)
    Q = np.hstack([Q, U[:, s > 1e-9 * np.linalg.norm(J)]])
    raw = np.zeros((len(laws), *problem.stacks[e].batch.y[c].shape))
    raw[:, k] = laws
    white = whitened(raw, problem, problem.rows[e], pick, c)
    return 1.0 - np.sum((white @ Q) ** 2, axis=1) / np.sum(white**2, axis=1)


def check_that_features_hold_drawn_laws(problem):
    """Of most laws of any two variables of a torque, features and nominal parameters leave a fiftieth at most."""
    rng = np.random.default_rng(0)
    for e, c, k, pick in measured_columns(problem):
        if c != "joint_torque":
            continue
        x = problem.stacks[e].batch.x
        _, taut = concerned(problem.nominal.finger, c, k)
        signals = {"angle": x.q[k], "speed": x.qd[k], "direction": x.joint_direction[k]}
        signals |= {f"tension {t}": x.tension[t] for t in taut}
        unit = {n: np.asarray(s) / np.abs(s).max() for n, s in signals.items() if np.any(np.asarray(s))}
        for (a, s), (b, t) in combinations_with_replacement(unit.items(), 2):
            left = np.quantile(missed(problem, e, c, k, pick, list(drawn_laws(s, t, rng))), 0.9)
            assert left < 0.02, f"{e} {k}: {left:.3f} of laws of {a} and {b}"


def test_they_hold_most_of_any_smooth_law_of_two_variables(planted):
    check_that_features_hold_drawn_laws(planted)


@pytest.mark.long
def test_they_hold_most_of_any_smooth_law_under_tensions():
    check_that_features_hold_drawn_laws(build(read_session(SHIPPED), Recipe()))
