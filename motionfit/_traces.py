"""Traced programs, kept in a folder from one process to the next.

JAX's own cache keeps what XLA compiled, and asks for it by the program's text, which is known once Python has traced
it: ten seconds for the blocks of an adaptation, where loading what was compiled takes one. So the text is kept too
(`jax.export`), under everything that it is made from: the source files, the versions of the libraries, the shapes, and
all that is not an array. What holds functions or classes from elsewhere is not kept: they may change unseen.
"""

import functools
import hashlib
import importlib.metadata
import io
import os
import pathlib
import pickle
import threading
import types
from collections.abc import Callable

import equinox as eqx
import jax
from jax import export

from motionfit._cache import cache_folder, remember
from motionfit._types import InputError

LIBRARIES = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy")  # what a trace may speak of, besides us
SETTINGS = ("jax_enable_x64", "jax_default_matmul_precision", "jax_numpy_dtype_promotion", "jax_debug_nans")
KNOWN = {"motionfit", "builtins", *LIBRARIES}
_folder: pathlib.Path | None = None


def keep_programs(folder: str | os.PathLike | None = None) -> None:
    """From now on keep what is traced and compiled in a folder, and look there first: the command line does so.

    None: the one that JAX_COMPILATION_CACHE_DIR names (empty: none, nothing is kept), else `xla` in the cache folder,
    MOTIONFIT_CACHE or the user's. Call it once, before the first adaptation.
    """
    global _folder
    chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if folder is None and chosen == "":
        return
    place = pathlib.Path(folder or chosen or cache_folder() / "xla")
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if folder is None:
            return  # a cache that cannot be written costs time, nothing else
        raise InputError(f"{place}: cannot be made a folder ({error.strerror}); choose another") from None
    _folder = place
    jax.config.update("jax_compilation_cache_dir", str(place))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def programs_folder() -> pathlib.Path | None:
    """The folder that `keep_programs` named."""
    return _folder


def kept(fn: Callable, jitted: Callable[[Callable], Callable]) -> Callable:
    """`jitted(fn)`, which takes its trace from the folder where there is one and the trace is there."""
    ready: dict = {}
    plain = functools.cache(lambda: jitted(fn))
    lock = threading.Lock()

    @functools.wraps(fn)
    def call(*args, **kwargs):
        if _folder is None:
            return plain()(*args, **kwargs)
        arrays, rest = eqx.partition((args, kwargs), eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        shapes = tuple((x.shape, str(x.dtype), getattr(x, "weak_type", False)) for x in leaves)
        key = structure, tuple((type(x), x) for x in jax.tree.leaves(rest)), shapes, _settings()
        with lock:  # two blocks of one structure side by side trace it once; others do not wait
            mine = ready.setdefault(key, threading.Lock())
        if not callable(mine):
            with mine:
                if not callable(ready[key]):
                    ready[key] = _program(fn, rest, structure, leaves, repr((shapes, _settings())), jitted) or plain()
                mine = ready[key]
        return mine(*args, **kwargs)

    return call


def _program(fn, rest, structure, leaves, about: str, jitted: Callable) -> Callable | None:
    """The program from the folder, else traced and put there; None for one that cannot be kept."""
    assert _folder is not None
    key = _key(fn, rest, about)
    if key is None:
        return None
    file = _folder / f"{fn.__name__}-{key}.trace"
    try:
        text, shape = pickle.loads(file.read_bytes())
        exported = export.deserialize(bytearray(text))
    except Exception:  # missing, cut off or unreadable: whatever it is, it can be made again
        found = _traced(fn, rest, structure, leaves)
        if found is None:
            return None
        exported, shape = found
        remember(file, pickle.dumps((bytes(exported.serialize()), shape)))
    run, back = jitted(exported.call), jax.tree.structure(shape)

    def call(*args, **kwargs):
        given = jax.tree.leaves(eqx.filter((args, kwargs), eqx.is_array))
        return jax.tree.unflatten(back, run(*given))

    return call


def _traced(fn, rest, structure, leaves):
    """A function's program, and its result with numbers in place of the arrays; None where it cannot be kept."""
    shape = None

    def flat(*given):
        nonlocal shape
        args, kwargs = eqx.combine(jax.tree.unflatten(structure, given), rest)
        found, back = jax.tree.flatten(fn(*args, **kwargs))
        if not all(eqx.is_array(x) for x in found):
            raise TypeError("a result that is not an array")
        shape = jax.tree.unflatten(back, range(len(found)))
        return found

    try:
        return export.export(jax.jit(flat))(*leaves), shape
    except (TypeError, ValueError, NotImplementedError):  # calls back to the host, or into a library that may change
        return None


class _OnlyKnown(pickle.Pickler):
    def reducer_override(self, obj):
        if isinstance(obj, type | types.FunctionType | types.BuiltinFunctionType):
            if not _known(obj):
                raise pickle.PicklingError(f"{obj.__qualname__} is from elsewhere")
        return NotImplemented


def _known(obj) -> bool:
    return (obj.__module__ or "").partition(".")[0] in KNOWN


def _key(fn: Callable, rest, about: str) -> str | None:
    """The name of a trace; None where something is not known well enough to tell whether it changed."""
    if not _known(fn):
        return None
    written = io.BytesIO()
    try:
        _OnlyKnown(written).dump(rest)
    except (pickle.PicklingError, TypeError, AttributeError):
        return None
    parts = (fn.__module__, fn.__qualname__, about, _sources())
    return hashlib.sha256(repr(parts).encode() + written.getvalue()).hexdigest()[:24]


def _settings() -> tuple:
    return (jax.default_backend(), *(getattr(jax.config, name) for name in SETTINGS))


@functools.cache
def _sources() -> str:
    """A digest of motionfit's own files and of the libraries' versions."""
    root, digest = pathlib.Path(__file__).parent, hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        digest.update(str(file.relative_to(root)).encode() + file.read_bytes())
    digest.update(repr([importlib.metadata.version(name) for name in LIBRARIES]).encode())
    return digest.hexdigest()
