"""The paper's staged identification, ID.2 → ID.3-static → ID.3-dynamic → ID.4.

Each stage is equation (1) with the terms that its experiment makes vanish, and frees the parameters that it shows. The
parameters of earlier stages stay fixed, and their errors go on (`propagate`).
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.data import Session, joints_of, moving_joints
from jaxfinger.experiments import EXPERIMENTS, Experiment, Stack, not_judged, prepare
from jaxfinger.identify.fit import Fit, StageReport
from jaxfinger.identify.identifiability import name_invisible
from jaxfinger.identify.noise import SLOW, Noise, estimate
from jaxfinger.identify.parameters import Parameter, describe, ravel
from jaxfinger.identify.plausible import implausible
from jaxfinger.identify.prior import Prior
from jaxfinger.identify.propagate import propagate
from jaxfinger.identify.recipe import Recipe
from jaxfinger.identify.shooting import AHEAD
from jaxfinger.identify.solve import (
    ROUGH_TOLERANCE,
    Solution,
    Source,
    Tangents,
    parameter_bounds,
    residuals_each,
    solve,
)
from jaxfinger.identify.start import start_values
from jaxfinger.model import Finger, Model

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Stage:
    """Which experiments and channels a stage reads, and which groups of parameters it frees."""

    name: str
    reads: dict[str, tuple[str, ...]]
    frees: tuple[str, ...]


# What a motor that moves a joint shows of its torque.
_DRIVEN = ("elastic", "friction", "damping", "friction_by_direction", "torque_friction", "rotor_inertia")

STAGES = {
    s.name: s
    for s in (
        Stage("ID.2", {"ID.2": ("tendon_excursion",)}, ("moment_arm",)),
        # From hold to hold the joint moves, slowly: that shows damping, too, if less well.
        Stage("ID.3-static", {"ID.3-static": ("joint_torque",)}, _DRIVEN),
        # The dynamic phase augments the static one: both are read, so that a sweep refines what the holds gave.
        Stage(
            "ID.3-dynamic",
            {"ID.3-static": ("joint_torque",), "ID.3-dynamic": ("joint_torque",)},
            _DRIVEN,
        ),
        Stage("ID.4", {"ID.4": ("joint_torque",)}, ("tendon_friction",)),
    )
}

# Groups of parameters on which each channel of each experiment depends.
_TORQUE = {*_DRIVEN, "mass", "com"}
_HELD_TORQUE = {"elastic", "mass", "com", "moment_arm", "tendon_friction"}
DEPENDS = {
    ("ID.2", "tendon_excursion"): {"moment_arm"},
    ("ID.3-static", "joint_torque"): _TORQUE,
    ("ID.3-dynamic", "joint_torque"): _TORQUE,
    ("ID.4", "joint_torque"): _HELD_TORQUE,
    ("ID.4", "tendon_excursion"): {"moment_arm"},
    ("VD.1", "tendon_excursion"): {"moment_arm"},
    ("VD.2", "fingertip_force"): _HELD_TORQUE,
    ("VD.2", "tendon_excursion"): {"moment_arm"},
    ("VD.3", "joint_torque"): _TORQUE | _HELD_TORQUE,
    ("VD.3", "tendon_excursion"): {"moment_arm"},
    (AHEAD, "q"): _TORQUE | _HELD_TORQUE,
}

GROUP_OF_TERM = {
    "joint_elastic": "elastic",
    "joint_coulomb": "friction",
    "joint_damping": "damping",
    "tendon_friction": "tendon_friction",
    "joint_offset": "elastic",  # a polynomial of degree zero
    "joint_friction_asymmetric": "friction_by_direction",
    "joint_torque_friction": "torque_friction",
    "rotor_inertia": "rotor_inertia",
}


def nominal_model(session: Session, recipe: Recipe) -> Model:
    """The recipe's nominal model of the session's finger: what its description gives, all other fitted terms zero."""
    finger = Finger.from_description(session.finger)
    r, known = recipe.model, session.finger.excursion
    model = Model.zeros(
        finger,
        moment_arm_degree=max(r.moment_arm_degree, 0 if known is None else known.shape[2]),
        cross=r.cross_terms,
        elastic_degree=0 if "joint_offset" in r.terms else r.elastic_degree,
        friction_degree=r.friction_degree,
    )
    if "gravity" not in r.terms:
        model = eqx.tree_at(lambda m: m.finger.gravity, model, jnp.zeros(3))
    if known is not None:
        given = jnp.asarray(_by_exponents(model, known, describe(model)))
        model = eqx.tree_at(lambda m: m.moment_arm.coefficients, model, given.reshape(finger.n, -1))
    return model


def _by_exponents(model: Model, known: np.ndarray, parameters: list[Parameter]) -> np.ndarray:
    """(n, m, k) polynomials of the joints as the moment arm's coefficients in order, zero beyond the power k."""
    joints, tendons = model.finger.joint_names, model.finger.tendon_names
    values = np.zeros(model.moment_arm.coefficients.size)
    for at, p in enumerate(p for p in parameters if p.group == "moment_arm"):
        if p.joint is not None and p.power is not None and p.power <= known.shape[2]:
            values[at] = known[tendons.index(p.tendon), joints.index(p.joint), p.power - 1]
    return np.nan_to_num(values)


def free_groups(recipe: Recipe) -> set[str]:
    """Groups of parameters that the recipe's nominal model has."""
    return {"moment_arm"} | {GROUP_OF_TERM[t] for t in recipe.model.terms if t in GROUP_OF_TERM}


def cad_covariance(session: Session, parameters: list[Parameter]) -> np.ndarray:
    """Covariance of the flat vector before any fit: what CAD and scale say of masses, centres of mass, rotors and
    excursions.
    """
    variance, finger = np.zeros(len(parameters)), session.finger
    position = {g: [i for i, p in enumerate(parameters) if p.group == g] for g in ("mass", "com")}
    for group, std in (("mass", session.finger.mass_std), ("com", session.finger.com_std)):
        if std is not None:
            variance[position[group]] = np.ravel(std) ** 2
    for i, p in enumerate(parameters):
        if p.group == "rotor_inertia" and p.determinable and finger.rotor_inertia_std is not None:
            variance[i] = finger.rotor_inertia_std[finger.joint_names.index(p.joint)] ** 2
        if p.group == "moment_arm" and p.determinable and p.joint is not None and finger.excursion_std is not None:
            std = finger.excursion_std[finger.tendon_names.index(p.tendon), finger.joint_names.index(p.joint)]
            variance[i] = 0.0 if p.power is None or p.power > len(std) else np.nan_to_num(std[p.power - 1]) ** 2
    return np.diag(variance)


def cad_prior(session: Session, recipe: Recipe, parameters: list[Parameter], free: np.ndarray) -> Prior:
    """What the finger's description says of the free parameters: a row each that it gives a standard deviation of."""
    variance = np.diag(cad_covariance(session, parameters))[free]
    rows = np.flatnonzero(variance > 0)
    root = np.zeros((rows.size, free.size))
    root[np.arange(rows.size), rows] = variance[rows] ** -0.5
    return Prior(np.asarray(ravel(nominal_model(session, recipe)))[free], root)


def identify(
    session: Session,
    recipe: Recipe | None = None,
    stages: tuple[str, ...] | None = None,
    start: Fit | None = None,
    progress: Progress = lambda message: None,
    stacks: dict[str, Stack] | None = None,
) -> Fit:
    """Run the staged fits on a session; a stage whose data are missing is skipped and named.

    `stages` limits the run to some of them; `start` gives the parameters of earlier ones; `stacks` are the session's
    trials where they are prepared already.

    The servo axis whose parameters are published (Janot, Gautier, Brunot 2019) weighs 95.11 kg:

    >>> import jaxfinger as jf
    >>> fit = jf.identify(jf.read("session.h5"), jf.recipe("emps"))
    >>> mass = fit.table()[0]
    >>> f"{mass['value']:.0f} ± {1.96 * mass['std']:.1f} {mass['units']}"
    '95 ± 0.4 kg'
    """
    recipe = recipe or (start.recipe if start else Recipe())
    wanted = stages or recipe.fit.stages
    fit = start or Fit.before(session, recipe, nominal_model(session, recipe))
    if start is None:
        fit = replace(fit, covariance=cad_covariance(session, describe(fit.model)))
    with ThreadPoolExecutor(1) as pool:  # a stage compiles while the recordings of the next are filtered
        experiments = dict.fromkeys(e for s in wanted for e in STAGES[s].reads) if stacks is None else ()
        named = {e: [t.name for t in session if t.experiment == e] for e in experiments}
        pending = {e: pool.submit(prepare, session, names) for e, names in named.items()}
        ready, tangents = dict(stacks or {}), Tangents()
        for name in wanted:
            progress(f"fitting {name}")
            for experiment in STAGES[name].reads.keys() & pending.keys():
                ready |= pending.pop(experiment).result()
            fit = run_stage(fit, STAGES[name], ready, session, tangents)
    return fit


def run_stage(
    fit: Fit, stage: Stage, stacks: dict[str, Stack], session: Session, tangents: Tangents | None = None
) -> Fit:
    """One stage: noise, estimate, covariance, and what its trials cannot see."""
    recipe = fit.recipe
    if stage.name not in stacks:
        report = StageReport(stage.name, "skipped", message=f"the session has no {stage.name} trial")
        return replace(fit, stages=(*fit.stages, report))
    reads = {e: c for e, c in stage.reads.items() if e in stacks}
    lost = [x for x in not_judged({stage.name: stacks[stage.name]}) if x.channel in stage.reads[stage.name]]
    if lost:
        report = StageReport(stage.name, "skipped", message=f"no sample of {lost[0].channel} counts: {lost[0].reason}")
        return replace(fit, stages=(*fit.stages, report))
    parameters = describe(fit.model)
    groups = set(stage.frees) & free_groups(recipe)
    touched = touched_by(reads, session)
    free = stage_free(fit, stage, parameters, touched)
    if not free.size:
        report = StageReport(stage.name, "skipped", message="the recipe leaves its terms out of the nominal model")
        return replace(fit, stages=(*fit.stages, report))
    prior = cad_prior(session, recipe, parameters, free)
    model, solution, sources, noise = estimate_with_noise(
        fit.model, free, stacks, reads, fit.noise, prior, recipe.fit.huber, tangents
    )
    covariance = propagate(fit.covariance, solution, sources, free, prior, recipe.fit.huber)
    warnings = name_invisible(parameters, free, solution.invisible)
    warnings += _unseen(parameters, groups, free, touched)
    warnings += implausible(model, covariance, free, parameter_bounds(fit.model, free)[0])
    trials = tuple(t for e in reads for t in stacks[e].trials)
    report = report_of(stage.name, solution, free, trials, warnings)
    estimated = np.union1d(fit.estimated, free).astype(int)
    return replace(
        fit, model=model, covariance=covariance, estimated=estimated, noise=noise, stages=(*fit.stages, report)
    )


def report_of(
    name: str, solution: Solution, free: np.ndarray, trials: tuple[str, ...], warnings: list[str], message: str = ""
) -> StageReport:
    """What became of a fit; `message` is said where it converged."""
    return StageReport(
        name,
        "fitted" if solution.converged else "not converged",
        solution.message or message,
        trials=trials,
        rows=solution.rows,
        chi2_per_row=solution.chi2_per_row(free.size),
        outliers=solution.outliers,
        warnings=tuple(warnings),
    )


def stage_free(fit: Fit, stage: Stage, parameters: list[Parameter], touched) -> np.ndarray:
    """Positions of the parameters that a stage estimates: those of its groups that its trials touch."""
    groups = set(stage.frees) & free_groups(fit.recipe)
    prior_groups = {"mass", "com"} if fit.recipe.fit.free_inertia and stage.name.startswith("ID.3") else set()
    free = [
        i
        for i, p in enumerate(parameters)
        if (p.group in groups and p.determinable and (p.joint or p.tendon) is not None and seen_by(p, touched))
        or (p.group in prior_groups and fit.covariance[i, i] > 0)
    ]
    return np.array(free, dtype=int)


def estimate_with_noise(
    model: Model,
    free: np.ndarray,
    stacks: dict[str, Stack],
    reads: dict[str, tuple[str, ...]],
    known: dict[tuple[str, str], Noise],
    prior: Prior | None,
    huber: float,
    tangents: Tangents | None = None,
    slow: int = SLOW,
) -> tuple[Model, Solution, dict[str, Source], dict[tuple[str, str], Noise]]:
    """Noise from the residuals of a fit with first guesses of it, where it is not known (`slow` as in
    `noise.estimate`); then the fit under it.
    """
    tangents, parameters, noise = tangents or Tangents(), describe(model), dict(known)
    unknown = {(e, c): first_noise(stacks[e], c, x) for (e, c), x in left_unknown(model, stacks, reads, noise).items()}
    model = start_values(model, free, parameters, sources_of(stacks, reads, noise | unknown, parameters))
    for _ in range(2 if unknown else 0):
        sources = sources_of(stacks, reads, noise | unknown, parameters)
        model, solution = solve(model, free, sources, prior, tangents=tangents, tolerance=ROUGH_TOLERANCE)
        noise |= _noise(solution, stacks, reads, slow)
        unknown = {}
    sources = sources_of(stacks, reads, noise, parameters)
    model, solution = solve(model, free, sources, prior, huber, tangents=tangents)
    again = start_values(model, free, parameters, sources)
    if again is not model:  # a tendon's friction has slid into a dead zone
        other, second = solve(again, free, sources, prior, huber, tangents=tangents)
        if total_cost(other, second, free, prior) < total_cost(model, solution, free, prior):
            model, solution = other, second
    return model, solution, sources, noise


def total_cost(model: Model, solution: Solution, free: np.ndarray, prior: Prior | None) -> float:
    """What a fit minimises, the prior included."""
    return solution.cost + (prior.cost(np.asarray(ravel(model))[free]) if prior else 0.0)


def touched_by(reads, session: Session) -> tuple[set[str], set[tuple[str, str]], set[str], list[set[str]]]:
    """Joints instrumented or moved, (tendon, joint) pairs recorded together, tendons pulled, and the joints that move
    together, by the trials read.
    """
    trials = [t for t in session if t.experiment in reads and len(t.time) > 1]
    joints = {joint for t in trials for joint in joints_of(t, session.finger)}
    moved = {(k, joint) for joint in joints for k in session.finger.tendon_names}
    free = [set(moving_joints(t, session.finger)) for t in trials if not EXPERIMENTS[t.experiment].held]
    return joints, moved, {t.tendon for t in trials if t.tendon}, free


def seen_by(p: Parameter, touched) -> bool:
    """Whether trials may tell a parameter, by what `touched_by` says of them."""
    joints, moved, tendons, together = touched
    if p.group == "moment_arm" and len(p.spans) > 1:  # one joint at a time never shows what two do together
        return any(joints.issuperset(p.spans) for joints in together)
    if p.group == "moment_arm":
        return (p.tendon, p.joint) in moved
    if p.group == "tendon_friction":
        return p.tendon in tendons
    return p.joint in joints


def _unseen(parameters, groups, free, touched) -> list[str]:
    names = [p.name for i, p in enumerate(parameters) if p.group in groups and p.determinable and i not in set(free)]
    pairs = {" and ".join(p.spans) for p in parameters if p.name in names and len(p.spans) > 1}
    mend = f"; record a trial that moves {' together, and '.join(sorted(pairs))} together" if pairs else ""
    return [f"no trial shows {', '.join(names)}: left as given, or at zero{mend}"] if names else []


def left_unknown(
    model: Model,
    stacks: dict[str, Stack],
    reads: dict[str, tuple[str, ...]],
    known: dict[tuple[str, str], Noise],
) -> dict[tuple[str, str], Float[np.ndarray, "_columns _B _T"]]:
    """What the model leaves, in their units, of the channels read whose noise is not known."""
    reads = {e: channels for e, channels in reads.items() if any((e, c) not in known for c in channels)}
    white = {(e, c): Noise.white(np.ones(len(stacks[e].batch.y[c])), "none") for e in reads for c in reads[e]}
    left = residuals_each(model, sources_of(stacks, reads, white, describe(model)))
    return {(e, c): left[e][c] for e, c in white if (e, c) not in known}


def first_noise(stack: Stack, channel: str, left: Float[Array | np.ndarray, "columns B T"]) -> Noise:
    """White noise by how much what is `left` of the channel changes from sample to sample: good enough to find
    residuals whose noise can then be estimated.

    Of the channel itself it would be none where that is nothing throughout, as the torque on a finger that is free.
    """
    left, mask = np.asarray(left), np.asarray(stack.batch.mask[channel]) > 0
    step = np.diff(left, axis=-1)[mask[..., 1:] & mask[..., :-1]]
    size = float(np.median(np.abs(step))) if step.size else 1.0
    return Noise.white(np.full(len(left), max(size, 1e-12)), "first guess")


def _noise(solution: Solution, stacks, reads, slow: int) -> dict[tuple[str, str], Noise]:
    return {
        (e, c): estimate(stacks[e], c, np.asarray(solution.linearised[e].residuals[c]), slow)
        for e, channels in reads.items()
        for c in channels
    }


def sources_of(
    stacks: dict[str, Stack],
    reads: dict[str, tuple[str, ...]],
    noise: dict[tuple[str, str], Noise],
    parameters: list[Parameter],
) -> dict[str, Source]:
    """Every experiment as a fit reads it."""
    out = {}
    for e, channels in reads.items():
        groups = set().union(*(DEPENDS[e, c] for c in channels), {"effects"})
        positions = np.array([i for i, p in enumerate(parameters) if p.group in groups and p.determinable])
        linear = set.intersection(*(_linear(stacks[e].experiment, c) for c in channels))
        affine = np.array([i for i in positions if parameters[i].group in linear], dtype=int)
        filters = {c: jax.device_put(noise[e, c].coefficients) for c in channels}
        out[e] = Source(stacks[e].batch, filters, positions, affine=affine, pace=stacks[e].experiment.pace)
    return out


def _linear(experiment: Experiment, channel: str) -> set[str]:
    """Groups of parameters in which a channel is affine, the others as they are: the sum of (1), where no tendon slips
    and no drive loses a share of its torque.
    """
    if channel == "tendon_excursion":
        return {"moment_arm"}
    return {"elastic", "friction", "damping", "friction_by_direction", "rotor_inertia"} if experiment.slack else set()
