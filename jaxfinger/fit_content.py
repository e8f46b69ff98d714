"""Content of the file of a fit, read without JAX, which takes seconds to start."""

import json
import os
from pathlib import Path
from typing import Any

from jaxfinger.errors import UserError

SCHEMA = "jaxfinger-fit/2"
HDF5 = b"\x89HDF\r\n\x1a\n"  # first bytes of an HDF5 file, such as a session


def read_content(path: str | os.PathLike) -> dict[str, Any]:
    """Read the content of a file that `identify` wrote.

    Raises:
        UserError: the file cannot be read, or is no fit.
    """
    try:
        raw = Path(path).read_bytes()
        if raw.startswith(HDF5):
            raise UserError(f"{path}: is an HDF5 file and no fit; `check` a session, or `identify` it first")
        content = json.loads(raw.decode("utf-8"))
    except OSError as e:
        raise UserError(f"{path}: cannot be read ({e.strerror}); give a file that `identify` wrote") from None
    except ValueError as e:
        raise UserError(f"{path}: is not a fit ({e}); give a file that `identify` wrote") from None
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        found = content.get("schema") if isinstance(content, dict) else None
        raise UserError(f"{path}: has schema {found!r} where {SCHEMA!r} is read; identify the session again")
    return content
