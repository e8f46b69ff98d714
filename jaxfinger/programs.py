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
from functools import cache, cached_property, update_wrapper, wraps
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
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
        self._ready: dict[Any, Callable[[list], Any]] = {}

    @cached_property
    def _jitted(self):
        return eqx.filter_jit(self._f, compiler_options=self._options())  # type: ignore[call-overload]

    def lower(self, *args, **named):
        """Lower the function for arguments like these, as `equinox.filter_jit` does."""
        return self._jitted.lower(*args, **named)

    def __call__(self, *args, **named):
        if named:  # not looked up on disk
            return self._jitted(*args, **named)
        leaves, structure = jax.tree.flatten(args)
        if not _are_kept() or any(isinstance(leaf, Tracer) for leaf in leaves):
            return self._jitted(*args)
        arrays = [leaf for leaf in leaves if _is_array(leaf)]
        key = structure, tuple(map(_constant, leaves))
        if key not in self._ready:
            self._ready[key] = self._made(key, leaves, arrays)
        return self._ready[key](arrays)

    def _made(self, key: tuple, leaves: list, arrays: list) -> Callable[[list], Any]:
        structure, constants = key
        nodes = list(_nodes(structure))
        said = repr([_name(self._f), _name(self._options), nodes, constants])
        if " at 0x" in said or not all(_is_own(node[0]) for node in nodes):
            return lambda arrays: self._jitted(*_filled(structure, leaves, arrays))
        name = _digest(said)
        if (known := _loaded(name, len(arrays))) is not None:
            return known
        return self._compiled(name, structure, leaves, arrays)

    def _compiled(self, name: str, structure, leaves: list, arrays: list) -> Callable[[list], Any]:
        """Lower the program, and compile it unless other arguments have led to the same one; keep both."""
        results: Any = None

        def flat(*arrays):
            nonlocal results
            out, results = jax.tree.flatten(self._f(*_filled(structure, leaves, arrays)))
            return out

        flat.__name__ = flat.__qualname__ = f"kept_{self._f.__name__}"
        lowered = jax.jit(flat, compiler_options=self._options()).lower(*arrays)
        text = lowered.as_text()
        if not all(target.startswith("lapack_") for target in re.findall(r"custom_call @(\w+)", text)):
            # JAX may ready what is called only where it traces; where it is not ready, the loaded program would crash.
            return lambda arrays: self._jitted(*_filled(structure, leaves, arrays))
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
        return lambda arrays: jax.tree.unflatten(results, compiled(*arrays))


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


def _loaded(name: str, arrays: int) -> Callable[[list], Any] | None:
    """The program of that name, which takes so many arrays; None where there is none, or a damaged one."""
    prepare_lapack_call("gesdd_ffi", np.dtype(float))  # JAX does so where it traces a call of LAPACK
    try:
        code, results = pickle.loads(_read(name))
        results = jax.tree.structure(results)
        takes, returns = (jax.tree.structure(tree) for tree in (((0,) * arrays, {}), [0] * results.num_leaves))
        compiled = deserialize_and_load(_read(code), takes, returns)
    except Exception:  # A damaged file raises exceptions of many kinds.
        return None
    return lambda arrays: jax.tree.unflatten(results, compiled(*arrays))


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


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray)


def _constant(leaf: Any) -> Any:
    """What a program depends on of a leaf: all of it, but of an array its shape and type alone."""
    return (leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)) if _is_array(leaf) else leaf


def _filled(structure, leaves: list, arrays) -> Any:
    """Arguments of that structure, with new arrays."""
    new = iter(arrays)
    return jax.tree.unflatten(structure, [next(new) if _is_array(leaf) else leaf for leaf in leaves])


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
