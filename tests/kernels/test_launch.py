"""The ways in which a launch reaches the cores: all must give what one thread gives."""

import os
import subprocess
import sys
import threading
import time
from typing import Any

import pytest
import torch
import warp as wp
from torch.utils.data import DataLoader, Dataset

from kernels import Mesh, gather_blend, interpolate_planes
from kernels.launch import concrete, launch
from kernels.planes import _kernels as _planes
from kernels.stencil import grid_of

QUERIES = 20_000  # enough to be split over cores


def work(seed=0):
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(16, 64, generator=generator) * 80
    queries = torch.rand(QUERIES, 2, generator=generator) * torch.tensor([15.0, 64.0])
    return gather_blend(image, queries, torch.randn(QUERIES, 4, generator=generator))


@pytest.fixture
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@wp.kernel(enable_backward=False)
def _generic_kernel(
    first: int,
    stored: wp.array2d[Any],
    pairs: wp.array[wp.types.vector(2, wp.Scalar)],
    factor: wp.Float,
    count: int,
):
    stored[0, 0] = stored.dtype()


def test_a_concrete_kernel_has_no_generic_type_left():
    lanes = wp.types.vector(16, wp.bfloat16)
    kernel = concrete(_generic_kernel, {Any: lanes, wp.Scalar: wp.float64, wp.Float: wp.float32})
    first, stored, pairs, factor, count = (argument.type for argument in kernel.adj.args)
    assert (stored.dtype, stored.ndim) == (lanes, 2)
    assert wp.types.types_equal(pairs.dtype, wp.vec2d)
    assert pairs.ndim == 1
    assert (first, factor, count) == (wp.int32, wp.float32, wp.int32)
    assert not kernel.is_generic


@pytest.mark.parametrize("cores", [1, 2])
def test_a_module_is_compiled_once(cores, tmp_path):
    script = (
        "import sys, torch, warp\n"
        f"torch.set_num_threads({cores})\n"
        "from kernels import Mesh\n"
        "mesh = Mesh(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]]))\n"
        "up = torch.tensor([0.0, 0, 1]).expand(5000, 3)\n"
        "assert mesh.cast(torch.tensor([0.2, 0.2, -1.0]), up, 9.0).range.eq(1).all()\n"
    )
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
    subprocess.run([sys.executable, "-c", script], env=environment, check=True, timeout=300)
    assert [name.split("_")[1] for name in kernel_folders(tmp_path)] == ["kernels.rays.mesh"]


def kernel_folders(cache):
    return sorted(folder.name for folder in cache.rglob("wp_*") if folder.is_dir())


@pytest.mark.parametrize("cores", [1, 2])
def test_threads_that_launch_first_load_a_module_one_after_the_other(cores, monkeypatch, one_thread):
    module = _planes[torch.float32].module
    load, asked, first_may_go = module.load, [], threading.Event()

    def slow(device, block_dim=None):
        asked.append(block_dim)
        assert first_may_go.wait(60)
        return load(device, block_dim)

    torch.set_num_threads(cores)
    monkeypatch.setattr("kernels.launch._loaded", set())
    monkeypatch.setattr(module, "load", slow)
    results = []

    def use():
        results.append(interpolate_planes(torch.ones(1, 4, 5), torch.ones(1, QUERIES, 2)))

    threads = [threading.Thread(target=use) for _ in range(4)]
    for thread in threads:
        thread.start()
    while not asked:
        time.sleep(0.01)
    time.sleep(0.1)  # long enough for the others to ask, if they could
    assert asked == [1]
    first_may_go.set()
    for thread in threads:
        thread.join()
    assert len(results) == 4
    assert set(asked) == {1}  # never another block size


@pytest.mark.parametrize("moved", ["image", "queries", "ranges_out"])
def test_tensors_on_two_devices_are_named_before_a_kernel_sees_them(moved):
    tensors = {"image": torch.ones(1, 4, 5), "queries": torch.ones(1, 7, 2), "ranges_out": torch.empty(1, 7)}
    tensors[moved] = tensors[moved].to("meta")
    image, queries, ranges = tensors.values()
    with pytest.raises(ValueError, match=rf"(?=.*{moved})(?=.* is on meta|.*be on meta)"):
        launch(_planes[torch.float32], 7, [image, queries, grid_of(4, 5, True)], [ranges])


def test_any_number_of_cores_gives_the_same(one_thread):
    expected = work()
    for cores in (2, 3, 7):
        torch.set_num_threads(cores)
        assert torch.equal(work(), expected)


def test_a_launch_is_split_over_cores(monkeypatch, one_thread):
    used = set()
    original = wp.launch

    def recording(*args, **kwargs):
        used.add(threading.get_ident())
        return original(*args, **kwargs)

    torch.set_num_threads(4)
    monkeypatch.setattr(wp, "launch", recording)
    for _ in range(20):
        work()
    assert len(used) > 1


def test_several_python_threads_at_once():
    expected = [work(seed) for seed in range(4)]
    results = [None] * 16

    def run(n):
        results[n] = work(n % 4)

    threads = [threading.Thread(target=run, args=(n,)) for n in range(16)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(torch.equal(result, expected[n % 4]) for n, result in enumerate(results))


class _Blends(Dataset):
    def __len__(self):
        return 4

    def __getitem__(self, index):
        # A worker has one core. With two the pool would be asked, whose threads stayed with the parent.
        torch.get_num_threads = lambda: 2
        return work(index)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_use_after_fork_in_dataloader_workers():
    expected = [work(seed) for seed in range(4)]
    loader = DataLoader(_Blends(), batch_size=None, num_workers=2, multiprocessing_context="fork", timeout=60)
    assert all(torch.equal(result, expected[n]) for n, result in enumerate(loader))


def test_a_mesh_survives_being_used_from_a_thread():
    mesh = Mesh(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]]))
    hits = []
    down = torch.tensor([0.0, 0.0, -1.0])
    thread = threading.Thread(target=lambda: hits.append(mesh.cast(torch.tensor([0.2, 0.2, 1.0]), down, 9.0)))
    thread.start()
    thread.join()
    assert hits[0].range == 1
