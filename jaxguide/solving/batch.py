"""`jg.solve_batch`: many problems of one kind, on all cores. Host only."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.certificate import Certified, certified, uncertified
from jaxguide.host.compilation import compiled
from jaxguide.host.cores import over_cores
from jaxguide.host.progress import Progress, metered
from jaxguide.problem import Problem, is_endless, with_array_leaves
from jaxguide.solving.given import default_method, given
from jaxguide.solving.solve import on_fixed_mesh, solve
from jaxguide.trajectory import Extremal
from jaxguide.transforms.endless import made_finite, opened
from jaxguide.types import RESULTS, SolveError, is_traced, require_x64

_tree = jax.tree_util.tree_map

CHUNK = 16  # lanes that one thread solves in one call of the program: dispatch costs as one lane


def solve_batch(
    problems: Problem | Sequence[Problem],
    method: Any = None,
    guess: Extremal | None = None,
    throw: bool = False,
    progress: Progress | None = None,
    workers: int | None = None,
) -> Certified:
    """Solves each of `problems` on the method's fixed mesh; one batched Extremal.

    Chunks of lanes go to whichever of the host threads is idle, and a lane is what its own `solve`
    without refinement would be, to rounding.

    **Arguments:**

    - `problems`: a Problem whose every leaf has one leading axis of lanes, such as
      `jax.vmap(lambda k: dataclasses.replace(problem, thrust=k))(thrusts)`; or a list of Problems
      of one class and structure.
    - `method`, `guess`: as for `solve`; a batched Extremal is one guess a lane.
    - `throw`: raise if a lane fails. By default failure is a value: look at `.result`.
    - `progress`: a meter (`jaxguide.progress`); none by default.
    - `workers`: host threads; default one a core.

    **Returns:** an Extremal whose leaves have the leading axis. Under a trace lanes take turns.

    **Raises:** `ValueError` for lanes that do not stack, `SolveError` naming the failed lanes.
    """
    require_x64("jg.solve_batch")
    batch = problems if isinstance(problems, Problem) else _stacked(problems)
    batch = with_array_leaves(batch)
    count = _lanes(batch)
    lane = lambda tree, i: _tree(lambda a: a[i], tree)
    own = isinstance(guess, Extremal) and guess.t.ndim == 2
    if guess is not None and own and guess.t.shape[0] != count:
        raise ValueError(
            f"solve_batch: guess has {guess.t.shape[0]} lanes for {count} problems; give one a "
            "problem, or a single Extremal for all."
        )
    method = default_method(batch) if method is None else method
    first = lane(batch, 0)
    given(first, method, lane(guess, 0) if own else guess)
    guess = uncertified(guess) if isinstance(guess, Extremal) else guess
    axes = (0, 0 if own else None)
    if is_traced((batch, guess)):
        one = lambda p, g: solve(p, method, g, throw=False)
        return jax.vmap(one, in_axes=axes)(batch, guess)
    if is_endless(first):
        one = lambda p, g: made_finite(p, g, method.time_scale)
        batch, guess = jax.vmap(one, in_axes=axes, out_axes=axes)(batch, guess)
    # On the host, so that taking a chunk costs no dispatch.
    batch, guess = jax.device_get((batch, guess))
    one = jax.tree_util.Partial(on_fixed_mesh, method)

    def chunk(k: int) -> Extremal:
        at = np.arange(k * CHUNK, min((k + 1) * CHUNK, count))
        padded = np.pad(at, (0, CHUNK - len(at)), mode="edge")
        own_or_shared = lane(guess, padded) if own else guess
        program = compiled(_lanes_of, method.quick)
        done = program(one, lane(batch, padded), own_or_shared, jnp.asarray(len(at)), own)
        return _tree(lambda a: a[: len(at)], jax.device_get(done))

    # The first alone: it compiles.
    chunks = -(-count // CHUNK)
    later = over_cores(chunk, range(1, chunks), workers)
    parts = [chunk(0), *metered(later, chunks - 1, progress)]
    out = _tree(lambda *a: jnp.asarray(np.concatenate(a)), *parts)
    failed = np.flatnonzero(np.asarray(out.result != RESULTS.successful))
    if throw and failed.size:
        raise SolveError(
            f"{failed.size} of {count} lanes failed: {', '.join(map(str, failed[:20]))}"
            f"{', ...' if failed.size > 20 else ''}. Solve one with jg.solve to see why, or pass "
            "throw=False and look at .result."
        )
    return certified(jax.vmap(opened)(out), method.accuracy)


def _lanes_of(one: Any, problems: Problem, guess: Any, count: Any, own: bool) -> Extremal:
    """The first `count` lanes, one after another; the others stay blank."""
    lane = lambda tree, i: _tree(lambda a: a[i], tree)
    at = lambda i: one(lane(problems, i), lane(guess, i) if own else guess)
    blank = jax.eval_shape(at, 0)
    blank = _tree(lambda a: jnp.zeros((CHUNK, *a.shape), a.dtype), blank)
    put = lambda i, out: _tree(lambda all, new: all.at[i].set(new), out, at(i))
    return jax.lax.fori_loop(0, count, put, blank)


def _stacked(problems: Sequence[Problem]) -> Problem:
    problems = [with_array_leaves(p) for p in problems]
    if not problems:
        raise ValueError("solve_batch: no problems were given.")
    structures = [jax.tree_util.tree_structure(p) for p in problems]
    for i, other in enumerate(structures):
        if other != structures[0]:
            raise ValueError(
                f"solve_batch: problem {i} differs from problem 0 in class, static fields or which "
                "entries are free; solve unlike problems in batches of their own."
            )
    return _tree(lambda *a: jnp.stack(a), *problems)


def _lanes(batch: Problem) -> int:
    sizes = {jnp.shape(a)[:1] for a in jax.tree_util.tree_leaves(batch)}
    if len(sizes) != 1 or sizes == {()}:
        raise ValueError(
            f"solve_batch: leading axes of the problem's leaves are {sorted(sizes)}; every leaf "
            "needs the same one. jax.vmap(lambda k: dataclasses.replace(problem, thrust=k))"
            "(thrusts) makes them."
        )
    count = sizes.pop()[0]
    if not count:
        raise ValueError("solve_batch: no problems were given: leading axes have length 0.")
    return count
