"""jaxfinger: dynamic models of tendon-driven fingers from recordings, and diagnosis of the remaining sim-to-real gap.

    import jaxfinger as jf

    session = jf.read("session.h5")
    fit = jf.identify(session)
    diagnosis = jf.diagnose(session)

Names are imported when they are first used, so that nothing loads JAX before it is needed.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0"

if TYPE_CHECKING:
    from jaxfinger.data import Session as Session
    from jaxfinger.data import check_file as check
    from jaxfinger.data import read_predictions as read_predictions
    from jaxfinger.data import read_session as read
    from jaxfinger.data import write_predictions as write_predictions
    from jaxfinger.data import write_session as write
    from jaxfinger.gap.diagnose import diagnose as diagnose
    from jaxfinger.identify import Fit as Fit
    from jaxfinger.identify import fit_many as fit_many
    from jaxfinger.identify import identify as identify
    from jaxfinger.identify import load_fit as load
    from jaxfinger.identify import read_recipe as recipe
    from jaxfinger.identify import refine as refine
    from jaxfinger.identify import save_fit as save
    from jaxfinger.identify.predictions import predict_session as predict
    from jaxfinger.identify.sensitivity import sensitivity as sensitivity
    from jaxfinger.identify.validate import validate as validate
    from jaxfinger.report import plots as plot

_PLACES = {
    "Fit": "identify:Fit",
    "Session": "data:Session",
    "check": "data:check_file",
    "diagnose": "gap.diagnose:diagnose",
    "fit_many": "identify:fit_many",
    "identify": "identify",  # the package itself is callable
    "load": "identify:load_fit",
    "plot": "report.plots",
    "predict": "identify.predictions:predict_session",
    "read": "data:read_session",
    "read_predictions": "data:read_predictions",
    "recipe": "identify:read_recipe",
    "refine": "identify:refine",
    "save": "identify:save_fit",
    "sensitivity": "identify.sensitivity:sensitivity",
    "validate": "identify.validate:validate",
    "write": "data:write_session",
    "write_predictions": "data:write_predictions",
}

__all__ = [
    "Fit",
    "Session",
    "check",
    "diagnose",
    "fit_many",
    "identify",
    "load",
    "plot",
    "predict",
    "read",
    "read_predictions",
    "recipe",
    "refine",
    "save",
    "sensitivity",
    "validate",
    "write",
    "write_predictions",
]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"jaxfinger has no {name!r}; it has {', '.join(sorted(_PLACES))}")
    module, _, attribute = _PLACES[name].partition(":")
    found = import_module(f"jaxfinger.{module}")
    return getattr(found, attribute) if attribute else found


def __dir__() -> list[str]:
    return __all__
