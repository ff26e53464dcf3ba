import math

import pytest
import torch

from kernels import Mesh

# float32 coordinates up to 100 m, cut and divided.
METRES = 1e-3
# Of the rays: those that graze an edge may meet it by one way and miss it by the other.
GRAZING = 1e-4


def turned(yaw=0.3, pitch=-0.1, position=(1.0, -2.0, 1.5)):
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[cy * cp, -sy, cy * sp], [sy * cp, cy, sy * sp], [-sp, 0.0, cp]], dtype=torch.float64)
    pose[:3, 3] = torch.tensor(position, dtype=torch.float64)
    return pose


def cast(mesh, pose, elevations, azimuths, max_range):
    """The same by the tree, ray by ray."""
    v, h = elevations.double()[:, None], azimuths.double()[None]
    directions = torch.stack(torch.broadcast_tensors(v.cos() * h.cos(), v.cos() * h.sin(), v.sin()), -1)
    directions = (directions @ pose[:3, :3].T).to(mesh.device)
    return mesh.cast(pose[:3, 3].to(mesh.device), directions, max_range).range


def soup(device, count=3000, size=3.0):
    """Triangles all around, some across the seam, above and below the sensor."""
    generator = torch.Generator().manual_seed(0)
    middle = torch.randn(count, 1, 3, generator=generator) * torch.tensor([30.0, 30.0, 6.0])
    vertices = (middle + torch.randn(count, 3, 3, generator=generator) * size).view(-1, 3)
    return Mesh(vertices, torch.arange(3 * count).view(-1, 3), device)


TABLES = {
    "a full circle from -180": (torch.linspace(-0.3, 0.3, 32), torch.arange(-180.0, 180.0, 0.7).deg2rad()),
    "falling, from another angle": (torch.linspace(0.5, -0.4, 33), torch.arange(290.0, -60.0, -0.9).deg2rad()),
    "uneven sector": (torch.tensor([-1.5, -0.2, -0.17, 0.0, 0.4, 1.5]), torch.tensor([-0.5, 0.1, 0.12, 1.3, 2.9])),
    "one ray": (torch.zeros(1), torch.tensor([math.pi])),
}


@pytest.mark.parametrize("tables", TABLES)
@pytest.mark.parametrize("position", [(1.0, -2.0, 1.5), (300.0, 0.0, 0.0)])
def test_gives_the_ranges_that_the_tree_gives(tables, position, device):
    mesh, pose = soup(device), turned(position=position)
    ranges = mesh.project(pose, *TABLES[tables], 60.0)
    expected = cast(mesh, pose, *TABLES[tables], 60.0)
    assert ranges.shape == expected.shape
    assert ((ranges - expected).abs() > METRES).double().mean() <= GRAZING
    if tables != "one ray":
        assert (expected > 0).any() == (position[0] < 100)  # 300 m away there is nothing to see


def test_a_floor_below_and_a_ceiling_above(device):
    corners = torch.tensor([[-50.0, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]])
    corners = torch.cat((corners, corners + torch.tensor([0.0, 0, 4])))
    mesh = Mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]), device)
    elevations = torch.tensor([-1.5, -0.5, -0.1, 0.1, 0.5, 1.5])
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 1.0
    ranges = mesh.project(pose, elevations, torch.arange(0.0, 6.2, 0.1), 40.0).cpu()
    expected = torch.tensor([1.0, 1, 1, 3, 3, 3]) / elevations.sin().abs()
    torch.testing.assert_close(ranges, expected.unsqueeze(1).expand_as(ranges), rtol=1e-5, atol=METRES)


def test_nothing_is_nearer_than_the_nearest_or_farther_than_the_limit(device):
    mesh = soup(device, count=200)
    elevations, azimuths = TABLES["a full circle from -180"]
    near, far = (mesh.project(turned(), elevations, azimuths, limit) for limit in (20.0, 200.0))
    assert near.max() <= 20
    assert torch.equal(near, far.where(far <= 20, 0.0))


def test_torchs_default_dtype_does_not_matter(device):
    mesh = soup(device, count=50)
    tables = TABLES["uneven sector"]
    rays = turned()[:3, 3].float().to(device), torch.eye(3).to(device), 60.0
    expected = mesh.project(turned(), *tables, 60.0), *mesh.cast(*rays)
    torch.set_default_dtype(torch.float64)
    try:
        ours = mesh.project(turned(), *tables, 60.0), *mesh.cast(*rays)
    finally:
        torch.set_default_dtype(torch.float32)
    assert all(torch.equal(a, b) for a, b in zip(ours, expected, strict=True))


def test_any_number_of_cores_gives_the_same(device):
    mesh, cores = soup(device), torch.get_num_threads()
    expected = mesh.project(turned(), *TABLES["uneven sector"], 60.0)
    try:
        for number in (1, 3):
            torch.set_num_threads(number)
            assert torch.equal(mesh.project(turned(), *TABLES["uneven sector"], 60.0), expected)
    finally:
        torch.set_num_threads(cores)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.eye(3), torch.zeros(2), torch.zeros(2), 9.0), r"pose has shape \(3, 3\)"),
        ((torch.eye(4), torch.zeros(0), torch.zeros(2), 9.0), r"elevations has shape \(0,\)"),
        ((torch.eye(4), torch.zeros(2), torch.tensor([math.nan]), 9.0), "azimuths holds NaN"),
        ((math.nan * torch.eye(4), torch.zeros(2), torch.zeros(2), 9.0), "pose holds NaN"),
        ((torch.eye(4), torch.zeros(2), torch.zeros(2), 0.0), "max_range is 0.0"),
        (
            (torch.zeros(4, 4), torch.zeros(2), torch.zeros(1), 9.0),
            "pose is .*it should be a rotation and a translation",
        ),
        ((2 * torch.eye(4), torch.zeros(2), torch.zeros(1), 9.0), "pose is"),
        ((torch.diag(torch.tensor([1.0, 1, -1, 1])), torch.zeros(2), torch.zeros(1), 9.0), "pose is"),
        ((torch.ones(4, 4) + torch.eye(4), torch.zeros(2), torch.zeros(1), 9.0), "pose is"),
        ((torch.eye(4), torch.tensor([1.6]), torch.zeros(1), 9.0), r"elevations reaches 1\.6"),
        (
            (torch.eye(4), torch.zeros(2), torch.tensor([0.0, 100.0]), 9.0),
            r"azimuths runs from 0\.0 to 100",
        ),
        ((torch.eye(4), torch.zeros(2), torch.zeros(2), 9.0), "azimuths has 1 values in 2 columns"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        soup("cpu", count=2).project(*arguments)
