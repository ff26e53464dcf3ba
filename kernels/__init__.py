"""Warp ops for torch tensors: rays, the neighbours of a query, and the fused steps of the Implicit LiDAR Network."""

from kernels.area_blend import area_blend
from kernels.attention import attend_neighbours
from kernels.gather import gather_neighbours
from kernels.gather_blend import gather_blend
from kernels.neighbour_attention import neighbour_attention
from kernels.neighbour_attention.block import DecoderWeights
from kernels.neighbour_attention.decoder import fused_decode, fused_decode_serves
from kernels.neighbour_attention.table import Projected, project_pixels
from kernels.planes import interpolate_planes
from kernels.rays.mesh import Hits, Mesh
from kernels.surfaces import (
    fused_surfaces,
    fused_surfaces_serves,
    surface_hypotheses,
    surface_likelihood,
    surface_median,
)

__all__ = [
    "DecoderWeights",
    "Hits",
    "Mesh",
    "Projected",
    "area_blend",
    "attend_neighbours",
    "fused_decode",
    "fused_decode_serves",
    "fused_surfaces",
    "fused_surfaces_serves",
    "gather_blend",
    "gather_neighbours",
    "interpolate_planes",
    "neighbour_attention",
    "project_pixels",
    "surface_hypotheses",
    "surface_likelihood",
    "surface_median",
]
