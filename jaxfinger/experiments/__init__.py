"""Experiments: reduction of trials to arrays that a model reads, and prediction of channels from others.

This is the only room that joins data to the model.
"""

from jaxfinger.experiments.affected import affected_channels, differs_in_repeats, refuse_broken
from jaxfinger.experiments.predict import change, demean, predict, predict_compiled
from jaxfinger.experiments.prepare import Batch, NotJudged, Stack, not_judged, prepare
from jaxfinger.experiments.shapes import SAMPLES, TRIALS, Block, blocks, in_rows, padded, padded_size, split
from jaxfinger.experiments.table import EXPERIMENTS, Experiment

__all__ = [
    "EXPERIMENTS",
    "SAMPLES",
    "TRIALS",
    "Batch",
    "Block",
    "Experiment",
    "NotJudged",
    "Stack",
    "affected_channels",
    "blocks",
    "change",
    "demean",
    "differs_in_repeats",
    "in_rows",
    "not_judged",
    "padded",
    "padded_size",
    "predict",
    "predict_compiled",
    "prepare",
    "refuse_broken",
    "split",
]
