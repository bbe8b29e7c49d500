"""Ready designs: their gradients against differences, and what they find."""
# Not every ready design has a count to round.
# pyright: reportOptionalCall=false

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import AS_WRITTEN, slow
from jax.flatten_util import ravel_pytree

from jaxguide import problems, tuning
from jaxguide.montecarlo.rollouts import case_key
from jaxguide.problems.designs import moon_lander
from jaxguide.tuning.variables import named, values


def directional(ready, design, cases, temperature=None, width=1e-3, options=None):
    """Of each leaf, the derivative along a fixed direction: by reverse mode, and by differences.

    Gains are good to some 1e-10 close to the end, so that a percentile of the miss has noise of up
    to 1e-8 of its size, and within 1e-3 it may change by as much as itself: a central difference,
    at its best step of 1e-5, is good to 1e-5 or so. A polynomial of degree 9 through 33 points of
    [-width, width], by least squares, is good to 1e-7 where no two cases change places there.
    """
    batch = jax.vmap(lambda k: case_key(0, k))(jnp.arange(cases))

    def loss(raw):
        own = values(raw)
        built = ready.build(own) if temperature is None else ready.build(own, temperature)
        return ready.objective(built, batch)[0]

    options = (ready.compiler_options or {}) | (options or {})
    program = jax.jit(jax.value_and_grad(loss), compiler_options=options)
    flat, unravel = ravel_pytree(design)
    slope = ravel_pytree(program(design)[1])[0]
    at = np.cos(np.pi * (np.arange(33) + 0.5) / 33)
    out, begin = {}, 0
    for name, leaf in named(design).items():
        size = np.size(leaf)
        way = np.zeros(flat.size)
        way[begin : begin + size] = np.random.default_rng(begin).normal(size=size)
        begin += size
        ends = [float(program(unravel(flat + s * width * jnp.asarray(way)))[0]) for s in at]
        fit = np.polynomial.Chebyshev.fit(at, ends, 9, domain=[-1, 1])
        out[name] = float(slope @ way), float(fit.deriv()(0.0)) / width
    return out


@pytest.mark.parametrize(
    ("name", "bound", "samples", "width"),
    [
        slow("earth-mars", 1e-5, 20.4, 3e-4),
        slow("earth-mars-history", 1e-6, 9.4, 1e-2),
    ],
)
def test_gradient_of_earth_mars(name, bound, samples, width, earth_mars):
    options = {"samples": samples, "most": math.ceil(samples) + 1}
    ready = problems.design(name, bound=bound, extremal=earth_mars, **options)
    # Above the bound, and between integers, where a sample enters with a kink.
    own = ready.design | {"places": jnp.linspace(0.1, -0.1, 12)}
    for leaf, (ours, theirs) in directional(ready, own, 16, width=width).items():
        assert ours == pytest.approx(theirs, rel=1e-5), leaf


@pytest.mark.slow
def test_moon_lander_breaks_find_the_switch():
    ready = problems.design("moon-lander")
    own = {"breaks": tuning.Ascending([0.0, 0.28, 0.55, 0.8, 1.0])}
    for leaf, (ours, theirs) in directional(ready, own, 1, options=AS_WRITTEN).items():
        assert ours == pytest.approx(theirs, rel=1e-5), leaf
    tuned = ready.tune()
    confirmed = ready.confirm(tuned, 1, 0)
    at, end = moon_lander.switch()
    assert end == pytest.approx(4.16414083415688, abs=1e-12)
    rows = confirmed.rows
    assert rows["mesh error"][1] < 1e-6 * rows["mesh error"][0]
    assert rows["nearest break to the switch, off by"][1] < 1e-3
    # In proportion to the distance that is left, which was some 0.05 of the horizon.
    assert rows["objective, relative error"][1] < 0.05 * rows["objective, relative error"][0]


@pytest.mark.slow
def test_gradient_of_lunar_launch():
    ready = problems.design("lunar-launch")
    nodes = np.linspace(0, 1, 9) ** 1.1
    own = {"nodes": tuning.Ascending(nodes), "present": jnp.array([0.3, -0.2, 0.5, 0.1, -0.4])}
    for leaf, (ours, theirs) in directional(ready, own, 4, jnp.asarray(1.0)).items():
        assert ours == pytest.approx(theirs, rel=1e-5), leaf


@pytest.mark.slow
def test_earth_mars_needs_fewer_gains(earth_mars):
    """At least 30 % fewer than the paper's, the same hold, on 100,000 fresh cases."""
    ready = problems.design("earth-mars", extremal=earth_mars)
    rounded = ready.rounded(ready.tune())
    confirmed = rounded.confirm(rounded.tune(), 100_000, 12345)
    before, after = confirmed.rows["gain evaluations"]
    assert before == 166 and after <= 0.7 * 166
    rows = confirmed.rows
    low, high = rows["its lower bound (95 %)"], rows["its upper bound (95 %)"]
    assert high[1] <= low[0]  # not by chance
    fine = rows["99th percentile, four times the integration steps"]
    assert fine[1] <= fine[0]
