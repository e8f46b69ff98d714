"""Prediction errors of the joint refinement and of the stages, on trials that neither has read.

    python benchmarks/joint.py [--sessions 100] [--joints 3|1] [--identification-only]

Every session has new noise, new offsets and poor CAD. It contains all experiments of the protocol. The stages read ID.2
to ID.4; the joint refinement reads all experiments, or with `--identification-only` those of the stages. Held out are
VD.1, VD.2 and VD.3 in other postures and motions. An error is the root mean square over all channels, in units of the
noise of a sample. On held-out trials it is that of the predictions against those of the true model, so that only
parameters count. On fitted trials it is that of the residuals, averaged over blocks.
"""

import argparse
import time
from dataclasses import replace

import equinox as eqx
import numpy as np

from jaxfinger.experiments import EXPERIMENTS, Stack, predict, prepare
from jaxfinger.identify import STAGES, Recipe, identify, refine
from jaxfinger.model import Model
from jaxfinger.synthetic import (
    SHORT,
    SpecimenPlant,
    clean_session,
    measure,
    recipe_from,
    study_finger,
    true_model,
)

HELD_OUT = {
    "experiments": ["VD.1", "VD.2", "VD.3"],
    "rate": 200.0,
    "motion_seed": 1,
    "vd1": {"duration": 10.0},
    "vd3": {"duration": 4.0},
}
VALIDATION = {k: HELD_OUT[k] for k in ("vd1", "vd3")}
SENSORS = recipe_from({}).sensors
predicted = eqx.filter_jit(predict)


def error(model: Model, stacks: dict[str, Stack], truth: Model | None = None) -> float:
    """Root mean square error of a model against the data or a true model, in units of a sample's noise."""
    energy, count = 0.0, 0.0
    for stack in stacks.values():
        channels = stack.experiment.channels
        found = predicted(model, stack.batch.x, channels)
        expected = predicted(truth, stack.batch.x, channels) if truth else stack.batch.y
        for c in channels:
            mask = np.asarray(stack.batch.mask[c])
            residual = mask * np.asarray(expected[c] - found[c]) / getattr(SENSORS, c).std
            if c == "tendon_excursion":  # The encoders' zeros are arbitrary.
                residual -= mask * residual.sum(-1, keepdims=True) / np.maximum(mask.sum(-1, keepdims=True), 1.0)
            energy, count = energy + float(np.sum(residual**2)), count + float(mask.sum())
    return (energy / count) ** 0.5


def main() -> None:
    """Print both errors of both fits, and how often the joint one is the better."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sessions", type=int, default=100)
    parser.add_argument("--joints", type=int, default=3, choices=(1, 3))
    parser.add_argument("--identification-only", action="store_true")
    options = parser.parse_args()
    specimen = study_finger(options.joints)
    plant, truth = SpecimenPlant(specimen), true_model(specimen)
    cad = {"mass": 0.05, "com": 2e-3}
    read = tuple(STAGES) if options.identification_only else tuple(EXPERIMENTS)
    trials = {**SHORT, **VALIDATION, "experiments": read}
    recipe = replace(Recipe(), fit=replace(Recipe().fit, joint_experiments=read))
    clean = clean_session(recipe_from({"cad": cad, "trials": trials}), plant, specimen.description)
    unseen = clean_session(recipe_from({"trials": HELD_OUT}), plant, specimen.description)
    held_out = prepare(measure(unseen, 0))
    rows, seconds = [], []
    for seed in range(options.sessions):
        session = measure(clean, seed)
        stacks = prepare(session)
        staged = identify(session, recipe, stacks=stacks)
        begun = time.perf_counter()
        joint = refine(session, staged)
        seconds.append(time.perf_counter() - begun)
        models = (staged.model, joint.model)
        rows.append([*(error(m, stacks) for m in models), *(error(m, held_out, truth) for m in models)])
    fitted, unseen_errors = np.array(rows)[:, :2], np.array(rows)[:, 2:]
    print(f"{'':28}{'stepwise':>10}{'joint':>10}")
    print(f"{'fitted trials, in noise':28}" + "".join(f"{x:10.4f}" for x in fitted.mean(axis=0)))
    print(f"{'held-out trials, in noise':28}" + "".join(f"{x:10.4f}" for x in unseen_errors.mean(axis=0)))
    wins = int(np.sum(unseen_errors[:, 1] < unseen_errors[:, 0]))
    ratio = unseen_errors[:, 1] / unseen_errors[:, 0]
    print(
        f"joint is the better on held-out trials in {wins} of {len(rows)} sessions; median ratio {np.median(ratio):.3f}"
    )
    print(f"refinement: {np.median(seconds):.2f} s a session, compiled; {seconds[0]:.2f} s the first")


if __name__ == "__main__":
    main()
