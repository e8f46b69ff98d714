"""Units that a mapping may name, and what one of them is in SI."""

from __future__ import annotations

import math

# (SI unit, factor)
TO_SI = {
    "rad": ("rad", 1.0),
    "mrad": ("rad", 1e-3),
    "deg": ("rad", math.pi / 180.0),
    "turn": ("rad", 2.0 * math.pi),
    "m": ("m", 1.0),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    "um": ("m", 1e-6),
    "N": ("N", 1.0),
    "mN": ("N", 1e-3),
    "kN": ("N", 1e3),
    "N m": ("N m", 1.0),
    "N cm": ("N m", 1e-2),
    "N mm": ("N m", 1e-3),
    "mN m": ("N m", 1e-3),
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
    "K": ("K", 1.0),
    "1": ("1", 1.0),
}
_SPELT = {"°": "deg", "degrees": "deg", "µm": "um", "µs": "us", "rev": "turn", "sec": "s"}


def known(stated: str) -> str:
    """A file's spelling of a unit as the one that a mapping uses; empty where it is none of these."""
    plain = stated.strip().replace("·", " ").replace("*", " ").replace("µ", "u")
    plain = _SPELT.get(plain.lower(), plain)
    joined = {name.replace(" ", ""): name for name in TO_SI if name != "1"}
    return joined.get(plain.replace(" ", ""), "")
