"""Simulate a session: plan the trials, run the plant, record. Noise can be drawn anew without another run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxfinger.data import FingerDescription, Session
from jaxfinger.synthetic.fingers import specimen_of
from jaxfinger.synthetic.plant import Channels, Plant, SpecimenPlant
from jaxfinger.synthetic.protocols import TrialPlan, session_plan
from jaxfinger.synthetic.recipe import SessionRecipe
from jaxfinger.synthetic.sensors import drawn_from_cad, record

Progress = Callable[[int, int, str], None]  # called with trials done, trials in all, name of the next


@dataclass(frozen=True)
class CleanSession:
    """A session before the sensors: every planned trial with its channels without noise."""

    recipe: SessionRecipe
    name: str  # of the specimen
    finger: FingerDescription  # exact, without the errors of CAD
    trials: tuple[tuple[TrialPlan, dict[str, Float[np.ndarray, "_channels _N"]]], ...]


def clean_session(
    recipe: SessionRecipe,
    plant: Plant | None = None,
    finger: FingerDescription | None = None,
    progress: Progress | None = None,
) -> CleanSession:
    """Plan the recipe's trials and run them on the recipe's specimen, or on another plant with its finger.

    Raises:
        UserError: the recipe does not fit the finger, or a driven motion leaves the joints' limits.
    """
    specimen = specimen_of(recipe.specimen)
    finger = finger or specimen.description
    plant = plant or SpecimenPlant(specimen)
    plans = session_plan(finger, recipe.trials)
    done: dict[tuple, Channels] = {}  # by motion: repeats have the same channels on most plants
    trials = []
    for k, plan in enumerate(plans):
        if progress:
            progress(k, len(plans), plan.name)
        key = (plan.motion, plan.session_start if plant.depends_on_session_time else 0.0)
        if key not in done:
            done[key] = plant.driven(plan) if plan.experiment == "VD.3" else plant.prescribed(plan)
        trials.append((plan, done[key]))
    return CleanSession(recipe, recipe.specimen.name or specimen.name, finger, tuple(trials))


def measure(clean: CleanSession, seed: int) -> Session:
    """Record a clean session. The seed determines noise, offsets, spikes and the errors of CAD."""
    recipe = clean.recipe
    cad, *streams = np.random.default_rng(seed).spawn(len(clean.trials) + 1)
    trials = {
        plan.name: record(plan, channels, clean.finger, recipe.sensors, rng)
        for (plan, channels), rng in zip(clean.trials, streams, strict=True)
    }
    finger = drawn_from_cad(clean.finger, recipe.cad, cad)
    return Session(clean.name, finger, trials, source=f"jaxfinger simulated rig, seed {seed}")


def simulate(
    recipe: SessionRecipe, seed: int | None = None, plant: Plant | None = None, progress: Progress | None = None
) -> Session:
    """Simulate the recipe's session, on its specimen or on another plant, with its seed unless another is given.

    Raises:
        UserError: as `clean_session`.
    """
    return measure(clean_session(recipe, plant, progress=progress), recipe.seed if seed is None else seed)


def simulate_many(recipe: SessionRecipe, seeds: Iterable[int], plant: Plant | None = None) -> Iterator[Session]:
    """Yield one session per seed. They differ only in what the seed of `measure` determines."""
    clean = clean_session(recipe, plant)
    for seed in seeds:
        yield measure(clean, seed)
