"""Kernels of neighbour_attention whose threads take one head of one query: for CUDA, float64 and any C.

A vector of lanes has one component here (`kernels.lanes`), and each head is a group of its own. Neighbouring threads
take the heads of one query, so that they read neighbouring channels. They leave to `op` what sums over heads or tokens.
"""

from typing import Any

import torch
import warp as wp

from kernels.lanes import vectors
from kernels.neighbour_attention.maths import PIXEL_TABLES, adj_squares, attend, attend_backward, stencil

__all__ = ["ATTEND", "ATTEND_BACKWARD"]


def _kernels(scalar: type) -> tuple[wp.Kernel, wp.Kernel]:
    """Returns the forward and the backward kernel for float32 or float64."""
    lane = vectors(1, scalar)
    pixel_table: Any = PIXEL_TABLES[lane]

    @wp.kernel(enable_backward=False)
    def _attend_kernel(
        first: int,
        # in
        table: pixel_table,
        queries: wp.array2d[scalar],
        # out
        tokens_out: wp.array2d[lane],
        attended_out: wp.array2d[lane],
    ):
        thread = first + wp.tid()
        n = thread // table.heads
        around = stencil(table, queries, n)
        attend(table, around, thread % table.heads, 4 * n, tokens_out, attended_out)

    @wp.kernel(enable_backward=False)
    def _attend_backward_kernel(
        first: int,
        # in
        table: pixel_table,
        queries: wp.array2d[scalar],
        adj_tokens: wp.array2d[lane],
        adj_attended: wp.array2d[lane],
        # out
        adj_rows_out: wp.array2d[lane],
        attended_out: wp.array2d[lane],
        adj_squares_out: wp.array2d[scalar],
        coefficients_out: wp.array2d[scalar],
    ):
        thread = first + wp.tid()
        n = thread // table.heads
        head = thread % table.heads
        around = stencil(table, queries, n)
        adj_inverse = attend_backward(table, around, head, 4 * n, adj_tokens, adj_attended, adj_rows_out, attended_out)
        for t in range(table.rolled_four):
            adj_squares_out[4 * n + t, head] = adj_squares(table, around, t, adj_inverse[t])
            if head == 0:
                coefficients_out[4 * n + t, 0] = around.down[t]
                coefficients_out[4 * n + t, 1] = around.right[t]
                coefficients_out[4 * n + t, 2] = scalar(1.0) / around.inverse[t]

    return _attend_kernel, _attend_backward_kernel


_made = {torch.float32: _kernels(wp.float32), torch.float64: _kernels(wp.float64)}
ATTEND = {dtype: forward for dtype, (forward, _) in _made.items()}
ATTEND_BACKWARD = {dtype: backward for dtype, (_, backward) in _made.items()}
