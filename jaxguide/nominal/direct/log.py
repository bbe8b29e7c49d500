"""The optimiser's iteration log, line by line. Host only."""

from typing import Any


def report(mode: Any, unit: Any, k: Any, f: Any, c: Any, error: Any, *rest: Any) -> None:
    """One line of the iteration log; objective in the user's units."""
    if k == 0:
        print("iter  objective        violation  error      mu       delta    step")
    kind = " re"[int(mode)]
    mu, delta, alpha = (float(v) for v in rest)
    print(
        f"{int(k):4d}{kind} {float(f) * float(unit):+.9e} {float(c):.2e}   {float(error):.2e}   "
        f"{mu:.1e}  {delta:.1e}  {alpha:.2g}"
    )
