"""Baselines without parameters: the nearest pixel, the paper's bilinear interpolation in two spaces, and planes."""

import torch

from ilnet.models.base import Model
from kernels import gather_blend, interpolate_planes

__all__ = ["Bilinear", "Nearest", "Planes"]


class Nearest(Model):
    """The range of the pixel nearest to the query."""

    def decode(self, encoded: torch.Tensor, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Returns the ranges (B, Q) [m] of queries (B, Q, 2)."""
        # For a query on a pixel centre, only that pixel has an area above 0.
        scores = queries.new_zeros(*queries.shape[:-1], 4)
        return gather_blend(image, queries.round(), scores, "bilinear", wrap, backend=self.backend)


class Bilinear(Model):
    """The neighbours' ranges, or their inverse ranges, weighted by area (paper, Eq. 2 with measured values).

    Args:
        inverse: Whether to interpolate inverse ranges, which keeps planes flat.
    """

    def __init__(self, inverse: bool = False):
        super().__init__()
        self.prior = "perspective" if inverse else "bilinear"

    def decode(self, encoded: torch.Tensor, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Returns the ranges (B, Q) [m] of queries (B, Q, 2)."""
        scores = queries.new_zeros(*queries.shape[:-1], 4)
        return gather_blend(image, queries, scores, self.prior, wrap, backend=self.backend)


class Planes(Model):
    """The planes around a query, continued to their crease or edge; see `kernels.planes`."""

    def decode(self, encoded: torch.Tensor, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Returns the ranges (B, Q) [m] of queries (B, Q, 2)."""
        return interpolate_planes(image, queries, wrap, backend=self.backend)
