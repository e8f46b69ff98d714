"""Identification: staged fits, joint refinement, their uncertainty, and the file of a fit."""

import sys
from types import ModuleType

from jaxfinger.identify.batch import Members, fit_many
from jaxfinger.identify.fit import Fit, StageReport
from jaxfinger.identify.fit_file import load_fit, save_fit
from jaxfinger.identify.identifiability import base_parameters
from jaxfinger.identify.joint import refine
from jaxfinger.identify.posterior import sampled_posterior
from jaxfinger.identify.recipe import Recipe, read_recipe
from jaxfinger.identify.resample import compress, refit
from jaxfinger.identify.sensitivity import Sensitivity, sensitivity
from jaxfinger.identify.stages import STAGES, identify
from jaxfinger.identify.uncertainty import bootstrap, identifiability, robust, sandwich

__all__ = [
    "STAGES",
    "Fit",
    "Members",
    "Recipe",
    "Sensitivity",
    "StageReport",
    "base_parameters",
    "bootstrap",
    "compress",
    "fit_many",
    "identifiability",
    "identify",
    "load_fit",
    "read_recipe",
    "refine",
    "refit",
    "robust",
    "sampled_posterior",
    "sandwich",
    "save_fit",
    "sensitivity",
]


class _Room(ModuleType):
    """Module type that makes the package callable: `jaxfinger.identify(session)` runs `stages.identify`."""

    def __call__(self, *args, **keywords) -> Fit:
        return identify(*args, **keywords)


sys.modules[__name__].__class__ = _Room
