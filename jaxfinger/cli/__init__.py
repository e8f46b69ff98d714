"""The command line: parse, call, print. Nothing here imports JAX before a command runs."""

from __future__ import annotations

import errno
import io
import logging
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

FULL = (errno.ENOSPC, errno.EDQUOT)


def main(tokens: Sequence[str] | None = None) -> None:
    """Entry point of `jaxfinger`. Exits 2 with one sentence where the user can mend something."""
    _environment()
    _streams()
    from cyclopts import CycloptsError

    from jaxfinger.cli.app import app
    from jaxfinger.errors import UserError

    try:
        app(tokens, exit_on_error=False, result_action="return_none")
        sys.stdout.flush()
    except UserError as error:
        from jaxfinger.cli.output import plain

        print(plain(f"jaxfinger: {error}"), file=sys.stderr)
        raise SystemExit(2) from None
    except CycloptsError:
        raise SystemExit(2) from None  # cyclopts has said what is wrong
    except BrokenPipeError:
        _say_no_more()
        raise SystemExit(1) from None
    except OSError as error:
        if error.errno not in FULL:
            raise
        _say_no_more()
        print(f"jaxfinger: the disk takes no more ({error.strerror}); free space, or write elsewhere", file=sys.stderr)
        raise SystemExit(2) from None
    except Exception:
        platform = os.environ.get("JAX_PLATFORMS")
        if not platform or _computes():
            raise
        print(
            f"jaxfinger: JAX_PLATFORMS names {platform}, which is not there; unset it, or set it to cpu",
            file=sys.stderr,
        )
        raise SystemExit(2) from None


def _say_no_more() -> None:
    """What still waits to be written to stdout is dropped, so that its flush at the end fails no more."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _computes() -> bool:
    """Whether JAX has a device to compute on."""
    import jax

    try:
        return bool(jax.devices())
    except Exception:  # of whatever kind its backends raise
        return False


def _streams() -> None:
    """What the terminal cannot encode is replaced; what libraries warn their callers of is not for a user."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    if not sys.warnoptions:  # `python -W` and PYTHONWARNINGS ask for them
        warnings.showwarning = _unsaid
    logging.getLogger().addHandler(logging.NullHandler())  # else what nobody handles goes to stderr


def _unsaid(message, category, filename, lineno, file=None, line=None) -> None:
    """In the place of `warnings.showwarning`; a filter that makes warnings errors still does."""


def _environment() -> None:
    """Before any import of NumPy or JAX: small factorisations on one thread, compilations kept between runs."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA writes past Python to stderr
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        from platformdirs import user_cache_path

        folder: Path = user_cache_path("jaxfinger", appauthor=False) / "compiled"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            return  # a home without room for a cache: compile each time
        if os.access(folder, os.W_OK):
            os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
