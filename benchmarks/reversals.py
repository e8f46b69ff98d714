"""Errors of the predicted torque of swept joints (ID.3-dynamic), near their reversals and elsewhere.

    python benchmarks/reversals.py [--causes] [FOLDER ...]

Each folder has `fit.h5`, from which the model is identified, and `fresh.h5`, whose trials are predicted. With
`--causes` they are predicted once more, by the model with the causes that a first look of the diagnosis names: an
effect that the nominal model lacks may show at reversals most. A reversal is
an instant at which the joint's angle, slowly filtered, turns back. The last line is a simulated finger with its true
model, whose friction changes its sign at once; a real contact yields before it slides.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxfinger.data import Session, Trial, read_session, smooth
from jaxfinger.gap import diagnose
from jaxfinger.identify import Fit, identify
from jaxfinger.identify.predictions import predict_session
from jaxfinger.model import Model
from jaxfinger.synthetic import paper_finger, polynomial_finger, recipe_from, simulate, true_model

NEAR = 0.06  # s: samples within this time of a reversal count as near it
SLOW = 5.0  # Hz, cut-off of a filter in which a joint's speed crosses zero once per reversal


def turning_times(trial: Trial, joint: int) -> np.ndarray:
    """Times, s, at which a moving joint turns back."""
    rate = smooth(trial.time, trial.q[:, joint], SLOW)[1]
    turns = np.flatnonzero(np.diff(np.sign(rate)) != 0)
    slope = np.abs(rate[np.minimum(turns + 50, len(rate) - 1)])
    return trial.time[turns[slope > 0.02 * np.abs(rate).max()]]


def errors(fit: Fit | Model, session: Session) -> tuple[np.ndarray, np.ndarray]:
    """Measured minus predicted torque, N mm, near reversals and elsewhere."""
    names = [t.name for t in session if t.experiment == "ID.3-dynamic"]
    near, far = [], []
    for name, channels in predict_session(fit, session, names).items():
        trial = session[name]
        joint = session.finger.joint_names.index(trial.joint or "")
        assert trial.joint_torque is not None
        error = 1e3 * (trial.joint_torque - channels["joint_torque"])[:, joint]
        beside = np.abs(trial.time[:, None] - turning_times(trial, joint)).min(axis=1) < NEAR
        near.append(error[beside])
        far.append(error[~beside])
    return np.concatenate(near), np.concatenate(far)


def simulated() -> tuple[Model, Session]:
    """True model and simulated session of a nominal finger, without its commanded directions."""
    sweep = {"repeats": 1, "postures": [[25, 30, 45]], "cycles": 1}
    trials = {"experiments": ["ID.3-dynamic"], "rate": 1000.0, "id3_dynamic": sweep}
    session = simulate(recipe_from({"specimen": {"kind": "polynomial"}, "trials": trials}), seed=5)
    session = replace(session, trials={t.name: replace(t, joint_direction=None) for t in session})
    return true_model(polynomial_finger(paper_finger())), session


def main() -> None:
    """Print a line for each folder."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--causes", action="store_true", help="predict with the causes that a diagnosis names, too")
    args = parser.parse_args()
    print(f"{'':32s} rms error, N mm: within {1e3 * NEAR:.0f} ms of a reversal, elsewhere")
    for folder in args.folders:
        session, fresh = read_session(folder / "fit.h5"), read_session(folder / "fresh.h5")
        _print(folder.name, identify(session), fresh)
        if args.causes:
            found = diagnose(session, quick=True)
            _print("  with " + (", ".join(k.effect for k in found.named) or "no cause"), found.augmented, fresh)
    _print("contacts that do not give", *simulated())


def _print(name: str, model: Fit | Model, session: Session) -> None:
    near, far = (np.sqrt(np.mean(e**2)) for e in errors(model, session))
    print(f"{name:32s} {near:6.2f} {far:6.2f}")


if __name__ == "__main__":
    main()
