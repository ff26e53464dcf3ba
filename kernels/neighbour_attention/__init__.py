"""The attention step among the 4 neighbours of a query (paper, Fig. 3b), and the whole decoder of ILN built on it.

Read in this order:

- `op`: `neighbour_attention`, the step as a differentiable op. It chooses between the two sets of kernels below.
- `table`: `project_pixels`, the part of the step that is done once for each pixel, in plain PyTorch.
- `maths`: the derivation, and the functions that all kernels share.
- `heads`: kernels whose threads take one head of one query. For CUDA, float64 and any number of channels.
- `vectors`: kernels whose threads take all heads of a query, as vectors. For CPUs, float32 and the paper's 8 heads.
- `block`: the step and the feed-forward layer behind it, a few queries at a time. For inference on CPUs.
- `decoder`: `fused_decode`, the block and all that follows it up to the range.
"""

from kernels.neighbour_attention.block import DecoderWeights
from kernels.neighbour_attention.decoder import fused_decode, fused_decode_serves
from kernels.neighbour_attention.op import neighbour_attention
from kernels.neighbour_attention.table import Projected, project_pixels

__all__ = [
    "DecoderWeights",
    "Projected",
    "fused_decode",
    "fused_decode_serves",
    "neighbour_attention",
    "project_pixels",
]
