"""Warp ops for torch tensors: rays, neighbours, and the fused blend of the Implicit LiDAR Network."""

from kernels.area_blend import area_blend
from kernels.attention import neighbour_attention
from kernels.gather import gather_neighbours
from kernels.gather_blend import gather_blend
from kernels.raycast import Hits, Mesh

__all__ = ["Hits", "Mesh", "area_blend", "gather_blend", "gather_neighbours", "neighbour_attention"]
