"""The horizon of `identify --ahead`: the joint fit refined with each of several horizons, judged on another motion.

    python benchmarks/ahead.py [--sessions 4] [--noise 1e-4]

The finger is simulated, has one joint, and poor CAD, as in `joint.py`. Errors are those of predictions 50, 100, 200 and
500 ms ahead on unseen trials of VD.3, divided by the noise that the sensors give them: root mean square, median over
the sessions.
"""

import argparse
from unittest.mock import patch

import numpy as np

from jaxfinger.experiments import prepare
from jaxfinger.identify import STAGES, Fit, identify, refine, shooting
from jaxfinger.identify.ahead import ahead
from jaxfinger.synthetic import SHORT, SpecimenPlant, clean_session, measure, recipe_from, study_finger

TRIED = (0.05, 0.1, 0.2, 0.4)  # s, horizons


def main() -> None:
    """Print a row for each horizon."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sessions", type=int, default=4)
    parser.add_argument("--noise", type=float, default=1e-4, help="of the load cells, N")
    options = parser.parse_args()
    specimen, cells = study_finger(1), {"tendon_force": {"std": options.noise, "resolution": options.noise / 3}}

    def clean(experiments, **more):
        trials = {**SHORT, "experiments": experiments, "vd3": {"duration": 4.0, "rate": 500.0}, **more}
        recipe = recipe_from({"cad": {"mass": 0.05, "com": 2e-3}, "trials": trials, "sensors": cells})
        return clean_session(recipe, SpecimenPlant(specimen), specimen.description)

    seen, unseen = clean([*STAGES, "VD.3"]), measure(clean(["VD.3"], motion_seed=1), 0)
    stack = prepare(unseen, reduced=False)["VD.3"]

    def errors(fit: Fit) -> list[float]:
        return [float(np.sqrt(np.nanmean((a.error / a.noise) ** 2))) for a in ahead(fit.model, unseen, stack)]

    found: dict[str, list[list[float]]] = {}
    for seed in range(options.sessions):
        session = measure(seen, seed)
        staged = identify(session)
        found.setdefault("without", []).append(errors(refine(session, staged)))
        for horizon in TRIED:
            with patch.object(shooting, "HORIZON", horizon):
                found.setdefault(f"{horizon:g} s", []).append(errors(refine(session, staged, ahead=True)))
    for name, rows in found.items():
        print(f"{name:8}" + "".join(f"{x:7.2f}" for x in np.median(rows, axis=0)))


if __name__ == "__main__":
    main()
