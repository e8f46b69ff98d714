"""Write the logs of a small rig for docs/your-own-data.md: one joint and two tendons, in everyday units.

    python docs/own_data_logs.py FOLDER

The joint obeys τ = k (q − q₀) + m g c cos q (gravity, upwards) + f sign q̇ + d q̇; the tendons run over pulleys.
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np

STIFFNESS, REST, FRICTION, DAMPING = 0.03, 0.5, 0.004, 0.0005  # N m/rad, rad, N m, N m s/rad
MASS, COM, INERTIA = 0.02, 0.02, 4e-6 + 0.02 * 0.02**2  # kg, m, kg m²
ARMS = {"T1": 0.008, "T2": -0.006}  # m
LOST, SHARE = 0.05, 0.1  # loss of a tendon that pulls: constant part, N, and share of its tension
RATE = 100.0  # Hz
NEWTON_PER_VOLT, ZERO = 12.5, 0.2  # scale and offset (V) of the load cells


def ramps(levels: list[float], move: float, hold: float) -> np.ndarray:
    """Smooth moves of `move` s from level to level, with a hold of `hold` s at each."""
    parts = [np.full(round(hold * RATE), levels[0])]
    for a, b in pairwise(levels):
        s = np.linspace(0.0, 1.0, round(move * RATE))
        parts += [a + (b - a) * s**3 * (10 - 15 * s + 6 * s**2), np.full(round(hold * RATE), b)]
    return np.concatenate(parts)


def torque(q: np.ndarray) -> np.ndarray:
    """External torque, N m, that moves the joint along q. Before the first motion friction is taken as zero."""
    speed = np.gradient(q) * RATE
    way = np.sign(speed)
    moved = np.maximum.accumulate(np.where(way != 0.0, np.arange(len(q)), 0))
    weight = -MASS * 9.81 * COM * np.cos(q)
    inertia = INERTIA * np.gradient(speed) * RATE
    return STIFFNESS * (q - REST) + weight + FRICTION * way[moved] + DAMPING * speed + inertia


def write(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Write columns by name as a CSV."""
    np.savetxt(path, np.column_stack(list(columns.values())), "%.6f", ",", header=",".join(columns), comments="")


def main(folder: Path) -> None:
    """Write the four logs into a folder."""
    rng = np.random.default_rng(1)

    def noise(size: float, count: int) -> np.ndarray:
        return size * rng.standard_normal(count)

    def volts(tension: np.ndarray) -> np.ndarray:
        return (tension + noise(0.02, len(tension))) / NEWTON_PER_VOLT + ZERO

    def ms(count: int) -> np.ndarray:
        return 1e3 * np.arange(count) / RATE

    def degrees(q: np.ndarray) -> np.ndarray:
        return np.rad2deg(q + noise(2e-4, len(q)))

    # arms.csv: ID.2. The joint is led through its range three times, with the tendons at 2 N.
    q = ramps([0.1, 1.4] * 3 + [0.1], 4.0, 0.5)
    pulled = {f"{t}_mm": 1e3 * (arm * q + noise(1e-5, len(q))) for t, arm in ARMS.items()}
    cells = {f"{t}_V": volts(np.full(len(q), 2.0)) for t in ARMS}
    write(folder / "arms.csv", {"t [ms]": ms(len(q)), "angle [deg]": degrees(q), **cells, **pulled})

    # joint.csv and torque.csv: two loggers. Phase 1 steps up and down (ID.3-static); phase 2 sweeps (ID.3-dynamic).
    steps = ramps([0.2, 0.5, 0.8, 1.1, 1.4, 1.1, 0.8, 0.5, 0.2], 1.0, 1.5)
    sweeps = [0.75 - 0.55 * np.cos(2 * np.pi * f * np.arange(round(3 / f * RATE)) / RATE) for f in (0.3, 0.8, 1.5)]
    q = np.concatenate([steps, *sweeps])
    phase = np.where(np.arange(len(q)) < len(steps), 1.0, 2.0)
    write(folder / "joint.csv", {"t [ms]": ms(len(q)), "angle [deg]": degrees(q), "phase": phase})
    write(folder / "torque.csv", {"t [s]": ms(len(q)) * 1e-3, "bridge [mV/V]": (torque(q) + noise(2e-4, len(q))) / 0.5})

    # pull.csv: ID.4. The torque sensor holds the joint at 0.6 rad; T1 is pulled in steps, then T2.
    pull = ramps([2.0, 5.0, 8.0, 11.0, 14.0], 1.0, 1.5)
    q = np.full(2 * len(pull), 0.6)
    tension = {"T1": np.concatenate([pull, 0 * pull]), "T2": np.concatenate([0 * pull, pull])}
    arrives = {t: f - np.minimum(LOST + SHARE * f, f) for t, f in tension.items()}
    held = STIFFNESS * (q - REST) - MASS * 9.81 * COM * np.cos(q) - sum(ARMS[t] * f for t, f in arrives.items())
    cells = {f"{t}_V": volts(f) for t, f in tension.items()}
    tendon = np.repeat([1.0, 2.0], len(pull))
    write(
        folder / "pull.csv",
        {"t [ms]": ms(len(q)), "angle [deg]": degrees(q), **cells, "torque [N mm]": 1e3 * (held + noise(2e-4, len(q))),
         "tendon": tendon},
    )  # fmt: skip


if __name__ == "__main__":
    main(Path(sys.argv[1]))
