"""Check that the finger of a file is physically possible and in SI units."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.checks.links import check_links
from jaxfinger.data.example import is_example
from jaxfinger.data.findings import Report
from jaxfinger.data.schema import JOINTS, LINKS
from jaxfinger.data.session import FingerDescription
from jaxfinger.data.units import beyond_a_turn

if TYPE_CHECKING:
    from jaxtyping import Float

UNIT_AXIS_TOLERANCE = 1e-3  # of an axis's length: axes typed with three digits pass.
_ROUNDING = 1e-5  # relative: 100 times that of float32, for tables that were computed in it
# kg/m³, of the finger's mass in a cube as wide as one of its lengths: a hundredth of air. Fingers have hundreds, and an
# arm of thin tubes still a tenth. Lengths in cm make a millionth of it, in mm a billionth.
_MIN_DENSITY = 0.01
# Degrees, which single precision keeps up to 5 turns. No whole number of degrees up to 360 is this near to a whole one
# again when it is read as rad, so limits of several turns that are whole degrees are not degrees read as rad.
_WHOLE = 1e-4
_MAX_ARM = 2.0  # of the finger's length: moment arms are about a tenth of it, and ten times it in cm.


def check_finger(finger: FingerDescription, report: Report) -> None:
    """Report every fault of `/finger`."""
    _names(finger.joint_names, "/finger/joints/name", "joint", report)
    _names(finger.tendon_names, "/finger/tendons/name", "tendon", report)
    if _finite(finger, report):
        _gravity(finger, report)
        _joints(finger, report)
        _links(finger, report)
        _lengths(finger, report)
        if report.fatal is None:
            check_links(finger, report)
        if is_example(finger):
            said = "has the masses and centres of mass that `jaxfinger new` writes as an example"
            report.warning("/finger/links", f"{said}; write those of your finger")
    _tendons(finger, report)
    _excursion(finger, report)


def _names(names: tuple[str, ...], place: str, what: str, report: Report) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            report.error(place, f"{what} {name!r} is listed {count} times; give each its own name")
        if not name.strip():
            report.error(place, f"a {what} has no name; name it")


def _finite(finger: FingerDescription, report: Report) -> bool:
    ok = True
    for folder, entries in (("joints", JOINTS), ("links", LINKS)):
        for entry in entries:
            if entry.kind != "float" or (value := getattr(finger, entry.name)) is None:
                continue
            bad = ~np.isfinite(value).reshape(finger.m, -1).all(axis=1)
            for i in np.flatnonzero(bad):
                message = f"joint {finger.joint_names[i]} has a value that is not finite; write a number"
                report.error(f"/finger/{folder}/{entry.name}", message, row=int(i))
                ok = False
    if not np.isfinite(finger.fingertip).all():
        report.error("/finger/fingertip", "is not finite; write the contact point in the last link's frame")
        ok = False
    return ok


def _gravity(finger: FingerDescription, report: Report) -> None:
    """Check that gravity is in m s⁻², and of a size found on Earth: 9.76 (high mountains) to 9.84 (the poles)."""
    size = float(np.linalg.norm(finger.gravity))
    if size == 0.0:
        report.warning(
            "/finger", "has `gravity` zero: no mass can be identified; write the base frame's gravity, 9.81 m s-2 long"
        )
    elif not 9.0 < size < 10.5:
        report.error("/finger", f"has `gravity` {size:.4g} long; it must be in m s-2, about 9.81")
    elif not 9.76 < size < 9.84:
        report.warning("/finger", f"has `gravity` {size:.4g} m s-2 long, which is found nowhere on Earth; correct it")


def _joints(finger: FingerDescription, report: Report) -> None:
    for i, (name, axis, (lower, upper)) in enumerate(zip(finger.joint_names, finger.axis, finger.limits, strict=True)):
        size = float(np.linalg.norm(axis))
        if abs(size - 1.0) > UNIT_AXIS_TOLERANCE:
            message = f"joint {name} has an axis {size:.4g} long; divide it by its length"
            report.error("/finger/joints/axis", message, row=i)
        if lower >= upper:
            message = f"joint {name} has its lower limit {lower:.4g} at or above its upper {upper:.4g}; swap them"
            report.error("/finger/joints/limits", message, row=i)
        if not finger.prismatic[i] and beyond_a_turn((lower, upper)) and not _whole_degrees(finger.limits[i]):
            said = f"joint {name} reaches {max(-lower, upper):.4g} rad, more than a turn"
            mend = "convert degrees to rad, or write `limits_deg`, in whole degrees where a joint turns several times"
            report.error("/finger/joints/limits", f"{said}; {mend}", row=i)


def _whole_degrees(angles: Float[np.ndarray, " a"]) -> bool:
    """Whether angles, rad, are whole degrees."""
    degrees = np.degrees(angles)
    return bool(np.abs(degrees - np.round(degrees)).max() < _WHOLE)


def _links(finger: FingerDescription, report: Report) -> None:
    for i, name in enumerate(finger.joint_names):
        mass = finger.mass[i]
        if mass <= 0.0:
            message = f"the link of joint {name} weighs {mass:.4g} kg; a mass must be positive"
            report.error("/finger/links/mass", message, row=i)
        if (fault := _inertia(finger.inertia[i], mass, finger)) is not None:
            report.error("/finger/links/inertia", f"the link of joint {name} has {fault}", row=i)
    for key in ("mass_std", "com_std"):
        value = getattr(finger, key)
        if value is not None and np.any(value < 0.0):
            report.error(f"/finger/links/{key}", "holds a negative standard deviation; write its size")
    for key in ("rotor_inertia", "rotor_inertia_std"):
        value = getattr(finger, key)
        if value is not None and np.any(value < 0.0):
            report.error(f"/finger/joints/{key}", "holds a negative number; write its size, 0 where there is no rotor")
    if finger.rotor_inertia is None and finger.rotor_inertia_std is not None:
        report.error("/finger/joints/rotor_inertia", "is missing beside its standard deviation; write both or neither")


def _inertia(inertia: np.ndarray, mass: float, finger: FingerDescription) -> str | None:
    """Fault of the inertia matrix of a link that no body has, or None."""
    scale = float(np.abs(inertia).max())
    if np.abs(inertia - inertia.T).max() > _ROUNDING * scale:
        return "an inertia that is not symmetric; write the full matrix with both halves equal"
    small, middle, large = np.linalg.eigvalsh(inertia)
    if small <= 0.0:
        return f"the principal inertia {small:.3g} kg m2; all three must be positive"
    if large > (small + middle) * (1.0 + _ROUNDING):
        return (
            f"principal inertias {small:.3g}, {middle:.3g}, {large:.3g} kg m2; no body has one larger than the sum of "
            "the others; check frame, signs and units"
        )
    if mass > 0.0 and _too_long(gyration := float(np.sqrt(large / mass)), finger):
        return f"a radius of gyration of {gyration:.3g} m; convert to kg m2"
    return None


def _too_long(length: float, finger: FingerDescription) -> bool:
    """Whether a length, m, is too long for what the finger weighs, as one in mm or cm is."""
    return bool(0.0 < finger.mass.sum() < _MIN_DENSITY * length**3)


def _lengths(finger: FingerDescription, report: Report) -> None:
    if any(finger.prismatic):
        return
    lengths = {"joints/origin": finger.origin, "links/com": finger.com, "fingertip": finger.fingertip[None]}
    for key, vectors in lengths.items():
        for i, length in enumerate(np.linalg.norm(vectors, axis=1)):
            if _too_long(float(length), finger):
                at, row = ("", None) if key == "fingertip" else (f" at joint {finger.joint_names[i]}", i)
                report.error(f"/finger/{key}", f"is {length:.4g} m long{at}; convert mm or cm to m", row=row)


def _tendons(finger: FingerDescription, report: Report) -> None:
    place = "/finger/tendons/crosses"
    for k, (name, active) in enumerate(zip(finger.tendon_names, finger.active, strict=True)):
        if not finger.crosses[k].any():
            said = f"tendon {name} crosses no joint; mark the joints that it spans"
            if active:
                report.error(place, f"active {said}", row=k)
            else:
                report.warning(place, f"passive {said}")


def _excursion(finger: FingerDescription, report: Report) -> None:
    """Check known excursions: finite, or NaN throughout where unknown, and 0 at joints that a tendon does not cross."""
    place = "/finger/tendons/excursion"
    if finger.excursion is None:
        if finger.excursion_std is not None:
            report.error(place, "is missing beside its standard deviation; write both or neither")
        return
    std = finger.excursion_std
    if std is not None and std.shape != finger.excursion.shape:
        report.error(f"{place}_std", f"has shape {std.shape}; it must be that of `excursion`, {finger.excursion.shape}")
        return
    for k, name in enumerate(finger.tendon_names):
        known = finger.excursion[k]
        if np.isnan(known).all():
            continue
        spread = np.zeros_like(known) if std is None else std[k]
        if not (np.isfinite(known).all() and np.isfinite(spread).all()):
            report.error(
                place, f"tendon {name} has values that are not finite; write all of them, or NaN throughout", row=k
            )
        elif np.any(spread < 0.0):
            report.error(f"{place}_std", f"tendon {name} has a negative standard deviation; write its size", row=k)
        elif np.any(known[~finger.crosses[k]] != 0.0):
            joint = finger.joint_names[int(np.argmax((known != 0.0).any(axis=1) & ~finger.crosses[k]))]
            report.error(
                place, f"tendon {name} is pulled in by joint {joint}, which it does not cross; correct one", row=k
            )
        elif (arm := np.abs(known[:, 0]).max()) > _MAX_ARM * finger.length > 0.0 and not any(finger.prismatic):
            report.error(place, f"tendon {name} has a moment arm of {arm:.4g} m; convert mm to m", row=k)
