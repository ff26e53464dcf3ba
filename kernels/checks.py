"""What every op asks of its arguments, and the constants that ops share with their plain PyTorch twins.

A public op checks its arguments first: its options with `check_backend`, `check_prior` and `check_area_floor`, its
tensors with `check_floating` (type and dtype), `check_queries` and `check_devices`. Then `broadcast_batch` gives all
tensors one batch dimension. Behind that point nothing is checked again, except that `kernels.launch.launch` compares
devices. An error names the argument, what it is, and what it should be.
"""

from collections.abc import Iterable

import torch

__all__ = [
    "AREA_FLOOR",
    "BACKENDS",
    "BACKGROUND",
    "CONTINUED",
    "FARTHEST",
    "KINDS",
    "LEAST_RANGE",
    "LEAST_SCALE",
    "PARTED",
    "PRIORS",
    "RANGE_FLOOR",
    "TOLERANCE",
    "WIDEST_GAP",
    "broadcast_batch",
    "check_area_floor",
    "check_backend",
    "check_devices",
    "check_floating",
    "check_prior",
    "check_queries",
]

BACKENDS = ("warp", "torch")

PRIORS = ("none", "bilinear", "perspective")

# Metres. The perspective prior divides by range, and no LiDAR measures below this.
RANGE_FLOOR = 0.1
# Two inverse ranges that differ by more than this share of the smaller one belong to different surfaces. Of 0.015,
# 0.03, 0.05 and 0.1, this gave `planes` the highest IoU at 128x2048 on scans held out of the training towns.
PARTED = 0.03

# The constants down to `TOLERANCE` are those of `kernels.surfaces.maths`. A neighbour has 9 hypotheses: its surface is
# continued along its column with the outer pixel, with the inner one or not at all, and along its row likewise.
KINDS = 9
# Least bilinear area in their prior, so that a neighbour can be right where its area is 0, but for queries on a pixel.
AREA_FLOOR = 1e-3
# Probability that a measured range is explained by no hypothesis, and the same for a no return (ε).
BACKGROUND = 1e-3
# The continued range differs from the measured one by this factor at most.
CONTINUED = 4.0
# Metres. A measured range below this is taken as this.
LEAST_RANGE = 0.01
# Metres. Least scale of a hypothesis (b).
LEAST_SCALE = 0.02
# Radians. No surface is continued over a wider gap.
WIDEST_GAP = 0.5
# Metres within which a range counts as right in a confidence.
TOLERANCE = 0.1
# Pixels. The attention step takes a coordinate farther out as this far, so that squares of offsets stay finite.
FARTHEST = 2.0**30


def check_floating(name: str, tensor: object, dtypes: Iterable[torch.dtype], shape: str) -> None:
    """Checks the type and the dtype of an argument.

    Args:
        name: The argument's name.
        tensor: What was passed.
        dtypes: The dtypes that the op takes.
        shape: The argument's shape in the words of the docstring. Only the error needs it; the shape is not checked.

    Raises:
        TypeError: If `tensor` is not a tensor of one of `dtypes`.
    """
    dtypes = list(dtypes)
    if not isinstance(tensor, torch.Tensor) or tensor.dtype not in dtypes:
        kind = getattr(tensor, "dtype", type(tensor).__name__)
        known = ", ".join(str(dtype).removeprefix("torch.") for dtype in dtypes)
        raise TypeError(f"{name} is {kind}; it should be a tensor {shape} of one of {known}")


def check_backend(backend: str) -> None:
    """Raises ValueError unless `backend` is one of `BACKENDS`."""
    if backend not in BACKENDS:
        raise ValueError(f"backend is {backend!r}; it should be one of {', '.join(BACKENDS)}")


def check_prior(prior: str) -> None:
    """Raises ValueError unless `prior` is one of `PRIORS`."""
    if prior not in PRIORS:
        raise ValueError(f"prior is {prior!r}; it should be one of {', '.join(PRIORS)}")


def check_area_floor(area_floor: float) -> None:
    """Raises ValueError unless `area_floor` is at least 0 and at most the area midway between pixels."""
    if not 0 <= area_floor <= 0.25:
        raise ValueError(f"area_floor is {area_floor}; it should be between 0 and 0.25, the area midway between pixels")


def check_devices(**tensors: torch.Tensor) -> None:
    """Checks that all tensors are on one device. The index counts: cuda:0 is not cuda:1.

    Args:
        **tensors: The tensors by the names of the arguments.

    Raises:
        ValueError: If a tensor is on another device than the first.
    """
    first, device = None, None
    for name, tensor in tensors.items():
        if device is None:
            first, device = name, tensor.device
        elif tensor.device != device:
            raise ValueError(f"{name} is on {tensor.device}; it should be on {device}, where {first} is")


def check_queries(queries: torch.Tensor) -> None:
    """Checks the queries of an op.

    Args:
        queries: (..., Q, 2) pixel coordinates (row, column).

    Raises:
        TypeError: If `queries` is not a floating-point tensor.
        ValueError: If its shape is another one.
    """
    if not isinstance(queries, torch.Tensor):
        raise TypeError(f"queries is {type(queries).__name__}; it should be a torch.Tensor (..., Q, 2)")
    if queries.ndim < 2 or queries.shape[-1] != 2:
        raise ValueError(
            f"queries has shape {tuple(queries.shape)}; it should be (..., Q, 2): row and column in pixels"
        )
    if not queries.is_floating_point():
        raise TypeError(f"queries is {queries.dtype}; it should be a floating-point tensor of pixel coordinates")


def broadcast_batch(**named: tuple[torch.Tensor, int]) -> tuple[torch.Size, list[torch.Tensor]]:
    """Broadcasts leading dimensions and folds them into one.

    Args:
        **named: For each argument its tensor and how many trailing dimensions are not batch.

    Returns:
        The broadcast batch shape, and the tensors as (B, ...) in the order given.

    Raises:
        ValueError: If the batch shapes do not broadcast.
    """
    batches = {name: tensor.shape[: tensor.ndim - own] for name, (tensor, own) in named.items()}
    try:
        batch = torch.broadcast_shapes(*batches.values())
    except RuntimeError:
        shapes = ", ".join(f"{name} {tuple(shape)}" for name, shape in batches.items())
        raise ValueError(f"the batch dimensions do not broadcast: {shapes}") from None
    folded = []
    for tensor, own in named.values():
        shape = tensor.shape[tensor.ndim - own :]
        folded.append(tensor.expand(*batch, *shape).reshape(batch.numel(), *shape))
    return batch, folded
