"""How entry points compile their programs. Host only."""

import functools
from collections.abc import Callable
from typing import Any

import jax

from jaxguide.host.executables import Kept, kept
from jaxguide.host.executables import without_collection as without_collection


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


@functools.cache
def brisk_compilation() -> dict[str, Any]:
    """XLA's options with fewer of LLVM's optimisations on a CPU: a sixth less time than by
    `quick_compilation`, for a program an eighth slower (by experiment on shooting)."""
    return _optimised_to(1)


@functools.cache
def hasty_compilation() -> dict[str, Any]:
    """XLA's options without LLVM's optimisations on a CPU: a third to a half of the time of
    `quick_compilation`, for programs up to seven times slower (by experiment on gains)."""
    return _optimised_to(0)


def _optimised_to(level: int) -> dict[str, Any]:
    quick = quick_compilation()
    known = bool(quick) and jax.default_backend() == "cpu"
    return quick | {"xla_backend_optimization_level": level} if known else quick


def kept_quickly(function: Callable[..., Any]) -> Kept:
    """`kept` with `quick_compilation`: for programs that run a few times, or in milliseconds."""
    return kept(function, quick_compilation)


def kept_hastily(function: Callable[..., Any]) -> Kept:
    """`kept` with `hasty_compilation`: for programs that take a second to compile and then run once
    or twice, in milliseconds. Under a trace they are compiled as what they are a part of."""
    return kept(function, hasty_compilation)


@functools.cache
def compiled(function: Callable[..., Any], quick: bool) -> Callable[..., Any]:
    """`function` as by `kept`: once with `quick_compilation`, once without."""
    return kept(function, quick_compilation if quick else None)
