"""What a set of causes must explain, in log evidence, before it is believed; and the probabilities that follow.

A cause costs the evidence that an imitator would bring where it acts, and the log of the number of its rivals. Rivals
of a further site are the effect's other sites alone: one cause that acts at many sites is one cause.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from jaxfinger.effects import NOMINAL_TERMS, Site
from jaxfinger.gap.formula import Parameters

Key = tuple[str, Site]  # effect, site


@dataclass(frozen=True)
class Costs:
    """Of all sets of causes that the trials of one file can see."""

    parameters: Parameters
    unexplained: Float[np.ndarray, " C"]  # log evidence, column by column, that something is at work
    explainable: Mapping[Key, Float[np.ndarray, " C"]]  # share that each visible cause could explain

    @cached_property
    def sites(self) -> Mapping[str, int]:
        """How many there are of every effect."""
        return Counter(effect for effect, _ in self.explainable)

    def of(self, keys: Iterable[Key]) -> float:
        """What a set must explain."""
        keys = list(keys)
        return self.odds(keys) + self.evidence_needed(keys)

    def odds(self, keys: Iterable[Key]) -> float:
        """Log odds against just these effects and sites, of all that there are. A term that the recipe leaves out is no
        rarity: it is as likely at work as not.
        """
        keys = list(keys)
        effects = {e for e, _ in keys} - set(NOMINAL_TERMS)
        return len(effects) * np.log(len(self.sites)) + sum(np.log(max(self.sites.get(e, 1), 1)) for e, _ in keys)

    @cached_property
    def _to_explain(self) -> Mapping[Key, float]:
        """Log evidence that something is at work, in the columns that each cause touches."""
        return {key: float(share @ self.unexplained) for key, share in self.explainable.items()}

    def evidence_needed(self, keys: Iterable[Key]) -> float:
        """A sum over causes: of each a constant, and a share of the evidence in the columns that it touches."""
        return sum(self.parameters.cause_cost + self.parameters.imitator_gain * self._to_explain[key] for key in keys)

    def probabilities(self, scores: Mapping[frozenset[Key], float]) -> dict[frozenset[Key], float]:
        """Posterior probability of every set: ∝ exp(β (score − evidence needed) − log odds)."""
        beta = self.parameters.tempering
        log_w = [beta * (s - self.evidence_needed(keys)) - self.odds(keys) for keys, s in scores.items()]
        return dict(zip(scores, np.exp(np.array(log_w) - logsumexp(log_w)).tolist(), strict=True))
