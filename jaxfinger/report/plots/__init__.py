"""Figures as functions: each draws on given Matplotlib axes, or on new ones, and returns them.

>>> import jaxfinger as jf
>>> axes = jf.plot.intervals(jf.load("fit.json"))
>>> axes.figure.savefig("intervals.png")
"""

from jaxfinger.report.plots.fit import correlation, influence, intervals
from jaxfinger.report.plots.gap import budget, closure, residuals, signal
from jaxfinger.report.plots.model import joint_torque, moment_arms, tendon_friction
from jaxfinger.report.plots.validation import against_tension, missed, over_time

__all__ = [
    "against_tension",
    "budget",
    "closure",
    "correlation",
    "influence",
    "intervals",
    "joint_torque",
    "missed",
    "moment_arms",
    "over_time",
    "residuals",
    "signal",
    "tendon_friction",
]
