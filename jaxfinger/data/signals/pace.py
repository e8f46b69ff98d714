"""How long trials last and how fast joints move, as numbers and in words: they show a person that times are wrong."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.signals.motion import still_spans
from jaxfinger.data.signals.quantiles import quantile
from jaxfinger.data.signals.sizes import travel_time
from jaxfinger.data.signals.spikes import without_spikes
from jaxfinger.errors import counted

if TYPE_CHECKING:
    from jaxtyping import Float

    from jaxfinger.data.session import Session


def speed(time: Float[np.ndarray, " N"], x: Float[np.ndarray, " N"]) -> float:
    """Speed at which a joint at its fastest passes a tenth of its travel, in the units of x by s; 0 where it rests."""
    lasts, travel = travel_time(time, x[:, None]), _travel(x)
    return 0.1 * travel / lasts if lasts > 0.0 else 0.0


def _travel(x: Float[np.ndarray, " N"]) -> float:
    """Travel without spikes."""
    x = without_spikes(x[:, None])[:, 0]
    x = x[np.isfinite(x)]
    return quantile(x, 0.99) - quantile(x, 0.01) if len(x) else 0.0


def pace_in_words(session: Session) -> str:
    """How long the trials last, and which joint moves fastest: one line to compare with the rig."""
    finger = session.finger
    lasts = [float(trial.time[-1]) for trial in session if len(trial.time)]
    if not lasts:
        return "no trial has a sample"
    short, long = f"{min(lasts):.3g}", f"{max(lasts):.3g}"
    said = f"{counted(len(lasts), 'trial')} of {short if short == long else f'{short} to {long}'} s"
    fastest = {}
    for trial in session:
        for i, still in enumerate(still_spans(finger)):
            if _travel(trial.q[:, i]) > still:
                kind = finger.prismatic[i]
                fastest[kind] = max(fastest.get(kind, (0.0,)), (speed(trial.time, trial.q[:, i]), i, trial.name))
    if not fastest:
        return f"{said}; no joint moves"
    for slides, (rate, i, name) in sorted(fastest.items()):
        size = f"{1e3 * rate:.3g} mm/s" if slides else f"{np.degrees(rate):.3g} degrees/s"
        said += f"; {finger.joint_names[i]} {'slides' if slides else 'turns'} fastest, at {size} in {name}"
    return said
