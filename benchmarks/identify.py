"""Times and memory of the staged identification, and ratios to other libraries, from one run.

    python benchmarks/identify.py [--only-inverse-dynamics]

1. The command `jaxfinger identify` on a session of 30 trials, 20 minutes at 1 kHz: with an empty and a full compile
   cache, and on half the session.
2. Inverse dynamics of 10,000, 100,000 and a million samples with 3 and 7 joints, beside Pinocchio's batch call and
   MuJoCo, in processor seconds of one thread.
3. Least squares of each stage, beside the quickest method of `scipy.optimize.least_squares` on the same compressed
   problem from the same start; and the same with derivatives by the parameters of earlier stages, which the
   propagation of their errors needs. NumPy has one thread there, as in every fit; SciPy, too, is quicker so.

Each figure is the median of five runs, with the smallest and largest.
"""

# pyright: reportAttributeAccessIssue=false
# (The compiled modules of MuJoCo and Pinocchio have no types.)

import argparse
import itertools
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio as pin
import scipy.optimize

from jaxfinger.compilation import one_blas_thread
from jaxfinger.data import FingerDescription, Session, read_session, write_session
from jaxfinger.experiments import prepare
from jaxfinger.identify import identify
from jaxfinger.identify.parameters import Free, describe
from jaxfinger.identify.solve import STEP_TOLERANCE, Tangents, linearise_each, solve, stacked
from jaxfinger.identify.sources import Source, sources_of
from jaxfinger.identify.stages import STAGES
from jaxfinger.identify.start import start_values
from jaxfinger.model import Finger, Model, rigid_body
from jaxfinger.synthetic import ModelPlant, paper_finger, polynomial_finger, recipe_from, simulate, true_model

RUNS = 5
TWENTY_MINUTES = {
    "specimen": {"kind": "polynomial"},
    "cad": {"mass": 0.02, "com": 3e-4},
    "trials": {
        "experiments": ["ID.2", "ID.3-static", "ID.3-dynamic", "ID.4"],
        "id2": {"strokes": 4, "stroke_time": 8.0},
        "id3_static": {"step": 8.0},
        "id3_dynamic": {"cycles": 5},
        "id4": {"postures": [[40.0, 45.0, 40.0]], "dwell": 1.6},
    },
}


def session_file(folder: Path) -> Path:
    """Simulate a session of about 30 trials and 20 minutes at 1 kHz, write it and its half, and return its file."""
    plant = ModelPlant(true_model(polynomial_finger(paper_finger())))
    session = simulate(recipe_from(TWENTY_MINUTES), seed=0, plant=plant)
    write_session(session, folder / "session.h5")
    half = list(session.trials)[::2]
    write_session(Session(session.specimen, session.finger, {n: session[n] for n in half}), folder / "half.h5")
    minutes = sum(t.duration for t in session) / 60
    print(f"session: {len(session)} trials, {minutes:.1f} min, {sum(len(t.time) for t in session):,} samples")
    return folder / "session.h5"


MEASURED = """
import resource, subprocess, sys, time
begun = time.perf_counter()
subprocess.run(sys.argv[1:], check=True, capture_output=True)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime, time.perf_counter() - begun, used.ru_maxrss / 1024)
"""


def measured(session: Path, folder: Path, cold: bool = False) -> np.ndarray:
    """Processor seconds, wall seconds and peak MiB of five runs of `jaxfinger identify`, (runs, 3).

    `cold`: each run has an empty compile cache. Otherwise a run before them fills a common one. Python keeps the
    bytecode of the package, as it does by default; without it each run would compile all modules, too.
    """
    inherited = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    command = [sys.executable, "-m", "jaxfinger", "identify", str(session), "-o", str(folder / "fit.json")]
    rows = []
    for run in range(RUNS if cold else RUNS + 1):
        cache = str(folder / (f"compiled-{run}" if cold else "compiled"))
        line = subprocess.run(
            [sys.executable, "-c", MEASURED, *command, "--overwrite"],
            check=True,
            capture_output=True,
            text=True,
            env=inherited | {"JAX_COMPILATION_CACHE_DIR": cache},
        )
        rows.append([float(x) for x in line.stdout.split()])
    return np.array(rows[-RUNS:])


def spread(values: np.ndarray, form: str = ".1f") -> str:
    """Median with the smallest and largest value, as text."""
    return f"{np.median(values):{form}} ({min(values):{form}} to {max(values):{form}})"


def whole(folder: Path) -> None:
    """Print part 1, the command."""
    path = session_file(folder)
    print(f"identify, median (least to most) of {RUNS} runs: seconds of processor, of wall; peak MiB")
    for name, session, cold in (
        ("empty compile cache", path, True),
        ("full cache", path, False),
        ("full cache, half the session", folder / "half.h5", False),
    ):
        used, wall, memory = measured(session, folder, cold).T
        print(f"  {name:28}  {spread(used)}, {spread(wall)}; {memory.max():.0f}")


def processor(*works) -> list[np.ndarray]:
    """Processor seconds of `RUNS` runs of each function, which take turns after a first run that compiles."""
    times = []
    for _ in range(RUNS + 1):
        for work in works:
            begun = time.process_time()
            work()
            times.append(time.process_time() - begun)
    return list(np.reshape(times, (RUNS + 1, -1))[1:].T)


def chain(m: int) -> FingerDescription:
    """Draw a chain of m revolute joints with arbitrary axes and links with full inertia tensors."""
    rng = np.random.default_rng(m)
    axis, root = rng.standard_normal((m, 3)), rng.standard_normal((m, 3, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return FingerDescription(
        gravity=np.array([0.0, 0.0, -9.81]), joint_names=tuple(f"J{i}" for i in range(m)), axis=axis,
        origin=rng.standard_normal((m, 3)), limits=np.tile([-3.0, 3.0], (m, 1)), mass=rng.uniform(0.1, 2.0, m),
        com=rng.standard_normal((m, 3)), inertia=root @ root.transpose(0, 2, 1), fingertip=np.ones(3),
        tendon_names=(), active=np.zeros(0, bool), crosses=np.zeros((0, m), bool),
    )  # fmt: skip


def in_pinocchio(d: FingerDescription) -> pin.Model:
    """The chain as Pinocchio's model."""
    model = pin.Model()
    for i in range(d.m):
        joint = pin.JointModelRevoluteUnaligned(d.axis[i])
        k = model.addJoint(i, joint, pin.SE3(np.eye(3), d.origin[i]), d.joint_names[i])
        model.appendBodyToJoint(k, pin.Inertia(float(d.mass[i]), d.com[i], d.inertia[i]), pin.SE3.Identity())
    model.gravity.linear = d.gravity
    return model


def in_mujoco(d: FingerDescription) -> mujoco.MjModel:
    """The chain as MuJoCo's model."""
    spec = mujoco.MjSpec()
    spec.option.gravity = d.gravity
    body = spec.worldbody
    for i in range(d.m):
        values, turn = np.linalg.eigh(d.inertia[i])
        turn[:, 0] *= np.linalg.det(turn)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, turn.ravel())
        body = body.add_body(
            pos=d.origin[i], mass=d.mass[i], ipos=d.com[i], inertia=values, iquat=quat, explicitinertial=True
        )
        body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=d.axis[i])
    spec.compiler.balanceinertia = True
    return spec.compile()


def inverse_dynamics(joints: int, samples: int) -> None:
    """Print part 2, inverse dynamics: one call for all samples on one thread, repeated for small numbers of them."""
    d = chain(joints)
    finger = Finger.from_description(d)
    q, qd, qdd = np.random.default_rng(0).uniform(-1, 1, (3, joints, samples))
    x = [jnp.asarray(a) for a in (q, qd, qdd)]
    repeats = max(1, 200_000 // samples)
    begun = time.process_time()
    ours = eqx.filter_jit(rigid_body.inverse_dynamics).lower(finger, *x).compile()
    compiling = time.process_time() - begun
    pool = pin.ModelPool(in_pinocchio(d), 1)
    a, b, c = (np.asfortranarray(v) for v in (q, qd, qdd))
    tau = np.zeros_like(a)
    mine, theirs = processor(
        lambda: [jax.block_until_ready(ours(finger, *x)) for _ in range(repeats)],
        lambda: [pin.rneaInParallel(1, pool, a, b, c, tau) for _ in range(repeats)],
    )
    error = float(np.abs(np.asarray(ours(finger, *x)) - tau).max() / np.abs(tau).max())
    model = in_mujoco(d)
    data, few = mujoco.MjData(model), min(samples, 20_000)

    def by_mujoco():
        for k in range(few):
            data.qpos[:], data.qvel[:], data.qacc[:] = q[:, k], qd[:, k], qdd[:, k]
            mujoco.mj_inverse(model, data)

    (third,) = processor(by_mujoco)
    print(f"inverse dynamics, {joints} joints, {samples:,} samples (compiled in {compiling:.1f} s)")
    for name, seconds, count in (
        ("ours", mine, samples * repeats),
        ("Pinocchio, batch call", theirs, samples * repeats),
        ("MuJoCo, from Python", third, few),
    ):
        print(f"  {name:22s} {spread(1e6 * seconds / count, '6.3f')} µs a sample")
    print(f"  Pinocchio / ours {np.median(theirs / mine):.2f}; largest difference {error:.0e} of the largest torque")


class Compressed:
    """The compressed cost of a stage, ½ ‖d + R δ‖² + ½ ρ² at every point, as residuals and Jacobians for SciPy.

    A linear stage is linearised once.
    """

    def __init__(self, model: Model, free: np.ndarray, sources: dict[str, Source], limit: float):
        self.model, self.free, self.sources, self.limit = model, free, sources, limit
        self.at = Free.at(model, free)
        self.start, self.size = np.asarray(self.at.get(model)), len(describe(model))
        self.quadratic = not limit and all(s.is_affine(model, free) for s in sources.values())
        self.forget()

    def forget(self) -> None:
        """Forget all linearisations."""
        self.tangents, self.known = Tangents(), None

    def rows(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Point of the linearisation, and [R d; 0 ρ] there."""
        if self.known is None or not (self.quadratic or np.array_equal(self.known[0], theta)):
            at = self.at.set(self.model, jnp.asarray(theta))
            linearised = linearise_each(at, self.sources, self.limit, self.tangents, self.free)
            factor = stacked(linearised, self.sources, self.size)
            self.known = theta.copy(), factor[:, [*self.free, self.size]]
        return self.known

    def residual(self, theta: np.ndarray) -> np.ndarray:
        at, rows = self.rows(theta)
        residual = np.zeros(theta.size + 1)  # SciPy needs a fixed number of rows; missing ones are zero.
        residual[: len(rows)] = rows[:, -1] + rows[:, :-1] @ (theta - at)
        return residual

    def jacobian(self, theta: np.ndarray) -> np.ndarray:
        _, rows = self.rows(theta)
        jacobian = np.zeros((theta.size + 1, theta.size))
        jacobian[: len(rows)] = rows[:, :-1]
        return jacobian

    def apart(self, a: np.ndarray, b: np.ndarray) -> float:
        """Distance of two points in standard deviations of the estimate (Mahalanobis)."""
        return float(np.linalg.norm(self.jacobian(b) @ (a - b)))


def by_scipy(problem: Compressed, **options) -> tuple[np.ndarray, int]:
    """Optimum by SciPy, without earlier linearisations, and at how many points it needs the residuals."""
    problem.forget()
    found = scipy.optimize.least_squares(problem.residual, problem.start, jac=problem.jacobian, **options)  # pyright: ignore[reportArgumentType]
    return found.x, found.nfev


def rivals(problem: Compressed, optimum: np.ndarray, near: float) -> list[dict]:
    """SciPy's methods and scales, each with the loosest tolerance that ends nearer than `near` to the optimum."""
    out = []
    for method, scale in itertools.product(("lm", "trf"), ("jac", 1.0)):
        for tolerance in 10.0 ** -np.arange(2, 16):
            options = {"method": method, "x_scale": scale} | dict.fromkeys(("ftol", "xtol", "gtol"), tolerance)
            if problem.apart(by_scipy(problem, **options)[0], optimum) < near:
                out.append(options)
                break
    return out


@one_blas_thread
def stages(path: Path) -> None:
    """Print part 3, the least squares of every stage."""
    session = read_session(path)
    (again,) = processor(lambda: identify(read_session(path)))
    print(f"identify, in a process that has compiled: {spread(again)} s of processor, reading included")
    fit, stacks = identify(session), prepare(session)
    parameters, huber = describe(fit.model), fit.recipe.fit.huber
    for limit, how in ((0.0, "plain least squares"), (huber, f"Huber's cost beyond {huber:g} standard deviations")):
        print(f"a stage from zero, {how}; ms of processor")
        for name, stage in STAGES.items():
            reads = {e: c for e, c in stage.reads.items() if e in stacks}
            free = np.array([i for i in fit.estimated if parameters[i].group in stage.frees], dtype=int)
            sources = sources_of(stacks, reads, fit.noise, parameters)
            zero = Free.at(fit.model, free).set(fit.model, jnp.zeros(free.size))
            start = start_values(zero, free, parameters, sources)
            alone = {n: s._replace(positions=np.intersect1d(s.positions, free)) for n, s in sources.items()}
            one_stage(name, Compressed(start, free, alone, limit), sources)


def one_stage(name: str, problem: Compressed, sources: dict[str, Source]) -> None:
    """Print a stage's times, ours beside those of SciPy's quickest method."""

    def ours(read: dict[str, Source], small: float = STEP_TOLERANCE):
        model, solution = solve(problem.model, problem.free, read, huber=problem.limit, tolerance=small)
        return np.asarray(problem.at.get(model)), solution.linearisations

    found, points = ours(problem.sources)
    optimum, _ = ours(problem.sources, 1e-3 * STEP_TOLERANCE)
    options = rivals(problem, optimum, max(STEP_TOLERANCE, problem.apart(found, optimum)))
    works = [partial(by_scipy, problem, **o) for o in options]
    mine, passing, *theirs = processor(lambda: ours(problem.sources), lambda: ours(sources), *works)
    best = int(np.argmin([np.median(t) for t in theirs]))
    used, (reached, needed) = options[best], works[best]()
    print(
        f"  {name:13} ours {spread(1e3 * mine)} at {points} points; "
        f"SciPy {spread(1e3 * theirs[best])} at {needed}, by {used['method']}, x_scale={used['x_scale']}, "
        f"{used['ftol']:.0e}; SciPy / ours {np.median(theirs[best] / mine):.2f}, "
        f"{problem.apart(reached, found):.0e} σ apart; "
        f"ours with the derivatives that errors are passed on by {spread(1e3 * passing)}"
    )


def main() -> None:
    """Print all parts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only-inverse-dynamics", action="store_true")
    only = parser.parse_args().only_inverse_dynamics
    for joints in (3, 7):
        for samples in (10_000, 100_000, 1_000_000):
            inverse_dynamics(joints, samples)
    if only:
        return
    with tempfile.TemporaryDirectory() as folder:
        whole(Path(folder))
        stages(Path(folder) / "session.h5")


if __name__ == "__main__":
    main()
