"""The contract of `jg.NodeFamily`, held by every family of the package."""

import numpy as np
import pytest
from numpy.polynomial import legendre

import jaxguide as jg
from jaxguide.nominal.direct.collocation import collocation
from jaxguide.spectral import FAMILIES, grid, node_family, nodes_lg
from jaxguide.spectral.families import LegendreGaussRadau

EPS = np.finfo(float).eps
# Whether -1 and +1 are nodes; support points of the state for 5 nodes; equations besides the main.
STATED = {
    "lgl": ((True, True), 5, 1),
    "cgl": ((True, True), 5, 1),
    "lgr-left": ((True, False), 6, 0),
    "lgr-right": ((False, True), 6, 0),
    "lg": ((False, False), 7, 0),
}
SIZES = (2, 3, 8, 33, 512)


def test_every_family_is_stated():
    assert set(STATED) == set(FAMILIES)


@pytest.mark.parametrize("name", FAMILIES)
def test_contract(name):
    family = FAMILIES[name]
    for n in (family.least, *SIZES):
        x, w = family.nodes(n)
        assert x.shape == w.shape == (n,) and x.dtype == w.dtype == np.float64
        assert np.all(np.diff(x) > 0) and x[0] >= -1 and x[-1] <= 1 and np.all(w > 0)
        assert abs(w.sum() - 2) < 4e-15  # ten ulps of 2
        if n > 1:
            assert (x[0] == -1.0, x[-1] == 1.0) == STATED[name][0]
        # P_k is at most 1 and the weights sum to 2; the recurrence for P_k loses up to k eps.
        degree = family.exact_degree(n)
        moments = w @ legendre.legvander(x, degree)[:, 1:]
        assert np.all(np.abs(moments) < 4 * EPS * (degree + 2))


@pytest.mark.parametrize("name", FAMILIES)
def test_an_object_is_as_good_as_its_name(name):
    family = node_family(name)
    assert node_family(family) is family
    for n in SIZES[:-1]:
        for of_name, of_object in zip(grid(name, n), grid(family, n), strict=True):
            assert np.array_equal(of_name, of_object)
            assert not of_name.flags.writeable and not of_object.flags.writeable


@pytest.mark.parametrize("name", FAMILIES)
def test_ends_decide_the_collocation(name):
    _, support, extra = STATED[name]
    for family in (name, FAMILIES[name]):
        rule = collocation(family, 5)
        assert len(rule.support) == support and len(rule.extra) == extra
        assert rule.support[0] == -1.0 and rule.support[-1] == 1.0
        np.testing.assert_array_equal(rule.support[rule.first :][:5], rule.nodes)


@pytest.mark.parametrize("name", FAMILIES)
def test_too_few_nodes(name):
    family = FAMILIES[name]
    with pytest.raises(ValueError, match=f"needs n >= {family.least} nodes, got"):
        grid(family, family.least - 1)
    least = 3 if all(STATED[name][0]) else 2
    with pytest.raises(ValueError, match=f"needs at least {least}"):
        collocation(family, least - 1)


def test_families_are_hashed_and_compared_by_value():
    again = LegendreGaussRadau("right")
    assert again == FAMILIES["lgr-right"] and hash(again) == hash(FAMILIES["lgr-right"])
    assert again != FAMILIES["lgr-left"]
    assert collocation(again, 4) is collocation(FAMILIES["lgr-right"], 4)
    with pytest.raises(ValueError, match="'middle'"):
        LegendreGaussRadau("middle")


class Bent(jg.NodeFamily):
    """Gauss nodes and weights, changed by `how`."""

    how: str

    def nodes(self, n):
        x, w = nodes_lg(n)
        outer = np.append(0.0, np.ones(n - 1))
        bent = {
            "reversed": (x[::-1], w),
            "outside": (x * 2, w),
            "not a number": (x * np.nan, w),
            "nearly an end": (np.append(np.nextafter(-1.0, 0.0), x[1:]), w),
            "too many": (np.append(x, 1.0), w),
            "halved": (x, w / 2),
            "negative": (x, w * (1 - 4 * (1 - outer))),
            "one short": (x, w[1:]),
            "uneven": (x, np.full(n, 2 / n)),
        }
        return bent[self.how]

    def exact_degree(self, n):
        return n - 1


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ("reversed", "nodes must ascend on"),
        ("outside", "nodes must ascend on"),
        ("not a number", "nodes must ascend on"),
        ("nearly an end", "if the end is a node, give exactly -1.0"),
        ("too many", r"nodes of shape \(7,\); give 6"),
        ("halved", "the weights sum to 1, not to 2"),
        ("negative", "one for each of the 6 nodes, positive"),
        ("one short", "one for each of the 6 nodes, positive"),
        ("uneven", r"the weights integrate P_2 to .*, not to 0, though exact_degree\(6\) is 5"),
    ],
)
def test_what_breaks_the_contract_is_refused(how, words):
    with pytest.raises(ValueError, match=words):
        grid(Bent(how), 6)


def test_other_things_are_refused():
    for other in ("gauss", 3, nodes_lg, jg.NodeFamily):
        with pytest.raises(ValueError, match="choose one of lgl, cgl, .* jg.NodeFamily"):
            node_family(other)

    class Holding(Bent):
        table: object = None

    with pytest.raises(ValueError, match="cannot be hashed"):
        node_family(Holding("halved", np.ones(3)))
