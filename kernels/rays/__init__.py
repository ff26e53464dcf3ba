"""A mesh and its rays."""

from kernels.rays.mesh import Hits, Mesh

__all__ = ["Hits", "Mesh"]
