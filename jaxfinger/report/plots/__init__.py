"""Figures as functions: each takes Matplotlib axes, or makes them, and returns them."""

from jaxfinger.report.plots.fit import correlation, influence, intervals
from jaxfinger.report.plots.gap import budget, closure, residuals, signal
from jaxfinger.report.plots.model import joint_torque, moment_arms, tendon_friction

__all__ = [
    "budget",
    "closure",
    "correlation",
    "influence",
    "intervals",
    "joint_torque",
    "moment_arms",
    "residuals",
    "signal",
    "tendon_friction",
]
