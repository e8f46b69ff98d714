"""How bad input is met: mistakes of unit, sign and column that pass without a word, and files that are damaged.

    python benchmarks/bad_input.py mistakes SESSION.h5 … [--sound SESSION.h5 …]
    python benchmarks/bad_input.py mutations [--count N] [--session SESSION.h5]

`mistakes` makes every mistake of a mapping in a sound session, and counts those that the checker does not warn of;
sound files must have no warning. `mutations` mutates mappings, recordings and sessions, and counts tracebacks, crashes,
hangs and files written where none should be.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from jaxfinger.data import Session, Trial, read_session
from jaxfinger.data.check import check_session, examine
from jaxfinger.data.findings import Report

Mistake = Callable[[Trial], Trial]

# Numbers taken for SI that are in other units: how many times too large they come out.
UNITS = {
    "time": {"ms": 1e3, "us": 1e6, "ns": 1e9, "s taken for ms": 1e-3, "min": 1 / 60},
    "q": {"deg": 57.29578, "turn": 0.1591549, "mrad": 1e3, "rad taken for deg": 0.01745329, "motor of gear 10": 10},
    "tendon_force": {"mN": 1e3, "kN": 1e-3, "g": 101.97, "kg": 0.10197, "lbf": 0.22481, "V of 10 N/V": 0.1},
    "tendon_excursion": {"mm": 1e3, "cm": 1e2, "um": 1e6, "inch": 39.370, "m for mm": 1e-3, "m for cm": 0.01},
    "joint_torque": {"N mm": 1e3, "N cm": 1e2, "kg cm": 10.197, "lbf inch": 8.8507, "N m taken for N mm": 1e-3,
                     "V of 0.1 N m/V": 10},
    "fingertip_force": {"mN": 1e3, "kN": 1e-3, "g": 101.97, "kg": 0.10197, "lbf": 0.22481, "V of 10 N/V": 0.1},
}  # fmt: skip


def mistakes(session: Session) -> Iterator[tuple[str, Mistake]]:
    """Every mistake that a mapping can make with the channels of this session, in all of its trials."""
    m, n = session.finger.m, session.finger.n
    active = np.flatnonzero(session.finger.active)
    for channel, units in UNITS.items():
        for name, factor in units.items():
            yield f"{channel} in {name}", _changed(channel, lambda x, f=factor: x * f)
    negated = {
        "q": range(m),
        "joint_torque": range(m),
        "tendon_excursion": active[:2],
        "tendon_force": active[:1],
        "fingertip_force": (0, 2),
    }
    for channel, columns in negated.items():
        for k in columns:
            yield f"{channel} {k} negated", _changed(channel, lambda x, k=k: x * _minus(x, k))
        yield f"{channel} negated", _changed(channel, lambda x: -x)
    swaps = {
        "q": ((0, 1), (m - 2, m - 1)),
        "joint_torque": ((0, 1), (m - 2, m - 1)),
        "tendon_excursion": (active[:2],),
        "tendon_force": (active[:2],),
        "fingertip_force": ((0, 2), (0, 1)),
    }
    for channel, (a, b) in ((channel, pair) for channel, pairs in swaps.items() for pair in pairs):
        yield f"{channel} {a} and {b} exchanged", _changed(channel, lambda x, a=a, b=b: _exchanged(x, a, b))
    yield (
        "tendon_force and tendon_excursion exchanged",
        lambda t: replace(t, tendon_force=t.tendon_excursion, tendon_excursion=t.tendon_force),
    )
    yield "every excursion is the first's", _changed("tendon_excursion", lambda x: np.repeat(x[:, :1], n, axis=1))
    yield "q is the speed", lambda t: replace(t, q=np.gradient(t.q, t.time, axis=0))
    yield "q is the time", lambda t: replace(t, q=np.repeat(t.time[:, None], m, axis=1))
    yield "joint_torque is zero", _changed("joint_torque", lambda x: 0 * x)
    yield "tendon_excursion is zero", _changed("tendon_excursion", lambda x: 0 * x)


def _minus(x: np.ndarray, k: int) -> np.ndarray:
    return np.where(np.arange(x.shape[1]) == k, -1, 1)


def _changed(channel: str, change: Callable[[np.ndarray], np.ndarray]) -> Mistake:
    def make(trial: Trial) -> Trial:
        values = getattr(trial, channel)
        return trial if values is None else replace(trial, **{channel: change(values)})

    return make


def _exchanged(x: np.ndarray, a: int, b: int) -> np.ndarray:
    out = x.copy()
    out[:, [a, b]] = x[:, [b, a]]
    return out


def findings(session: Session) -> Report:
    """What the checker says of a session in memory."""
    report = Report()
    check_session(session, report)
    examine(session, report)
    return report


def said(session: Session) -> set[str]:
    """Errors and warnings."""
    return {str(f) for f in findings(session) if f.severity != "note"}


def run_mistakes(paths: list[str], sound: list[str]) -> None:
    """Print the mistakes that pass without a word, and the warnings on sound files."""
    for path in paths:
        session = read_session(path)
        before, silent, count = said(session), [], 0
        for name, mistake in mistakes(session):
            wrong = replace(session, trials={t.name: mistake(t) for t in session})
            if all(wrong[t.name] is t for t in session):
                continue  # the session has no such channel
            count += 1
            if said(wrong) <= before:
                silent.append(name)
        print(f"{path}: {len(silent)} of {count} mistakes pass without a word: {'; '.join(silent)}")
    warnings = {path: said(read_session(path)) for path in (*paths, *sound)}
    print(f"{sum(map(len, warnings.values()))} warnings on {len(warnings)} sound files")
    for path, texts in warnings.items():
        for text in sorted(texts):
            print(f"  {path}: {text}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("mistakes")
    command.add_argument("sessions", nargs="+")
    command.add_argument("--sound", nargs="*", default=[])
    chosen = parser.parse_args()
    run_mistakes(chosen.sessions, chosen.sound)


if __name__ == "__main__":
    main()
