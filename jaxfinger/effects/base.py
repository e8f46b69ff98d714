"""What every effect of the catalogue says of itself, so that others can look for it."""

from itertools import combinations, permutations, product
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfinger.model import Effect, Finger

Site = tuple[str, ...]


class CatalogueEffect(Effect):
    """An effect with a name, the places where it can act, and its parameters.

    Amplitudes enter (nearly) in proportion and vanish with the effect; shapes say how it acts and mean nothing without
    an amplitude. A subclass declares each as a scalar array field, and in `AMPLITUDES` its unit, its plausible size
    and whether it may be negative, in `SHAPES` its unit and the values worth trying. The site enters as indices, so
    that one compilation serves every site and shape.
    """

    ID: ClassVar[str]
    PLACE: ClassVar[str]  # joint, tendon, joint pair, tendon pair, channel, or the site's own name
    AMPLITUDES: ClassVar[dict[str, tuple[str, float, bool]]]
    SHAPES: ClassVar[dict[str, tuple[str, tuple[float, ...]]]] = {}
    # Amplitudes that are the share of something: at most one.
    SHARES: ClassVar[tuple[str, ...]] = ()
    # Shapes that a refit leaves as they are, and shapes that it moves by differences; it moves the others by factors.
    CHOICES: ClassVar[tuple[str, ...]] = ()
    SHIFTS: ClassVar[tuple[str, ...]] = ()
    # Shapes that are periods in the session's time, and the two amplitudes of each, alike but for the period. A fine
    # scan finds them, since a refit would stop in the nearest of many valleys; it sets the shape `middle`, from which
    # phases count, to the middle of the session.
    PERIODS: ClassVar[dict[str, tuple[str, str]]] = {}
    # Plausible sizes at which its signature is read: several where it decides whether a held tendon slips.
    SIZES: ClassVar[tuple[float, ...]] = (1.0,)
    # Experiments and channels that can show the effect; everywhere else it is silent.
    SHOWS: ClassVar[dict[str, tuple[str, ...]]]
    # Whether it changes the rigid body or the motion that drives it, beside the other terms of (1).
    MOVES_RIGID_BODY: ClassVar[bool] = False

    site: Site = eqx.field(static=True)
    index: Int[Array, " k"]

    @classmethod
    def at(cls, finger: Finger, site: Site, **values: float) -> Self:
        """At a site of a finger; amplitudes default to zero, shapes to the first value worth trying."""
        defaults = dict.fromkeys(cls.AMPLITUDES, 0.0) | {k: grid[0] for k, (_, grid) in cls.SHAPES.items()}
        if unknown := set(values) - set(defaults):
            raise TypeError(f"{cls.ID} has no parameter {sorted(unknown)}; it has {sorted(defaults)}")
        fields = {k: jnp.asarray(v, dtype=float) for k, v in (defaults | values).items()}
        return cls(
            tuple(site),
            jax.device_put(np.array(cls.indices(finger, tuple(site)), dtype=int)),
            **fields,
            **cls.constants(finger, site),
        )

    @classmethod
    def indices(cls, finger: Finger, site: Site) -> tuple[int, ...]:
        """Indices of the site's joints, tendons or channel."""
        match cls.PLACE:
            case "joint" | "joint pair":
                return tuple(finger.joint_names.index(s) for s in site)
            case "tendon" | "tendon pair":
                return tuple(finger.tendon_names.index(s) for s in site)
        return ()

    @classmethod
    def constants(cls, finger: Finger, site: Site) -> dict[str, Any]:
        """Further fields that the finger decides."""
        return {}

    @classmethod
    def sites(cls, finger: Finger) -> list[Site]:
        """Every place of a finger where the effect can act."""
        active = [name for name, a in zip(finger.tendon_names, finger.active, strict=True) if a]
        match cls.PLACE:
            case "joint":
                return [(j,) for j in finger.joint_names]
            case "tendon":
                return [(t,) for t in active]
            case "joint pair":
                return list(combinations(finger.joint_names, 2))
            case "tendon pair":
                return list(permutations(active, 2))
            case place:
                return [(place,)]

    @classmethod
    def shapes(cls, finger: Finger, site: Site) -> list[dict[str, float]]:
        """Every combination of shapes worth trying at a site; periods are scanned for instead."""
        grids = {n: values[:1] if n in cls.PERIODS else values for n, (_, values) in cls.SHAPES.items()}
        return [dict(zip(grids, v, strict=True)) for v in product(*grids.values())]

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Least and most of every amplitude and of every shape that a refit moves: one-sided amplitudes not below zero,
        shares not above one, and shapes no further out than those worth trying.
        """
        signed = {n: s for n, (_, _, s) in self.AMPLITUDES.items()}
        ends = {n: (-np.inf if signed[n] else 0.0, 1.0 if n in self.SHARES else np.inf) for n in signed}
        for n, (_, grid) in self.SHAPES.items():
            if n not in self.CHOICES and len(grid) > 1:
                wide = 1.0 if n in self.SHIFTS else 2.0
                ends[n] = (min(grid) / wide, max(grid) * wide)
        return ends

    @classmethod
    def units(cls) -> dict[str, str]:
        """Units of every parameter, amplitudes and shapes, where joints turn."""
        return {k: v[0] for k, v in (cls.AMPLITUDES | cls.SHAPES).items()}

    def values(self) -> dict[str, float]:
        """Every parameter by name."""
        return {k: float(getattr(self, k)) for k in (*self.AMPLITUDES, *self.SHAPES)}


def dahl(z: Float[Array, "*T"], dx: Float[Array, "*T"], delta: Float[Array, ""]) -> Float[Array, "*T"]:
    """Share of the friction that is built up after a displacement, in lengths: dz = (1 − z sgn dx)^δ dx (Dahl 1968).

    δ = 1 builds up exponentially. δ = ½ has built up after 2√2 lengths, as many elements in parallel have that slip one
    after the other (Maxwell slip, evenly spread).
    """
    way = jnp.sign(dx)
    lacking, share = 1.0 - z * way, jnp.abs(dx)
    root = jnp.sqrt(jnp.maximum(lacking, 1e-12))  # whose slope at nothing is infinite
    left = jnp.where(delta > 0.75, lacking * jnp.exp(-share), jnp.square(jnp.maximum(root - 0.5 * share, 0.0)))
    return jnp.where(dx == 0.0, z, way * (1.0 - left))


DELTA = ("1", (1.0, 0.5))  # both forms of `dahl`


_SIXTH_ORDER = ((1, 0.75), (2, -0.15), (3, 1 / 60))  # how far off on either side, and weight


def rate(y: Float[Array, "*T"], time: Float[Array, "*T"]) -> Float[Array, "*T"]:
    """Time derivative along the last axis; zero where time stands still.

    Central differences of the sixth order where samples are evenly spaced (Fornberg, Math. Comp. 51 (1988) 699), since
    reduced channels change by much from sample to sample; of the second order elsewhere.
    """
    dy, dt = (jnp.asarray(jnp.gradient(a, axis=-1)) for a in (y, time))
    slope = jnp.where(dt > 0, dy / jnp.where(dt > 0, dt, 1.0), 0.0)
    if y.shape[-1] < 7:
        return slope

    def wide(a):
        return sum(
            w * (a[..., 3 + k : a.shape[-1] - 3 + k] - a[..., 3 - k : a.shape[-1] - 3 - k]) for k, w in _SIXTH_ORDER
        )

    inner, step = wide(time), dt[..., 3:-3]
    even = (step > 0) & (jnp.abs(time[..., 6:] - time[..., :-6] - 6.0 * step) < 0.01 * step)
    smooth = jnp.where(even, wide(y) / jnp.where(even, inner, 1.0), slope[..., 3:-3])
    return slope.at[..., 3:-3].set(smooth)


TORQUE = {"ID.3-static": ("joint_torque",), "ID.3-dynamic": ("joint_torque",), "VD.3": ("joint_torque",)}
ELASTIC = TORQUE | {"ID.4": ("joint_torque",), "VD.2": ("fingertip_force",)}
TENSION = {"ID.4": ("joint_torque",), "VD.2": ("fingertip_force",), "VD.3": ("joint_torque",)}
EXCURSION = {e: ("tendon_excursion",) for e in ("ID.2", "VD.1", "ID.4", "VD.2", "VD.3")}
BOTH = {
    "ID.2": ("tendon_excursion",),
    "VD.1": ("tendon_excursion",),
    "ID.4": ("joint_torque", "tendon_excursion"),
    "VD.2": ("fingertip_force", "tendon_excursion"),
    "VD.3": ("joint_torque", "tendon_excursion"),
}
ALL = BOTH | TORQUE | {"VD.3": ("joint_torque", "tendon_excursion")}
