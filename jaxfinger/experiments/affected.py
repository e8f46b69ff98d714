"""Channels that an effect can change, found by tracing the dependence of predictions on the effect's amplitudes."""

import traceback
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import Literal
from jaxtyping import Array, Float

from jaxfinger.effects import CatalogueEffect, file_of
from jaxfinger.errors import UserError, did_you_mean
from jaxfinger.experiments.predict import change
from jaxfinger.experiments.table import EXPERIMENTS
from jaxfinger.model import Effect, Finger, Model, Motion, Terms, contact_map, terms_without_effects
from jaxfinger.programs import kept

# Fields of `Motion` in which repeats of one motion differ.
DIFFER_IN_REPEATS = ("session_time", "temperature")


def affected_channels(kind: type[CatalogueEffect], finger: Finger) -> dict[str, tuple[str, ...]]:
    """Channels of each experiment that an effect can change; experiments without one are left out.

    The effect changes no other channel in any trial. A channel that it can change may still be unchanged in some
    trials, as by friction in proportion to tension where all tendons are slack.
    """
    shown = _reached_at(kind, finger).by_amplitudes
    found = {e.name: tuple(c for c in e.channels if e.predicted_as(c) in shown) for e in EXPERIMENTS.values()}
    return {e: channels for e, channels in found.items() if channels}


def differs_in_repeats(kind: type[CatalogueEffect], finger: Finger) -> bool:
    """Whether what an effect does depends on `DIFFER_IN_REPEATS`, so that repeats of one motion may differ."""
    return bool(_reached_at(kind, finger).by_session)


def _reached_at(kind: type[CatalogueEffect], finger: Finger) -> "_Reached":
    names = finger.joint_names, finger.tendon_names
    return _Reached(*_reached(kind, *names, finger.prismatic, finger.active, finger.crosses))


def refuse_broken(kind: type[CatalogueEffect], finger: Finger) -> None:
    """Check a user's effect.

    Raises:
        UserError: it fails in a prediction, or changes no channel at any amplitude.
    """
    file = file_of(kind)
    try:
        without_effect = kind.sites(finger) and not affected_channels(kind, finger)
    except Exception as e:  # The effect is a user's program, which may raise anything.
        lines = [frame.lineno for frame in traceback.extract_tb(e.__traceback__) if frame.filename == file]
        where = f"{file}, line {lines[-1]}" if lines else file
        raise UserError(f"{where}: {kind.ID} fails in a prediction: {type(e).__name__}: {e}") from e
    if without_effect:
        hooks = {name for name in vars(Effect) if not name.startswith("_")}
        odd = [name for name in vars(kind) if name not in hooks and callable(getattr(kind, name))]
        near = next(filter(None, (did_you_mean(name, hooks) for name in odd if not name.startswith("_"))), "")
        raise UserError(f"{file}: {kind.ID} changes no channel at any size; override a hook of Effect{near}")


class _Nominal(NamedTuple):
    """A nominal model with a motion of two samples, whose shapes alone matter."""

    finger: Finger
    model: Model
    x: Motion
    terms: Terms
    contact: Float[Array, "3 m *T"]

    @classmethod
    @cache
    def of(cls, joint_names, tendon_names, prismatic, active, crosses, held: bool) -> "_Nominal":
        m, n, T = len(joint_names), len(tendon_names), 2
        described: Any = SimpleNamespace(
            gravity=np.array([0.0, 0.0, -9.8]), axis=np.tile([0.0, 1.0, 0.0], (m, 1)), origin=np.ones((m, 3)),
            mass=np.ones(m), com=np.ones((m, 3)), inertia=np.tile(np.eye(3), (m, 1, 1)), fingertip=np.ones(3),
            limits=np.tile([-1.0, 1.0], (m, 1)), prismatic=prismatic, joint_names=joint_names,
            tendon_names=tendon_names, active=active, crosses=crosses,
        )  # fmt: skip
        finger = Finger.from_description(described)
        model = Model.zeros(finger)
        joints, tendons, time = jax.device_put((np.zeros((m, T)), np.zeros((n, T)), np.zeros(T)))
        x = Motion(time, joints, joints, joints, tendons, joints, tendons, time, joints, held, temperature=joints)
        shapes = jax.eval_shape(lambda model: (terms_without_effects(model, x), contact_map(model, x)), model)
        terms, contact = jax.tree.map(lambda s: np.zeros(s.shape, s.dtype), shapes)
        return cls(finger, model, x, *jax.device_put((terms, contact)))


class _Reached(NamedTuple):
    """Predictions (`Experiment.predicted_as`) that an effect can change."""

    by_amplitudes: frozenset[tuple[str, bool]]
    by_session: frozenset[tuple[str, bool]]  # differently in repeats of one motion


@kept
def _reached(kind, *description) -> tuple[frozenset[tuple[str, bool]], frozenset[tuple[str, bool]]]:
    """Fields of `_Reached`."""
    finger = _Nominal.of(*description, held=False).finger
    sites = kind.sites(finger)
    if not sites:
        return frozenset(), frozenset()
    effect = kind.at(finger, sites[0])
    amplitudes = {k: getattr(effect, k) for k in kind.amplitudes()}

    def depends(channel: str, held: bool) -> tuple[bool, bool]:
        _, model, x, terms, contact = _Nominal.of(*description, held=held)
        y0 = {
            "joint_torque": x.q,
            "tendon_excursion": x.tension,
            "fingertip_force": jax.device_put(np.asarray(contact)[:, 0]),
        }[channel]
        of_force = contact if channel == "fingertip_force" else None

        def of(amplitudes, session):
            return change(channel, replace(effect, **amplitudes), model, replace(x, **session), y0, terms, of_force)

        jaxpr = jax.make_jaxpr(of)(amplitudes, {k: getattr(x, k) for k in DIFFER_IN_REPEATS}).jaxpr
        n = len(amplitudes)
        return _dependent(jaxpr, jaxpr.invars[:n]), _dependent(jaxpr, jaxpr.invars[n:])

    kinds = {e.predicted_as(c) for e in EXPERIMENTS.values() for c in e.channels}
    found = {key: depends(*key) for key in kinds}
    return frozenset(k for k, (a, _) in found.items() if a), frozenset(k for k, (_, s) in found.items() if s)


def _dependent(jaxpr, arguments) -> bool:
    """Whether a result depends on some of the arguments; an operation's outputs depend on all of its inputs."""
    dependent = set(arguments)

    def tainted(v) -> bool:
        return not isinstance(v, Literal) and v in dependent

    for equation in jaxpr.eqns:
        if any(map(tainted, equation.invars)):
            dependent.update(equation.outvars)
    return any(map(tainted, jaxpr.outvars))
