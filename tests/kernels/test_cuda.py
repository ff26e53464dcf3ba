"""What can be said of CUDA where there is none: every kernel that it launches compiles for it."""

import gc
import sys

import pytest
import warp as wp

import kernels
from kernels.launch import initialise

MODULES = [
    "area_blend",
    "attention",
    "gather",
    "gather_blend",
    "neighbour_attention.decoder",
    "neighbour_attention.heads",
    "neighbour_attention.vectors",
    "planes",
    "rays.mesh",
    "rays.projection",
    "scatter",
    "surfaces.float32x1",
    "surfaces.float64x1",
]
# Kernels with 36 vectors of 16 lanes for each query, which are launched on CPUs only; CUDA has those of one lane.
CPU_ONLY = ["surfaces.decoder", "surfaces.float32x16"]


def test_the_list_is_whole():
    every = {kernel.module.name for kernel in gc.get_objects() if type(kernel) is wp.Kernel}
    assert {f"kernels.{name}" for name in MODULES + CPU_ONLY} == {name for name in every if name.startswith("kernels.")}


@pytest.mark.skipif(sys.platform == "darwin", reason="Warp has no CUDA compiler on macOS")
@pytest.mark.parametrize("name", MODULES)
def test_compiles_for_cuda(name, tmp_path):
    initialise()
    assert kernels.__all__  # imported: all overloads are made
    wp.compile_aot_module(f"kernels.{name}", arch=80, module_dir=tmp_path, use_ptx=True)
    assert any(file.suffix == ".ptx" and file.stat().st_size > 0 for file in tmp_path.iterdir())
