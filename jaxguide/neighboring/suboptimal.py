"""Neighbouring suboptimal gains: how the optimal parameters of a piecewise-linear control change
with the state met on the way (thesis, chapter 3, after Hull & Helfrich)."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxguide.bounds import positive, size_along
from jaxguide.host.compilation import kept_quickly
from jaxguide.linalg import gauss_solve
from jaxguide.nominal.parametric import flow as par
from jaxguide.nominal.parametric.equality import KKTPoint, polished
from jaxguide.problem import is_free
from jaxguide.spectral import interval
from jaxguide.trajectory import Extremal
from jaxguide.types import is_traced, require_x64

# Pivot of the Gram matrix of unit constraint rows below which they count as dependent. Pivots are
# squares of sines, of which rounding leaves 1e-15: rows that differ by an angle above 3e-5 count as
# independent. Chosen, not tuned.
_RANK = 1e-9


class SuboptimalSchedule(eqx.Module):
    """Gains about `extremal` for deviations met at `stations`, fractions of the horizon.

    `K` (g, k, m, n): change of the control at each of the k nodes per deviation of the state at
    each station; a station between nodes replaces the last node passed. `K_time` (g, n): change of
    the final time as a parameter of the whole horizon; the time to go from the station changes by
    (1 - tau) of it. A law uses two of the k nodes: `here` (g, m, n) is the change at the station,
    `ahead` (g, m, n) that at the next node, `spacing` (g,) of the horizon away. All in user units.
    """

    stations: Float[Array, " g"]
    positions: Float[Array, " k"]
    controls: Float[Array, "k m"]
    K: Float[Array, "g k m n"]
    K_time: Float[Array, "g n"]
    here: Float[Array, "g m n"]
    ahead: Float[Array, "g m n"]
    spacing: Float[Array, " g"]
    polynomials: Float[Array, "interval p n"]  # of the nominal state, from the highest power down
    extremal: Extremal

    @property
    def initial_time(self) -> Float[Array, ""]:
        """When the nominal starts."""
        return self.extremal.t[0]

    @property
    def duration(self) -> Float[Array, ""]:
        """How long the nominal's horizon is, in its unit of time."""
        return self.extremal.t[-1] - self.extremal.t[0]

    def state(self, tau: Any) -> Float[Array, " n"]:
        """The nominal state at the scalar `tau`; beyond the ends, its polynomial goes on."""
        i = interval(self.positions, tau)
        a, b = self.positions[i], self.positions[i + 1]
        local, terms = (2 * tau - a - b) / (b - a), self.polynomials[i]
        value = terms[0]
        for term in terms[1:]:
            value = value * local + term
        return value

    def control(self, tau: Any) -> Float[Array, " m"]:
        """The nominal control at the scalar `tau`; beyond the ends, its line goes on."""
        return par.control_at(self.positions, self.controls, tau)


class Sensitivities(NamedTuple):
    """Derivatives of the trajectory after each station, by the state x there and the parameters a.

    G = J + nu^T psi is the augmented cost: thesis, eq. (3.1).
    """

    end_state: Float[Array, "g n n"]  # dx_f/dx = Phi^-1
    end_parameters: Float[Array, "g n p"]  # dx_f/da = -Phi^-1 Psi
    psi_state: Float[Array, "g q n"]  # psi_x Phi^-1
    psi_parameters: Float[Array, "g q p"]  # -psi_x Phi^-1 Psi
    G_aa: Float[Array, "g p p"]
    G_ax: Float[Array, "g p n"]

    @property
    def Phi(self) -> Float[Array, "g n n"]:
        """Transition matrix of dx = Phi dx_f + Psi da: thesis, eqs (3.8), (3.12), (3.14)."""
        eye = jnp.broadcast_to(jnp.eye(self.end_state.shape[1]), self.end_state.shape)
        return jax.vmap(gauss_solve)(self.end_state, eye)

    @property
    def Psi(self) -> Float[Array, "g n p"]:
        """Effect of the parameters on the state at the station: thesis, eqs (3.13), (3.15)."""
        return -self.Phi @ self.end_parameters


def suboptimal_gains(
    extremal: Extremal,
    form: str = "remaining",
    stations: Any = None,
) -> SuboptimalSchedule:
    """Gains of a piecewise-linear `extremal` (`jg.PiecewiseLinear`).

    **Arguments:**

    - `form`: "whole" is thesis, eq. (3.25): of the changes of all parameters that meet the end, the
      one that costs least by the second derivatives of the whole trajectory's cost. Nodes passed
      are changed too; their share is then discarded, and with it optimality. "remaining": the
      derivative of the parameters that are optimal from the station on, about their own optimum (a
      tail of an optimal parameter vector is not quite optimal itself), including how their gradient
      changes with the state.
    - `stations` (g,): fractions of the horizon in [0, 1), ascending; default every node from which
      the end can still be controlled.

    **Error:** rounding, in "remaining" relative to re-optimised parameters.

    **Raises:** `ValueError` for an extremal of another kind; for a station from which fewer
    parameters remain than there are endpoint constraints, or whose parameters do not move them.

    **Source:** thesis, eqs (3.1)-(3.25); G_aa, there by finite differences, is exact here.
    """
    require_x64("jg.suboptimal_gains")
    if not extremal.parametric:
        raise ValueError(
            "suboptimal_gains: the extremal's control is no parameter vector; solve with "
            "jg.PiecewiseLinear, or use jg.gain_schedule."
        )
    if form not in ("whole", "remaining"):
        raise ValueError(f"form is {form!r}; choose 'whole' or 'remaining'.")
    positions = (extremal.breaks - extremal.t[0]) / (extremal.t[-1] - extremal.t[0])
    q, m = extremal.multipliers.endpoint.shape[0], extremal.problem.m
    free = is_free(extremal.problem.final_time)
    k = positions.shape[0]
    if stations is None:
        # Node i of 0 ... k - 1 leaves k - i controls to choose.
        count = min(k - 1, k - -(-(q - free) // m) + 1)
        if count < 1:
            raise ValueError(_too_few(extremal, k * m + free, q, 0.0))
        stations = positions[:count]
    stations = jnp.asarray(stations, positions.dtype)
    if not is_traced(stations):
        _check_stations(extremal, np.asarray(stations), np.asarray(positions), q, m, free)
    schedule, rank = _schedule(extremal, stations, positions, form == "whole")
    if not is_traced(rank) and not np.all(np.asarray(rank) > _RANK):
        i = int(np.argmin(np.asarray(rank)))
        raise ValueError(
            f"suboptimal_gains: from tau = {float(stations[i]):.6g} on, the remaining parameters "
            "do not move every endpoint constraint (their rows are dependent): no deviation can be "
            "taken out. Drop the constraint, add nodes after it, or leave out this station."
        )
    return schedule


def sensitivities(
    extremal: Extremal, stations: Float[Array, " g"], whole: bool = True
) -> Sensitivities:
    """First and second derivatives of the trajectory after each station, by autodiff of the flow.

    `whole`: stations move with tf, and the Hessian G_aa is that of the whole trajectory at every
    station. Otherwise the time at the station is held, and the Hessian is that of the rest.
    """
    positions = (extremal.breaks - extremal.t[0]) / (extremal.t[-1] - extremal.t[0])
    a, nu, x = _nominal(extremal, positions, stations)
    derive = lambda tau, x: _derivatives(extremal, positions, a, nu, tau, x, whole)
    out = jax.vmap(derive)(stations, x)
    if whole:
        start = par.from_the_start(extremal.problem, a.dtype)
        first = _derivatives(extremal, positions, a, nu, start.tau, start.x, True)
        out = out._replace(G_aa=jnp.broadcast_to(first.G_aa, out.G_aa.shape))
    return out


def _nominal(
    extremal: Extremal, positions: Array, stations: Array
) -> tuple[Array, Array, Float[Array, "g n"]]:
    step = extremal.reference_nodes.shape[0] - 1
    a = par.pack(extremal.problem, extremal.u[::step], extremal.t[-1])
    span = extremal.t[-1] - extremal.t[0]
    x = jax.vmap(lambda tau: extremal.point(extremal.t[0] + tau * span).x)(stations)
    return a, extremal.multipliers.endpoint, x


def _derivatives(
    extremal: Extremal, positions: Array, a: Array, nu: Array, tau: Array, x: Array, whole: bool
) -> Sensitivities:
    problem, degree, p = extremal.problem, extremal.degree, a.shape[0]
    when = None if whole else extremal.t[0] + tau * (extremal.t[-1] - extremal.t[0])

    def lagrangian(z: Array) -> tuple[Array, tuple[Array, Array]]:
        start = par.Departure(tau, when, z[p:])
        cost, e, end = par.outcome(problem, positions, z[:p], start, degree)
        return cost + jnp.dot(nu, e), (e, end)

    def slope(z: Array) -> tuple[Array, Array, Array]:
        gradient, (e, end) = jax.grad(lagrangian, has_aux=True)(z)
        return gradient[:p], e, end

    G, psi, final = jax.jacfwd(slope)(jnp.concatenate([a, x]))
    return Sensitivities(final[:, p:], final[:, :p], psi[:, p:], psi[:, :p], G[:, :p], G[:, p:])


@kept_quickly
def _schedule(
    extremal: Extremal, stations: Array, positions: Array, whole: bool
) -> tuple[SuboptimalSchedule, Float[Array, " g"]]:
    problem = extremal.problem
    a, nu, x = _nominal(extremal, positions, stations)
    p, k, n, m = a.shape[0], positions.shape[0], problem.n, problem.m
    free = is_free(problem.final_time)

    if whole:
        s = sensitivities(extremal, stations, True)
        active = jnp.ones((stations.shape[0], p), bool)
        s = s._replace(G_ax=jnp.zeros_like(s.G_ax))
    else:
        fit = lambda tau, x: _remaining(extremal, positions, a, nu, tau, x)
        s, active = jax.vmap(fit)(stations, x)

    a_size = _parameter_sizes(extremal, k)
    K, rank = jax.vmap(lambda s, active: _gain(s, active, a_size))(s, active)
    K_time = K[:, -1] if free else jnp.zeros((stations.shape[0], n), K.dtype)
    K = K[:, : k * m].reshape(-1, k, m, n)
    controls = par.unpack(problem, a)[0]
    first = jax.vmap(lambda tau: interval(positions, tau))(stations)
    at = lambda i: jax.vmap(lambda K, i: K[i])(K, i)
    points = extremal.reference_nodes
    exponents = jnp.arange(points.shape[0] - 1, -1, -1).astype(points.dtype)
    powers = points[:, None] ** exponents[None, :]
    polynomials = jax.vmap(lambda x: gauss_solve(powers, x))(extremal.by_segment(extremal.x))
    schedule = SuboptimalSchedule(
        stations=stations,
        positions=positions,
        controls=controls,
        K=K,
        K_time=K_time,
        here=at(first),
        ahead=at(first + 1),
        spacing=positions[first + 1] - stations,
        polynomials=polynomials,
        extremal=extremal,
    )
    return schedule, rank


def _parameter_sizes(extremal: Extremal, k: int) -> Float[Array, " p"]:
    """How large each parameter is along the nominal: the controls of k nodes, a free duration."""
    problem = extremal.problem
    sizes = jnp.tile(size_along(extremal.u, problem.control_bounds), k)
    return (
        jnp.append(sizes, extremal.t[-1] - extremal.t[0]) if is_free(problem.final_time) else sizes
    )


def _gain(
    s: Sensitivities, active: Bool[Array, " p"], size: Float[Array, " p"]
) -> tuple[Float[Array, "p n"], Float[Array, ""]]:
    """da/dx at one station, and how independent the constraints are of each other (`_dependence`).

    Thesis, eq. (3.25), with P = psi_x Phi^-1:

        K_0 = G_aa^-1 (P Psi)^T [(P Psi) G_aa^-1 (P Psi)^T]^-1 P

    which is K of the linear system

        [ G_aa  D^T ] [  K  ]     [ G_ax ]
        [  D     0  ] [dnu/dx] = -[  C   ],   D = -P Psi,  C = P,

    with G_ax = 0. Solved as such: "remaining" gains have a G_ax, and G_aa need not be regular.
    """
    q = s.psi_parameters.shape[0]
    # Parameters of passed nodes stay where they are.
    G = jnp.where(active[:, None] & active[None, :], s.G_aa, 0.0)
    scale = jnp.max(jnp.abs(G)) + jnp.finfo(G.dtype).tiny
    G = G + jnp.diag(jnp.where(active, 0.0, scale))
    D = jnp.where(active[None, :], s.psi_parameters, 0.0)
    rows = _lengths(D)
    D, C = D / rows, s.psi_state / rows
    kkt = jnp.block([[G / scale, D.T], [D, jnp.zeros((q, q), G.dtype)]])
    right = jnp.concatenate([jnp.where(active[:, None], s.G_ax, 0.0) / scale, C])
    K = -gauss_solve(kkt, right)[: size.shape[0]]  # thesis, eq. (3.25)
    sized = D * size[None, :]
    return K, _dependence(sized / _lengths(sized))


def _lengths(rows: Float[Array, "q p"]) -> Float[Array, "q 1"]:
    return positive(jnp.sqrt(jnp.sum(rows**2, axis=1, keepdims=True)))


def _dependence(D: Float[Array, "q p"]) -> Float[Array, ""]:
    """The least pivot of the Gram matrix of unit rows: 0 where they are dependent."""
    gram, least = D @ D.T, jnp.ones((), D.dtype)
    for i in range(D.shape[0]):
        pivot = gram[i, i]
        least = jnp.minimum(least, pivot)
        gram = gram - jnp.outer(gram[:, i], gram[i]) / jnp.where(pivot == 0, 1.0, pivot)
    return least


def _remaining(
    extremal: Extremal, positions: Array, a: Array, nu: Array, tau: Array, x: Array
) -> tuple[Sensitivities, Array]:
    """Derivatives of the trajectory after `tau`, at its own optimum."""
    z, active = _optimum(extremal, positions, a, nu, tau, x)
    return _derivatives(extremal, positions, z.a, z.nu, tau, x, False), active


def _optimum(
    extremal: Extremal, positions: Array, a: Array, nu: Array, tau: Array, x: Array
) -> tuple[KKTPoint, Array]:
    """The optimum from the state `x` at `tau` on, found from the tail of the nominal, and which
    parameters belong to it: those of nodes not yet passed."""
    problem, m = extremal.problem, extremal.problem.m
    k = positions.shape[0]
    first = interval(positions, tau)
    order = jnp.arange(k, dtype=first.dtype)
    active = jnp.repeat(order >= first, m)
    if is_free(problem.final_time):
        active = jnp.append(active, True)
    controls, tf = par.unpack(problem, a)
    here = par.control_at(positions, controls, tau)
    a = par.pack(problem, jnp.where((order == first)[:, None], here, controls), tf)
    when = extremal.t[0] + tau * (extremal.t[-1] - extremal.t[0])

    def values(b: Array, args: Any) -> tuple[Array, Array]:
        problem, positions, start, held = args
        cost, e, _ = par.outcome(problem, positions, b, start, extremal.degree)
        # A quadratic cost on parameters of passed nodes keeps the system regular and moves nothing.
        return cost + 0.5 * jnp.sum(jnp.where(active, 0.0, b - held) ** 2), e

    args = (problem, positions, par.Departure(tau, when, x), a)
    return polished(values, KKTPoint(a, nu), args), active


@kept_quickly
def remaining_optimum(
    extremal: Extremal, stations: Float[Array, " g"], dx: Float[Array, "g n"]
) -> Float[Array, "g p"]:
    """The parameters that are optimal from each station on when the state there is off by `dx`:
    the "remaining" gains are their derivative. Those of passed nodes keep their values."""
    positions = (extremal.breaks - extremal.t[0]) / (extremal.t[-1] - extremal.t[0])
    a, nu, x = _nominal(extremal, positions, stations)
    best = lambda tau, x: _optimum(extremal, positions, a, nu, tau, x)[0].a
    return jax.vmap(best)(stations, x + dx)


def _too_few(extremal: Extremal, left: int, q: int, tau: float) -> str:
    return (
        f"suboptimal_gains: from tau = {tau:.6g} on, {left} parameters of "
        f"{type(extremal.problem).__name__} remain for {q} endpoint constraints: not controllable. "
        "Leave out this station, or solve with more nodes after it."
    )


def _check_stations(
    extremal: Extremal, stations: np.ndarray, positions: np.ndarray, q: int, m: int, free: bool
) -> None:
    if stations.ndim != 1 or not np.all(np.diff(stations) > 0):
        raise ValueError(f"stations are {stations}; give a vector of ascending fractions.")
    if stations[0] < 0 or stations[-1] >= 1:
        raise ValueError(f"stations span [{stations[0]}, {stations[-1]}]; give them within [0, 1).")
    for tau in stations:
        first = int(np.searchsorted(positions, tau, side="right")) - 1
        left = (len(positions) - first) * m + free
        if left < q:
            raise ValueError(_too_few(extremal, left, q, float(tau)))
