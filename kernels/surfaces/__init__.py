"""Surfaces instead of ranges: what the neighbours' surfaces say of a query, and the whole decoder that weighs them.

Read in this order:

- `maths`: the derivation, and the functions that all kernels share.
- `op`: hypotheses, likelihood and median as ops.
- `decoder`: `fused_surfaces`, attention and all that follows it up to the median. For inference on CPUs.
"""

from kernels.surfaces.decoder import fused_surfaces, fused_surfaces_serves
from kernels.surfaces.op import surface_hypotheses, surface_likelihood, surface_median

__all__ = ["fused_surfaces", "fused_surfaces_serves", "surface_hypotheses", "surface_likelihood", "surface_median"]
