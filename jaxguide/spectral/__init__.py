"""Nodes, matrices, interpolation, transforms and domain maps of pseudospectral methods."""

from jaxguide.spectral.barycentric import barycentric_weights as barycentric_weights
from jaxguide.spectral.barycentric import differentiation_matrix as differentiation_matrix
from jaxguide.spectral.barycentric import interpolation_matrix as interpolation_matrix
from jaxguide.spectral.extremes import extremes_near as extremes_near
from jaxguide.spectral.families import FAMILIES as FAMILIES
from jaxguide.spectral.families import NodeFamily as NodeFamily
from jaxguide.spectral.families import node_family as node_family
from jaxguide.spectral.grids import Grid as Grid
from jaxguide.spectral.grids import grid as grid
from jaxguide.spectral.interpolation import interpolate as interpolate
from jaxguide.spectral.interpolation import interpolate_piecewise as interpolate_piecewise
from jaxguide.spectral.interpolation import interval as interval
from jaxguide.spectral.maps import AbstractMap as AbstractMap
from jaxguide.spectral.maps import BilinearMap as BilinearMap
from jaxguide.spectral.maps import LinearMap as LinearMap
from jaxguide.spectral.matrices import birkhoff_matrix as birkhoff_matrix
from jaxguide.spectral.matrices import integration_matrix as integration_matrix
from jaxguide.spectral.matrices import (
    weighted_differentiation_matrix as weighted_differentiation_matrix,
)
from jaxguide.spectral.matrices import weighted_quadrature as weighted_quadrature
from jaxguide.spectral.nodes import nodes_cgl as nodes_cgl
from jaxguide.spectral.nodes import nodes_lg as nodes_lg
from jaxguide.spectral.nodes import nodes_lgl as nodes_lgl
from jaxguide.spectral.nodes import nodes_lgr as nodes_lgr
from jaxguide.spectral.transforms import chebyshev_coefficients as chebyshev_coefficients
from jaxguide.spectral.transforms import chebyshev_matrix as chebyshev_matrix
from jaxguide.spectral.transforms import chebyshev_values as chebyshev_values
from jaxguide.spectral.transforms import chebyshev_vandermonde as chebyshev_vandermonde
from jaxguide.spectral.transforms import legendre_coefficients as legendre_coefficients
from jaxguide.spectral.transforms import legendre_matrix as legendre_matrix
from jaxguide.spectral.transforms import legendre_values as legendre_values
from jaxguide.spectral.transforms import legendre_vandermonde as legendre_vandermonde
