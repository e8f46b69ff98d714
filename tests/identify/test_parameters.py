"""The flat vector of a model: what NumPy does with values is what JAX traces."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxfinger.identify.parameters import Free, describe, ravel, with_flat
from jaxfinger.model import Finger, Model
from jaxfinger.synthetic import paper_finger, polynomial_finger, true_model

POSITIONS = ((), (0,), (3, 17, 40), tuple(range(12)))


@pytest.fixture(scope="module")
def model():
    return true_model(polynomial_finger(paper_finger()))


def test_the_flat_vector_and_the_model_are_each_other(model):
    flat = ravel(model)
    np.testing.assert_array_equal(flat, jax.jit(ravel)(model))
    again = with_flat(model, flat[::-1])
    assert jax.tree.structure(again) == jax.tree.structure(model)
    np.testing.assert_array_equal(ravel(again), flat[::-1])


@pytest.mark.parametrize("positions", POSITIONS, ids=len)
def test_free_entries_alone_are_set(model, positions):
    positions = np.array(positions, dtype=int)
    free, flat = Free.at(model, positions), ravel(model)
    np.testing.assert_array_equal(free.get(model), flat[positions])
    theta = np.arange(1.0, 1.0 + len(positions))
    moved = free.set(model, theta)
    expected = np.array(flat)
    expected[positions] = theta
    np.testing.assert_array_equal(ravel(moved), expected)
    np.testing.assert_array_equal(ravel(model), flat)  # the model itself is as it was
    np.testing.assert_array_equal(jax.jit(lambda t: ravel(free.set(model, t)))(theta), expected)


def test_units_of_an_excursion_follow_the_kind_of_its_joints(model):
    """Of a joint that slides they are lengths over lengths, as those of its torque are forces over lengths."""
    finger = replace(model.finger, prismatic=(True, False, False))
    mixed = Model.zeros(finger, moment_arm_degree=3, cross=True)
    units = {p.name.removeprefix("excursion T1 "): p.units for p in describe(mixed) if p.tendon == "T1"}
    assert [units[f"MCP^{p}"] for p in (1, 2, 3)] == ["1", "1/m", "1/m^2"]
    assert [units[f"PIP^{p}"] for p in (1, 2, 3)] == ["m/rad", "m/rad^2", "m/rad^3"]
    assert [units[f"MCP^{a} PIP^{b}"] for a, b in ((1, 1), (1, 2), (2, 1))] == ["1/rad", "1/rad^2", "1/m/rad"]


def test_making_a_model_and_moving_its_values_trace_nothing(model):
    """JAX would trace and compile programs for every structure of a model, dozens of them in a diagnosis."""
    description, steps = paper_finger().description, []

    def record(name, _, **__):
        steps.append(name)

    jax.monitoring.register_event_duration_secs_listener(record)
    try:
        free = Free.at(model, np.array([1, 5, 7]))
        free.set(with_flat(model, ravel(model)), free.get(model))
        Model.zeros(Finger.from_description(description))
        assert not steps
        jax.jit(lambda m: free.get(m))(model)
        assert steps  # the listener hears what JAX does
    finally:
        jax.monitoring.unregister_event_duration_listener(record)
