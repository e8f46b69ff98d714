"""Costs of sets of causes, in nats of log evidence, and the posterior probabilities of sets.

A set costs the log of the prior odds against it, and the evidence that imitators of the true causes would bring:

    cost = Σ_effects log E + Σ_causes [ log S_effect + cause_cost + imitator_gain Σ_c τ_c u_c ].

E is the number of effects that the trials can see, S_effect the number of sites where they can see an effect. So an
effect at one site more costs less than another effect. u_c is the evidence in column c that something is at work
(`formula.unexplained`), and τ_c the share of that column's gap which the cause would explain if it were as large as the
whole gap.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import fsum, log

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from jaxfinger.effects import NOMINAL_TERMS, Site
from jaxfinger.gap.formula import Parameters

CauseKey = tuple[str, Site]  # A cause in the search: id of the effect, and site. A diagnosis holds it as `result.Key`.


@dataclass(frozen=True)
class Costs:
    """Costs of all sets of causes that the trials of one file can see.

    Sums are rounded once (`fsum`), so that they do not depend on the order of a set, which differs between processes.
    """

    parameters: Parameters
    unexplained: Float[np.ndarray, " C"]  # u_c, nats
    explainable: Mapping[CauseKey, Float[np.ndarray, " C"]]  # τ_c of every cause that the trials can see

    @cached_property
    def sites(self) -> Mapping[str, int]:
        """Number of sites of every effect."""
        return Counter(effect for effect, _ in self.explainable)

    def of(self, keys: Iterable[CauseKey]) -> float:
        """Cost of a set, nats: log odds against it and the evidence that its causes need."""
        keys = list(keys)
        return self.odds(keys) + self.evidence_needed(keys)

    def odds(self, keys: Iterable[CauseKey]) -> float:
        """Log prior odds against these effects and sites: Σ_effects log E + Σ_causes log S_effect.

        A term of the nominal model that the recipe leaves out costs no log E, since it is as likely at work as not.
        """
        keys = list(keys)
        effects = {e for e, _ in keys} - set(NOMINAL_TERMS)
        return len(effects) * log(len(self.sites) or 1) + fsum(log(self.sites.get(e, 1) or 1) for e, _ in keys)

    @cached_property
    def _evidence_where_it_acts(self) -> Mapping[CauseKey, float]:
        """Σ_c τ_c u_c of every cause."""
        return {key: float(share @ self.unexplained) for key, share in self.explainable.items()}

    def evidence_needed(self, keys: Iterable[CauseKey]) -> float:
        """Log evidence that a set's causes must bring, summed over the causes."""
        p, there = self.parameters, self._evidence_where_it_acts
        return fsum(p.cause_cost + p.imitator_gain * there[key] for key in keys)

    def probabilities(self, scores: Mapping[frozenset[CauseKey], float]) -> dict[frozenset[CauseKey], float]:
        """Posterior probability of every set, ∝ exp(β (score − evidence needed) − log odds)."""
        beta = self.parameters.tempering
        log_w = [beta * (s - self.evidence_needed(keys)) - self.odds(keys) for keys, s in scores.items()]
        return dict(zip(scores, np.exp(np.array(log_w) - logsumexp(log_w)).tolist(), strict=True))
