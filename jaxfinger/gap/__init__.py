"""The sim-to-real gap: where it lies, which effect causes it, how far it shrinks, and what to record next."""

from jaxfinger.gap.diagnose import Diagnosis, Verdict, as_gap_json, diagnose, write
from jaxfinger.gap.known import fit_with

__all__ = ["Diagnosis", "Verdict", "as_gap_json", "diagnose", "fit_with", "write"]
