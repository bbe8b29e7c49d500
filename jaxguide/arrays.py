"""One algebra on two engines: NumPy's where every array is NumPy's, JAX's otherwise.

A first solve in a process would compile for seconds what it computes in hundredths of one. So the
optimiser's algebra is written once, with `xp` in place of `jax.numpy`: under a trace it is JAX's
and becomes one program, on the host it is NumPy's and SciPy's and compiles nothing.
"""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

if TYPE_CHECKING:
    Array = jax.Array  # a type checker need not tell the engines apart
else:
    Array = jax.Array | np.ndarray | np.generic


# The commonest types of the host, which need no question; a first solve asks a hundred thousand.
_HOST = {np.ndarray, np.float64, np.bool_, float, int, bool, slice, type(None)}


def on_numpy(*arrays: Any) -> bool:
    """Whether none of them, or of what a list or tuple of them holds, is JAX's."""
    for a in arrays:
        if type(a) in _HOST:
            continue
        if isinstance(a, (list, tuple)):
            if not on_numpy(*a):
                return False
        elif isinstance(a, jax.Array):
            return False
    return True


class _Engine:
    """`xp.name(...)`: `numpy.name` or `jax.numpy.name`, by the arrays among the arguments."""

    def __getattr__(self, name: str) -> Any:
        mine, theirs = getattr(np, name), getattr(jnp, name)
        if not callable(mine) or isinstance(mine, type):
            setattr(self, name, mine)
            return mine

        @functools.wraps(mine)
        def either(*args: Any, **options: Any) -> Any:
            for a in args:
                if type(a) not in _HOST and not on_numpy(a):
                    return theirs(*args, **options)
            return mine(*args, **options)

        setattr(self, name, either)
        return either


xp: Any = _Engine()


@functools.cache
def _lapack(name: str) -> Any:
    """A routine of LAPACK in float64. SciPy takes a quarter of a second to import."""
    from scipy.linalg import get_lapack_funcs

    return get_lapack_funcs(name)


def on_device(tree: Any) -> Any:
    """`tree` with JAX's arrays for the host's, without a compilation."""
    return jax.tree_util.tree_map(lambda a: jax.device_put(a) if on_numpy(a) else a, tree)


def put(a: Any, at: Any, values: Any) -> Any:
    """`a` with `values` at the indices `at`."""
    if on_numpy(a, values):
        out = np.array(a)
        out[at] = values
        return out
    return jnp.asarray(a).at[at].set(values)


def added(a: Any, at: Any, values: Any) -> Any:
    """`a` with `values` added at the indices `at`, each of which is named once."""
    if on_numpy(a, values):
        out = np.array(a)
        out[at] += values
        return out
    return jnp.asarray(a).at[at].add(values)


def loop(going: Callable, body: Callable, carry: Any) -> Any:
    """`jax.lax.while_loop`."""
    if not on_numpy(*jax.tree_util.tree_leaves(carry)):
        return jax.lax.while_loop(going, body, carry)
    while going(carry):
        carry = body(carry)
    return carry


def either(condition: Any, yes: Callable, no: Callable) -> Any:
    """`jax.lax.cond` of two functions without arguments."""
    if isinstance(condition, jax.Array):
        return jax.lax.cond(condition, yes, no)
    return yes() if condition else no()


def scan(step: Callable, carry: Any, items: Any, reverse: bool = False) -> tuple[Any, Any]:
    """`jax.lax.scan`."""
    leaves, structure = jax.tree_util.tree_flatten(items)
    if not on_numpy(*leaves, *jax.tree_util.tree_leaves(carry)):
        return jax.lax.scan(step, carry, items, reverse=reverse)
    out: list[Any] = []
    for k in range(len(leaves[0])):
        at = -1 - k if reverse else k
        carry, one = step(carry, structure.unflatten([a[at] for a in leaves]))
        out.append(one)
    return carry, stacked_trees(out[::-1] if reverse else out)


def stacked_trees(trees: list[Any]) -> Any:
    """One tree of the host's arrays from several, along a new leading axis."""
    return jax.tree_util.tree_map(lambda *a: np.stack(a), *trees)


def one_by_one(f: Callable, items: Any) -> Any:
    """`jax.lax.map`."""
    leaves, structure = jax.tree_util.tree_flatten(items)
    if not on_numpy(*leaves):
        return jax.lax.map(f, items)
    return stacked_trees(
        [f(structure.unflatten([a[k] for a in leaves])) for k in range(len(leaves[0]))]
    )


def cholesky(a: Any) -> Any:
    """The lower factor; NaN where `a` is not positive definite."""
    if not on_numpy(a):
        return jnp.linalg.cholesky(a)
    if not a.size:
        return a
    factor, info = _lapack("potrf")(a, lower=1, clean=1)
    return factor if info == 0 else np.full_like(a, np.nan)


def cho_solve(factor: Any, b: Any) -> Any:
    """A^-1 b from the lower Cholesky factor of A."""
    if not on_numpy(factor, b):
        return jax.scipy.linalg.cho_solve((factor, True), b)
    return _lapack("potrs")(factor, b, lower=1)[0] if b.size else b


def solve_triangular(
    a: Any, b: Any, trans: int = 0, lower: bool = False, unit_diagonal: bool = False
) -> Any:
    """`jax.scipy.linalg.solve_triangular`; on the host `a` may be a batch."""
    if not on_numpy(a, b):
        return jax.scipy.linalg.solve_triangular(
            a, b, trans=trans, lower=lower, unit_diagonal=unit_diagonal
        )
    if a.ndim > 2:
        one = lambda a, b: solve_triangular(a, b, trans, lower, unit_diagonal)
        return np.stack([one(*pair) for pair in zip(a, b, strict=True)])
    if not b.size:
        return b
    # LAPACK's matrices stand by columns, so that it takes the transpose without a copy.
    x, info = _lapack("trtrs")(a.T, b, not lower, not trans, unit_diagonal)
    return x if info == 0 else np.full_like(x, np.nan)


def pivoted_lu(a: Any) -> tuple[Any, Any]:
    """L and U of each matrix of the host, in one array, and the order of rows by pivoting."""
    if a.ndim > 2:
        lu, order = zip(*map(pivoted_lu, a), strict=True)
        return np.stack(lu), np.stack(order)
    lu, exchanges, _ = _lapack("getrf")(a)
    order = np.arange(len(a), dtype=np.int32)
    for k, other in enumerate(exchanges):
        order[k], order[other] = order[other], order[k]
    return lu, order


def eigh(a: Any) -> Any:
    """Eigenvalues and vectors; NaN where there are none."""
    if not on_numpy(a):
        return jnp.linalg.eigh(a)
    try:
        return tuple(np.linalg.eigh(a))
    except np.linalg.LinAlgError:
        return np.full(a.shape[0], np.nan), np.full_like(a, np.nan)


def eigvalsh(a: Any) -> Any:
    """Eigenvalues of a batch of symmetric matrices, ascending; NaN where there are none."""
    if not on_numpy(a):
        return jnp.linalg.eigvalsh(a)
    finite = np.all(np.isfinite(a), axis=(-2, -1))
    values = np.linalg.eigvalsh(np.where(finite[..., None, None], a, 0.0))
    return np.where(finite[..., None], values, np.nan)


def traced_once(function: Callable) -> Callable:
    """`jax.jit` of `function` where its arguments are JAX's; itself where they are the host's."""
    program = jax.jit(function)

    @functools.wraps(function)
    def called(*args: Any) -> Any:
        host = on_numpy(*jax.tree_util.tree_leaves(args[1:] or args))
        return function(*args) if host else program(*args)

    return called
