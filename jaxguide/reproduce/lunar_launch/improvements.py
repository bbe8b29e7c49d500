"""What the last chapter asks for: better terminal guidance, and nodes where they serve best."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from jaxguide.flight.mission import Mission
from jaxguide.laws.suboptimal import LinearGains
from jaxguide.nominal.piecewise_linear import PiecewiseLinear
from jaxguide.problems.lunar_launch import LunarLaunch, mission
from jaxguide.reproduce.lunar_launch.flights import TARGET, fly_cases, thesis_mission
from jaxguide.solving import quick_compilation, solve
from jaxguide.trajectory import Extremal

WEIGHTS = (1.0, 0.1, 0.1)  # of squared errors of y [ft], u and v [ft/s] at the end
ALLOWANCE = 0.02  # s of extra flight that cost nothing
STEPS, RATE = 120, 0.1  # of Adam
SAMPLES = 84  # 72 in the longest flight, and some for its end


class Placed(NamedTuple):
    """Nodes found by gradient, and how."""

    positions: Float[np.ndarray, " k"]
    losses: Float[np.ndarray, " step"]
    mission: Mission


def positions(logits: Float[Array, " k_1"]) -> Float[Array, " k"]:
    """Nodes from 0 to 1 whose spacings are the softmax of `logits`: any, in order."""
    inner = jnp.cumsum(jax.nn.softmax(logits))[:-1]
    return jnp.concatenate([jnp.zeros(1), inner, jnp.ones(1)])


def place_nodes(nominal: Extremal, times: Float[np.ndarray, " case"]) -> Placed:
    """Nine nodes for the thesis's own law, by Adam on the loss of all twenty flights.

    Each gradient goes through the whole closed loop: the nominal re-optimised for the nodes
    (implicitly), its second derivatives and gains, the search for the reference time (implicitly)
    and the flights. `times`: of the flights with even nodes, beyond which extra flight costs.
    """
    method = lambda logits: PiecewiseLinear(positions(logits))

    def flights(logits: Array) -> tuple[Array, Array]:
        again = solve(LunarLaunch(), method(logits), nominal, throw=False)
        loop = thesis_mission(again, max_samples=SAMPLES)
        flown = fly_cases(loop, "ends")
        return flown.final_time, flown.final_state[:, 1:] - TARGET[None]

    def loss(logits: Array) -> Array:
        final_time, off = flights(logits)
        late = jnp.maximum(final_time - times - ALLOWANCE, 0.0)
        return jnp.mean(off**2 @ jnp.asarray(WEIGHTS)) + 1e3 * jnp.mean(late**2)

    options: Any = quick_compilation()
    step = jax.jit(jax.value_and_grad(loss), compiler_options=options)
    optimiser = optax.adam(RATE)
    logits: Any = jnp.zeros(nominal.breaks.shape[0] - 1)
    state, losses, best = optimiser.init(logits), [], (np.inf, logits)
    for _ in range(STEPS):
        value, gradient = step(logits)
        losses.append(float(value))
        if losses[-1] < best[0]:
            best = (losses[-1], logits)
        update, state = optimiser.update(gradient, state)
        logits = optax.apply_updates(logits, update)
    found = solve(LunarLaunch(), method(best[1]), nominal)
    return Placed(np.asarray(positions(best[1])), np.asarray(losses), thesis_mission(found))


def variants(nominal: Extremal, placed: Placed) -> dict[str, Mission]:
    """The law as it is in the thesis, and each change of it."""
    thesis = thesis_mission(nominal)
    exact = mission(nominal, interpolation=LinearGains(), quiet=0.0, miss=None)
    return {
        "the thesis's": thesis,
        "exact gains": exact,
        "exact gains, scaled by the time to go, 1 s quiet": mission(nominal, miss=None),
        "the thesis's, nodes placed by gradient": placed.mission,
    }
