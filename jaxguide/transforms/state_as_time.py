"""A Problem with one of its states as independent variable in place of time, such as the
horizontal velocity of the lunar launch (thesis)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.problem import Free, Problem, initial_values
from jaxguide.trajectory import Extremal


class StateAsTime(Problem):
    """`problem` with the state `name` as independent variable; time becomes the last state.

    dx/ds = f/f_s and dt/ds = 1/f_s, where f_s is the rate of that state; costs and constraints are
    those of `problem`. The horizon runs from the state's initial to its final value, which is free:
    endpoint constraints fix it. Where f_s has another sign than along the nominal, rates are NaN:
    such a flight ends as `diverged` and never runs backwards in time.

    **Arguments:** `nominal`: an Extremal of `problem`, along which the state must be monotone; it
    gives the direction, and the guess of the final value.

    **Raises:** `ValueError` for an unknown state, or one that is not monotone along the nominal.
    """

    problem: Problem
    name: str = eqx.field(static=True)
    falling: bool = eqx.field(static=True)

    def __init__(self, problem: Problem, name: str, nominal: Extremal):
        states = problem.state_names
        if name not in states:
            raise ValueError(f"StateAsTime: {name!r} is no state; there are {', '.join(states)}.")
        rates = np.asarray(jax.vmap(problem.dynamics)(nominal.t, nominal.x, nominal.u))
        i, monotone = states.index(name), _monotone(rates)
        if not monotone[i]:
            k = int(np.argmax(np.sign(rates[:, i]) != np.sign(rates[0, i])))
            others = [s for s, ok in zip(states, monotone, strict=True) if ok]
            raise ValueError(
                f"StateAsTime: {name} is not monotone along the nominal: its rate is "
                f"{rates[0, i]:.6g} at first and {rates[k, i]:.6g} at t = "
                f"{float(nominal.t[k]):.6g}. "
                + (f"Choose {' or '.join(others)}." if others else "No state of it is; keep time.")
            )
        self.problem, self.name, self.falling = problem, name, bool(rates[0, i] < 0)
        self.state_names = (*(s for s in states if s != name), "t")
        self.control_names = problem.control_names
        start = initial_values(problem, jnp.result_type(float))
        self.initial_time = start[i]
        self.final_time = Free(guess=nominal.x[-1, i])
        t0 = jnp.asarray(problem.initial_time, start.dtype)
        self.initial_state = jnp.append(jnp.delete(start, i), t0)
        bounds = lambda b: jnp.broadcast_to(jnp.asarray(b, start.dtype), (problem.n,))
        self.state_bounds = tuple(
            jnp.append(jnp.delete(bounds(b), i), edge)
            for b, edge in zip(problem.state_bounds, (-jnp.inf, jnp.inf), strict=True)
        )
        self.control_bounds = problem.control_bounds
        self.endpoint_bounds, self.path_bounds = problem.endpoint_bounds, problem.path_bounds
        self.integral_bounds = problem.integral_bounds

    def in_time(self, s: Any, y: Any) -> tuple[Any, Any]:
        """Time and state of `problem`, from the independent variable and state here."""
        i = self.problem.state_names.index(self.name)
        s = jnp.asarray(s, y.dtype)
        return y[-1], jnp.concatenate([y[:i], s[None], y[i:-1]])

    def dynamics(self, t: Any, x: Any, u: Any) -> Any:
        i = self.problem.state_names.index(self.name)
        time, state = self.in_time(t, x)
        f = self.problem.dynamics(time, state, u)
        rate = self._checked(f[i])
        return jnp.concatenate([f[:i], f[i + 1 :], jnp.ones_like(f[:1])]) / rate

    def running_cost(self, t: Any, x: Any, u: Any) -> Any:
        i = self.problem.state_names.index(self.name)
        time, state = self.in_time(t, x)
        rate = self._checked(self.problem.dynamics(time, state, u)[i])
        return self.problem.running_cost(time, state, u) / rate

    def path_constraints(self, t: Any, x: Any, u: Any) -> Any:
        return self.problem.path_constraints(*self.in_time(t, x), u)

    def endpoint_cost(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        (a, x0), (b, xf) = self.in_time(t0, x0), self.in_time(tf, xf)
        return self.problem.endpoint_cost(x0, xf, a, b)

    def endpoint_constraints(self, x0: Any, xf: Any, t0: Any, tf: Any) -> Any:
        (a, x0), (b, xf) = self.in_time(t0, x0), self.in_time(tf, xf)
        return self.problem.endpoint_constraints(x0, xf, a, b)

    def _checked(self, rate: Any) -> Any:
        right = rate < 0 if self.falling else rate > 0
        return jnp.where(right, rate, jnp.nan)


def _monotone(rates: np.ndarray) -> np.ndarray:
    return np.all(rates > 0, axis=0) | np.all(rates < 0, axis=0)
