"""Diagnosis of real measurements, the EMPS axis, with known terms withheld, and judged on another recording.

    python benchmarks/emps.py

With nothing withheld, the diagnosis of one recording may propose a formula for the rest. On the other recording, with
its nominal parameters refitted, the formula's gain is 1 if the rest is real and 0 if it is noise. ± is half of a 95 %
interval.
"""

import tempfile
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from jaxfinger.data import Session, read_session
from jaxfinger.data.importing.by_mapping import import_file
from jaxfinger.gap import diagnose
from jaxfinger.gap.columns import Columns
from jaxfinger.gap.formula import Weights
from jaxfinger.gap.problem import Problem, build
from jaxfinger.gap.projector import Projector
from jaxfinger.gap.propose import Proposal, terms
from jaxfinger.gap.signatures import whitened
from jaxfinger.identify import Fit, Recipe, read_recipe
from jaxfinger.identify.validate import validate
from jaxfinger.report.sentences import summary

ROOT = Path(__file__).parents[1]
DATA = ROOT / "datasets/emps"
PUBLISHED = 20.39  # N, Coulomb friction (NOTICE.md)

# Names of terms that are withheld, and their ids.
TERMS = {
    "Coulomb": "joint_coulomb",
    "damping": "joint_damping",
    "offset": "joint_elastic",
    "direction": "joint_friction_asymmetric",
}


def recordings(folder: Path) -> tuple[Session, Session]:
    """Import the recording for estimation and the one with pulses as sessions, with files in the folder."""
    found = []
    for recording, mapping in (("DATA_EMPS.mat", "emps.toml"), ("DATA_EMPS_PULSES.mat", "emps-pulses.toml")):
        file = folder / f"{Path(mapping).stem}.h5"
        import_file([DATA / recording], DATA / mapping, file)
        found.append(read_session(file))
    return found[0], found[1]


def rms(fit: Fit, session: Session) -> float:
    """rms error of the motor's force over all samples, N."""
    (score,) = validate(fit, session).scores
    return score.rms


def gain(proposal: Proposal, problem: Problem) -> tuple[float, float]:
    """Factor by which the proposal fits another recording best, and its standard deviation."""
    ((experiment, rows),) = problem.rows.items()
    library = dict(terms(problem, experiment, proposal.channel, 0))
    raw = np.sum([a * library[text] for a, text in proposal.terms], axis=0)
    columns = Columns.of(problem)
    projector = Projector(problem, columns, Weights.plain(columns))
    z = projector(whitened(raw[None, None], problem, rows, np.arange(rows.size), proposal.channel))[0]
    r = projector.residual(problem.r)
    fitted = float(z @ r / (z @ z))
    scale = np.sqrt(np.sum((r - fitted * z) ** 2) / r.size)  # The rest is no white noise of unit variance.
    return fitted, float(scale / np.linalg.norm(z))


def main() -> None:
    """Print the report, with files in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder:
        report(*recordings(Path(folder)))


def one_to_three_withheld(estimation: Session, pulses: Session) -> None:
    """Print a line for each choice of one to three of four terms: verdict, and rms on the pulses before, with the named
    effects, and with all four terms.
    """
    full = read_recipe(ROOT / "fits/emps.toml")

    def recipe(left_out: tuple[str, ...]) -> Recipe:
        terms = tuple(term for name, term in TERMS.items() if name not in left_out)
        return replace(full, model=replace(full.model, terms=terms))

    best = rms(diagnose(estimation, recipe(()), quick=True).nominal, pulses)
    for left_out in (x for n in (1, 2, 3) for x in combinations(TERMS, n)):
        found = diagnose(estimation, recipe(left_out))
        before, after = rms(found.nominal, pulses), rms(found.augmented, pulses)
        rivals = [" or ".join(k.effect for k in members) for members in found.ambiguous_sets]
        values = [f"{v.name} {v.value:.4g} ± {1.96 * v.std:.2g}" for c in found.budget for v in c.values if v.std > 0.0]
        said = ", ".join([*(k.effect for k in found.named), *rivals]) or "nothing"
        print(f"without {', '.join(left_out)}: {found.status.value}, {said} ({'; '.join(values)});")
        print(f"    pulses {before:.2f} N before, {after:.2f} N after, {best:.2f} N at best")


def report(estimation: Session, pulses: Session) -> None:
    """Print the named effect and its value, the share of the gap on the pulses that it closes, and the rest's gain."""
    withheld = diagnose(estimation, read_recipe(ROOT / "fits/emps-no-coulomb.toml"))
    (key,) = withheld.named
    lines = [line for line in withheld.augmented.table() if str(line["name"]).startswith(key.effect)]
    print(summary(withheld))
    for line in lines:
        print(f"{line['name']}: {line['value']:.2f} ± {1.96 * line['std']:.2f} {line['units']} (published {PUBLISHED})")
    full = read_recipe(ROOT / "fits/emps.toml")
    known = diagnose(estimation, full)
    before, after, best = (rms(f, pulses) for f in (withheld.nominal, withheld.augmented, known.nominal))
    print(f"pulses: {before:.2f} N before, {after:.2f} N with {key.effect}, {best:.2f} N where nothing was withheld")
    print(f"closed on the pulses: {100 * (before**2 - after**2) / (before**2 - best**2):.1f} % of what it can close")
    one_to_three_withheld(estimation, pulses)
    print(summary(known))
    if proposal := known.unexplained.proposal:
        value, std = gain(proposal, build(pulses, full))
        print(f"on the pulses the proposal has a gain of {value:.2f} ± {1.96 * std:.2f}")


if __name__ == "__main__":
    main()
