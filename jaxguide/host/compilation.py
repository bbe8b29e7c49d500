"""How entry points compile their programs. Host only."""

import contextlib
import functools
import gc
from collections.abc import Callable, Iterator
from typing import Any

import jax

from jaxguide.host.executables import kept


@functools.cache
def quick_compilation() -> dict[str, bool]:
    """XLA's options that halve the time to compile a direct solve and make it a fifth slower (by
    experiment); none if this XLA does not know them."""
    options = {"xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda x: x, compiler_options=options).lower(1.0).compile()
    except Exception:  # a backend may raise any error for an option that it does not know
        return {}
    return options


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


@functools.cache
def compiled(function: Callable[..., Any], quick: bool) -> Callable[..., Any]:
    """`function` as by `kept`: once with `quick_compilation`, once without."""
    return kept(function, compiler_options=(quick and quick_compilation()) or None)
