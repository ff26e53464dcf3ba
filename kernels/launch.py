"""The one way a kernel is launched: torch tensors in, on their device, stream and CPU cores."""

import collections
import contextlib
import itertools
import math
import os
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
import warp as wp

__all__ = [
    "BLOCKS",
    "LEAST",
    "channel_spans",
    "concrete",
    "initialise",
    "launch",
    "overload",
    "overload_vectors",
    "query_blocks",
    "vector_width",
]

# Below this many threads of work a second core costs more to wake than it saves.
LEAST = 512
# More chunks than cores, so that a core which drew the cheap ones takes another.
_CHUNKS_PER_CORE = 4

# For each dtype of the tensors what Warp calls it, and the scalar that a kernel computes with.
_DTYPES = {
    torch.float32: (wp.float32, wp.float32),
    torch.float64: (wp.float64, wp.float64),
    torch.bfloat16: (wp.bfloat16, wp.float32),
    torch.float16: (wp.float16, wp.float32),
}

# How many channels may move together. 16 float32 are a cache line.
_WIDTHS = (1, 16)

_initialised = False
_lock = threading.Lock()
_pools: dict[int, ThreadPoolExecutor] = {}

# Warp greets and reports each compilation on stdout, where the command line prints results.
wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)


def _forget_pools() -> None:
    # Threads do not survive a fork (DataLoader workers): the child makes its own, and a new lock as well.
    global _lock
    _lock = threading.Lock()
    _pools.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pools)


def _pool(cores: int) -> ThreadPoolExecutor:
    with _lock:
        if cores not in _pools:
            _pools[cores] = ThreadPoolExecutor(cores, thread_name_prefix="kernels")
        return _pools[cores]


def initialise() -> None:
    """Starts Warp, once; everything that calls Warp before a launch calls this first."""
    global _initialised
    with _lock:
        if not _initialised:
            _start_warp()
            _initialised = True


def _start_warp() -> None:
    with contextlib.ExitStack() as undo:
        if not torch.cuda.is_available():
            # Without a driver Warp's native library warns on stderr at every start; who has no GPU knows.
            with contextlib.suppress(OSError):
                stderr = os.dup(2)
                undo.callback(os.close, stderr)
                undo.callback(os.dup2, stderr, 2)
                with open(os.devnull, "w") as nowhere:
                    os.dup2(nowhere.fileno(), 2)
        try:
            wp.init()
        except OSError:
            # No home to keep compiled kernels in: they are compiled again in the next process.
            wp.config.kernel_cache_dir = tempfile.mkdtemp(prefix="warp-")
            wp.init()


def concrete(kernel: wp.Kernel, known: dict[Any, type]) -> wp.Kernel:
    """Instantiates a generic kernel.

    All concrete kernels are to be made when their module is imported: a later one would change the module's hash, and
    Warp would compile the module again.

    Args:
        kernel: A kernel with generic types among its arguments: `Any`, `wp.Scalar`, `wp.Float` and the like.
        known: For each generic type the scalar or vector that replaces it: as an argument, as the elements of an
            array, and as the components of a vector.

    Returns:
        The concrete kernel.
    """

    def replaced(annotation: Any) -> Any:
        if annotation in known:
            return known[annotation]
        if wp.types.is_array(annotation):
            return wp.array(dtype=replaced(annotation.dtype), ndim=annotation.ndim)
        if (scalar := getattr(annotation, "_wp_scalar_type_", None)) in known:
            return wp.types.vector(annotation._length_, known[scalar])
        return annotation

    return wp.overload(kernel, [replaced(argument.type) for argument in kernel.adj.args])


def overload(kernel: wp.Kernel, half: bool = False) -> dict[torch.dtype, wp.Kernel]:
    """Instantiates a generic kernel for each dtype that it serves.

    Args:
        kernel: A kernel with two generic types. `Any` is what its tensors store. `wp.Float` is what it computes with,
            in other tensors or in scalars: the same type, or float32 where half precision is stored. In vectors of a
            fixed length `wp.Scalar` stands for `Any`.
        half: Whether bfloat16 and float16 are served besides float32 and float64.

    Returns:
        The concrete kernel for each torch dtype of the stored tensors.
    """
    return {
        dtype: concrete(kernel, {Any: stored, wp.Scalar: stored, wp.Float: computed})
        for dtype, (stored, computed) in _dtypes(half).items()
    }


def overload_vectors(kernel: wp.Kernel, half: bool = False) -> dict[tuple[torch.dtype, int], wp.Kernel]:
    """Instantiates a generic kernel that moves vectors of channels, which a CPU does many times faster than numbers.

    The last dimension of a tensor of type `Any` is then counted in vectors; `launch` takes care of that.

    Args:
        kernel: As for `overload`. Elements of type `Any` are only copied and added.
        half: As for `overload`.

    Returns:
        The concrete kernel for each torch dtype and each width that `vector_width` may choose.
    """
    return {
        (dtype, width): concrete(
            kernel, {Any: stored if width == 1 else wp.types.vector(width, stored), wp.Float: computed}
        )
        for dtype, (stored, computed) in _dtypes(half).items()
        for width in _WIDTHS
    }


def vector_width(channels: int) -> int:
    """Returns how many channels move together as one vector: the most that divide `channels`."""
    return max(width for width in _WIDTHS if channels % width == 0)


def _dtypes(half: bool) -> dict[torch.dtype, tuple[type, type]]:
    return {dtype: types for dtype, types in _DTYPES.items() if half or dtype.itemsize >= 4}


def _to_warp(argument: Any, annotation: Any) -> Any:
    if not isinstance(argument, torch.Tensor):
        return argument
    dtype = getattr(annotation, "dtype", None)
    if shape := getattr(dtype, "_shape_", ()):
        outer, inner = argument.shape[: annotation.ndim - 1], argument.shape[annotation.ndim - 1 :]
        argument = argument.view(*outer, math.prod(inner) // math.prod(shape), *shape)
        if shape == (1,):  # a dimension of one element may have any stride; one that torch adds has the one Warp wants
            argument = argument.squeeze(-1).unsqueeze(-1)
        return wp.from_torch(argument.detach(), dtype=dtype, requires_grad=False, return_ctype=True)
    return wp.from_torch(argument.detach(), requires_grad=False, return_ctype=True)


def launch(kernel: wp.Kernel, threads: int, inputs: list[Any], outputs: list[Any], least: int = LEAST) -> None:
    """Runs `threads` threads of a kernel on the device of its outputs and waits for nothing but CPU work.

    A kernel's first argument is `first: int`, the number of its first thread: Warp runs a CPU launch on one core,
    so that a CPU launch is split into ranges of threads that run side by side (Warp releases the GIL). The threads
    of a kernel therefore must not write to shared elements, not even atomically: Warp's CPU atomics are plain adds.
    The number of cores is torch's (`torch.set_num_threads`, `OMP_NUM_THREADS`), one inside a DataLoader worker.

    Args:
        kernel: A Warp kernel without generic arguments (see `overload`).
        threads: How many threads to run.
        inputs: The kernel's arguments after `first`: tensors, numbers, Warp handles, None for no array. The vectors of
            an array of vectors lie one after the other in the last dimensions of the tensor.
        outputs: Tensors the kernel writes, all on one device; the first is not None.
        least: Fewest threads that are worth a core of their own.
    """
    if threads == 0:
        return
    if threads >= 2**31:
        raise ValueError(f"{threads} threads are more than a kernel can count; split the queries")
    initialise()
    annotations = [argument.type for argument in kernel.adj.args[1:]]
    arguments = [_to_warp(a, t) for a, t in zip((*inputs, *outputs), annotations, strict=True)]
    device = outputs[0].device
    if device.type == "cuda":
        # Given the stream, Warp neither switches its own, which all Python threads share, nor waits for it.
        stream = wp.stream_from_torch(torch.cuda.current_stream(device))
        wp.launch(kernel, threads, inputs=[0, *arguments], stream=stream, record_tape=False)
        return

    def run(begin: int, end: int) -> None:
        wp.launch(kernel, end - begin, inputs=[begin, *arguments], device="cpu", record_tape=False)

    cores = torch.get_num_threads()
    pieces = min(cores * _CHUNKS_PER_CORE, threads // least)
    if cores == 1 or pieces < 2:
        run(0, threads)
        return
    with _lock:  # compiled or loaded once, before the cores ask for it together
        kernel.module.load("cpu")
    edges = [threads * i // pieces for i in range(pieces + 1)]
    chunks = collections.deque(itertools.pairwise(edges))

    def work() -> None:
        while True:
            try:
                chunk = chunks.popleft()
            except IndexError:
                return
            run(*chunk)

    # This thread works as well; helpers that have not begun when it is done are not waited for.
    helpers = [_pool(cores).submit(work) for _ in range(cores - 1)]
    try:
        work()
    finally:
        for helper in helpers:
            if not helper.cancel():
                helper.result()


# Queries that a thread takes on a CPU, where the vectors of so many fill its registers, and on a GPU.
BLOCKS = (4, 1)


def query_blocks(count: int, device: torch.device) -> list[tuple[int, slice]]:
    """Which queries go how many to a thread: on a CPU all but the odd ones at the end go in whole blocks."""
    whole = 0 if device.type == "cuda" else count - count % BLOCKS[0]
    parts = zip(BLOCKS, [(0, whole), (whole, count)], strict=True)
    return [(n, slice(*ends)) for n, ends in parts if ends[0] < ends[1]]


def channel_spans(blocks: int, device: torch.device) -> tuple[int, int]:
    """How many blocks of channels a thread handles, and how many threads that takes.

    A CPU core handles all; on a GPU each thread handles one, since neighbouring threads read together.
    """
    return (1, blocks) if device.type == "cuda" else (blocks, 1)
