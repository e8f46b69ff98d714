"""Backends, one file each: `Address` declares the keys of `[address]` in the rig file, `make(description)` the Rig."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxfinger.rig.backend import Rig
    from jaxfinger.rig.channels import RigDescription

NAMES = tuple(module.name for module in iter_modules(__path__))


def open_rig(description: RigDescription) -> Rig:
    """Return the rig that a rig file describes, not yet connected."""
    return import_module(f"{__name__}.{description.backend}").make(description)
