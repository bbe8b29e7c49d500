"""Numbers and statements of the 2012 review, and of a reference computed without this package.

The review prints figures, Table 1 and rates, and hardly a number. The reference counts points in
"N", as the review's E1 and E2 do.
"""

# E1 on uniform grids, section 4.2.2: the review says that all weights are positive at 10 points,
# and that "when N >= 11, at least one of the weights is negative".
POSITIVE_POINTS = 10
LEAST_WEIGHT = {10: 0.0241, 12: -0.220}  # reference, in the digits given
NEGATIVE_WEIGHTS = {10: 0, 12: 4}
STILL_OPTIMAL = (9, 11)  # reference: negative weights, yet u = -1

# E2 on 10 points: max |u - 1| that the reference's optimiser reached; 1 is the bound itself.
CONTROL_ERRORS = {
    ("lgl", False): 1.7e-9,
    ("lgr-left", False): 1.0,
    ("lg", False): 1.0,
    ("lgr-left", True): 2e-9,
    ("lg", True): 1.5e-9,
}

# Table 1: weight W, grid, boundary conditions.
TABLE_1 = {"lgl": ("1", "any"), "lgr-left": ("1-t", "fixed-free"), "lg": ("1-t^2", "free-free")}

# Infinite-horizon regulator: order of the error of J by points (reference).
INFINITE = {10: 1e-5, 20: 1e-10, 40: 1e-14}


def residual_rate(m: int) -> float:
    """Theorem 2: delta^N = (N - 1)^(3/2 - m)."""
    return 1.5 - m


def state_rate(m: int) -> float:
    """Theorem 2: |x_i - x(t_i)| <= L (N - 1)^(1 - m)."""
    return 1.0 - m


def cost_rate(m: int) -> float:
    """Kang, as section 4.3 quotes him: the cost converges as N^(1 - 2m/3)."""
    return 1.0 - 2.0 * m / 3.0
