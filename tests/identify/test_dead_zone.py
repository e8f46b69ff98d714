"""Torques whose tensions lie at the end of a friction's dead zone do not count."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from equinox import tree_at

from jaxfinger.data import EXPERIMENT_NAMES
from jaxfinger.data.signals.sizes import sizes_of
from jaxfinger.experiments import not_judged
from jaxfinger.identify import Recipe, identify, refine
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.identify.readings import readings_of
from jaxfinger.identify.recipe import FitRecipe
from jaxfinger.synthetic import (
    SHORT,
    SpecimenPlant,
    clean_session,
    controller,
    measure,
    recipe_from,
    study_finger,
    true_model,
)


def counting(stacks):
    return np.asarray(stacks["VD.3"].batch.mask["joint_torque"]) > 0


@pytest.mark.parametrize("proportional", [0.0, 0.2])
def test_torques_count_where_tensions_are_clear_of_the_dead_zone(short, short_truth, proportional):
    names = [t.name for t in short if t.experiment in ("VD.3", "ID.4")]
    before, sizes = readings_of(short, names), sizes_of(short)
    tension = np.asarray(before["VD.3"].batch.x.tension)
    kink = float(np.median(tension[1]))  # N, where the second tendon loses all of its tension
    model = tree_at(
        lambda m: (m.tendon_friction.constant, m.tendon_friction.proportional),
        short_truth.model,
        (jnp.zeros(len(tension)).at[1].set((1.0 - proportional) * kink), jnp.full(len(tension), proportional)),
    )
    after = readings_of(short, names, model=model)
    near = np.abs(tension[1] - kink) < 3.0 * sizes.noise
    lost = counting(before) & ~counting(after)
    crossed = short.finger.crosses[1]
    assert (lost[crossed] == (counting(before)[crossed] & near)).all()
    assert lost[crossed].any()
    assert counting(after)[crossed].any()  # on either side of the dead zone's end
    assert not lost[~crossed].any()
    held, still = (np.asarray(x["ID.4"].batch.mask["joint_torque"]) for x in (before, after))
    np.testing.assert_array_equal(held, still)  # held tendons slip from their own state


def test_a_tendon_without_dead_zone_leaves_no_torque_out(short, short_truth):
    slack = dataclasses.replace(  # Noise about zero tension
        short,
        trials={
            n: dataclasses.replace(t, tendon_force=t.tendon_force - t.tendon_force.mean(axis=0))
            if t.experiment == "VD.3"
            else t
            for n, t in short.trials.items()
        },
    )
    model = tree_at(lambda m: m.tendon_friction.constant, short_truth.model, jnp.zeros(short.finger.n))
    names = [t.name for t in slack if t.experiment == "VD.3"]
    np.testing.assert_array_equal(counting(readings_of(slack, names, model=model)), counting(readings_of(slack, names)))


def test_a_trial_wholly_at_the_end_of_a_dead_zone_is_not_judged(short, short_truth):
    names = [t.name for t in short if t.experiment == "VD.3"]
    tension = np.asarray(readings_of(short, names)["VD.3"].batch.x.tension)
    at = {
        n: dataclasses.replace(t, tendon_force=np.broadcast_to(tension.mean(axis=(1, 2)), t.tendon_force.shape))
        for n, t in short.trials.items()
        if t.experiment == "VD.3"
    }
    model = tree_at(lambda m: m.tendon_friction.constant, short_truth.model, jnp.asarray(tension.mean(axis=(1, 2))))
    model = tree_at(lambda m: m.tendon_friction.proportional, model, jnp.zeros(len(tension)))
    still = dataclasses.replace(short, trials=short.trials | at)
    (judged,) = [x for x in not_judged(readings_of(still, names, model=model)) if x.channel == "joint_torque"]
    assert "dead zone" in judged.reason


@pytest.mark.long
def test_an_antagonist_at_the_end_of_its_dead_zone_biases_no_friction(monkeypatch):
    """Its load cell has steps of half of the dead zone."""
    monkeypatch.setattr(controller, "MIN_TO_DEAD", 0.5)
    specimen = study_finger()
    trials = {**SHORT, "experiments": list(EXPERIMENT_NAMES), "vd1": {"duration": 6.0}, "vd3": {"duration": 4.0}}
    recipe = recipe_from({"cad": {"mass": 0.05, "com": 2e-3}, "trials": trials})
    clean, truth = clean_session(recipe, SpecimenPlant(specimen), specimen.description), ravel(true_model(specimen))
    for seed in (0, 1):
        session = measure(clean, seed)
        joint = refine(session, identify(session, Recipe(fit=FitRecipe(joint_experiments=EXPERIMENT_NAMES))))
        friction = [i for i in joint.estimated if describe(joint.model)[i].group == "tendon_friction"]
        z = (np.asarray(ravel(joint.model)) - np.asarray(truth))[friction] / joint.std[friction]
        assert np.abs(z).max() < 3.0
