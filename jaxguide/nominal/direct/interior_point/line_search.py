"""The filter line search: the full step, its second-order correction, then halves of it.

**Source:** Waechter & Biegler (2006), sections 2.3 and 2.4.
"""

from typing import NamedTuple

from jaxtyping import Bool, Float, Int

from jaxguide.arrays import Array, loop, xp
from jaxguide.nominal.direct.box import barrier_value, longest_step
from jaxguide.nominal.direct.interior_point.barrier import Barrier, probed
from jaxguide.nominal.direct.interior_point.direction import (
    Gradients,
    Matrix,
    Move,
    direction,
    loaded,
)
from jaxguide.nominal.direct.interior_point.evaluation import Iterate
from jaxguide.nominal.direct.interior_point.filter import GAMMA, Filter, acceptable
from jaxguide.nominal.direct.interior_point.state import Setup, State
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.trees import all_finite, along, choose, one_norm, zeros_like
from jaxguide.nominal.direct.unknowns import Equations

# delta, s_theta and s_phi of the switching condition, and eta_phi of Armijo's: Waechter & Biegler
# (2006), eqs (19) and (20).
_DELTA, _S_THETA, _S_PHI, _ETA = 1.0, 1.1, 2.3, 1e-4
# Armijo's factor for the violation, in restoration: the value of eta_phi.
_NEARER = 1e-4
# Room for rounding of phi in eqs (18) and (20), in roundings of 1 + |phi|. Ipopt allows 10
# roundings of |phi|; ten times that, and of 1 where phi is small: chosen, not tuned.
_ROUNDINGS = 1e2
# Halvings before a step counts as failed: 2^-30 is about 1e-9, where a step is lost in rounding.
_HALVINGS = 30
# Largest share of the horizon that one step may remove. From a guess at rest, a model linear in
# time would remove most of it. Chosen, not tuned.
_SHRINK = 0.5


class Search(NamedTuple):
    """Fixed while lengths are tried. `theta`: violation, the 1-norm of the constraints;
    `logs`: the barrier function with mu = 1 and no objective."""

    setup: Setup
    at: Iterate
    matrix: Matrix
    gradients: Gradients
    barrier: Barrier
    theta: Float[Array, ""]
    logs: Float[Array, ""]


class Judgement(NamedTuple):
    """Whether a trial point is acceptable; whether as a step of f-type, which decreases the barrier
    function and leaves the filter as it is; the point's constraints and violation."""

    ok: Bool[Array, ""]
    f_type: Bool[Array, ""]
    c: Equations
    theta: Float[Array, ""]


class Aim(NamedTuple):
    """The loop over whole steps. `target`: the constraints that the step is to undo; `first` and
    `latest`: the uncorrected and the last step with their longest lengths; `count`: -1 for a
    probe, 0 for the full step, 1 for its correction."""

    count: Int[Array, ""]
    mu: Float[Array, ""]
    target: Equations
    first: tuple[Move, Array]
    latest: tuple[Move, Array]
    accepted: Bool[Array, ""]
    f_type: Bool[Array, ""]
    again: Bool[Array, ""]


class Found(NamedTuple):
    """The result of the search: the barrier and its filter, the uncorrected step, the step taken
    and its length, violation `theta` and barrier function `phi` before it, whether it is
    `accepted`, and as an f-type step; `regular`: whether the step could be computed at all."""

    mu: Float[Array, ""]
    filter: Filter
    step: Move
    taken: Move
    alpha: Float[Array, ""]
    theta: Float[Array, ""]
    phi: Float[Array, ""]
    regular: Bool[Array, ""]
    accepted: Bool[Array, ""]
    f_type: Bool[Array, ""]


def searched(
    setup: Setup, at: Iterate, matrix: Matrix, gradients: Gradients, barrier: Barrier
) -> Found:
    """The step from an iterate, and how long it is."""
    kind, one = at.kind, xp.ones_like(barrier.mu)
    logs = barrier_value(setup.box, at.state.w, one)
    search = Search(setup, at, matrix, gradients, barrier, one_norm(at.c), logs)
    aim = _aimed(search)
    step, longest = aim.first
    regular, filter = matrix.regular & all_finite(step), filter_under(at.state, aim.mu)
    slope = _slope(search, aim.mu, step.primal)

    def shorten(carry: tuple) -> tuple:
        alpha, _, _, k = carry
        half = judged_trial(search, aim.mu, alpha / 2, slope, step.primal, alpha / 2)
        return alpha / 2, half.ok, half.f_type, k + 1

    # An estimate of the multipliers moves nothing, so that there is no length to look for.
    settled = aim.accepted | kind.estimate | ~regular
    alpha, found, f_type, _ = loop(
        lambda a: ~a[1] & (a[3] < _HALVINGS), shorten, (longest, settled, aim.f_type, 0)
    )
    accepted = regular & found & ~kind.estimate
    taken, alpha = choose(aim.accepted, aim.latest, (step, alpha))
    phi = at.f + aim.mu * logs
    return Found(aim.mu, filter, step, taken, alpha, search.theta, phi, regular, accepted, f_type)


def _aimed(search: Search) -> Aim:
    """The full step and whether it is acceptable; if it is not, and adds to the violation, its
    second-order correction. Where the barrier is free, first a probe: a step without barrier.

    **Source:** Waechter & Biegler (2006), section 2.4, eq. (27); at most one correction, not four.
    """
    setup, at, matrix, gradients, barrier, theta, _ = search
    s, kind = at.state, at.kind

    def aim(now: Aim) -> Aim:
        probe = now.count < 0
        load = loaded(setup, at, gradients, now.target, xp.where(probe, 0.0, now.mu))
        step = direction(setup, matrix, load)
        # Waechter & Biegler (2006), eq. (15a).
        inside = longest_step(at.low, at.high, step.primal, setup.box, barrier.tau)
        length = xp.minimum(inside, patient_length(setup.program, s.w, step.primal))
        first = choose(now.count == 0, (step, length), now.first)
        slope = _slope(search, now.mu, first[0].primal)
        trial = judged_trial(search, now.mu, first[1], slope, step.primal, length)
        ok = trial.ok & all_finite(step) & ~probe
        sound = probe & matrix.regular & all_finite(step)
        mu = xp.where(sound, probed(setup, at, barrier, step), now.mu)
        worse = (trial.theta >= theta) & xp.isfinite(trial.theta)
        again = probe | ((now.count == 0) & kind.newton & matrix.regular & ~ok & worse)
        # c_soc = alpha c(x) + c(x + alpha d), Waechter & Biegler (2006), eq. (27).
        target = choose(probe, now.target, along(trial.c, length, at.c))
        return Aim(now.count + 1, mu, target, first, (step, length), ok, trial.f_type, again)

    target = choose(kind.estimate, zeros_like(at.c), at.c)
    none = (Move(xp.zeros_like(s.w), zeros_like(s.y)), xp.ones_like(s.mu))
    no, yes = xp.array(False), xp.array(True)
    count = xp.where(barrier.free, -1, 0)
    start = Aim(count, barrier.mu, target, none, none, no, no, yes)
    return loop(lambda a: a.again, aim, start)


def judged_trial(
    search: Search, mu: Array, alpha: Array, slope: Array, d: Array, length: Array
) -> Judgement:
    """Whether the point `length` along d is acceptable, judged as a step of size `alpha` along
    which the barrier function begins with `slope`.

    **Source:** Waechter & Biegler (2006), eqs (18)-(20).
    """
    (program, box, _), at, theta, s = search.setup, search.at, search.theta, search.at.state
    phi = at.f + mu * search.logs
    slack = _ROUNDINGS * xp.finfo(phi.dtype).eps * (1 + xp.abs(phi))
    steep = xp.where(slope < 0, -slope, 0.0)
    w = along(s.w, length, d)
    f, c = program.objective_and_residual(program.shaped(w))
    theta_new, phi_new = one_norm(c), f + barrier_value(box, w, mu)
    sane = xp.isfinite(theta_new) & xp.isfinite(phi_new) & (theta_new <= s.theta_max)
    # Waechter & Biegler (2006): the switching condition, eq. (19); Armijo's, eq. (20); sufficient
    # progress, eq. (18).
    switch = alpha * steep**_S_PHI > _DELTA * theta**_S_THETA
    f_type = (slope < 0) & switch & (theta <= s.theta_min)
    armijo = phi_new <= phi + _ETA * alpha * slope + slack
    progress = (theta_new <= (1 - GAMMA) * theta) | (phi_new <= phi - GAMMA * theta + slack)
    good = xp.where(f_type, armijo, progress)
    good = good & acceptable(filter_under(s, mu), theta_new, phi_new - slack)
    nearer = theta_new <= (1 - _NEARER * alpha) * theta
    ok = sane & xp.where(at.kind.restore, nearer, good)
    return Judgement(ok, f_type & armijo, c, theta_new)


def filter_under(s: State, mu: Float[Array, ""]) -> Filter:
    """The filter for a barrier `mu`: empty if the barrier has changed, since points refused under
    another one say nothing of this one; Waechter & Biegler (2006), Algorithm A, step A-3."""
    return s.filter._replace(used=xp.where(mu != s.mu, 0, s.filter.used))


def patient_length(program: Transcription, w: Array, d: Array) -> Float[Array, ""]:
    """The longest step, up to 1, by which the horizon loses no more than `_SHRINK` of itself."""
    now, more = (program.shaped(a).times for a in (w, d))
    horizon, change = now[1] - now[0], more[1] - more[0]
    shrinks = (change < 0) & (horizon > 0)
    return xp.minimum(1.0, xp.where(shrinks, -_SHRINK * horizon / change, 1.0))


def _slope(search: Search, mu: Array, d: Array) -> Array:
    """Slope of the barrier function along `d`."""
    return xp.dot(search.gradients.objective + mu * search.gradients.barrier, d)
