"""Guesses of the wrong kind, refused with the remedy. Shapes and types alone count, which a trace
does not hide."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.nominal.method import Method
from jaxguide.problem import Problem, is_endless
from jaxguide.trajectory import Extremal
from jaxguide.types import is_traced


def is_key(guess: Any) -> bool:
    """Whether `guess` is a random key: a random start."""
    return isinstance(guess, jax.Array) and jnp.issubdtype(guess.dtype, jax.dtypes.prng_key)


def check_guess(problem: Problem, guess: Any, method: Method) -> None:
    """Refuses what `method` cannot start from.

    **Raises:** `ValueError`.
    """
    kind, name, can = type(problem).__name__, type(method).__name__, method.capabilities
    if guess is None:
        return
    if isinstance(guess, Extremal):
        _check_extremal(problem, guess, can.endless)
        return
    if is_key(guess):
        if not can.random_start:
            raise ValueError(
                f"guess is a random key, which is for jg.Pseudospectral and not for {name}; "
                "jg.Shooting and jg.PiecewiseLinear have random starts of their own: starts=..., "
                "seed=...."
            )
        if guess.shape:
            raise ValueError(f"guess is {guess.shape[0]} random keys; give one, such as key[0].")
        return
    array = isinstance(guess, (jax.Array, np.ndarray, list, tuple))
    if array and getattr(guess, "dtype", None) == np.uint32:
        raise ValueError(
            "guess is an array of uint32, as jax.random.PRNGKey makes; for a random start give "
            "jax.random.key(seed)."
        )
    if not (array and can.array_guess):
        raise ValueError(
            f"guess is a {type(guess).__name__}; give {kind} an Extremal"
            + (", a jax.random.key" if can.random_start else "")
            + (f", {can.array_guess}" if can.array_guess else "")
            + ", or None."
            + ("" if can.array_guess else " Initial costates are for jg.Shooting.")
        )


def _check_extremal(problem: Problem, guess: Extremal, endless: bool) -> None:
    kind = type(problem).__name__
    if guess.t.ndim != 1:
        raise ValueError(
            f"guess is a batch of {guess.t.shape[0]} extremals; pick one, such as "
            "jax.tree_util.tree_map(lambda a: a[0], guess), or solve lane by lane with "
            "jg.solve_batch."
        )
    for what, names, count in (
        ("states", problem.state_names, guess.x.shape[1]),
        ("controls", problem.control_names, guess.u.shape[1]),
    ):
        if count != len(names):
            raise ValueError(
                f"guess has {count} {what}; {kind} has {len(names)}: {names}. Give an extremal of "
                "a problem alike, or None."
            )
    without_end = is_endless(problem) or is_traced(problem.final_time)
    if guess.stretch is not None and not (endless and without_end):
        raise ValueError(
            f"guess runs to t = inf and {kind} ends at a finite time; give an extremal of a "
            "finite horizon, or None."
        )
