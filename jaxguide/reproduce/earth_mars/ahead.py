"""Programs compiled while another one is: those of gains and flights beside that of the nominal.

XLA compiles without the interpreter's lock, and most of its time on one core.
"""

import dataclasses
from concurrent.futures import Executor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxguide.arrays import on_device
from jaxguide.certificate import certified
from jaxguide.neighboring.gains import gain_schedule
from jaxguide.nominal.indirect.shooting import shooting_program
from jaxguide.problem import with_typed_leaves
from jaxguide.problems import earth_mars
from jaxguide.problems.earth_mars import EarthMars
from jaxguide.reproduce.earth_mars.flights import METHOD, fly_variants, histories
from jaxguide.sweeping.tiles import TILE, Order, Tiles
from jaxguide.trajectory import Extremal


def compile_ahead(beside: Executor, times: np.ndarray, instants: np.ndarray, cases: int) -> None:
    """Has `beside` run the gains, a tile of the sweep and the flights about a stand-in of the
    nominal, whose numbers mean nothing: what comes after it finds their programs. Nothing is done
    where the nominal's program is kept already: then so are these.

    **Arguments:** as of what comes after: the schedule's times, the stages' `instants`, and the
    `cases` of the sweep.
    """
    arguments = METHOD, with_typed_leaves(EarthMars()), None
    if not shooting_program.is_kept(*arguments):
        # Traced here: two threads that trace take turns at the interpreter.
        like = shooting_program.eval_shape(*arguments)
        beside.submit(_run, _stand_in(like), times, instants, cases)


def _stand_in(like: Any) -> Extremal:
    """An extremal of these shapes and types about which everything can be computed."""
    number = lambda a: np.full(a.shape, jnp.issubdtype(a.dtype, jnp.floating), a.dtype)
    some = jax.tree_util.tree_map(number, like)
    problem = with_typed_leaves(EarthMars())
    end = problem.final_time
    t = np.linspace(0.0, end, some.t.size)
    some = dataclasses.replace(some, t=t, final_time=end, problem=problem)
    return on_device(certified(some, METHOD.accuracy))


def _run(extremal: Extremal, times: np.ndarray, instants: np.ndarray, cases: int) -> None:
    schedule = gain_schedule(extremal, times)
    of_exact = histories(schedule, instants)
    mission = earth_mars.mission(extremal)
    tiles = Tiles(Order(mission, earth_mars.dispersions(), 0, cases, TILE))
    _ = tiles.bins, tiles.reference
    fly_variants(schedule, instants, of_exact, of_exact, np.asarray(of_exact))
