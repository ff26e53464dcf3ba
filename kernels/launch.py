"""The one way a kernel is launched: torch tensors in, on their device, its current stream and all CPU cores.

`overload` and `overload_vectors` make the concrete kernels of a generic one, `launch` runs a concrete kernel. The other
functions say how the work of an op is shared out among threads.
"""

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

from kernels.checks import check_devices

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

# Threads per core. With fewer, waking a second core costs more than it saves.
LEAST = 512
# There are more chunks than cores, so that a core whose chunks were cheap takes another.
_CHUNKS_PER_CORE = 4
# CPU threads have no blocks. Warp compiles a module once per block size, and this is what it launches with on a CPU.
_CPU_BLOCK = 1

# For each dtype of the tensors its name in Warp, and the scalar that a kernel computes with.
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
_loaded: set[tuple[wp.Kernel, torch.device]] = set()
_pools: dict[int, ThreadPoolExecutor] = {}

# By default Warp prints a greeting and every compilation to stdout, where the command line prints results.
wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)


def _forget_pools() -> None:
    # Threads do not survive a fork (DataLoader workers), so the child makes its own. The lock may have been held.
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
    """Starts Warp, once. `launch` does it as well; code that calls Warp before any launch calls this first."""
    global _initialised
    with _lock:
        if not _initialised:
            _start_warp()
            _initialised = True


def _start_warp() -> None:
    with contextlib.ExitStack() as undo:
        if not torch.cuda.is_available():
            # Without a driver Warp's native library warns on stderr at every start, which helps nobody without a GPU.
            with contextlib.suppress(OSError):
                stderr = os.dup(2)
                undo.callback(os.close, stderr)
                undo.callback(os.dup2, stderr, 2)
                with open(os.devnull, "w") as nowhere:
                    os.dup2(nowhere.fileno(), 2)
        try:
            wp.init()
        except OSError:
            # There is no writable home for compiled kernels, so the next process compiles them again.
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
    if isinstance(argument, dict):
        struct = annotation()
        # Fields are set in the C struct: Warp's own setters want whole Warp arrays, which are slow to make.
        for name, field in annotation.vars.items():
            value = _to_warp(argument[name], field.type)
            setattr(struct.__ctype__(), name, value.__ctype__() if wp.types.is_struct(value) else value)
        return struct
    if not isinstance(argument, torch.Tensor):
        return argument
    dtype = getattr(annotation, "dtype", None)
    if shape := getattr(dtype, "_shape_", ()):
        outer, inner = argument.shape[: annotation.ndim - 1], argument.shape[annotation.ndim - 1 :]
        argument = argument.view(*outer, math.prod(inner) // math.prod(shape), *shape)
        if shape == (1,):  # a dimension of size 1 may have any stride; `unsqueeze` gives it the one that Warp wants
            argument = argument.squeeze(-1).unsqueeze(-1)
        return wp.from_torch(argument.detach(), dtype=dtype, requires_grad=False, return_ctype=True)
    return wp.from_torch(argument.detach(), requires_grad=False, return_ctype=True)


def _load(kernel: wp.Kernel, device: torch.device) -> None:
    # Under the lock, since Warp must not compile or load one module in several threads at once.
    initialise()
    with _lock:
        kernel.module.load(str(device), block_dim=_CPU_BLOCK if device.type == "cpu" else None)
        _loaded.add((kernel, device))


def launch(kernel: wp.Kernel, threads: int, inputs: list[Any], outputs: list[Any], least: int = LEAST) -> None:
    """Runs `threads` threads of a kernel on the device of its tensors.

    On a CPU the call returns when the threads are done. On CUDA it queues them on torch's current stream and returns
    at once.

    Warp runs a CPU launch on one core but releases the GIL, so a CPU launch is split into ranges of threads that run
    side by side. That has two consequences for a kernel. Its first argument is `first: int`, the number of the first
    thread of a range. And its threads must not write to shared elements, not even atomically: Warp's CPU atomics are
    plain additions. The number of cores is torch's (`torch.set_num_threads`, `OMP_NUM_THREADS`), and one inside a
    DataLoader worker.

    Args:
        kernel: A Warp kernel without generic arguments (see `overload`).
        threads: How many threads to run.
        inputs: The kernel's arguments after `first`: tensors, None for no array, numbers, Warp handles and structs. A
            struct with arrays is given as a dict of its fields. The vectors of an array of vectors lie one after the
            other in the last dimensions of the tensor.
        outputs: The arguments that the kernel writes, of the same kinds.
        least: Fewest threads that are worth a core of their own.

    Raises:
        ValueError: If the tensors are not all on one device, or there are too many threads.
    """
    if threads == 0:
        return
    if threads >= 2**31:
        raise ValueError(f"threads is {threads}; it should be below 2^31: split the queries")
    variables, values = kernel.adj.args[1:], (*inputs, *outputs)
    tensors: dict[str, torch.Tensor] = {}
    for variable, value in zip(variables, values, strict=True):
        if isinstance(value, torch.Tensor):
            tensors[variable.label] = value
        elif isinstance(value, dict):
            fields = {f"{variable.label}.{name}": field for name, field in value.items()}
            tensors |= {name: field for name, field in fields.items() if isinstance(field, torch.Tensor)}
    check_devices(**tensors)
    device = next(iter(tensors.values())).device
    if (kernel, device) not in _loaded:
        _load(kernel, device)
    arguments = [_to_warp(value, v.type) for v, value in zip(variables, values, strict=True)]
    if device.type == "cuda":
        # Warp leaves the device of its last launch as the current one, and torch.cuda.device restores it. Given a
        # stream, Warp neither switches its own, which all Python threads share, nor waits for it.
        with torch.cuda.device(device):
            stream = wp.stream_from_torch(torch.cuda.current_stream(device))
            wp.launch(kernel, threads, inputs=[0, *arguments], stream=stream, record_tape=False)
        return

    def run(begin: int, end: int) -> None:
        wp.launch(
            kernel, end - begin, inputs=[begin, *arguments], device="cpu", record_tape=False, block_dim=_CPU_BLOCK
        )

    cores = torch.get_num_threads()
    pieces = min(cores * _CHUNKS_PER_CORE, threads // least)
    if cores == 1 or pieces < 2:
        run(0, threads)
        return
    edges = [threads * i // pieces for i in range(pieces + 1)]
    chunks = collections.deque(itertools.pairwise(edges))

    def work() -> None:
        while True:
            try:
                chunk = chunks.popleft()
            except IndexError:
                return
            run(*chunk)

    # This thread works as well. Helpers that have not begun when it is done have nothing left to do.
    helpers = [_pool(cores).submit(work) for _ in range(cores - 1)]
    try:
        work()
    finally:
        for helper in helpers:
            if not helper.cancel():
                helper.result()


# How many queries a thread takes: on a CPU 4, whose vectors fill its registers; on a GPU 1.
BLOCKS = (4, 1)


def query_blocks(count: int, device: torch.device) -> list[tuple[int, slice]]:
    """Splits `count` queries into those that go to threads in blocks, and the rest.

    Returns:
        For each part that is not empty how many of its queries go to a thread, and the slice of its queries. On CUDA
        each thread takes one.
    """
    whole = 0 if device.type == "cuda" else count - count % BLOCKS[0]
    parts = zip(BLOCKS, [(0, whole), (whole, count)], strict=True)
    return [(n, slice(*ends)) for n, ends in parts if ends[0] < ends[1]]


def channel_spans(blocks: int, device: torch.device) -> tuple[int, int]:
    """Returns how many blocks of channels a thread handles, and how many threads handle all of them.

    On a CPU one thread handles all blocks. On a GPU each thread handles one, since neighbouring threads read together.
    """
    return (1, blocks) if device.type == "cuda" else (blocks, 1)
