"""Programs of entry points, compiled once for each machine and version: kept between processes in
`jaxguide.host.cache`. Host only; no setting of JAX is changed."""

import contextlib
import functools
import gc
import hashlib
import importlib.metadata
import inspect
import operator
import os
import pickle
import platform
import re
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jax.experimental import serialize_executable

from jaxguide.host import cache, fingerprint, flags

# A call of Python out of a program holds an address of this process.
_CALLBACK = re.compile(r"custom_call @\w*callback")
# What XLA's loader prints about options of its own that no machine has ("prefer-no-gather").
_NOISE = b"cpu_aot_loader"
# Settings of JAX that decide how a program is traced or compiled.
_SETTINGS = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_softmax_custom_jvp",
    "jax_optimization_level",
    "jax_exec_time_optimization_effort",
    "jax_memory_fitting_level",
)
# Settings under which every operation must be JAX's own.
_CHECKS = ("jax_disable_jit", "jax_debug_nans", "jax_debug_infs", "jax_check_tracer_leaks")


def kept(
    function: Callable[..., Any], options: Callable[[], dict[str, Any]] | None = None
) -> "Kept":
    """`function` as by `eqx.filter_jit`, its programs kept between processes.

    A program of another process is found by what decides it, without a trace (`fingerprint`), or
    where that is not told by its own text; and by the machine, the versions and the options.
    Nothing is kept with an empty `JAXGUIDE_CACHE_DIR`, and with a compilation cache of JAX's own:
    an executable that JAX has loaded cannot be kept again. Under a trace it is the jitted function,
    and so it is on several devices, and for programs that call back into Python.

    **Arguments:** `function`: pure, without arrays of its own (a function of a module); `options`:
    gives XLA's options when they are first needed, such as `quick_compilation`.
    """
    return Kept(function, options)


class Kept:
    """A function by `kept`."""

    def __init__(self, function: Callable[..., Any], options: Callable[[], dict[str, Any]] | None):
        functools.update_wrapper(self, function)
        self.__wrapped__ = function
        self.__signature__ = inspect.signature(function)
        self._of_compiler = options
        self._programs: dict[Any, _Program] = {}
        self._lock = threading.Lock()

    @functools.cached_property
    def _options(self) -> dict[str, Any]:
        return {} if self._of_compiler is None else self._of_compiler()

    @functools.cached_property
    def _jitted(self) -> Any:
        options: Any = {"compiler_options": self._options or None}
        return eqx.filter_jit(self.__wrapped__, **options)

    @functools.cached_property
    def _inside(self) -> Any:
        """The jitted function under a trace, which takes no options of its own."""
        return eqx.filter_jit(self.__wrapped__)

    @functools.cached_property
    def _flat(self) -> Any:
        """The function jitted, of arrays and what is left."""
        function = self.__wrapped__

        def flat(arrays: list[Any], static: _Static) -> tuple[Any, _Aside]:
            given = iter(arrays)
            leaves = [next(given) if leaf is _ARRAY else leaf for leaf in static.leaves]
            args, kwargs = jax.tree_util.tree_unflatten(static.structure, leaves)
            moved, still = eqx.partition(function(*args, **kwargs), eqx.is_array)
            return moved, _Aside(still)

        flat.__name__ = getattr(function, "__name__", "kept")
        # Unused arguments stay: which ones they are does not stand in the text of a program.
        options = self._options or None
        return jax.jit(flat, static_argnums=1, keep_unused=True, compiler_options=options)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        given = _given(args, kwargs)
        if given is None:
            return self._inside(*args, **kwargs)
        arrays, static, kinds = given
        try:
            out = None
            if not _stands_aside(arrays):
                program = self._program((static, kinds, _settings()))
                out = program.run(self, arrays, static, (args, kwargs))
            moved, still = jax.block_until_ready(self._flat(arrays, static)) if out is None else out
        except jax.errors.JaxRuntimeError:  # Equinox says its own errors better
            return self._jitted(*args, **kwargs)
        return eqx.combine(moved, still.value)

    def is_kept(self, *args: Any, **kwargs: Any) -> bool:
        """Whether an earlier process kept the program for these arguments, told without a trace."""
        given = _given(args, kwargs)
        if given is None or _stands_aside(given[0]) or not _keeps():
            return False
        known = _told_key(self, (args, kwargs))
        return known is not None and cache.read(known) is not None

    def lower(self, *args: Any, **kwargs: Any) -> jax.stages.Lowered:
        """The program for these arguments, lowered; a call finds it traced."""
        given = _given(args, kwargs)
        assert given is not None, "lower: an argument is traced"
        return self._flat.lower(*given[:2])

    def eval_shape(self, *args: Any, **kwargs: Any) -> Any:
        """Shapes and types of the result; a call finds the program traced."""
        given = _given(args, kwargs)
        assert given is not None, "eval_shape: an argument is traced"
        moved, still = self._flat.eval_shape(*given[:2])
        return eqx.combine(moved, still.value)

    def _program(self, key: Any) -> "_Program":
        """The program of this key, made or to be made."""
        program = self._programs.get(key)
        if program is None:
            with self._lock:
                program = self._programs.setdefault(key, _Program())
        return program


class _Static(NamedTuple):
    """Arguments without their arrays: the leaves, with `_ARRAY` for each array, their types (1, 1.0
    and True are equal), and the structure."""

    leaves: tuple[Any, ...]
    types: tuple[type, ...]
    structure: Any


def _given(args: tuple, kwargs: dict[str, Any]) -> tuple[list[Any], _Static, tuple] | None:
    """The arrays of arguments, what is left, and the kind of each array; None under a trace."""
    leaves, structure = jax.tree_util.tree_flatten((args, kwargs))
    arrays, rest, kinds = [], [], []
    for leaf in leaves:
        described = _describing(type(leaf))
        if described is _TRACER:
            return None
        if described is None:
            rest.append(leaf)
        else:
            arrays.append(leaf)
            rest.append(_ARRAY)
            kinds.append(described(leaf))
    return arrays, _Static(tuple(rest), tuple(map(type, rest)), structure), tuple(kinds)


_TRACER = object()


@functools.cache
def _describing(leaf: type) -> Any:
    """How to describe an array of this type to a compiler; None for what is no array."""
    if issubclass(leaf, Tracer):
        return _TRACER
    if issubclass(leaf, jax.Array):
        return operator.attrgetter("aval")
    if issubclass(leaf, (np.ndarray, np.generic)):
        return operator.attrgetter("shape", "dtype")
    return None


class _Mark:
    """Stands for an array among static leaves."""


_ARRAY = _Mark()


class _Aside(eqx.Module):
    """A value that is no array, carried out of a program in the structure of its result."""

    value: Any = eqx.field(static=True)


class _Program:
    """A program, made at its first run; other threads wait for it."""

    def __init__(self):
        self._call: Any = None  # takes the arrays; None as well where it cannot be kept
        self._made = False
        self._lock = threading.Lock()

    def run(self, of: Kept, arrays: list[Any], static: _Static, arguments: tuple) -> Any:
        """What it gives for `arrays`, ready; None if it cannot be kept."""
        if not self._made:
            with self._lock:
                if not self._made:
                    self._call, out = _made(of, arrays, static, arguments)
                    self._made = True
                    if out is not None:
                        return out
        return None if self._call is None else jax.block_until_ready(self._call(arrays))


def _made(of: Kept, arrays: list[Any], static: _Static, arguments: tuple) -> tuple[Any, Any]:
    """The program loaded and what it gave for `arrays`, or else compiled and kept, and None; two
    None if it calls back into Python."""
    keeps = _keeps()
    known = _told_key(of, arguments) if keeps else None
    if known is not None and (found := _found(known, None, arrays)) is not None:
        return found
    flat, options = of._flat, of._options
    with without_collection():
        traced = flat.trace(arrays, static)
        lowered = traced.lower()
    text = lowered.as_text()
    if _CALLBACK.search(text):
        return None, None
    if not keeps:
        return lowered.compile(), None
    structure = jax.tree_util.tree_unflatten(lowered.out_tree, [0] * lowered.out_tree.num_leaves)
    key, packed = known, _packed(structure)
    if key is None or packed is None:
        # Types of the results and their weakness do not stand in the text.
        types = [str(aval) for aval in (*traced.jaxpr.in_avals, *traced.jaxpr.out_avals)]
        key = _key(text, *types, repr(sorted(options.items())), repr(_settings()))
        if (found := _found(key, lowered.out_tree, arrays)) is not None:
            return found
        packed = b""
    compiled = lowered.compile()
    try:
        cache.keep(key, pickle.dumps((serialize_executable.serialize(compiled)[0], packed)))
    except Exception:  # a backend may have any reason, of any type, not to serialise
        pass
    return compiled, None


def _told_key(of: Kept, arguments: tuple) -> str | None:
    """The key by what decides the program, which needs no trace; None where that is not told."""
    try:
        told = fingerprint.told(of.__wrapped__, arguments)
    except fingerprint.Untold:
        return None
    options = getattr(of._of_compiler, "__qualname__", "")
    errors = os.environ.get("EQX_ON_ERROR", "")  # what Equinox's checks become
    return _key("told", told, fingerprint.known_code(), options, errors, repr(_settings()))


def _packed(structure: Any) -> bytes | None:
    """The structure of a result, a number at each array; None where it cannot be packed."""
    try:
        return pickle.dumps(structure)
    except Exception:  # a class may have any reason not to be pickled
        return None


def _found(key: str, structure: Any, arrays: list[Any]) -> tuple[Any, Any] | None:
    """The program kept by `key` and what it gives for `arrays`: one whose parts are missing fails
    only when it is run. None if there is none. `structure`: of its result; None: as kept."""
    data = cache.read(key)
    if data is None:
        return None
    try:
        program, packed = pickle.loads(data)
        if structure is None:
            structure = jax.tree_util.tree_structure(pickle.loads(packed))
        given = jax.tree_util.tree_structure(((arrays,), {}))
        if b"lapack_" in program:
            _lapack_found()
        with _without_noise():
            loaded = serialize_executable.deserialize_and_load(
                program, given, structure, execution_devices=jax.devices()[:1]
            )
        return loaded, jax.block_until_ready(loaded(arrays))
    except Exception:  # unpickling and XLA's loader may raise anything
        cache.remove(key)
        return None


@functools.cache
def _lapack_found() -> None:
    """Has JAX look up SciPy's LAPACK, as it does when it lowers a call of it: a program that was
    loaded without a trace would call nothing, and crash."""
    jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), np.float32))


def _key(*parts: str) -> str:
    """A name for a program in the cache."""
    digest = hashlib.sha256()
    for part in (*parts, *_here()):
        digest.update(f"{len(part)}:".encode() + part.encode())
    return digest.hexdigest()


@functools.cache
def _here() -> tuple[str, ...]:
    """Everything that decides a program besides its text, which holds all of this package that
    matters: versions, machine, options of XLA."""
    versions = [importlib.metadata.version(name) for name in ("jax", "jaxlib")]
    device = jax.devices()[0]
    backend = device.client
    machine = [platform.system(), platform.machine(), *_processor(), str(os.cpu_count())]
    kind = [backend.platform, backend.platform_version, device.device_kind]
    return (*versions, *machine, *kind, flags.deciding(), sys.byteorder)


def _processor() -> list[str]:
    """Model and features of the first processor, as far as the system says."""
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            lines = file.read().split("\n\n")[0].splitlines()
    except OSError:
        return [platform.processor()]
    wanted = ("model name", "flags", "Features", "CPU part", "CPU implementer", "vendor_id")
    return sorted(line for line in lines if line.partition("\t")[0].strip(": ") in wanted)


def _settings() -> tuple:
    return tuple(getattr(jax.config, name, None) for name in _SETTINGS)


def _keeps() -> bool:
    """Whether programs are kept: see `kept`."""
    config: Any = jax.config
    own = config.jax_compilation_cache_dir and config.jax_enable_compilation_cache
    return cache.folder() is not None and not own


def _stands_aside(arrays: list[Any]) -> bool:
    """Whether JAX's own ways are to be taken: see `kept`."""
    devices = jax.devices()
    return (
        any(getattr(jax.config, name) for name in _CHECKS)
        or len(devices) > 1
        # Beside an accelerator arrays may lie on the host.
        or (devices[0].platform != "cpu" and any(_elsewhere(a, devices[0]) for a in arrays))
    )


def _elsewhere(array: Any, device: Any) -> bool:
    return isinstance(array, jax.Array) and array.devices() != {device}


@contextlib.contextmanager
def without_collection() -> Iterator[None]:
    """Stops Python's cyclic garbage collector inside the block: it frees nothing of a program that
    is being traced, and took a sixth of the time (by experiment on direct solves)."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


_redirecting = threading.Lock()


@contextlib.contextmanager
def _without_noise() -> Iterator[None]:
    """Keeps the warnings of XLA's loader, which C++ writes to file descriptor 2, off it. What else
    is written there meanwhile, by any thread, follows at the end of the block."""
    with _redirecting, tempfile.TemporaryFile() as aside:
        try:
            stderr = os.dup(2)
        except OSError:  # this process has none
            yield
            return
        try:
            os.dup2(aside.fileno(), 2)
            yield
        finally:
            os.dup2(stderr, 2)
            aside.seek(0)
            for line in aside.readlines():
                if _NOISE not in line:
                    os.write(stderr, line)
            os.close(stderr)
