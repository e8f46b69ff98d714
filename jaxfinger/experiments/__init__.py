"""Experiments: reduction of trials to arrays that a model reads, and prediction of channels from others.

This is the only room that joins data to the model.
"""

from jaxfinger.experiments.predict import change, demean, predict
from jaxfinger.experiments.prepare import Batch, NotJudged, Stack, not_judged, prepare
from jaxfinger.experiments.shapes import SAMPLES, TRIALS, blocks, padded, roomy, split
from jaxfinger.experiments.shows import refuse_broken, shows
from jaxfinger.experiments.table import EXPERIMENTS, Experiment

__all__ = [
    "EXPERIMENTS",
    "SAMPLES",
    "TRIALS",
    "Batch",
    "Experiment",
    "NotJudged",
    "Stack",
    "blocks",
    "change",
    "demean",
    "not_judged",
    "padded",
    "predict",
    "prepare",
    "refuse_broken",
    "roomy",
    "shows",
    "split",
]
