"""Node families: the contract of `jg.NodeFamily`, the five of the package, and their names."""

import abc
from typing import ClassVar

import equinox as eqx
import numpy as np

from jaxguide.spectral.nodes import Nodes, check_end, nodes_cgl, nodes_lg, nodes_lgl, nodes_lgr

# How far a quadrature rule may miss the integral of a Legendre polynomial. The five families miss
# it by n eps, 1e-13 at n = 512. A rule of a lower degree than stated misses by 0.5 / n^3 or more
# (tests), which is above this for n < 1700.
_EXACT = 1e-10
# Nodes nearer to an end than this, but not on it, are rounding: the nearest of 512 Gauss nodes is
# 1e-5 away.
_ON_THE_END = 1e-12


class NodeFamily(eqx.Module):
    r"""Nodes on [-1, 1] with quadrature weights, for every number of nodes: where
    `jg.Pseudospectral(grid=...)` collocates, segment by segment.

    To write one, derive a class that defines `nodes` and `exact_degree`, and `least` if one node
    is too few; hand over an object of it. This one is Fejer's first rule:

        class Fejer(jg.NodeFamily):
            def nodes(self, n):
                theta = (2 * np.arange(n)[::-1] + 1) * np.pi / (2 * n)
                k = np.arange(1, n // 2 + 1)
                terms = np.cos(2 * k * theta[:, None]) / (4 * k**2 - 1)
                return np.cos(theta), 2 / n * (1 - 2 * terms.sum(axis=1))

            def exact_degree(self, n):
                return n - 1

        jg.solve(problem, jg.Pseudospectral(grid=Fejer()))

    **Which collocation follows** depends on one thing, whether -1 and +1 are among the nodes:

    - both (LGL, CGL): state and control live at the n nodes. The differentiation matrix is square,
      one equation a segment more than the states after the first; it restricts the control. Needs
      3 nodes.
    - -1 alone (LGR): the state also lives at +1.
    - +1 alone (LGR flipped): the state also lives at -1.
    - neither (LG): the state also lives at both ends; the last is the first plus the quadrature
      of the dynamics.

    The last three need 2 nodes.

    **What the weights do:** they integrate the running cost, and defect multipliers over weights
    are the costates. Solutions are of spectral accuracy if the rule is exact to degree 2n - 3 or
    more. With a rule that is exact to degree n - 1 only, as interpolation through any n nodes makes
    it, controls and costates converge about as n^-2 and the cost as n^-4 (measured with Fejer's
    rule on the double integrator).

    **Fields** of a family, such as the exponents of Jacobi polynomials, are numbers, strings or
    tuples of these, never arrays: a family is hashed, compared by value, and a static part of
    compiled programs. `nodes` computes on the host, in NumPy; its result is kept.

    **Source:** Ross & Karpenko, review (2012), eqs. (10)-(16), and section 4.2.2 for why weights
    must be positive.
    """

    least: ClassVar[int] = 1
    """The smallest n that `nodes` takes."""

    @abc.abstractmethod
    def nodes(self, n: int) -> Nodes:
        """`n` nodes and their weights.

        **Arguments:** `n`: number of nodes, from `least` to 512 (the most that
        `jg.Pseudospectral` asks for).

        **Returns:** `(x, w)`, NumPy float64 of shape (n,). `x` ascends on [-1, 1], dimensionless;
        an end that is a node is exactly -1.0 or 1.0. `w` is positive, and
        sum_i w_i f(x_i) is the integral of f from -1 to 1 for polynomials f to `exact_degree(n)`,
        so that the weights sum to 2. The arrays may be read-only; callers do not write to them.

        **Error:** of nodes 1e-15 and of weights 1e-13, relative, for solutions of full accuracy.
        Checked is that `w` integrates Legendre polynomials to 1e-10.

        **Raises:** nothing for n >= `least`; it is not called with fewer.
        """

    @abc.abstractmethod
    def exact_degree(self, n: int) -> int:
        """Highest degree of the polynomials that the weights of `nodes(n)` integrate exactly; at
        least 0. Of interpolatory weights n - 1, of Gauss rules 2n - 1, 2n - 2 or 2n - 3."""


class LegendreGauss(NodeFamily):
    """`nodes_lg`: neither end, exact to degree 2n - 1."""

    def nodes(self, n):
        return nodes_lg(n)

    def exact_degree(self, n):
        return 2 * n - 1


class LegendreGaussLobatto(NodeFamily):
    """`nodes_lgl`: both ends, exact to degree 2n - 3."""

    least = 2

    def nodes(self, n):
        return nodes_lgl(n)

    def exact_degree(self, n):
        return 2 * n - 3


class ChebyshevGaussLobatto(NodeFamily):
    """`nodes_cgl`: both ends, Clenshaw-Curtis weights exact to degree n - 1."""

    least = 2

    def nodes(self, n):
        return nodes_cgl(n)

    def exact_degree(self, n):
        return n - 1


class LegendreGaussRadau(NodeFamily):
    """`nodes_lgr`: one end, exact to degree 2n - 2.

    **Arguments:** `end`: which, "left" (-1) or "right" (+1).

    **Raises:** `ValueError` for another `end`.
    """

    end: str = "left"

    def __check_init__(self):
        check_end(self.end)

    def nodes(self, n):
        return nodes_lgr(n, self.end)

    def exact_degree(self, n):
        return 2 * n - 2


FAMILIES: dict[str, NodeFamily] = {
    "lgl": LegendreGaussLobatto(),
    "cgl": ChebyshevGaussLobatto(),
    "lgr-left": LegendreGaussRadau("left"),
    "lgr-right": LegendreGaussRadau("right"),
    "lg": LegendreGauss(),
}


def node_family(family: object, argument: str = "grid") -> NodeFamily:
    """The family of a name, or `family` itself if it is one.

    **Arguments:** `family`: "lgl", "cgl", "lgr-left", "lgr-right", "lg" or a `NodeFamily`;
    `argument`: what messages call it.

    **Raises:** `ValueError` for anything else, and for a family that cannot be hashed.
    """
    if isinstance(family, str) and family in FAMILIES:
        return FAMILIES[family]
    if not isinstance(family, NodeFamily):
        raise ValueError(
            f"{argument} is {family!r}; choose one of {', '.join(FAMILIES)}, or give an object of "
            "a class derived from jg.NodeFamily."
        )
    try:
        hash(family)
    except TypeError as error:
        raise ValueError(
            f"{argument} is {family}, which cannot be hashed: let its fields be numbers, strings "
            "or tuples of these, not arrays."
        ) from error
    return family


def checked_nodes(family: NodeFamily, n: int) -> Nodes:
    """`family.nodes(n)`, held to the contract of `NodeFamily`.

    **Returns:** the nodes and weights, read-only float64.

    **Raises:** `ValueError` naming the family and what is wrong: fewer than `least` nodes asked
    for, another number of them given, nodes that do not ascend on [-1, 1] or are within rounding of
    an end without being on it, weights that are not positive, that do not integrate 1, or not every
    polynomial to `exact_degree`.
    """
    if n < family.least:
        raise ValueError(f"{family} needs n >= {family.least} nodes, got {n}: ask for more points.")
    x, w = (np.array(a, float) for a in family.nodes(n))
    _check_positions(family, n, x)
    _check_weights(family, x, w)
    x.flags.writeable = w.flags.writeable = False
    return x, w


def _check_positions(family: NodeFamily, n: int, x: np.ndarray) -> None:
    if x.shape != (n,):
        raise ValueError(f"{family}.nodes({n}) gives nodes of shape {x.shape}; give {n} of them.")
    if not (np.all(np.diff(x) > 0) and x[0] >= -1 and x[-1] <= 1):
        raise ValueError(f"{family}.nodes({n}) gives {x}; nodes must ascend on [-1, 1].")
    for node, end in ((x[0], -1.0), (x[-1], 1.0)):
        if 0 < abs(node - end) < _ON_THE_END:
            raise ValueError(
                f"{family}.nodes({n}) has a node {abs(node - end):.1e} from {end:g}; if the end is "
                f"a node, give exactly {end}."
            )


def _check_weights(family: NodeFamily, x: np.ndarray, w: np.ndarray) -> None:
    n, degree = len(x), family.exact_degree(len(x))
    if w.shape != x.shape or not np.all(w > 0):
        raise ValueError(
            f"{family}.nodes({n}) gives weights {w}; give one for each of the {n} nodes, positive."
        )
    if abs(w.sum() - 2) > _EXACT:
        raise ValueError(
            f"{family}.nodes({n}): the weights sum to {w.sum():.12g}, not to 2, so they do not "
            "integrate 1 from -1 to 1."
        )
    moments = w @ np.polynomial.legendre.legvander(x, degree)[:, 1:]
    if np.any(np.abs(moments) > _EXACT):
        k = int(np.argmax(np.abs(moments) > _EXACT)) + 1
        raise ValueError(
            f"{family}.nodes({n}): the weights integrate P_{k} to {moments[k - 1]:.3g}, not to 0, "
            f"though exact_degree({n}) is {degree}; mend the weights or state {k - 1}."
        )
