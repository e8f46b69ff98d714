"""Staged fits, joint refinement, their uncertainty, and the file that holds a result."""

from jaxfinger.identify.fit import Fit, StageReport
from jaxfinger.identify.fit_file import load_fit, save_fit
from jaxfinger.identify.joint import refine
from jaxfinger.identify.recipe import Recipe, read_recipe
from jaxfinger.identify.stages import STAGES, identify

__all__ = ["STAGES", "Fit", "Recipe", "StageReport", "identify", "load_fit", "read_recipe", "refine", "save_fit"]
