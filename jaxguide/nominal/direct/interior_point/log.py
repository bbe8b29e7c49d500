"""The optimiser's iteration log, line by line. Host only."""

from typing import Any


def print_iteration(
    mode: Any, unit: Any, k: Any, f: Any, c: Any, error: Any, mu: Any, delta: Any, alpha: Any
) -> None:
    """Prints iteration `k`: objective in user units (`f` times `unit`), worst constraint, scaled
    error, barrier, regularisation and step. "r" marks restoration, "e" an estimate of the
    multipliers."""
    if k == 0:
        print("iter  objective        violation  error      mu       delta    step")
    kind = " re"[int(mode)]
    print(
        f"{int(k):4d}{kind} {float(f) * float(unit):+.9e} {float(c):.2e}   {float(error):.2e}   "
        f"{float(mu):.1e}  {float(delta):.1e}  {float(alpha):.2g}"
    )
