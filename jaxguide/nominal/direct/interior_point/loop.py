"""The iterations: one step after another, until the first-order conditions hold or none helps."""

import functools
from collections.abc import Callable
from typing import Any

import jax

from jaxguide.arrays import Array, either, loop, on_numpy, xp
from jaxguide.nominal.direct.box import Box, boxed, distances, inside
from jaxguide.nominal.direct.interior_point.barrier import MEMORY, barrier_of
from jaxguide.nominal.direct.interior_point.direction import factorised, gradients_of
from jaxguide.nominal.direct.interior_point.evaluation import Iterate, evaluated
from jaxguide.nominal.direct.interior_point.filter import empty_filter
from jaxguide.nominal.direct.interior_point.line_search import searched
from jaxguide.nominal.direct.interior_point.log import print_iteration
from jaxguide.nominal.direct.interior_point.state import (
    CONVERGED,
    ESTIMATE,
    INFEASIBLE,
    NEWTON,
    RUNNING,
    STALLED,
    Options,
    Setup,
    Solution,
    Start,
    State,
)
from jaxguide.nominal.direct.interior_point.transition import following
from jaxguide.nominal.direct.limits import Limits
from jaxguide.nominal.direct.transcription import Transcription
from jaxguide.nominal.direct.trees import largest, one_norm
from jaxguide.nominal.direct.unknowns import flattened

# Violations above which no point is acceptable, and below which the switching condition counts,
# relative to the first violation or 1: Waechter & Biegler (2006), eq. (21), and before eq. (19).
_THETA_MAX, _THETA_MIN = 1e4, 1e-4


def minimise(program: Transcription, limits: Limits, start: Start, options: Options) -> Solution:
    """Iterates from `start` to a point that meets the first-order conditions, or says why not.

    Contradictory bounds, and a horizon that cannot be positive, are infeasible at once.

    **Source:** Waechter & Biegler (2006), Algorithm A.
    """
    return ended(
        program, iterated(program, limits, options, begun(program, limits, start, options))
    )


def begun(program: Transcription, limits: Limits, start: Start, options: Options) -> State:
    """The state before the first iteration of `minimise`."""
    impossible = xp.any(flattened(limits.lo) > flattened(limits.hi))
    impossible = impossible | (limits.hi.times[1] <= limits.lo.times[0])
    return _first_state(_setup(program, limits, options), start, impossible)


def iterated(
    program: Transcription,
    limits: Limits,
    options: Options,
    state: State,
    further: Callable[[], bool] | None = None,
) -> State:
    """The state after all iterations; on the host, before one for which `further` is false."""
    setup = _setup(program, limits, options)

    def going(s: State) -> Any:
        running = s.status == RUNNING
        return running if further is None else running and further()

    return loop(going, lambda s: _advanced(setup, s), state)


def ended(program: Transcription, end: State) -> Solution:
    """The solution in the last state."""
    w, zl, zu = (program.shaped(a) for a in (end.w, end.zl, end.zu))
    _, c = program.objective_and_residual(w)
    return Solution(w, end.y, zl, zu, end.mu, end.status, end.iteration, end.error, largest(c))


def _setup(program: Transcription, limits: Limits, options: Options) -> Setup:
    return Setup(program, Box(*map(flattened, boxed(limits))), options)


def _first_state(setup: Setup, start: Start, impossible: Array) -> State:
    """The start moved inside its bounds, with bounds' multipliers mu/distance or those given;
    Waechter & Biegler (2006), section 3.6."""
    (program, box, options), dtype = setup, setup.program.dtype
    w, net = inside(box, flattened(start.w), options.push), flattened(start.net)
    mu = xp.asarray(options.mu, dtype)
    low, high = distances(box, w)
    held = lambda a, z, on: xp.where(on, xp.maximum(mu / a, z), 0.0)
    zl, zu = held(low, -net, box.below), held(high, net, box.above)
    _, c = program.objective_and_residual(program.shaped(w))
    theta = one_norm(c)
    zero, none = xp.zeros((), dtype), xp.zeros((), xp.int32)
    return State(
        w=w,
        y=start.y,
        zl=zl,
        zu=zu,
        mu=mu,
        filter=empty_filter(dtype),
        theta_max=_THETA_MAX * xp.maximum(1.0, theta),
        theta_min=_THETA_MIN * xp.maximum(1.0, theta),
        theta_entry=theta,
        delta=zero,
        mode=xp.where(options.warm, NEWTON, ESTIMATE).astype(xp.int32),
        iteration=none,
        status=xp.where(impossible, none + INFEASIBLE, RUNNING),
        error=zero + xp.inf,
        free=xp.array(False),
        errors=xp.full(MEMORY, xp.inf, dtype),
    )


def _advanced(setup: Setup, s: State) -> State:
    """The state after one step of any kind; converged, if none is needed any more."""
    at = evaluated(setup, s)
    now = at.error_now
    done = at.kind.newton & (now <= setup.options.tolerance)  # Waechter & Biegler (2006), eq. (6)
    # A derivative that is no number leaves no step: the error says so.
    lost = xp.isnan(now)
    status = s.status * 0 + xp.where(lost, STALLED, CONVERGED).astype(s.status.dtype)
    ended = s._replace(status=status, iteration=s.iteration + 1, error=now)
    none = xp.zeros_like(s.mu)
    stop, go_on = lambda: (ended, none, none), lambda: _step(setup, at)
    new, delta, alpha = either(done | lost, stop, go_on)
    program = setup.program
    if program.log:
        numbers = (s.iteration, at.f, largest(at.c), now, new.mu, delta, alpha)
        show = (
            print_iteration
            if on_numpy(s.w)
            else functools.partial(jax.debug.callback, print_iteration)
        )
        show(s.mode, program.scale.objective, *numbers)
    return new


def _step(setup: Setup, at: Iterate) -> tuple[State, Array, Array]:
    """One step: the next state, and the step's regularisation and length."""
    gradients = gradients_of(setup, at)
    matrix = factorised(setup, at)
    barrier = barrier_of(setup, at, matrix.delta)
    found = searched(setup, at, matrix, gradients, barrier)
    new = following(setup, at, matrix, barrier, found)
    return new, matrix.delta, xp.where(found.accepted, found.alpha, 0.0)
