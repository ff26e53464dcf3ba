"""What all tests share."""

import os
from pathlib import Path

import pytest
import torch

# Each of the processes that run tests, and what they start, gets its share of the cores. More threads than cores would
# wait for one another.
if workers := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", 0)):
    threads = max(1, (os.cpu_count() or 1) // workers)
    os.environ["OMP_NUM_THREADS"] = str(threads)
    torch.set_num_threads(threads)

# Measurements that serve the tests but do not travel with the project.
SHARED = Path(__file__).resolve().parents[1].parent / "shared"


@pytest.fixture(
    params=[
        "cpu",
        pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")),
    ]
)
def device(request):
    return torch.device(request.param)


@pytest.fixture
def shared():
    if not SHARED.is_dir():
        pytest.skip("needs the folder shared/ beside the checkout")
    return SHARED


@pytest.fixture
def poisoned(monkeypatch):
    """Memory that nobody wrote reads as NaN, so that an element a kernel forgets shows."""

    def fill(make):
        def filled(*args, **kwargs):
            tensor = make(*args, **kwargs)
            return tensor.fill_(float("nan")) if tensor.is_floating_point() else tensor.fill_(-(2**30))

        return filled

    monkeypatch.setattr(torch, "empty", fill(torch.empty))
    monkeypatch.setattr(torch, "empty_like", fill(torch.empty_like))
    monkeypatch.setattr(torch.Tensor, "new_empty", fill(torch.Tensor.new_empty))
