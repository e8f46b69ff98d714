"""The sim-to-real gap: where it lies, which effects cause it, how far it shrinks, and what to record next."""

from jaxfinger.gap.diagnose import diagnose
from jaxfinger.gap.known_effects import fit_with
from jaxfinger.gap.result import Diagnosis, Status

__all__ = ["Diagnosis", "Status", "diagnose", "fit_with"]
