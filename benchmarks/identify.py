"""The staged identification: seconds, memory, and ratios to other libraries, from one run.

    python benchmarks/identify.py [--only-inverse-dynamics]

1. `jaxfinger identify` on a session of 30 trials, 20 minutes at 1 kHz, as a user runs it: with an empty compile cache
   and with a full one; peak memory there and on half the session.
2. Inverse dynamics of 10,000, 100,000 and a million samples, 3 and 7 joints, against Pinocchio's batch call and
   MuJoCo, in processor seconds of one thread: median and spread of five runs.
3. Each stage's least squares against `scipy.optimize.least_squares` on the same rows, with the same derivatives; and
   with the derivatives by the parameters of earlier stages too, which the errors that are passed on need.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pinocchio as pin
import scipy.optimize

from jaxfinger.data import FingerDescription, Session, read_session, write_session
from jaxfinger.experiments import prepare
from jaxfinger.identify import identify
from jaxfinger.identify.linearise import linearise
from jaxfinger.identify.parameters import Free, describe
from jaxfinger.identify.solve import solve
from jaxfinger.identify.stages import STAGES, sources_of
from jaxfinger.identify.start import start_values
from jaxfinger.model import Finger, rigid_body
from jaxfinger.synthetic import ModelPlant, paper_finger, polynomial_finger, recipe_from, simulate, true_model

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
    """A simulated session of about 30 trials and 20 minutes at 1 kHz."""
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
print(time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024)
"""


def measured(session: Path, cache: Path) -> tuple[float, float]:
    """Wall seconds and peak MiB of one `jaxfinger identify`."""
    command = [
        sys.executable,
        "-m",
        "jaxfinger",
        "identify",
        str(session),
        "-o",
        str(cache / "fit.json"),
        "--overwrite",
    ]
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache / "compiled")}
    line = subprocess.run(
        [sys.executable, "-c", MEASURED, *command], check=True, capture_output=True, text=True, env=environment
    )
    seconds, memory = map(float, line.stdout.split())
    return seconds, memory


def best(work, repeats: int = 3) -> float:
    """Shortest time of a few runs, s, compiled before."""
    work()
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        work()
        times.append(time.perf_counter() - begun)
    return min(times)


def whole(folder: Path) -> None:
    """1. The command."""
    path = session_file(folder)
    cold, memory = measured(path, folder)
    warm, _ = measured(path, folder)
    half, less = measured(folder / "half.h5", folder)
    print(f"identify, empty compile cache: {cold:.1f} s; full cache: {warm:.1f} s; peak memory {memory:.0f} MiB")
    print(f"identify, half the session:    {half:.1f} s; peak memory {less:.0f} MiB")


def processor(work, runs: int = 5) -> tuple[float, float, float]:
    """Median, least and most processor seconds of a few runs, compiled before."""
    work()
    times = []
    for _ in range(runs):
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return float(np.median(times)), min(times), max(times)


def chain(m: int) -> FingerDescription:
    """m revolute joints with any axes, links with full inertia tensors."""
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
    """The chain."""
    model = pin.Model()
    for i in range(d.m):
        joint = pin.JointModelRevoluteUnaligned(d.axis[i])
        k = model.addJoint(i, joint, pin.SE3(np.eye(3), d.origin[i]), d.joint_names[i])
        model.appendBodyToJoint(k, pin.Inertia(float(d.mass[i]), d.com[i], d.inertia[i]), pin.SE3.Identity())
    model.gravity.linear = d.gravity
    return model


def in_mujoco(d: FingerDescription) -> mujoco.MjModel:
    """The chain."""
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
    """2. One call for all samples, on one thread; repeated until a run takes some tenths of a second."""
    d = chain(joints)
    finger = Finger.from_description(d)
    q, qd, qdd = np.random.default_rng(0).uniform(-1, 1, (3, joints, samples))
    x = [jnp.asarray(a) for a in (q, qd, qdd)]
    repeats = max(1, 200_000 // samples)
    begun = time.process_time()
    ours = eqx.filter_jit(rigid_body.inverse_dynamics).lower(finger, *x).compile()
    compiling = time.process_time() - begun
    mine = processor(lambda: [jax.block_until_ready(ours(finger, *x)) for _ in range(repeats)])
    pool = pin.ModelPool(in_pinocchio(d), 1)
    a, b, c = (np.asfortranarray(v) for v in (q, qd, qdd))
    tau = np.zeros_like(a)
    theirs = processor(lambda: [pin.rneaInParallel(1, pool, a, b, c, tau) for _ in range(repeats)])
    error = float(np.abs(np.asarray(ours(finger, *x)) - tau).max() / np.abs(tau).max())
    model = in_mujoco(d)
    data, few = mujoco.MjData(model), min(samples, 20_000)

    def by_mujoco():
        for k in range(few):
            data.qpos[:], data.qvel[:], data.qacc[:] = q[:, k], qd[:, k], qdd[:, k]
            mujoco.mj_inverse(model, data)

    third = processor(by_mujoco)
    print(f"inverse dynamics, {joints} joints, {samples:,} samples (compiled in {compiling:.1f} s)")
    for name, seconds, count in (
        ("ours", mine, samples * repeats),
        ("Pinocchio, batch call", theirs, samples * repeats),
        ("MuJoCo, from Python", third, few),
    ):
        each, low, high = (1e6 * s / count for s in seconds)
        print(f"  {name:22s} {each:6.3f} µs a sample ({low:.3f} to {high:.3f})")
    print(f"  Pinocchio / ours {theirs[0] / mine[0]:.2f}; largest difference {error:.0e} of the largest torque")


def stages(path: Path) -> None:
    """3. The least squares of every stage, all else equal."""
    warm = best(lambda: identify(read_session(path)), 1)
    print(f"identify, in a process that has compiled: {warm:.1f} s, reading included")
    session = read_session(path)
    fit, stacks = identify(session), prepare(session)
    parameters = describe(fit.model)
    for name, stage in STAGES.items():
        reads = {e: c for e, c in stage.reads.items() if e in stacks}
        groups = set(stage.frees)
        free = np.array([i for i in fit.estimated if parameters[i].group in groups], dtype=int)
        sources = sources_of(stacks, reads, fit.noise, parameters)
        zero = Free.at(fit.model, free).set(fit.model, jnp.zeros(free.size))
        start = start_values(zero, free, parameters, sources)
        alone = {n: s._replace(positions=np.intersect1d(s.positions, free)) for n, s in sources.items()}
        ours = best(lambda s=start, f=free, src=alone: solve(s, f, src)[0], 1)
        passing = best(lambda s=start, f=free, src=sources: solve(s, f, src)[0], 1)
        free_of = Free.at(start, free)

        def rows(theta, s=start, f=free_of, src=sources):
            lin = [linearise(f.set(s, jnp.asarray(theta)), f, x.batch, x.filters) for x in src.values()]
            r = np.concatenate([np.asarray(x.white).ravel() for x in lin])
            return r, np.concatenate([np.asarray(x.jacobian).reshape(-1, theta.size) for x in lin])

        def theirs(run=rows, s=start, f=free_of):
            return scipy.optimize.least_squares(
                lambda x: run(x)[0], np.asarray(f.get(s)), jac=lambda x: run(x)[1], method="trf", x_scale="jac"
            )

        scipy_time = best(theirs, 1)
        print(
            f"{name:13} ours {ours:6.2f} s, SciPy {scipy_time:6.2f} s: {scipy_time / ours:.1f} times; "
            f"with the errors passed on {passing:.2f} s"
        )


def main() -> None:
    """Print all three."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
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
