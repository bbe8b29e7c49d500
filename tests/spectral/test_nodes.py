"""Nodes and weights against closed forms and 30-digit arithmetic."""

import time

import mpmath as mp
import numpy as np
import pytest

from jaxguide.spectral import nodes_cgl, nodes_lg, nodes_lgl, nodes_lgr

FAMILIES = {
    "lg": (nodes_lg, lambda n: 2 * n - 1),
    "lgl": (nodes_lgl, lambda n: 2 * n - 3),
    "lgr": (nodes_lgr, lambda n: 2 * n - 2),
    "lgr-right": (lambda n: nodes_lgr(n, "right"), lambda n: 2 * n - 2),
    "cgl": (nodes_cgl, lambda n: n - 1),
}


def pair(n, x):
    """P_n and P_{n-1}, 30 digits."""
    before, p = mp.mpf(0), mp.mpf(1)
    for k in range(n):
        before, p = p, ((2 * k + 1) * x * p - k * before) / (k + 1)
    return p, before


def exact(family, n, i, guess):
    """Node i and its weight to 30 digits, by Newton from the double and textbook formulas."""
    x = mp.mpf(float(guess))
    if family == "cgl":
        m, angle = n - 1, mp.pi * i / (n - 1)
        terms = ((1 if 2 * k == m else 2) * mp.cos(2 * k * angle) / (4 * k * k - 1)
                 for k in range(1, m // 2 + 1))  # fmt: skip
        return -mp.cos(angle), (1 if i in (0, m) else 2) * (1 - mp.fsum(terms)) / m
    m = n - 1
    for _ in range(2):
        if family == "lg":
            p, q = pair(n, x)
            x -= p * (1 - x * x) / (n * (q - x * p))
        elif family == "lgl" and abs(x) < 1:
            p, q = pair(m, x)
            slope = m * (q - x * p) / (1 - x * x)
            x -= slope * (1 - x * x) / (2 * x * slope - m * n * p)
        elif family == "lgr" and x > -1:
            p, q = pair(n, x)
            x -= (p + q) * (1 - x) / (n * (q - p))
    if family == "lg":
        return x, 2 * (1 - x * x) / (n * pair(n, x)[1]) ** 2
    if family == "lgl":
        return x, 2 / (n * m * pair(m, x)[0] ** 2)
    return x, (1 - x) / (n * pair(n, x)[1]) ** 2


@pytest.mark.parametrize("n", [3, 6, 33, 64, 512, 513])
@pytest.mark.parametrize("family", ["lg", "lgl", "lgr", "cgl"])
def test_against_30_digits(family, n):
    x, w = FAMILIES[family][0](n)
    with mp.workdps(30):
        for i in {0, 1, 2, n // 4, n // 2, 2 * n // 3, n - 2, n - 1}:
            node, weight = exact(family, n, i, x[i])
            # Rounding of the result is 1e-16 (half an ulp below 1). In the weights the recurrence
            # adds sqrt(n) roundings, squared: 2 * 23 * 2.2e-16 = 1e-14 at n = 512.
            assert abs(x[i] - node) < 4e-16, (i, x[i], node)
            assert abs(w[i] / weight - 1) < 1e-14, (i, w[i], weight)


@pytest.mark.parametrize(
    ("x_w", "i", "x", "w"),
    [
        (nodes_lg(2), 1, np.sqrt(1 / 3), 1),  # Abramowitz & Stegun, table 25.4
        (nodes_lg(3), 2, np.sqrt(3 / 5), 5 / 9),
        (nodes_lgl(4), 2, np.sqrt(1 / 5), 5 / 6),  # table 25.6
        (nodes_lgl(5), 3, np.sqrt(3 / 7), 49 / 90),
        (nodes_lgr(2), 1, 1 / 3, 3 / 2),
        (nodes_lgr(3), 2, (1 + np.sqrt(6)) / 5, (16 - np.sqrt(6)) / 18),
        (nodes_lgr(3, "right"), 0, -(1 + np.sqrt(6)) / 5, (16 - np.sqrt(6)) / 18),
        (nodes_cgl(5), 1, -np.sqrt(1 / 2), 8 / 15),
        (nodes_cgl(4), 1, -1 / 2, 8 / 9),
    ],
)
def test_closed_forms(x_w, i, x, w):
    np.testing.assert_allclose((x_w[0][i], x_w[1][i]), (x, w), rtol=4e-16 * 2)


@pytest.mark.parametrize("family", FAMILIES)
def test_quadrature_is_exact_to_its_degree_and_no_further(family):
    rule, degree = FAMILIES[family]
    for n in (2, 5, 16):
        x, w = rule(n)
        values = np.polynomial.legendre.legvander(x, degree(n) + 2)
        integrals = w @ values  # of P_k: 2, 0, 0, ...
        integrals[0] -= 2
        # |P_k| <= 1 and weights of sum 2; the recurrence for P_k loses up to k eps.
        assert np.all(np.abs(integrals[: degree(n) + 1]) < 2e-16 * (degree(n) + 2) * 2)
        # The first failure is of order 1 for Gauss rules, n^-3 for Clenshaw-Curtis.
        assert np.any(np.abs(integrals[degree(n) + 1 :]) > 0.5 / n**3)


def test_every_size_is_ascending_symmetric_positive_and_sums_to_two():
    for name, (rule, _) in FAMILIES.items():
        for n in (*range(2, 40), 255, 256, 400):
            x, w = rule(n)
            assert x.shape == w.shape == (n,) and np.all(np.diff(x) > 0) and np.all(w > 0)
            assert abs(w.sum() - 2) < 4e-15  # ten ulps of 2
            if "lgr" in name:
                continue
            assert np.array_equal(x, -x[::-1]) and np.array_equal(w, w[::-1])
    for n in (1, 7, 64):
        right, left = nodes_lgr(n, "right"), nodes_lgr(n, "left")
        assert left[0][0] == -1 and right[0][-1] == 1
        assert np.array_equal(right[0], -left[0][::-1])
        assert np.array_equal(right[1], left[1][::-1])
    assert nodes_lg(1)[0][0] == 0 and nodes_lg(1)[1][0] == 2


def test_cached_read_only_and_quick():
    assert nodes_lg(9) is nodes_lg(9)
    with pytest.raises(ValueError, match="read-only"):
        nodes_lg(9)[0][0] = 0
    for rule in (nodes_lg, nodes_lgl, nodes_lgr, nodes_cgl):
        start = time.process_time()
        rule.__wrapped__(512)
        assert time.process_time() - start < 0.1  # takes 0.002 to 0.02


@pytest.mark.parametrize(
    "call",
    [
        lambda: nodes_lg(0),
        lambda: nodes_lgl(1),
        lambda: nodes_lgr(0),
        lambda: nodes_cgl(1),
    ],
)
def test_too_few_points(call):
    with pytest.raises(ValueError, match=r"needs n >= \d nodes, got"):
        call()


def test_wrong_end():
    with pytest.raises(ValueError, match="'middle'"):
        nodes_lgr(4, "middle")
