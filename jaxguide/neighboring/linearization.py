"""The linear two-point boundary-value problem about an extremal by autodiff: 2002 paper,
eqs (11)-(21)."""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxguide.bounds import bounds_of
from jaxguide.conditions.hamiltonian import endpoint_lagrangian, hamiltonian
from jaxguide.linalg import gauss_solve, left_null_space
from jaxguide.problem import Problem, is_free, replace_parameters
from jaxguide.trajectory import Extremal


class SecondVariation(NamedTuple):
    """Partial derivatives at one point of the extremal; `p` are the chosen parameters."""

    f_x: Array
    f_u: Array
    H_xx: Array
    H_xu: Array
    H_uu: Array
    f_p: Array
    H_xp: Array
    H_up: Array


def parameter_values(problem: Problem, names: tuple[str, ...], dtype: Any) -> Float[Array, " p"]:
    """Current values of the scalar fields `names`.

    **Raises:** `ValueError` for a name that is not a scalar field.
    """
    known = [f.name for f in dataclasses.fields(problem)]
    for name in names:
        value: Any = getattr(problem, name, None)
        if name not in known or isinstance(value, (tuple, list, str)) or jnp.shape(value) != ():
            raise ValueError(
                f"{name!r} is not a scalar parameter of {type(problem).__name__}; fields: {known}."
            )
    return jnp.asarray([getattr(problem, name) for name in names], dtype).reshape(len(names))


@functools.partial(jax.jit, static_argnames="parameters")
def second_variation(
    problem: Problem,
    t: Any,
    x: Float[Array, " n"],
    u: Float[Array, " m"],
    costate: Float[Array, " n"],
    parameters: tuple[str, ...] = (),
) -> SecondVariation:
    """f_x, f_u and the Hessian of H at one point, and their derivatives by the parameters named:
    2002 paper, eqs (11)-(13)."""
    n, m = problem.n, problem.m
    p = parameter_values(problem, parameters, x.dtype)
    z = jnp.concatenate([x, u, p])

    def both(z: Array) -> tuple[Array, Array]:
        plant = replace_parameters(problem, parameters, z[n + m :]) if parameters else problem
        f = lambda z: plant.dynamics(t, z[:n], z[n : n + m])

        def h(w: Array) -> Array:
            return hamiltonian(plant, t, w[:n], w[n:], costate)

        return f(z), jax.grad(h)(z[: n + m])

    jac_f, hess = jax.jacfwd(both)(z)  # forward over reverse: one sweep of n + m + p tangents
    a, b = n, n + m
    return SecondVariation(
        jac_f[:, :a],
        jac_f[:, a:b],
        hess[:a, :a],
        hess[:a, a:b],
        hess[a:b, a:b],
        jac_f[:, b:],
        hess[:a, b:],
        hess[a:b, b:],
    )


class Canonical(NamedTuple):
    """y' = M y + b dp for y = (dx, dlambda), and du = U y + U_p dp: 2002 paper, eqs
    (16)-(21)."""

    M: Float[Array, "two_n two_n"]
    b: Float[Array, "two_n p"]
    U: Float[Array, "m two_n"]
    U_p: Float[Array, "m p"]


@jax.jit
def canonical(v: SecondVariation) -> Canonical:
    """Eliminates du: 2002 paper, eq. (16). A singular H_uu gives entries that are not finite, which
    callers flag."""
    rows = jnp.concatenate([v.H_xu.T, v.f_u.T, v.H_up], axis=1)
    gain = -_inverse_times(v.H_uu, rows)  # du in terms of (dx, dlambda, dp)
    n = v.f_x.shape[0]
    U, U_p = gain[:, : 2 * n], gain[:, 2 * n :]
    A = v.f_x + v.f_u @ U[:, :n]  # 2002 paper, eq. (19)
    B = v.f_u @ U[:, n:]  # 2002 paper, eq. (20)
    Q = v.H_xx + v.H_xu @ U[:, :n]  # 2002 paper, eq. (21)
    M = jnp.concatenate(
        [jnp.concatenate([A, B], axis=1), jnp.concatenate([-Q, -A.T], axis=1)], axis=0
    )
    b = jnp.concatenate([v.f_p + v.f_u @ U_p, -(v.H_xp + v.H_xu @ U_p)], axis=0)
    return Canonical(M, b, U, U_p)


def _inverse_times(h_uu: Array, rows: Array) -> Array:
    if h_uu.shape[0] == 1:
        return rows / h_uu[0, 0]
    return gauss_solve(h_uu, rows)


class Terminal(NamedTuple):
    """End conditions psi y + psi_p dp + psi_target dpsi = 0 and the change of the final time."""

    psi: Float[Array, "n two_n"]
    psi_p: Float[Array, "n p"]
    psi_target: Float[Array, "n q"]
    time: Float[Array, "deviation"]


@functools.partial(jax.jit, static_argnames="parameters")
def terminal_conditions(extremal: Extremal, parameters: tuple[str, ...] = ()) -> Terminal:
    r"""The 2002 paper's eq. (15) for any endpoint constraint, $\nu$ (and $d t_f$) eliminated.

    The conditions e = target, lambda = dEbar/dx and, if tf is free, H + dEbar/dtf = 0 are
    linearised about the end, along the flow for a change of tf. A reduced basis of the left null
    space of the columns of (nu, tf) removes those unknowns: n rows remain.
    """
    problem = extremal.problem
    n, p = problem.n, len(parameters)
    x0, t0, tf = extremal.x[0], extremal.t[0], extremal.t[-1]
    xf, costate, u = extremal.x[-1], extremal.costate[-1], extremal.u[-1]
    nu = extremal.multipliers.endpoint
    q = nu.shape[0]
    free_time = is_free(problem.final_time)
    dtype = xf.dtype

    def conditions(z: Array) -> Array:
        x, lam = z[:n], z[n : 2 * n]
        values, target = z[2 * n : 2 * n + p], z[2 * n + p : 2 * n + p + q]
        nu, tf = z[2 * n + p + q : 2 * n + p + 2 * q], z[-1]
        plant = replace_parameters(problem, parameters, values) if parameters else problem
        e = plant.endpoint_constraints(x0, x, t0, tf)
        e = e - bounds_of(plant.endpoint_bounds, q, dtype)[0] - target
        grads = jax.grad(endpoint_lagrangian, argnums=(3, 5))(plant, nu, x0, x, t0, tf)
        rows = [e, lam - grads[0]]
        if free_time:
            rows.append((hamiltonian(plant, tf, x, u, lam) + grads[1])[None])
        return jnp.concatenate(rows)

    z = jnp.concatenate(
        [
            xf,
            costate,
            parameter_values(problem, parameters, dtype),
            jnp.zeros(q, dtype),
            nu,
            tf[None],
        ]
    )
    jac = jax.jacfwd(conditions)(z)
    known, unknown = jac[:, : 2 * n + p + q], jac[:, 2 * n + p + q : -1]
    if free_time:
        f = problem.dynamics(tf, xf, u)
        h_x = jax.grad(hamiltonian, argnums=2)(problem, tf, xf, u, costate)
        along = jac[:, -1] + jac[:, :n] @ f - jac[:, n : 2 * n] @ h_x
        unknown = jnp.concatenate([unknown, along[:, None]], axis=1)
    basis, inverse = left_null_space(unknown)
    rows = basis @ known
    time = -inverse[-1] @ known if free_time else jnp.zeros(2 * n + p + q, dtype)
    return Terminal(rows[:, : 2 * n], rows[:, 2 * n : 2 * n + p], rows[:, 2 * n + p :], time)


class LinearTPBVP(eqx.Module):
    """2002 paper, eqs (11)-(21), at times `t`: arrays with a leading time axis, and the end
    conditions."""

    t: Float[Array, " time"]
    f_x: Float[Array, "time n n"]
    f_u: Float[Array, "time n m"]
    H_xx: Float[Array, "time n n"]
    H_xu: Float[Array, "time n m"]
    H_uu: Float[Array, "time m m"]
    A: Float[Array, "time n n"]
    B: Float[Array, "time n n"]
    Q: Float[Array, "time n n"]
    U: Float[Array, "time m two_n"]
    psi_x: Float[Array, "n n"]
    psi_lambda: Float[Array, "n n"]
    dtf_dx: Float[Array, " n"]
    dtf_dlambda: Float[Array, " n"]


def refuse_integrals(extremal: Extremal, what: str) -> None:
    """Raises `ValueError` if integral constraints bind the extremal's neighbours together."""
    if extremal.multipliers.integral.shape[-1]:
        raise ValueError(
            f"{what}: {type(extremal.problem).__name__} has integral constraints, which the "
            "second variation leaves out; state each integral as a further state that starts "
            "at 0 and is constrained at the end."
        )


def linearize(extremal: Extremal, t: Any) -> LinearTPBVP:
    """The linear TPBVP of neighbouring extremals about `extremal` at times `t` (T,).

    **Returns:** f_x, f_u, H_xx, H_xu, H_uu (2002 paper, eqs (11)-(13)), A, B, Q (eqs (19)-(21)),
    `U` with du = U (dx, dlambda) (eq. (16)), psi_x and psi_lambda (eq. (15); n rows, defined up to
    row operations), and the change of a free final time, dtf = dtf_dx dx_f + dtf_dlambda dlambda_f.

    **Error:** that of the extremal, to first order, and rounding.

    **Raises:** `ValueError` for times that are no vector, and for integral constraints.
    """
    t = jnp.asarray(t, extremal.t.dtype)
    if t.ndim != 1:
        raise ValueError(f"linearize: t has shape {t.shape}; give a vector of times (T,).")
    refuse_integrals(extremal, "linearize")
    n = extremal.problem.n

    def at(t: Array) -> tuple[SecondVariation, Canonical]:
        point = extremal(t)
        v = second_variation(extremal.problem, t, point.x, point.u, point.costate)
        return v, canonical(v)

    v, c = jax.vmap(at)(t)
    end = terminal_conditions(extremal)
    return LinearTPBVP(
        t,
        v.f_x,
        v.f_u,
        v.H_xx,
        v.H_xu,
        v.H_uu,
        c.M[:, :n, :n],
        c.M[:, :n, n:],
        -c.M[:, n:, :n],
        c.U,
        end.psi[:, :n],
        end.psi[:, n:],
        end.time[:n],
        end.time[n : 2 * n],
    )
