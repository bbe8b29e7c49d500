"""`jg.tune`: a design that lowers an objective, by gradient. A host loop around one program."""

import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from jaxguide.host.progress import NoProgress, Progress
from jaxguide.montecarlo.rollouts import case_key
from jaxguide.tuning.record import Recorder, Tuned, on_host
from jaxguide.tuning.variables import checked, named, values

_EVERY = 1.0  # s between two writings of the history: a killed run loses no more


class _Descent(NamedTuple):
    """What each step of a run needs, and when it stops: `program(raw, state, keys, temperature)`
    gives value, gradient norm, terms, gradient, and the next `raw` and `state`."""

    program: Any
    keys: Array
    temperature: Callable[[int], np.ndarray]
    cools: bool
    steps: int
    tolerance: float


class _Best(NamedTuple):
    """The best design of a run: its loss, step and temperature, `raw` as the optimiser has it and
    `design` as `build` takes it."""

    loss: float
    at: int
    temperature: float
    raw: Any
    design: Any


class _End(NamedTuple):
    """Why a run ended: `stopped`, a word, and `message`, a sentence."""

    best: _Best | None
    stopped: str
    message: str


def tune(
    objective: Callable[..., Any],
    design: Any,
    build: Callable[..., Any],
    optimizer: Any = None,
    *,
    steps: int = 100,
    cases: int = 256,
    seed: int = 0,
    temperature: Callable[[int], float] | None = None,
    tolerance: float = 0.0,
    out: Any = None,
    progress: Progress | None = None,
    compiler_options: dict[str, Any] | None = None,
) -> Tuned:
    """Lowers `objective(build(design), keys)` by gradient.

    One program, compiled once, gives value, gradient and the next design. The derivative goes
    through all that `build` does: a nominal (implicitly), its second variation and gains, a law;
    and through the flights of the objective.

    **Arguments:**

    - `objective(built, keys)`: a scalar, or (scalar, dict of scalars to record beside it). Pure. A
      `jaxguide.tuning.Flown` flies the cases, and `jaxguide.tuning.cvar`, `quantile`, `above` ...
      reduce them to one number. `keys` (cases,): the same at every step (common random numbers),
      and those of `jg.sweep` with this seed.
    - `design`: a pytree of floating arrays; `jaxguide.tuning.Bounded` and `Ascending` keep a leaf
      within bounds or in order. A mission's `max_samples` must not depend on it.
    - `build`: design -> Mission, or another object that the objective takes (an Extremal, say).
      With a `temperature`: (design, temperature) -> the same.
    - `optimizer`: an Optax gradient transformation; default `optax.adam(0.05)`.
    - `temperature`: step -> temperature of a relaxation, such as `jaxguide.tuning.cooling`.
    - `tolerance`: stop when the gradient's norm is below it.
    - `out`: a folder for the history, written every second of the run.
    - `progress`: a meter. `compiler_options`: XLA's.

    **Returns:** a `Tuned`, with the best design seen.

    **Raises:** `ValueError` for a design with a leaf that is no floating array, is not finite, or
    on which the objective does not depend; for an objective that is no scalar, or is not finite at
    the start, naming the leaf. If it stops being finite later the run ends there, with a warning.
    """
    _check(steps, cases, tolerance)
    optimizer = optax.adam(0.05) if optimizer is None else optimizer
    if not hasattr(optimizer, "update"):
        raise ValueError(
            f"tune: optimizer is {optimizer!r}; give an Optax transformation, such as "
            "optax.adam(0.05)."
        )
    raw = checked(design)
    keys = jax.vmap(lambda k: case_key(seed, k))(jnp.arange(cases))
    cools = temperature is not None
    cooled = temperature or (lambda k: 0.0)
    heat = lambda k: np.asarray(cooled(k), float)
    with jax.numpy_dtype_promotion("standard"):
        state = optimizer.init(raw)
    step = _step(_loss(objective, build, cools), optimizer)
    began = time.perf_counter()
    program = _compiled(step, (raw, state, keys, heat(0)), compiler_options)
    compile_s = time.perf_counter() - began

    recorder = Recorder(None if out is None else Path(out))
    meter = NoProgress() if progress is None else progress
    descent = _Descent(program, keys, heat, cools, steps, tolerance)
    shown, began = meter.init(), time.perf_counter()
    try:
        end = _descend(descent, raw, state, recorder, meter, shown)
    finally:
        meter.close(shown)
        if recorder.rows:
            recorder.write()
    if end.best is None:
        raise ValueError(f"tune: {end.message}")
    if end.stopped == "not finite":
        text = f"tune: {end.message} The best design before is returned."
        warnings.warn(text, RuntimeWarning, stacklevel=2)
    return Tuned(
        design=end.best.design,
        raw=end.best.raw,
        start=on_host(raw),
        loss=end.best.loss,
        at=end.best.at,
        history=recorder.columns(),
        stopped=end.stopped,
        message=end.message,
        compile_s=compile_s,
        step_s=(time.perf_counter() - began) / len(recorder.rows),
    )


def _check(steps: Any, cases: Any, tolerance: float) -> None:
    for name, value in (("steps", steps), ("cases", cases)):
        if not isinstance(value, (int, np.integer)) or value < 1:
            raise ValueError(f"tune: {name} is {value!r}; give an integer of at least 1.")
    if not tolerance >= 0:
        raise ValueError(f"tune: tolerance is {tolerance}; give a number >= 0.")


def _loss(
    objective: Callable[..., Any], build: Callable[..., Any], cools: bool
) -> Callable[..., tuple[Array, dict[str, Array]]]:
    """(raw, keys, temperature) -> the objective, and the terms recorded beside it."""

    def loss(raw: Any, keys: Array, heat: Array) -> tuple[Array, dict[str, Array]]:
        design = values(raw)
        built = build(design, heat) if cools else build(design)
        found = objective(built, keys)
        value, terms = found if isinstance(found, tuple) else (found, {})
        if jnp.shape(value) != ():
            raise ValueError(
                f"tune: the objective returned shape {jnp.shape(value)}; give a scalar, such as "
                "jnp.mean(...) over the flights."
            )
        return value, terms

    return loss


def _step(loss: Callable[..., Any], optimizer: Any) -> Callable[..., tuple]:
    """(raw, state, keys, temperature) -> value, gradient norm, terms, gradient, next raw, state."""

    def step(raw: Any, state: Any, keys: Array, heat: Array) -> tuple:
        (value, terms), slope = jax.value_and_grad(loss, has_aux=True)(raw, keys, heat)
        with jax.numpy_dtype_promotion("standard"):  # Optax adds floats to integers
            update, state = optimizer.update(slope, state, raw)
            moved = optax.apply_updates(raw, update)
            norm = optax.tree.norm(slope)
        return value, norm, terms, slope, moved, state

    return step


def _compiled(step: Callable[..., tuple], arguments: tuple, options: Any) -> Any:
    """`step` compiled, once it is known that the objective depends on every leaf."""
    traced = jax.jit(step, compiler_options=options).trace(*arguments)
    _refuse_idle(traced.jaxpr, arguments[0])
    return traced.lower().compile()


def _descend(
    run: _Descent, raw: Any, state: Any, recorder: Recorder, meter: Progress, shown: Any
) -> _End:
    """Steps from `raw` until the gradient vanishes, something is not finite, or all are done."""
    best, written = None, time.perf_counter()
    for k in range(run.steps):
        heat = run.temperature(k)
        value, norm, terms, slope, moved, state = jax.device_get(
            run.program(raw, state, run.keys, heat)
        )
        design = on_host(raw)
        recorder.add(_row(value, norm, heat if run.cools else None, terms, design))
        fault = _not_finite(value, slope, raw)
        if fault:
            return _End(best, "not finite", f"step {k}: {fault}")
        if k == 0 and float(norm) == 0:
            raise ValueError(
                "tune: the gradient is zero at the start, in every leaf of the design: the "
                "objective does not depend on it here (a count that was rounded, a comparison, a "
                "constraint met by all?). Relax it, or start elsewhere."
            )
        # At another temperature the objective is another one, so losses do not compare.
        if best is None or float(heat) < best.temperature or float(value) < best.loss:
            best = _Best(float(value), k, float(heat), raw, design)
        shown = meter.step(shown, (k + 1) / run.steps)
        if time.perf_counter() - written > _EVERY:
            recorder.write()
            written = time.perf_counter()
        coldest = not run.cools or float(heat) == run.temperature(run.steps)
        if float(norm) <= run.tolerance and coldest:
            return _End(best, "tolerance", f"the gradient's norm is {float(norm):.3g}.")
        raw = moved
    return _End(best, "steps", f"all {run.steps} steps done.")


def _row(value: Any, norm: Any, heat: Any, terms: dict[str, Any], design: Any) -> dict[str, Any]:
    """One row of the history, by column."""
    row = {"loss": value, "gradient_norm": norm}
    row |= {} if heat is None else {"temperature": heat}
    row |= {f"term:{name}": term for name, term in terms.items()}
    return row | {f"design:{name}": leaf for name, leaf in named(design).items()}


def _not_finite(value: Any, slope: Any, raw: Any) -> str:
    """Names the value that is not finite and a likely cause; "" if all are finite."""
    leaves = named(slope)
    bad = [name for name, leaf in leaves.items() if not np.all(np.isfinite(leaf))]
    where = ", ".join(f"{name} = {np.asarray(named(on_host(raw))[name])}" for name in bad)
    if not np.isfinite(value):
        at = where or ", ".join(f"{k} = {np.asarray(v)}" for k, v in named(on_host(raw)).items())
        return (
            f"the objective is {float(value)} at {at}. Keep the design where flights are finite "
            "(tuning.Bounded), or lower the learning rate."
        )
    if bad:
        return (
            f"the objective is finite, but its derivative by {where} is not: look for a square "
            "root, a norm or a division at zero, and guard it by a double `where`; or keep the "
            "leaf away from there (tuning.Bounded)."
        )
    return ""


def _refuse_idle(closed: Any, raw: Any) -> None:
    """Raises `ValueError` for leaves that the loss, the first output of `closed`, does not read."""
    jaxpr = closed.jaxpr
    needed = {id(jaxpr.outvars[0])}
    for equation in reversed(jaxpr.eqns):
        if any(id(out) in needed for out in equation.outvars):
            needed |= {id(v) for v in equation.invars}
    leaves = named(raw)
    idle = [n for n, v in zip(leaves, jaxpr.invars, strict=False) if id(v) not in needed]
    if idle:
        raise ValueError(
            f"tune: the objective does not depend on {', '.join(map(repr, idle))} of the design; "
            "use it in `build`, or leave it out."
        )
