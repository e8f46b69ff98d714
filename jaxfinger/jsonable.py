"""Values as JSON has them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any


def jsonable(value: Any) -> Any:
    """Value with None for NaN and infinities, which JSON does not have, and with text for paths and keys.

    >>> jsonable({"std": float("inf"), "seen": (0.5, float("nan"))})
    {'std': None, 'seen': [0.5, None]}
    """
    match value:
        case dict():
            return {str(k): jsonable(v) for k, v in value.items()}
        case list() | tuple():
            return [jsonable(v) for v in value]
        case float() if not math.isfinite(value):
            return None
        case Path():
            return str(value)
    return value
