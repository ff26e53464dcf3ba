"""The ways in which a launch reaches the cores: all must give what one thread gives."""

import os
import threading

import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from kernels import Mesh, gather_blend

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


def test_any_number_of_cores_gives_the_same(one_thread):
    expected = work()
    for cores in (2, 3, 7):
        torch.set_num_threads(cores)
        assert torch.equal(work(), expected)


def test_a_launch_is_split_over_cores(monkeypatch, one_thread):
    import warp as wp

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
