"""The attention step among the 4 neighbours of a query, and the whole decoder of ILN."""

from kernels.neighbour_attention.decoder import DecoderWeights, fused_decode, fused_decode_serves
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
