"""Array aliases, every way a computation can fail with its remedy, and the float64 gate."""

import difflib
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Scalar = Float[Array, ""]
Times = Float[Array, " time"]
State = Float[Array, " state"]
Control = Float[Array, " control"]


class RESULTS(eqx.Enumeration):
    """How a computation ended: `successful`, or a reason whose message names the remedy.

    Members compare with `==` and merge with `RESULTS.where`, also under a trace. It does not extend
    the enumerations of Diffrax and its kin, which take a quarter of a second to import: where they
    are called, their reasons are translated.
    """

    successful = ""
    not_converged = (
        "The boundary conditions were not met: the shooting iterations stalled. Pass a `guess` "
        "(an Extremal or costates), raise `starts` or `arcs`, or check that the end is reachable."
    )
    optimiser_stopped = (
        "The interior-point iterations ended before the first-order conditions were met: raise "
        "`max_iterations`, change the mesh, give bounds or a `guess`, or look for a discontinuity "
        "in the dynamics."
    )
    parameters_not_found = (
        "Newton on the parameters ended before the KKT conditions were met: give a `guess`, more "
        "`starts` or other nodes; on a long or unstable horizon, or with bounds, use "
        "jg.Pseudospectral."
    )
    infeasible = (
        "The search ended where nothing nearby violates the constraints less, which does not show "
        "that no trajectory exists: give a `guess` or more `starts`, relax a constraint or a "
        "bound, or free a component of the initial state or the final time."
    )
    bounds_violated = (
        "The extremal leaves state, control or path bounds, which shooting and "
        "piecewise-linear parameters do not enforce: use a method that does, or widen the bounds."
    )
    not_minimising = (
        "H_uu is not positive definite on the extremal (Legendre-Clebsch): the control does not "
        "minimise the Hamiltonian there, or the arc is singular. Add a control cost, or use a "
        "direct method."
    )
    underresolved = (
        "The mesh does not resolve the solution to `mesh_tolerance`: raise `segments`, `nodes` or "
        "`refinements`, solve outside a trace, which refines, or take it as it is with "
        "`refinements=0`."
    )
    gain_unresolved = (
        "The gain is not resolved at this time: raise `segments` or `nodes`, or stay further "
        "from the final time."
    )
    conjugate_point = (
        "A conjugate point lies ahead of this time: the nominal is no minimum from here and the "
        "gain means nothing. Choose another extremal or a shorter horizon."
    )
    outside_horizon = "Queried outside the nominal horizon; the command was held at its end."
    saturated = "The command was limited to its cap; widen the cap if the authority is there."
    no_reference_time = (
        "No time on the nominal has the time to go of this state, within the law's window; the "
        "command went on as it was. Widen `window`, or look at this case's dispersion."
    )
    end_not_reached = (
        "The law had not brought the flight to its end when the latest time or the samples ran "
        "out: the perturbation is too large, or give the mission a later `final_time`."
    )
    missed = (
        "The flight ended further from its endpoint constraints than `miss` allows: the "
        "perturbation is too large for the law, or the allowance too small."
    )
    diverged = (
        "The flight left finite numbers: the plant diverged. Look at this case's dispersion, or "
        "cap the command."
    )
    steps_exhausted = (
        "An adaptive integration took all its steps within one sample: raise `max_steps`, loosen "
        "`tolerance`, or look for a jump or a growing oscillation in the dynamics."
    )
    integration_failed = (
        "An adaptive integration found no step that meets its tolerance, or left finite numbers: "
        "look at this case's rates, or fly it with fixed steps (jg.RungeKutta4)."
    )
    undefined = (
        "A cost, constraint or rate of the problem, or a derivative of one, is NaN or infinite "
        "where the search went: keep clear of its singularity by bounds or a `guess`, or mend it."
    )
    hidden_horizon = (
        "The final time is infinite, which could not be seen under the trace, and decides how a "
        "problem is solved: keep it a concrete jnp.inf, and differentiate or map over other fields "
        "only."
    )


def code(result: RESULTS) -> int:
    """The number by which a result is stored. Host only."""
    return int(result._value)  # pyright: ignore


def succeeded(result: RESULTS) -> bool:
    """Whether one result is success. Host only; under a trace, compare with `==`."""
    return code(result) == code(RESULTS.successful)


def usable(result: RESULTS) -> bool:
    """Whether one result is success, or a solution that its mesh does not resolve to the tolerance.
    Host only."""
    return succeeded(result) or code(result) == code(RESULTS.underresolved)


def message(number: int) -> str:
    """The name of a result stored by its `code`, or "code N" if there is none."""
    for name in RESULTS._name_to_item:  # pyright: ignore
        if code(getattr(RESULTS, name)) == number:
            return name
    return f"code {number}"


class UnknownName(ValueError):
    """A name that is not registered; the message suggests the nearest one that is.

    **Arguments:** `kind`: of the thing named ("problem"); `known`: the registered names.
    """

    def __init__(self, kind: str, name: str, known: Iterable[str]):
        known = tuple(known)
        # 0.4 for difflib's 0.6: names are few, so that a distant suggestion is still of use.
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}."
        super().__init__(f"no {kind} named {name!r}: {hint}")


class SolveWarning(UserWarning):
    """A solution is not all that was asked for; the message names what is worst and the remedy."""


class SolveError(RuntimeError):
    """An outermost solve failed; the message names the worst condition and what to try."""


def require_x64(what: str) -> None:
    """Checks that JAX runs in float64.

    **Arguments:** `what`: the function that needs it, for the message.

    **Raises:** `RuntimeError`, with the remedy, if it runs in float32.
    """
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise RuntimeError(
            f"{what} needs float64, but JAX is running in float32. Call "
            "jax.config.update('jax_enable_x64', True) before any array is made, or set the "
            "environment variable JAX_ENABLE_X64=1."
        )


def is_traced(tree: object) -> bool:
    """Whether any leaf of `tree` is a tracer; then its values cannot be checked on the host."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree_util.tree_leaves(tree))


def as_float(x: Any) -> Any:
    """`x` as a floating array (integers become the default float): NumPy's stay NumPy's."""
    if isinstance(x, (np.ndarray, np.generic)):
        return x if np.issubdtype(x.dtype, np.floating) else x.astype(jnp.result_type(float))
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))
