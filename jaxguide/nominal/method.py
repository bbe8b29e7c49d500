"""What a method is: a way from a Problem to an Extremal, what it can do and what it refuses."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxguide.host.compilation import compiled
from jaxguide.problem import Problem, count, endpoint_count, is_endless
from jaxguide.trajectory import Extremal
from jaxguide.types import is_traced


class Capabilities(NamedTuple):
    """What a method can do with a Problem. `refuse_beyond` refuses the rest by name.

    - `direct`: optimises a discretised problem; otherwise solves the necessary conditions or a
      problem in few parameters.
    - `bounds`: keeps state and control bounds and path constraints. Otherwise the method looks at
      them in the end, and an extremal that leaves them has `RESULTS.bounds_violated`.
    - `inequalities`: endpoint constraints between bounds that differ.
    - `integrals`: integral constraints.
    - `parameters`: static parameters, fields of the Problem that hold a `jg.Free`.
    - `endless`: an infinite final time; the method is then given the problem on [-1, 1], with a
      field `time_scale` for the map (`jaxguide/transforms/endless.py`).
    - `mesh`: has a mesh that `solve` may refine. Such a method has the fields of
      `jg.Pseudospectral` that a mesh consists of (`nodes`, `segments`, `fractions`, `knots`,
      `arcwise`), those that say how long to go on (`refinements`, `mesh_tolerance`, `tolerance`,
      `starts`, `seed`, `relaxation`), `units(problem)` and `key(k)`: `solve` replaces them.
    - `random_start`: takes a `jax.random.key` as its guess.
    - `array_guess`: what an array given as the guess means to it, such as "the initial costates";
      empty: it takes none.
    """

    direct: bool
    bounds: bool = False
    inequalities: bool = False
    integrals: bool = False
    parameters: bool = False
    endless: bool = False
    mesh: bool = False
    random_start: bool = False
    array_guess: str = ""


class Method(eqx.Module):
    """Abstract: a way from a Problem to an Extremal, for `jg.solve` and `jg.solve_batch`.

    A subclass states `accuracy` and `capabilities` as class variables and implements `__call__`.
    Its fields are its options: static ones (`eqx.field(static=True)`) may decide shapes, the others
    are differentiable. `jg.solve` validates the Problem, refuses what is beyond `capabilities`,
    calls `check`, checks the guess, and attaches the certificate.
    """

    accuracy: eqx.AbstractClassVar[float]
    """Relative error up to which a row of its certificates passes."""

    capabilities: eqx.AbstractClassVar[Capabilities]

    quick = False
    """Whether its program compiles in half the time, to run a fifth slower. A field may say so."""

    @abc.abstractmethod
    def __call__(self, problem: Problem, guess: Any) -> Extremal:
        """The extremal. Pure: under `jit`, `vmap` and `grad`, without host checks.

        **Arguments:**

        - `problem`: checked, every leaf an array (traced, perhaps). Derivatives by its leaves
          should be implicit, of the conditions that were met, never through the iterations; where
          none were met they are NaN.
        - `guess`: None, an Extremal of a similar problem, and what `capabilities` admits besides.

        **Returns:** an Extremal in the user's units, on segments that share their ends, whose
        multipliers have the signs of the Extremal's docstring. `.result` is `RESULTS.successful`
        or the reason; it never raises for a number, and NaN is never successful.

        **Raises:** `ValueError` for shapes alone.
        """

    def check(self, problem: Problem) -> None:
        """Refuses what this method cannot do with `problem` beyond what its `capabilities` say.

        Called before every solve, under a trace too: shapes and types may be looked at always,
        numbers only where `jaxguide.types.is_traced` denies that they are traced.

        **Raises:** `ValueError` that names the field, its value and the remedy.
        """

    def run(self, problem: Problem, guess: Any) -> Extremal:
        """`__call__` as one compiled program: what `jg.solve` calls outside a trace. A method whose
        program is better cut in two overrides it, and may give the host's arrays. Host only."""
        return compiled(called, self.quick)(self, problem, guess)


def run_on_host(method: Method, problem: Problem, guess: Any) -> Extremal:
    """`method.run`, its numbers as the host's arrays."""
    return jax.device_get(method.run(problem, guess))


def called(method: Method, problem: Problem, guess: Any) -> Extremal:
    """`method(problem, guess)` as a function, for a compiler."""
    return method(problem, guess)


def refuse_beyond(method: Method, problem: Problem) -> None:
    """Refuses what `problem` has and `method.capabilities` lacks. Shapes and types are looked at
    under a trace too, numbers where they are not traced.

    **Raises:** `ValueError` that names the field and the remedy.
    """
    kind, name, can = type(problem).__name__, type(method).__name__, method.capabilities
    paths = problem.parameter_paths()
    if paths and not can.parameters:
        raise ValueError(
            f"{kind}.{'.'.join(map(str, paths[0]))} is a jg.Free static parameter, which {name} "
            "does not choose; give it a number, use jg.Pseudospectral, or add it as a state with "
            "zero rate and a free initial value."
        )
    if not problem.m and not can.mesh:
        raise ValueError(
            f"{kind} has no control, and {name} seeks one; use jg.Pseudospectral, which chooses "
            "initial states and static parameters without."
        )
    if not can.integrals and (r := count(problem, "integrands")):
        raise ValueError(
            f"{kind}.integrands: {r} integral constraints, which {name} does not enforce; write "
            "each as a state with an endpoint constraint, or use jg.Pseudospectral."
        )
    if not can.endless and is_endless(problem):
        raise ValueError(
            f"{kind}.final_time is infinite; {name} needs a finite one (try some ten time "
            "constants), or use jg.Pseudospectral."
        )
    if not can.inequalities and not is_traced(problem.endpoint_bounds):
        q = endpoint_count(problem)
        lo, hi = (np.broadcast_to(np.asarray(b), (q,)) for b in problem.endpoint_bounds)
        if np.any(lo != hi):
            i = int(np.argmax(lo != hi))
            raise ValueError(
                f"{kind}.endpoint_bounds: constraint {i} is an inequality [{lo[i]}, {hi[i]}]; "
                f"{name} takes equalities: set both bounds to the active value, leave it out, or "
                "use jg.Pseudospectral."
            )
