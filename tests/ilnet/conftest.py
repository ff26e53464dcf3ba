import sys

import numpy as np
import pytest
import torch
from tqdm import tqdm

from ilnet.commands import cli
from ilnet.world import places
from kernels import Mesh


def block(x, y, half, height):
    """A box that stands on the ground."""
    corners = torch.tensor([[x + sx, y + sy, z] for sx in (-half, half) for sy in (-half, half) for z in (0.0, height)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, torch.tensor([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def yard_triangles():
    """Flat ground of 100 m and some blocks to look at."""
    parts = [block(0.0, 0.0, 100.0, 0.0), block(12.0, 3.0, 2.0, 4.0), block(-8.0, 15.0, 3.0, 6.0), block(5, -9, 0.2, 3)]
    vertices, triangles, count = [], [], 0
    for v, t in parts:
        vertices.append(v)
        triangles.append(t + count)
        count += len(v)
    return torch.cat(vertices), torch.cat(triangles)


@pytest.fixture(scope="session")
def yard_on():
    return lambda device: Mesh(*yard_triangles(), device)


@pytest.fixture(scope="session")
def yard(yard_on):
    return yard_on("cpu")


@pytest.fixture(scope="session")
def quiet_place():
    """Makes a place without traffic of waypoints in some triangles, by default those of the yard."""

    def make(waypoints, triangles=None):
        corners, faces = triangles or yard_triangles()
        waypoints = np.asarray(waypoints, np.float32)
        return places.Place(corners.numpy(), faces.numpy(), waypoints, np.zeros(len(waypoints), np.float32))

    return make


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """Runs a command line in an empty folder and in this process: starting another takes seconds each time."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GOMP_SPINCOUNT", "3000")
    tqdm._instances.clear()  # a training that a test cut short left its bar, which others would draw around

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["ilnet", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit:
            cli.main()
        out, err = capsys.readouterr()
        return exit.value.code or 0, out, err.splitlines()

    return run
