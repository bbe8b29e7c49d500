"""Numbers and statements of Ross & Karpenko, review (2012), and numbers of a reference computed
without this package.

The review prints figures, Table 1 and rates, but few numbers. The reference's "N" is the number of
points, as in the review's E1 and E2.
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

# Infinite-horizon regulator: order of magnitude of the error of J by points (reference).
INFINITE = {10: 1e-5, 20: 1e-10, 40: 1e-14}


def residual_rate(m: int) -> float:
    """Exponent of N - 1 in the residual delta^N of a state in W^{m,inf}: review, Theorem 2."""
    return 1.5 - m


def state_rate(m: int) -> float:
    """Exponent of N - 1 in the bound of |x_i - x(t_i)|: review, Theorem 2."""
    return 1.0 - m


def cost_rate(m: int) -> float:
    """Exponent of N in the error of the cost: Kang, quoted in the review, section 4.3."""
    return 1.0 - 2.0 * m / 3.0
