"""The only place that joins data to model: which trials an experiment takes, and what it predicts from what."""

from jaxfinger.experiments.predict import demean, predict
from jaxfinger.experiments.prepare import Batch, Stack, prepare
from jaxfinger.experiments.shapes import roomy, widened
from jaxfinger.experiments.table import EXPERIMENTS, Experiment

__all__ = ["EXPERIMENTS", "Batch", "Experiment", "Stack", "demean", "predict", "prepare", "roomy", "widened"]
