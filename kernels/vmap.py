"""`torch.vmap` over custom ops.

The tensors of most ops begin with a batch dimension, and `fold_into_batch` folds the mapped dimension into it. Other
ops cannot be mapped over, and `refuse` says so.
"""

from typing import Any

import torch

__all__ = ["fold_into_batch", "refuse"]


def fold_into_batch(op: Any) -> None:
    """Registers a rule that runs a mapped op once. Without a rule PyTorch runs it once per element, and warns.

    Args:
        op: A `torch.library.custom_op` all of whose tensors, inputs and outputs, are (B, ...) with one B.
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


def refuse(op: Any, remedy: str) -> None:
    """Registers a rule that raises NotImplementedError and says what to do instead.

    Args:
        op: A `torch.library.custom_op` some of whose tensors have no batch dimension.
        remedy: What to do instead.
    """

    def rule(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Any, Any]:
        name = op._qualname.partition("::")[2].removesuffix("_backward")
        raise NotImplementedError(f"{name} does not go through torch.vmap; {remedy}")

    op.register_vmap(rule)
