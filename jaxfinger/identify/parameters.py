"""The model's parameters as one flat vector, with a name and a unit for every entry.

Flat vectors exist only inside a solver call and in a covariance. Elsewhere a parameter is a field of its module.
NumPy moves values between both, since JAX would compile a program for every structure of a model. JAX does it where it
traces.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxfinger.compilation import quick_jit
from jaxfinger.data.schema import units_where
from jaxfinger.effects import CatalogueEffect, Site
from jaxfinger.model import Finger, Model

Shapes = tuple[tuple[int, ...] | None, ...]


def ravel(model: Model) -> Float[Array | np.ndarray, " P"]:
    """Flat vector of the model: its floating-point leaves in order."""
    leaves = _leaves(model)
    xp = _namespace(leaves)
    return xp.concatenate([xp.ravel(leaf) for leaf in leaves])


def with_flat(model: Model, flat: Float[Array | np.ndarray, " P"]) -> Model:
    """Copy of the model with the flat vector `flat`, the inverse of `ravel`."""
    leaves = _leaves(model)
    ends = np.cumsum([0] + [leaf.size for leaf in leaves])
    new = [flat[a:b].reshape(leaf.shape) for leaf, (a, b) in zip(leaves, pairwise(ends), strict=True)]
    return _with_leaves(model, dict(enumerate(jax.device_put(new))))


class Free(eqx.Module):
    """Free entries of the flat vector, kept leaf by leaf, so that JAX sees that the other leaves are constant."""

    leaves: tuple[int, ...] = eqx.field(static=True)  # numbers of the leaves with free entries
    parts: tuple[str, ...] = eqx.field(static=True)  # field of the model that holds each of those leaves
    entries: tuple[Int[Array | np.ndarray, " _k"], ...]  # positions within each of those leaves

    @classmethod
    def at(cls, model: Model, positions: Int[np.ndarray, " p"]) -> "Free":
        """Free entries at these positions of the flat vector, which must ascend.

        Raises:
            ValueError: the positions do not ascend.
        """
        positions = np.asarray(positions)
        if np.any(np.diff(positions) <= 0):
            raise ValueError("positions must ascend")
        starts = np.cumsum([0] + [leaf.size for leaf in _leaves(model)])
        ends = pairwise(np.searchsorted(positions, starts))
        within = {i: positions[a:b] - starts[i] for i, (a, b) in enumerate(ends) if a < b}
        fields = _fields(*_structure(model))
        return cls(tuple(within), tuple(fields[i] for i in within), tuple(within.values()))

    def values(self, model: Model) -> list[Float[Array | np.ndarray, " _k"]]:
        """Free parameters of a model, leaf by leaf."""
        leaves = _leaves(model)
        xp = _namespace(leaves)
        return [xp.ravel(leaves[i])[e] for i, e in zip(self.leaves, self.entries, strict=True)]

    def put(self, model: Model, values: list[Float[Array | np.ndarray, " _k"]]) -> Model:
        """Copy of the model with these free parameters, leaf by leaf."""
        new = []
        for leaf, e, value in zip(self.whole(model), self.entries, values, strict=True):
            if _namespace([leaf, e, value]) is np:
                flat = np.array(leaf).ravel()
                flat[e] = value
            else:
                flat = jnp.ravel(leaf).at[e].set(value)
            new.append(flat.reshape(leaf.shape))
        return self.put_whole(model, jax.device_put(new))

    def whole(self, model: Model) -> list[Float[Array, "..."]]:
        """The leaves of a model that hold free entries, with their other entries."""
        leaves = _leaves(model)
        return [leaves[i] for i in self.leaves]

    def put_whole(self, model: Model, whole: list[Float[Array, "..."]]) -> Model:
        """Copy of the model with these leaves."""
        return _with_leaves(model, dict(zip(self.leaves, whole, strict=True)))

    def get(self, model: Model) -> Float[Array | np.ndarray, " p"]:
        """Free parameters of a model as one vector."""
        values = self.values(model)
        return _namespace(values).concatenate([np.zeros(0), *values])  # the empty array, since there may be no value

    def set(self, model: Model, theta: Float[Array | np.ndarray, " p"]) -> Model:
        """Copy of the model with its free parameters set to `theta`."""
        ends = np.cumsum([0] + [e.size for e in self.entries])
        return self.put(model, [theta[a:b] for a, b in pairwise(ends)])


@quick_jit
def value_and_jacobian(
    f: Callable[[Model], Float[Array, "*k"]], model: Model, free: Free, theta: Float[Array, " p"]
) -> tuple[Float[Array, "*k"], Float[Array, "*k p"]]:
    """Value of a function of the model, and its derivatives by the free parameters, at `theta`."""

    def of(theta):
        return f(free.set(model, theta))

    return of(theta), jax.jacfwd(of)(theta)


def _leaves(model: Model):
    return [leaf for leaf in jax.tree.leaves(model) if eqx.is_inexact_array(leaf)]


def _with_leaves(model: Model, new: dict[int, Float[Array, "..."]]) -> Model:
    """Copy of the model with other floating-point leaves, by their numbers among these."""
    leaves, structure = jax.tree.flatten(model)
    floating = [i for i, leaf in enumerate(leaves) if eqx.is_inexact_array(leaf)]
    for i, leaf in new.items():
        leaves[floating[i]] = leaf
    return jax.tree.unflatten(structure, leaves)


def _structure(model: Model) -> tuple[Any, Shapes]:
    """Structure of a model with the shapes of its floating-point leaves, None for others."""
    leaves, structure = jax.tree.flatten(model)
    return structure, tuple(leaf.shape if eqx.is_inexact_array(leaf) else None for leaf in leaves)


def _paths(structure, shapes: Shapes) -> tuple[Model, list]:
    """Model of zeros of this structure without its other leaves, and the paths of its leaves."""
    model = jax.tree.unflatten(structure, [None if shape is None else np.zeros(shape) for shape in shapes])
    return model, jax.tree_util.tree_flatten_with_path(model)[0]


@cache
def _fields(structure, shapes: Shapes) -> tuple[str, ...]:
    """Field of the model that holds each floating-point leaf."""
    return tuple(str(getattr(path[0], "name", "")) for path, _ in _paths(structure, shapes)[1])


def _namespace(leaves):
    """JAX's NumPy where it traces any of the leaves, else NumPy."""
    return jnp if any(isinstance(leaf, Tracer) for leaf in leaves) else np


def units_at(finger: Finger, effect: type[CatalogueEffect], site: Site) -> dict[str, str]:
    """Units of an effect's parameters at a site; those of sliding joints are of lengths and forces."""
    own = [slides for joint, slides in zip(finger.joint_names, finger.prismatic, strict=True) if joint in site]
    if own:
        return {k: units_where(u, own) for k, u in effect.units().items()}
    # Orientations of a base or a sensor stay angles.
    return {k: u if u == "rad" else units_where(u, finger.prismatic) for k, u in effect.units().items()}


def effect_parameter(effect: CatalogueEffect, name: str) -> str:
    """`Parameter.name` of an effect's parameter, unique among effects and sites."""
    return f"{effect.ID} {'-'.join(effect.site)} {name}"


@dataclass(frozen=True)
class Parameter:
    """One entry of the flat vector."""

    name: str  # for people, for example `moment arm T1 MCP^2`
    group: str  # kind of parameter, for example `moment_arm`, `mass` or `friction`
    units: str
    joint: str | None = None
    tendon: str | None = None
    power: int | None = None
    spans: tuple[str, ...] = ()  # joints whose angles the term of a tendon's excursion multiplies
    term: str = ""  # its field in the module where a group has several, for example `constant`
    determinable: bool = True  # false where the finger has no such parameter: a tendon that does not cross the joint


def describe(model: Model) -> list[Parameter]:
    """Describe the entries of the flat vector, in order."""
    return list(_described(*_structure(model)))


@cache
def _described(structure, shapes: Shapes) -> tuple[Parameter, ...]:
    """Describe the entries of any model of this structure; names and units do not depend on its numbers."""
    model, paths = _paths(structure, shapes)
    entries = []
    for path, leaf in paths:
        keys = [getattr(k, "name", getattr(k, "idx", None)) for k in path]
        entries += [_describe(model, keys, index) for index in np.ndindex(leaf.shape)]
    return tuple(entries)


def _describe(model: Model, keys: list, index: tuple[int, ...]) -> Parameter:
    joints, tendons = model.finger.joint_names, model.finger.tendon_names
    match keys:
        case ["finger", "mass"]:
            return Parameter(f"mass {joints[index[0]]}", "mass", "kg", joints[index[0]])
        case ["finger", "com"]:
            return Parameter(f"centre of mass {joints[index[0]]} {'xyz'[index[1]]}", "com", "m", joints[index[0]])
        case ["finger", "rotor_inertia"]:
            a, b = index
            units = "kg" if model.finger.prismatic[a] and model.finger.prismatic[b] else "kg m2"
            label = f"rotor inertia {joints[a]}" if a == b else f"rotor inertia {joints[a]}-{joints[b]}"
            return Parameter(label, "rotor_inertia", units, joints[a], determinable=a == b)
        case ["finger", field]:
            units = {"axis": "1", "gyration": "m2", "gravity": "m s-2"}.get(field, "m")
            return Parameter(f"{field} {index}", field, units)
        case ["moment_arm", _]:
            return _moment_arm(model, *index)
        case ["joint_torque", field]:
            return _joint_torque(model, field, *index)
        case ["tendon_friction", field]:
            tendon = tendons[index[0]]
            active = model.finger.active[index[0]]
            symbol, units = {"constant": ("a0", "N"), "proportional": ("a1", "1")}[field]
            return Parameter(
                f"tendon friction {tendon} {symbol}",
                "tendon_friction",
                units,
                tendon=tendon,
                term=field,
                determinable=active,
            )
        case ["effects", int(i), field]:
            effect = model.effects[i]
            assert isinstance(effect, CatalogueEffect)
            label = effect_parameter(effect, field)
            units = units_at(model.finger, type(effect), effect.site)
            if index or field not in units:  # a constant of the effect
                return Parameter(f"{label} {index}" if index else label, "constant", "", determinable=False)
            return Parameter(label, "effects", units[field], term=field)
    raise AssertionError(keys)


def _joint_torque(model: Model, field: str, i: int, power: int = 0) -> Parameter:
    joint, slides = model.finger.joint_names[i], model.finger.prismatic[i]
    torque, viscous = ("N", "N s/m") if slides else ("N m", "N m s/rad")
    match field:
        case "damping":
            return Parameter(f"damping {joint}", field, viscous, joint)
        case "torque_friction":
            return Parameter(f"friction of its own torque {joint}", field, "1", joint)
        case "friction_by_direction":
            return Parameter(f"friction torque by direction {joint}", field, torque, joint)
        case "damping_by_direction":
            return Parameter(f"damping by direction {joint}", "friction_by_direction", viscous, joint)
    units = _per_rad(torque, power)
    return Parameter(
        f"{field} torque {joint}^{power}", field, units.replace("rad", "m") if slides else units, joint, power=power
    )


def _moment_arm(model: Model, k: int, t: int) -> Parameter:
    exponents = model.moment_arm.exponents[t]
    joints, tendon = model.finger.joint_names, model.finger.tendon_names[k]
    spanned = [i for i, p in enumerate(exponents) if p]
    label = " ".join(f"{joints[i]}^{exponents[i]}" for i in spanned)
    crosses = all(model.finger.crosses[k][i] for i in spanned)
    return Parameter(
        f"excursion {tendon} {label}",
        "moment_arm",
        _excursion_units(exponents, model.finger.prismatic),
        joints[spanned[0]] if len(spanned) == 1 else None,
        tendon,
        sum(exponents),
        tuple(joints[i] for i in spanned),
        determinable=crosses and model.finger.active[k],
    )


def _excursion_units(exponents: tuple[int, ...], prismatic: tuple[bool, ...]) -> str:
    """Units of the coefficient of a term in an excursion: m over the product of its angles and travels."""
    travels = sum(p for p, slides in zip(exponents, prismatic, strict=True) if slides)
    angles = sum(exponents) - travels
    if not travels:
        return _per_rad("m", angles)
    return _per_rad(_per_rad("1", travels - 1).replace("rad", "m"), angles)


def _per_rad(units: str, power: int) -> str:
    return units if power == 0 else f"{units}/rad" if power == 1 else f"{units}/rad^{power}"
