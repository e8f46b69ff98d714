"""Which combinations of parameters the trials cannot see, in words."""

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.identify.parameters import Parameter


def name_invisible(
    parameters: list[Parameter], free: Int[np.ndarray, " p"], invisible: Float[np.ndarray, "k p"]
) -> list[str]:
    """One sentence a combination: its parameters with their shares, largest first."""
    sentences = []
    for combination in invisible:
        order = np.argsort(-np.abs(combination))
        share = [(k, combination[k]) for k in order if abs(combination[k]) > 0.05]
        names = " ".join(f"{c:+.2f}·[{parameters[free[k]].name}]" for k, c in share)
        sentences.append(f"the trials cannot see the combination {names} (in units of each parameter's own column)")
    return sentences
