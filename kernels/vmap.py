"""`torch.vmap` over an op whose tensors all begin with a batch dimension: one more is folded into it."""

from typing import Any

import torch

__all__ = ["fold_into_batch"]


def fold_into_batch(op: Any) -> None:
    """Registers the rule for a custom op; without one PyTorch would call it once per element, and warn.

    Args:
        op: A `torch.library.custom_op` whose tensors, in and out, all are (B, ...) with one B.
    """

    def rule(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Any, Any]:
        size = info.batch_size

        def fold(argument: Any, dim: int | None) -> Any:
            if not isinstance(argument, torch.Tensor):
                return argument
            batched = argument.expand(size, *argument.shape) if dim is None else argument.movedim(dim, 0)
            return batched.flatten(0, 1).contiguous()

        def unfold(result: torch.Tensor) -> torch.Tensor:
            return result.view(size, len(result) // size, *result.shape[1:])

        results = op(*(fold(argument, dim) for argument, dim in zip(arguments, in_dims, strict=True)))
        if isinstance(results, torch.Tensor):
            return unfold(results), 0
        return tuple(map(unfold, results)), (0,) * len(results)

    op.register_vmap(rule)
