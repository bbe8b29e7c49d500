"""`jg.tune`: a design that lowers an objective, by gradient. A host loop around one program."""

import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from jaxguide.host.progress import NoProgress, Progress
from jaxguide.montecarlo.rollouts import case_key
from jaxguide.tuning.designs import checked, named, values
from jaxguide.tuning.record import History, Tuned, on_host

_EVERY = 1.0  # s between two writings of the history


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

    One program gives value, gradient and the next design; it is compiled once. The derivative goes
    through whatever `build` does: a nominal (implicitly), its second variation and gains, a law;
    and through the flights of the objective.

    **Arguments:**

    - `objective(built, keys)`: a scalar, or (scalar, dict of scalars to record beside it). Pure. A
      `jaxguide.tuning.Flown` flies the cases, and `jaxguide.tuning.cvar`, `quantile`, `above` ...
      make one number of them. `keys` (cases,): the same at every step (common random numbers), and
      those of `jg.sweep` with this seed.
    - `design`: a pytree of floating arrays; `jaxguide.tuning.Bounded` and `Ascending` keep a leaf
      within bounds or in order. A mission's `max_samples` must not depend on it.
    - `build`: design -> Mission, or whatever else the objective takes (an Extremal, say). With a
      `temperature`: (design, temperature) -> the same.
    - `optimizer`: an Optax gradient transformation; default `optax.adam(0.05)`.
    - `temperature`: step -> temperature of a relaxation, such as `jaxguide.tuning.cooling`.
    - `tolerance`: stop when the gradient's norm is below it.
    - `out`: a folder for the history, kept up to date as the run goes.
    - `progress`: a meter. `compiler_options`: for XLA.

    **Returns:** a `Tuned`, with the best design seen.

    **Raises:** `ValueError` for a design with a leaf that is no floating array, is not finite, or
    on which the objective does not depend; for an objective that is no scalar, or is not finite at
    the start, naming the leaf. If it stops being finite later the run ends there, with a warning.
    """
    for name, value in (("steps", steps), ("cases", cases)):
        if not isinstance(value, (int, np.integer)) or value < 1:
            raise ValueError(f"tune: {name} is {value!r}; give an integer of at least 1.")
    if not tolerance >= 0:
        raise ValueError(f"tune: tolerance is {tolerance}; give a number >= 0.")
    optimizer = optax.adam(0.05) if optimizer is None else optimizer
    if not hasattr(optimizer, "update"):
        raise ValueError(
            f"tune: optimizer is {optimizer!r}; give an Optax transformation, such as "
            "optax.adam(0.05)."
        )
    raw = checked(design)
    keys = jax.vmap(lambda k: case_key(seed, k))(jnp.arange(cases))
    cooled = (lambda k: 0.0) if temperature is None else temperature
    warm = lambda k: np.asarray(cooled(k), float)

    def loss(raw: Any, keys: Array, heat: Array) -> tuple[Array, dict[str, Array]]:
        own = values(raw)
        built = build(own) if temperature is None else build(own, heat)
        found = objective(built, keys)
        value, terms = found if isinstance(found, tuple) else (found, {})
        if jnp.shape(value) != ():
            raise ValueError(
                f"tune: the objective returned shape {jnp.shape(value)}; give a scalar, such as "
                "jnp.mean(...) of what the flights measured."
            )
        return value, terms

    def step(raw: Any, state: Any, keys: Array, heat: Array) -> tuple:
        (value, terms), slope = jax.value_and_grad(loss, has_aux=True)(raw, keys, heat)
        with jax.numpy_dtype_promotion("standard"):  # Optax adds floats to integers
            update, state = optimizer.update(slope, state, raw)
            moved = optax.apply_updates(raw, update)
            norm = optax.tree.norm(slope)
        return value, norm, terms, slope, moved, state

    with jax.numpy_dtype_promotion("standard"):
        state = optimizer.init(raw)
    began = time.perf_counter()
    traced = jax.jit(step, compiler_options=compiler_options).trace(raw, state, keys, warm(0))
    _refuse_idle(traced.jaxpr, raw)
    program = traced.lower().compile()
    compile_s = time.perf_counter() - began

    history = History(None if out is None else Path(out))
    best, stopped, message = None, "steps", f"all {steps} steps done."
    lowest, written = np.inf, time.perf_counter()
    meter = NoProgress() if progress is None else progress
    shown, began = meter.init(), time.perf_counter()
    try:
        for k in range(steps):
            heat = warm(k)
            value, norm, terms, slope, moved, state = jax.device_get(
                program(raw, state, keys, heat)
            )
            own = on_host(raw)
            row = {"loss": value, "gradient_norm": norm}
            row |= {"temperature": heat} if temperature else {}
            row |= {f"term:{name}": term for name, term in terms.items()}
            history.add(row | {f"design:{name}": leaf for name, leaf in named(own).items()})
            bad = _not_finite(value, slope, raw)
            if bad:
                stopped, message = "not finite", f"step {k}: {bad}"
                break
            if k == 0 and float(norm) == 0:
                raise ValueError(
                    "tune: the gradient is zero at the start, in every leaf of the design: the "
                    "objective does not depend on it here (a count that was rounded, a comparison, "
                    "a constraint met by all?). Relax it, or start elsewhere."
                )
            # At another temperature it is another objective.
            if best is None or float(heat) < lowest or float(value) < best[0]:
                best, lowest = (float(value), k, raw, own), float(heat)
            shown = meter.step(shown, (k + 1) / steps)
            if time.perf_counter() - written > _EVERY:
                history.write()
                written = time.perf_counter()
            if float(norm) <= tolerance and (temperature is None or float(heat) == warm(steps)):
                stopped, message = "tolerance", f"the gradient's norm is {float(norm):.3g}."
                break
            raw = moved
    finally:
        meter.close(shown)
        if history.rows:
            history.write()
    done = len(history.rows)
    if best is None:
        raise ValueError(f"tune: {message}")
    if stopped == "not finite":
        warnings.warn(
            f"tune: {message} The best design before is returned.", RuntimeWarning, stacklevel=2
        )
    return Tuned(
        design=best[3],
        raw=best[2],
        start=on_host(checked(design)),
        loss=best[0],
        at=best[1],
        history=history.columns(),
        stopped=stopped,
        message=message,
        compile_s=compile_s,
        step_s=(time.perf_counter() - began) / done,
    )


def _not_finite(value: Any, slope: Any, raw: Any) -> str:
    """What is not finite, if anything, and where to look."""
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
    """Refuses leaves that the loss, the first output of `closed`, does not read."""
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
