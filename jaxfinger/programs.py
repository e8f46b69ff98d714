"""Compiled programs on disk, which a later process loads without tracing, lowering and compiling them again.

JAX's own cache saves the compilation alone: to look a program up there, JAX traces and lowers it, which takes thirty
times as long as loading it. Here a program is looked up by the structure and the shapes of its arguments, and by all
else that it could depend on: this package's code, the libraries, XLA's options, and the kind of processor.

Programs are kept where the environment variable `JAXFINGER_PROGRAMS` names a folder, as the command line sets it.
A file that no process has read for a month is removed from it, as those of older code.
Whoever may write there can run code in this process, as is true of JAX's cache.
"""

import hashlib
import os
import pickle
import re
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, update_wrapper, wraps
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jax._src.config import persistent_cache_min_compile_time_secs
from jax.core import Tracer
from jax.experimental.serialize_executable import deserialize_and_load, serialize
from jaxlib.lapack import prepare_lapack_call
from jaxlib.xla_client import get_topology_for_devices

Result = TypeVar("Result")

LIBRARIES = ("jax", "jaxlib", "equinox", "numpy")
MONTH = 30 * 86_400.0  # s: whoever comes back later waits for one compilation.
OWN = ("builtins", "jaxfinger", *LIBRARIES)  # packages whose code a key holds


class Program:
    """A function compiled by XLA for each structure of its arguments, and kept on disk.

    Arrays are traced, and all other leaves of the arguments are constants, as for `equinox.filter_jit`. `options` gives
    XLA's options. It is called where a program is compiled, since what XLA knows is found out by compiling.
    """

    def __init__(self, f: Callable, options: Callable[[], dict[str, Any]]):
        update_wrapper(self, f)
        self._f, self._options = f, options
        self._ready: dict[tuple[Any, tuple, bool], Callable] = {}

    def lower(self, *args, **named):
        """Lower the function for arguments like these, as `jax.jit` does."""
        structure, constants, arrays = _parts(args, named)
        return self._jitted(structure, constants).lower(*arrays)

    def __call__(self, *args, **named):
        structure, constants, arrays = _parts(args, named)
        key = structure, constants, _are_kept() and not any(isinstance(a, Tracer) for a in arrays)
        if key not in self._ready:
            self._ready[key] = self._made(*key, arrays)
        return self._ready[key](*arrays)

    def _jitted(self, structure, constants: tuple, compiled_as: str = ""):
        """The function of the arrays alone."""

        def of_arrays(*arrays):
            args, named = _filled(structure, constants, arrays)
            return self._f(*args, **named)

        of_arrays.__name__ = of_arrays.__qualname__ = compiled_as or self._f.__name__
        return jax.jit(of_arrays, compiler_options=self._options())

    def _made(self, structure, constants: tuple, on_disk: bool, arrays: list) -> Callable:
        if not on_disk:
            return self._jitted(structure, constants)
        nodes = list(_nodes(structure))
        said = repr([_name(self._f), _name(self._options), nodes, constants])
        if " at 0x" in said or not all(_is_own(node[0]) for node in nodes):
            return self._jitted(structure, constants)
        name = _digest(said)
        if (known := _loaded(name, len(arrays))) is not None:
            return known
        return self._compiled(name, structure, constants, arrays)

    def _compiled(self, name: str, structure, constants: tuple, arrays: list) -> Callable:
        """Lower the program, and compile it unless other arguments have led to the same one; keep both."""
        lowered = self._jitted(structure, constants, f"kept_{self._f.__name__}").lower(*arrays)
        text, results = lowered.as_text(), lowered.out_tree
        if not all(target.startswith("lapack_") for target in re.findall(r"custom_call @(\w+)", text)):
            # JAX may ready what is called only where it traces; where it is not ready, the loaded program would crash.
            return self._jitted(structure, constants)
        # The text lacks arguments that the function ignores, and the program checks their shapes, too.
        code = _digest(text + repr([_constant(a) for a in arrays]))
        _write(name, pickle.dumps((code, jax.tree.unflatten(results, [0] * results.num_leaves))))
        if (known := _loaded(name, len(arrays))) is not None:
            return known
        # JAX's cache would keep it a second time; and XLA cannot save again what that cache has loaded.
        with persistent_cache_min_compile_time_secs(float("inf")):
            compiled = lowered.compile()
        with suppress(ValueError, NotImplementedError, jax.errors.JaxRuntimeError):  # a program that cannot be saved
            _write(code, serialize(compiled)[0])
        return compiled


def kept(f: Callable[..., Result]) -> Callable[..., Result]:
    """Keep the results of a function of classes and constants, which must be costly, in memory and on disk."""

    @cache
    @wraps(f)
    def recalled(*args):
        said = repr([_name(f), args])
        if not _are_kept() or " at 0x" in said or not all(_is_own(a) for a in args if isinstance(a, type)):
            return f(*args)
        name = _digest(said)
        with suppress(Exception):  # There is no file, or a damaged one, which raises exceptions of many kinds.
            return pickle.loads(_read(name))
        result = f(*args)
        _write(name, pickle.dumps(result))
        return result

    return recalled


def _loaded(name: str, arrays: int) -> Callable | None:
    """The program of that name, which takes so many arrays; None where there is none, or a damaged one."""
    prepare_lapack_call("gesdd_ffi", np.dtype(float))  # JAX does so where it traces a call of LAPACK
    try:
        code, results = pickle.loads(_read(name))
        results = jax.tree.structure(results)
        return deserialize_and_load(_read(code), jax.tree.structure(((0,) * arrays, {})), results)
    except Exception:  # A damaged file raises exceptions of many kinds.
        return None


def _read(name: str) -> bytes:
    """Content of a file; its time becomes that of its last use."""
    content = (_folder() / name).read_bytes()
    with suppress(OSError):  # The folder takes no changes.
        os.utime(_folder() / name)
    return content


def _write(name: str, content: bytes) -> None:
    """Write a file whole, or not at all where the folder takes none."""
    with suppress(OSError):
        _folder().mkdir(parents=True, exist_ok=True)
        _remove_unused(_folder())
        with tempfile.NamedTemporaryFile(dir=_folder(), delete=False) as part:
            part.write(content)
        os.replace(part.name, _folder() / name)


@cache
def _remove_unused(folder: Path) -> None:
    """Remove the files that have not been of use for a month, once in a process that writes new ones."""
    for file in folder.iterdir():
        with suppress(OSError):  # Another process has removed it.
            if file.stat().st_mtime < time.time() - MONTH:
                file.unlink()


def _are_kept() -> bool:
    return bool(os.environ.get("JAXFINGER_PROGRAMS")) and jax.process_count() == 1


def _folder() -> Path:
    return Path(os.environ["JAXFINGER_PROGRAMS"])


def _name(f: Callable) -> str:
    return f"{f.__module__}.{f.__qualname__}"


class Form(NamedTuple):
    """What a program depends on of an array; JAX's own record of that takes three times as long in each call."""

    shape: tuple[int, ...]
    dtype: np.dtype
    weak_type: bool


def _constant(leaf: Any) -> Any:
    """What a program depends on of a leaf: all of it, but of an array its form alone."""
    if not isinstance(leaf, jax.Array | np.ndarray):
        return leaf
    return Form(leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False))


def _parts(args: tuple, named: dict) -> tuple[Any, tuple, list]:
    """Structure of the arguments, what a program depends on of each leaf, and the arrays among the leaves."""
    leaves, structure = jax.tree.flatten((args, named))
    constants = tuple(map(_constant, leaves))
    return structure, constants, [a for a, x in zip(leaves, constants, strict=True) if isinstance(x, Form)]


def _filled(structure, constants: tuple, arrays) -> tuple[tuple, dict]:
    """Arguments of that structure, by position and by name, with new arrays."""
    new = iter(arrays)
    return jax.tree.unflatten(structure, [next(new) if isinstance(x, Form) else x for x in constants])


def _nodes(structure) -> Iterator[tuple[type | None, Any, int]]:
    """Class, constants and number of children of all nodes of a pytree's structure, in order."""
    kind, constants = structure.node_data() or (None, None)
    yield kind, constants, len(structure.children())
    for child in structure.children():
        yield from _nodes(child)


def _is_own(kind: type | None) -> bool:
    """Whether the key tells all about a class: its code belongs to this package or a library, and its name is its own.

    The class of a user's effect, or one made within a function, may be another under the same name.
    """
    return kind is None or (kind.__module__.partition(".")[0] in OWN and "<locals>" not in kind.__qualname__)


def _digest(text: str) -> str:
    """Digest of a text and of what every program depends on."""
    return hashlib.sha256(_surroundings() + text.encode()).hexdigest()


@cache
def _surroundings() -> bytes:
    """Digest of what every program depends on: code, libraries, options, and the processor with its instructions."""
    code = hashlib.sha256()
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        code.update(file.read_bytes())
    processor = get_topology_for_devices(jax.devices()).fingerprint()
    rest = [*map(version, LIBRARIES), processor, os.environ.get("XLA_FLAGS"), jax.config.read("jax_enable_x64")]
    code.update(repr(rest).encode())
    return code.digest()
