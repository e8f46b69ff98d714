"""What every effect of the catalogue says of itself, so that others can look for it."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from itertools import combinations, permutations, product
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfinger.effects.scales import Scales
from jaxfinger.model import Effect, Finger

Site = tuple[str, ...]
Kind = TypeVar("Kind", bound="CatalogueEffect")


@dataclass(frozen=True)
class Amplitude:
    """A parameter that the effect is (nearly) in proportion to, and that vanishes with it."""

    units: str  # where joints turn
    size: float  # that an effect worth naming has, of the scale `of`
    of: str  # a product of `Scales`
    signed: bool
    most: float  # 1 for the share of something


@dataclass(frozen=True)
class Shape:
    """A parameter that says how an effect acts, and means nothing without an amplitude."""

    units: str
    values: tuple[float, ...]  # worth trying, of the scale `of`
    of: str
    # How a refit moves it: by factors, by differences, or not at all, since it chooses a form, a side or a place.
    moves: str
    # The two amplitudes of a period in the session's time, alike but for it. A fine scan finds a period, since a refit
    # would stop in the nearest of many valleys.
    period_of: tuple[str, str] | None = None


def amplitude(units: str, size: float, of: str = "1", *, signed: bool = False, most: float = np.inf) -> Any:
    """A field that is an amplitude: `amplitude("N m", 0.1, "torque")` is plausible at a tenth of the joint's torque.

    It is not below zero unless `signed`, and not above `most`.
    """
    return eqx.field(metadata={"parameter": Amplitude(units, size, of, signed, most)})


def shape(
    units: str, values: tuple[float, ...], of: str = "1", *, moves: str = "by factors", period_of: Any = None
) -> Any:
    """A field that is a shape, with the `values` worth trying in units of the scale `of`, the first one its default.

    `moves`: `by factors`, `by differences`, or `not`.
    """
    if moves not in ("by factors", "by differences", "not"):
        raise ValueError(f"a shape moves by factors, by differences or not, where {moves!r} stands")
    return eqx.field(metadata={"parameter": Shape(units, tuple(values), of, moves, period_of)})


class CatalogueEffect(Effect):
    """An effect with a name, the places where it can act, and its parameters.

    A subclass declares each parameter once, as a scalar array field made by `amplitude` or `shape`. The site enters as
    indices, so that one compilation serves every site and shape.
    """

    ID: ClassVar[str]
    PLACE: ClassVar[str]  # joint, tendon, joint pair, tendon pair, channel, or the site's own name
    # For people, one sentence each: what happens, what it looks like in the data, what to change.
    HAPPENS: ClassVar[str] = ""
    LOOKS: ClassVar[str] = ""
    CHANGE: ClassVar[str] = ""
    # Sizes, in plausible ones, at which its signature is read: several where it decides whether a held tendon slips.
    SIZES: ClassVar[tuple[float, ...]] = (1.0,)

    site: Site = eqx.field(static=True)
    index: Int[Array, " k"]

    @classmethod
    def parameters(cls) -> Mapping[str, Amplitude | Shape]:
        """Every parameter by name, in the order of the fields."""
        return _declared(cls)

    @classmethod
    def amplitudes(cls) -> dict[str, Amplitude]:
        """The amplitudes by name."""
        return {n: p for n, p in cls.parameters().items() if isinstance(p, Amplitude)}

    @classmethod
    def shape_parameters(cls) -> dict[str, Shape]:
        """The shapes by name."""
        return {n: p for n, p in cls.parameters().items() if isinstance(p, Shape)}

    @classmethod
    def periods(cls) -> dict[str, tuple[str, str]]:
        """Shapes that are periods in the session's time, with the two amplitudes of each. Such an effect has a shape
        `middle`, from which phases count: the middle of the session.
        """
        return {n: p.period_of for n, p in cls.shape_parameters().items() if p.period_of}

    @classmethod
    def sizes(cls, scales: Scales, site: Site) -> dict[str, float]:
        """The plausible size of every amplitude at a site, in its own unit."""
        return {n: p.size * scales(p.of, site) for n, p in cls.amplitudes().items()}

    @classmethod
    def worth_trying(cls, scales: Scales, site: Site) -> dict[str, tuple[float, ...]]:
        """The values of every shape that are worth trying at a site, in its own unit."""
        grids = {n: np.array(p.values) * scales(p.of, site) for n, p in cls.shape_parameters().items()}
        return {n: tuple(values.tolist()) for n, values in grids.items()}

    @classmethod
    def shapes(cls, finger: Finger, site: Site, scales: Scales) -> list[dict[str, float]]:
        """Every combination of shapes worth trying at a site; periods are scanned for instead."""
        grids = {n: v[:1] if n in cls.periods() else v for n, v in cls.worth_trying(scales, site).items()}
        combined = [dict(zip(grids, v, strict=True)) for v in product(*grids.values())]
        return [s for s in combined if cls.sensible(scales, site, s)]

    @classmethod
    def sensible(cls, scales: Scales, site: Site, shapes: dict[str, float]) -> bool:
        """Whether a combination of shapes is worth trying where each of them is."""
        return True

    @classmethod
    def at(cls: type[Kind], finger: Finger, site: Site, **values: float) -> Kind:
        """At a site of a finger; amplitudes default to zero, shapes to the first value worth trying there as far as the
        finger's description tells.
        """
        site, shapes = tuple(site), cls.shape_parameters()
        defaults = dict.fromkeys(cls.amplitudes(), 0.0)
        if set(shapes) - set(values):
            defaults |= {n: v[0] for n, v in cls.worth_trying(Scales.of(finger), site).items()}
        if unknown := set(values) - set(cls.parameters()):
            raise TypeError(f"{cls.ID} has no parameter {sorted(unknown)}; it has {sorted(cls.parameters())}")
        numbers = {k: jnp.asarray(v, dtype=float) for k, v in (defaults | values).items()}
        index = jax.device_put(np.array(cls.indices(finger, site), dtype=int))
        return cls(site, index, **numbers, **cls.constants(finger, site))

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
    def moves_rigid_body(cls) -> bool:
        """Whether it changes more than the torque that resists a motion: the rigid body, the motion itself, or what a
        drive loses of all of (1).
        """
        return any(getattr(cls, h) is not getattr(Effect, h) for h in ("finger", "true_motion", "torque_friction"))

    @classmethod
    def reads(cls) -> bool:
        """Whether it changes what a sensor says of what it measures."""
        return cls.reading is not Effect.reading

    def bounds(self, scales: Scales) -> dict[str, tuple[float, float]]:
        """Least and most of every amplitude and of every shape that a refit moves: one-sided amplitudes not below zero,
        shares not above one, and shapes no further out than those worth trying.
        """
        ends = {n: (-np.inf if p.signed else 0.0, p.most) for n, p in self.amplitudes().items()}
        for n, values in self.worth_trying(scales, self.site).items():
            moves = self.shape_parameters()[n].moves
            if moves != "not" and len(values) > 1:
                wide = 1.0 if moves == "by differences" else 2.0
                ends[n] = (min(values) / wide, max(values) * wide)
        return ends

    @classmethod
    def units(cls) -> dict[str, str]:
        """Units of every parameter, amplitudes and shapes, where joints turn."""
        return {n: p.units for n, p in cls.parameters().items()}

    def values(self) -> dict[str, float]:
        """Every parameter by name."""
        return {n: float(getattr(self, n)) for n in self.parameters()}


@cache
def _declared(cls: type[CatalogueEffect]) -> dict[str, Amplitude | Shape]:
    found = {f.name: f.metadata["parameter"] for f in fields(cls) if "parameter" in f.metadata}
    amplitudes = {n: p for n, p in found.items() if isinstance(p, Amplitude)}
    return amplitudes | found


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


def delta() -> Any:
    """A shape that chooses between both forms of `dahl`."""
    return shape("1", (1.0, 0.5), moves="not")


_SIXTH_ORDER = ((1, 0.75), (2, -0.15), (3, 1 / 60))  # how far off on either side, and weight


def rate(y: Float[Array, "*T"], time: Float[Array, "*#T"]) -> Float[Array, "*T"]:
    """Time derivative along the last axis; zero where time stands still.

    Central differences of the sixth order where samples are evenly spaced (Fornberg, Math. Comp. 51 (1988) 699), since
    reduced channels change by much from sample to sample; of the second order elsewhere.
    """
    time = jnp.broadcast_to(time, y.shape)
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
