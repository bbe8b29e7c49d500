"""Matrices of a mesh's reference nodes on the engine of their arrays: NumPy's or JAX's."""

from typing import Any

from jaxguide.arrays import on_numpy
from jaxguide.spectral import grids
from jaxguide.spectral.barycentric import differentiation_matrix, interpolation_matrix
from jaxguide.spectral.transforms import legendre_matrix


def differentiating(x: Any) -> Any:
    """`differentiation_matrix`."""
    return grids.differentiation(x) if on_numpy(x) else differentiation_matrix(x)


def interpolating(x: Any, query: Any) -> Any:
    """`interpolation_matrix`."""
    return grids.evaluation(x, query) if on_numpy(x, query) else interpolation_matrix(x, query)


def to_legendre(x: Any) -> Any:
    """`legendre_matrix`."""
    return grids.legendre(x) if on_numpy(x) else legendre_matrix(x)
