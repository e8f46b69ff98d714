"""Command line: parse, call, print. Nothing here imports JAX before a command runs."""

from __future__ import annotations

import ctypes
import errno
import gc
import io
import logging
import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
INTERRUPTED = 130  # exit code after Ctrl-C, as shells have it
# Options of glibc's malloc.h: the number of heaps, the size from which a block is mapped apart (32 MiB at most), and
# the free memory from which a heap is given back. By default each array of a channel is mapped anew, and the kernel
# clears its pages, which takes a tenth of the time of `identify`.
M_ARENA_MAX, M_MMAP_THRESHOLD, M_TRIM_THRESHOLD = -8, -3, -1
HEAPS, MAPPED, KEPT_FREE = 1, 2**25, 2**29
# Collections of young objects before one of all objects. With Python's 10 a quick diagnosis spends a second in
# searching the million objects of JAX's modules and programs, and finds next to nothing to free.
FULL_COLLECTIONS = 100


def main(tokens: Sequence[str] | None = None) -> None:
    """Entry point of `jaxfinger`. A mistake that the user can mend ends in one sentence and exit code 2."""
    try:
        _run(tokens)
    except KeyboardInterrupt:  # While modules are imported; cyclopts takes it once a command runs.
        raise SystemExit(INTERRUPTED) from None


def _run(tokens: Sequence[str] | None) -> None:
    """Run the command that the line names."""
    _environment()
    _one_heap()
    gc.set_threshold(*gc.get_threshold()[:2], FULL_COLLECTIONS)
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
        raise SystemExit(2) from None  # cyclopts has printed the message.
    except BrokenPipeError:
        _discard_stdout()
        raise SystemExit(1) from None
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        _discard_stdout()
        print(f"jaxfinger: the disk takes no more ({error.strerror}); free space, or write elsewhere", file=sys.stderr)
        raise SystemExit(2) from None
    except Exception:  # Without a device JAX raises exceptions of many kinds; every other error is raised again.
        platform = os.environ.get("JAX_PLATFORMS")
        if not platform or _has_device():
            raise
        print(
            f"jaxfinger: JAX_PLATFORMS names {platform}, which is not there; unset it, or set it to cpu",
            file=sys.stderr,
        )
        raise SystemExit(2) from None


def _discard_stdout() -> None:
    """Discard buffered output, so that the flush of stdout at exit cannot fail again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _has_device() -> bool:
    """Whether JAX has a device to compute on."""
    import jax

    try:
        return bool(jax.devices())
    except Exception:  # JAX's backends raise exceptions of many kinds.
        return False


def _streams() -> None:
    """Replace characters that the terminal cannot encode, and hide warnings that libraries address to programmers."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    if not sys.warnoptions:  # `python -W` and PYTHONWARNINGS ask for warnings.
        warnings.showwarning = _hide_warning
    logging.getLogger().addHandler(logging.NullHandler())  # Without a handler, log records go to stderr.


def _hide_warning(message, category, filename, lineno, file=None, line=None) -> None:
    """Stand in for `warnings.showwarning` and print nothing. Filters that turn warnings into errors still work."""


def _one_heap() -> None:
    """Let all threads share one heap, which keeps what is freed. By default glibc gives each its own.

    What one thread has freed no other could use. Other C libraries have one heap for all, or no such option.
    """
    with suppress(AttributeError, OSError, TypeError):
        for option, value in ((M_ARENA_MAX, HEAPS), (M_MMAP_THRESHOLD, MAPPED), (M_TRIM_THRESHOLD, KEPT_FREE)):
            ctypes.CDLL(None).mallopt(option, value)


def _environment() -> None:
    """Set environment variables before NumPy and JAX are imported: one thread for BLAS, and a cache of compilations."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `compilation.one_blas_thread` for callers from Python
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA writes to stderr without Python's logging.
    # Programs are lowered an eighth quicker where operations do not carry the lines of Python that they come from.
    os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        from platformdirs import user_cache_path

        folder: Path = user_cache_path("jaxfinger", appauthor=False) / "compiled"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            return  # The home folder cannot hold a cache, so each run compiles anew.
        if os.access(folder, os.W_OK):
            os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    if cached := os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        os.environ.setdefault("JAXFINGER_PROGRAMS", str(Path(cached, "programs")))
