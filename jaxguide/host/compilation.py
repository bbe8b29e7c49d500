"""How the outermost calls compile their programs. Host only."""

import contextlib
import functools
import gc
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax


@functools.cache
def quick_compilation() -> dict[str, bool]:
    """Options that halve the time it takes to compile a direct solve, for a fifth of its speed;
    none where this XLA does not know them."""
    options = {"xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda x: x, compiler_options=options).lower(1.0).compile()
    except Exception:  # whatever the backend says of options it does not know
        return {}
    return options


@contextlib.contextmanager
def without_collection() -> Iterator[None]:
    """Python's cyclic collector waits: it frees nothing of a program being traced, and took a
    sixth of the time."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


@functools.cache
def compiled(function: Callable[..., Any], quick: bool) -> Callable[..., Any]:
    """`function` jitted, once for each way to compile it."""
    options: Any = {"compiler_options": (quick and quick_compilation()) or None}
    return eqx.filter_jit(function, **options)
