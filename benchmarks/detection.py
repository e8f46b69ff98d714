"""Detection limits: how often the diagnosis names an effect in the same session at several sizes of it.

    python benchmarks/detection.py tendon_stretch joint_stribeck [--severities 0.5 1 2 5] [--fingers 1]

A severity is the rms that a refitted nominal model leaves in the channel that shows the effect best, in units of the
noise of a hold's mean (`jaxfinger/sealed/severity.py`). Each size is a sealed case, diagnosed in a process without its
truth. A row states how often effect and site were named, and with which probability.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from jaxfinger.sealed.cases import CaseSpec, make_case
from jaxfinger.sealed.run import Command, run_cases

FIRST = 10_000  # first number of a case, which no block of `jaxfinger sealed make` reaches
DIAGNOSE = Command(f"{sys.executable} -m jaxfinger diagnose {{fit}} -o {{out}}")


def made(effect: str, number: int, severity: float, specimen: str, folder: Path) -> Path:
    """Make a case with one effect of one size. The seed is the finger's, so that sizes differ in nothing else."""
    root = folder / f"{effect}-{number}-{severity:g}"
    make_case(number, "develop", CaseSpec("listed", specimen, (effect,), (severity,)), root, root / "truth")
    return root


def judged(root: Path, out: Path) -> tuple[float, bool, float, str]:
    """Severity reached, whether the first named effect is the true one, its probability, and the verdict's status."""
    truth = json.loads(next((root / "truth").glob("*.json")).read_text(encoding="utf-8"))["effects"][0]
    if not list(out.glob("*/gap.json")):
        return truth["reached"], False, 0.0, "failed"
    gap = json.loads(next(out.glob("*/gap.json")).read_text(encoding="utf-8"))
    key = {"effect": truth["effect"], "site": truth["site"]}
    probability = sum(c["probability"] for c in gap["candidates"] if {k: c[k] for k in key} == key)
    named = gap["verdict"]["effects"]
    return truth["reached"], named[:1] == [key], probability, gap["verdict"]["status"]


def main() -> None:
    """Print a row for each size."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("effects", nargs="+")
    parser.add_argument("--severities", type=float, nargs="+", default=[0.5, 1.0, 2.0, 5.0])
    parser.add_argument("--specimen", default="planar")
    parser.add_argument("--fingers", type=int, default=1, help="fingers and sites of each effect")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        for effect in options.effects:
            for severity in options.severities:
                rows = []
                for number in range(FIRST, FIRST + options.fingers):
                    root = made(effect, number, severity, options.specimen, Path(scratch))
                    run_cases(root, root / "diagnoses", DIAGNOSE)
                    rows.append(judged(root, root / "diagnoses"))
                reached, named, probability, said = zip(*rows, strict=True)
                print(
                    f"{effect:28s} severity {severity:4g} (reached {np.mean(reached):.2g}): named {sum(named)} of "
                    f"{len(rows)}, P(truth) {np.mean(probability):.2f}, {', '.join(said)}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
