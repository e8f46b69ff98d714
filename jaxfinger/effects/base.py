"""Base class of the catalogue's effects. Each declares its sites and parameters, so that a search can try it."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from itertools import combinations, permutations, product
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Int

from jaxfinger.effects.scales import Scales, refuse_unknown_scale
from jaxfinger.model import Effect, Finger

Site = tuple[str, ...]
Kind = TypeVar("Kind", bound="CatalogueEffect")


@dataclass(frozen=True)
class Amplitude:
    """A parameter that the effect is proportional to, or nearly so. At zero the effect is absent."""

    units: str  # for revolute joints
    size: float  # of an effect worth naming, in units of the scale `of`
    of: str  # a product of `Scales`
    signed: bool  # whether it may be negative
    most: float  # of its magnitude: 1 for a share

    @property
    def least(self) -> float:
        """Lower bound."""
        return -self.most if self.signed else 0.0


@dataclass(frozen=True)
class Shape:
    """A parameter that sets how an effect acts: a length, a time constant, an exponent. Its amplitude sets how much."""

    units: str
    values: tuple[float, ...]  # to try, in units of the scale `of`
    of: str
    # How a refit moves it: by factors, by differences, or not at all where it chooses a form, a side or a place.
    moves: str
    # Where the shape is a period in the session's time: the amplitudes of its cosine and sine. A fine scan finds the
    # period, since the cost has many local minima along it.
    period_of: tuple[str, str] | None = None
    # Words for each value, where the shape chooses a form that people are to know of: its number tells them nothing.
    says: tuple[str, ...] = ()

    @property
    def fixed(self) -> bool:
        """Whether no refit moves it: it chooses a form, or has one value."""
        return self.moves == "not" or len(self.values) == 1


def amplitude(units: str, size: float, of: str = "1", *, signed: bool = False, most: float = np.inf) -> Any:
    """Declare a field that is an amplitude: `amplitude("N m", 0.1, "torque")` expects a tenth of the joint's torque.

    Its magnitude is at most `most`. It is not negative unless `signed`.

    Raises:
        ValueError: `size` is not positive, or `of` is no product of scales.
    """
    if not size > 0.0:
        raise ValueError(f"an amplitude needs the size of an effect worth naming, above zero, where {size!r} stands")
    refuse_unknown_scale(of)
    return eqx.field(metadata={"parameter": Amplitude(units, size, of, signed, most)})


def shape(
    units: str,
    values: tuple[float, ...],
    of: str = "1",
    *,
    moves: str = "by factors",
    period_of: Any = None,
    says: tuple[str, ...] = (),
) -> Any:
    """Declare a field that is a shape, with the `values` to try in units of the scale `of`. The first is its default.

    `moves`: how a refit moves it, `by factors`, `by differences`, or `not`. `says`: words for each value of a shape
    that does not move, which people read in place of its number.

    Raises:
        ValueError: `moves` is none of the three, `says` has not one text for each value that does not move, or `of` is
            no product of scales.
    """
    refuse_unknown_scale(of)
    if moves not in ("by factors", "by differences", "not"):
        raise ValueError(f"a shape moves by factors, by differences or not, where {moves!r} stands")
    if says and (moves != "not" or len(says) != len(values)):
        raise ValueError(f"a shape says one text for each of its values, and does not move, where {says!r} stands")
    return eqx.field(metadata={"parameter": Shape(units, tuple(values), of, moves, period_of, tuple(says))})


class CatalogueEffect(Effect):
    """An effect with a name, the places where it can act, and its parameters.

    A subclass declares each parameter once, as a scalar array field made by `amplitude` or `shape`. The site enters as
    indices, so that one compilation serves every site and shape.
    """

    ID: ClassVar[str]
    PLACE: ClassVar[str]  # joint, tendon, joint pair, tendon pair, channel, or the name of a single site
    # Sentences for people: what happens, what it looks like in the data, what to change.
    HAPPENS: ClassVar[str] = ""
    LOOKS: ClassVar[str] = ""
    CHANGE: ClassVar[str] = ""
    # Multiples of the plausible size at which the signature is computed. An effect that decides whether a held tendon
    # slips is not linear in its size, and has several.
    SIZES: ClassVar[tuple[float, ...]] = (1.0,)
    OF_SPRING: ClassVar[bool] = False  # whether a joint without a spring cannot have the effect

    site: Site = eqx.field(static=True)
    index: Int[Array, " k"]

    @classmethod
    def parameters(cls) -> Mapping[str, Amplitude | Shape]:
        """Parameters by name: amplitudes first, then shapes, each in the order of the fields."""
        return _declared(cls)

    @classmethod
    def amplitudes(cls) -> dict[str, Amplitude]:
        """Amplitudes by name."""
        return {n: p for n, p in cls.parameters().items() if isinstance(p, Amplitude)}

    @classmethod
    def shape_parameters(cls) -> dict[str, Shape]:
        """Shapes by name."""
        return {n: p for n, p in cls.parameters().items() if isinstance(p, Shape)}

    @classmethod
    def periods(cls) -> dict[str, tuple[str, str]]:
        """Amplitudes of the cosine and sine of every shape that is a period in the session's time.

        Such an effect also has a shape `middle`, the middle of the session, where the phase is zero.
        """
        return {n: p.period_of for n, p in cls.shape_parameters().items() if p.period_of}

    @classmethod
    def sizes(cls, scales: Scales, site: Site) -> dict[str, float]:
        """Plausible size of every amplitude at a site, in its own unit."""
        return {n: p.size * scales(p.of, site) for n, p in cls.amplitudes().items()}

    @classmethod
    def worth_trying(cls, scales: Scales, site: Site) -> dict[str, tuple[float, ...]]:
        """Values to try of every shape at a site, in its own unit."""
        grids = {n: np.array(p.values) * scales(p.of, site) for n, p in cls.shape_parameters().items()}
        return {n: tuple(values.tolist()) for n, values in grids.items()}

    @classmethod
    def shapes(cls, finger: Finger, site: Site, scales: Scales) -> list[dict[str, float]]:
        """Combinations of shapes to try at a site. A period has its default only, since a scan finds it."""
        grids = {n: v[:1] if n in cls.periods() else v for n, v in cls.worth_trying(scales, site).items()}
        combined = [dict(zip(grids, v, strict=True)) for v in product(*grids.values())]
        return [s for s in combined if cls.sensible(scales, site, s)]

    @classmethod
    def sensible(cls, scales: Scales, site: Site, shapes: dict[str, float]) -> bool:
        """Whether a combination of shapes is worth trying."""
        return True

    @classmethod
    def at(cls: type[Kind], finger: Finger, site: Site, **values: float) -> Kind:
        """Place the effect at a site of a finger, with parameters by name.

        Amplitudes default to zero. Shapes default to the first of the values to try, scaled by the finger's
        description.

        Raises:
            TypeError: The effect has no parameter of a given name.
        """
        site, shapes = tuple(site), cls.shape_parameters()
        defaults = dict.fromkeys(cls.amplitudes(), 0.0)
        if set(shapes) - set(values):
            defaults |= {n: v[0] for n, v in cls.worth_trying(Scales.of(finger), site).items()}
        if unknown := set(values) - set(cls.parameters()):
            raise TypeError(f"{cls.ID} has no parameter {sorted(unknown)}; it has {sorted(cls.parameters())}")
        numbers = {k: np.asarray(v, dtype=float) for k, v in (defaults | values).items()}
        numbers, index = jax.device_put((numbers, np.array(cls.indices(finger, site), dtype=int)))
        return cls(site, index, **numbers, **cls.constants(finger, site))

    def with_values(self: Kind, **values: float) -> Kind:
        """Copy with other values of some parameters, in arrays of NumPy: hundreds of effects are stacked at once."""
        leaves, structure = jax.tree_util.tree_flatten_with_path(self)
        fields = [(path[0].name, leaf) for path, leaf in leaves]
        new = [np.asarray(values.get(name, leaf), float if name in values else None) for name, leaf in fields]
        return jax.tree.unflatten(structure, new)

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
        """Further fields of the effect, computed from the finger."""
        return {}

    @classmethod
    def sites(cls, finger: Finger) -> list[Site]:
        """Sites of a finger where the effect can act."""
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
        """Whether the effect changes the rigid body, the motion itself, or the share of torque that a drive loses.

        Such an effect changes more of equation (1) than the torque that resists a motion.
        """
        return any(getattr(cls, h) is not getattr(Effect, h) for h in ("finger", "true_motion", "torque_friction"))

    @classmethod
    def reads(cls) -> bool:
        """Whether the effect changes the reading of a sensor."""
        return cls.reading is not Effect.reading

    def bounds(self, scales: Scales) -> dict[str, tuple[float, float]]:
        """Lower and upper bound of every parameter that a refit moves, in its own unit.

        Amplitudes end at the largest magnitude, those without a sign at zero. A shape that moves by factors may
        leave the range of values to try by a factor of two; one that moves by differences stays within it.
        """
        ends = {n: (p.least, p.most) for n, p in self.amplitudes().items()}
        for n, values in self.worth_trying(scales, self.site).items():
            p = self.shape_parameters()[n]
            if not p.fixed:
                margin = 1.0 if p.moves == "by differences" else 2.0
                ends[n] = (min(values) / margin, max(values) * margin)
        return ends

    @classmethod
    def units(cls) -> dict[str, str]:
        """Units of every parameter, for revolute joints."""
        return {n: p.units for n, p in cls.parameters().items()}

    @classmethod
    def form(cls, finger: Finger, values: Mapping[str, float]) -> list[str]:
        """What the shapes that choose a form mean at these values, in words."""
        said = {n: p for n, p in cls.shape_parameters().items() if p.says and values.get(n) in p.values}
        return [p.says[p.values.index(values[n])] for n, p in said.items()]

    def values(self) -> dict[str, float]:
        """Values of the parameters by name."""
        return {n: float(getattr(self, n)) for n in self.parameters()}


@cache
def _declared(cls: type[CatalogueEffect]) -> dict[str, Amplitude | Shape]:
    found = {f.name: f.metadata["parameter"] for f in fields(cls) if "parameter" in f.metadata}
    amplitudes = {n: p for n, p in found.items() if isinstance(p, Amplitude)}
    return amplitudes | found
