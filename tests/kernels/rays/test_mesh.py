import math
import threading
import time

import numpy as np
import pytest
import torch

from kernels import Mesh
from kernels.rays import mesh as mesh_module

# float32 of coordinates up to some tens of metres, through a few operations.
METRES = 1e-4


def plane(z=0.0, half=100.0):
    corners = torch.tensor([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return corners, torch.tensor([[0, 1, 2], [0, 2, 3]])


def box(half=1.0):
    corners = torch.tensor([[x, y, z] for x in (-half, half) for y in (-half, half) for z in (-half, half)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, torch.tensor([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def soup(count, seed=0):
    """Small triangles at random places, wound at random."""
    generator = torch.Generator().manual_seed(seed)
    centres = torch.rand(count, 1, 3, generator=generator) * 20 - 10
    vertices = (centres + torch.randn(count, 3, 3, generator=generator)).reshape(-1, 3)
    return vertices, torch.arange(3 * count).view(count, 3)


def unit_vectors(count, seed=0):
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(seed)), dim=1)


def test_plane(device):
    mesh = Mesh(*plane(), device)
    directions = unit_vectors(5000).to(device)
    hits = mesh.cast(torch.tensor([0.0, 0.0, 2.0], device=device), directions, 50.0)
    expected = 2.0 / -directions[:, 2]
    seen = (directions[:, 2] < 0) & (expected <= 50)
    torch.testing.assert_close(hits.range, expected.where(seen, 0.0), rtol=1e-5, atol=METRES)
    torch.testing.assert_close(hits.cosine, directions[:, 2].abs().where(seen, 0.0), rtol=0, atol=1e-5)
    assert ((hits.triangle >= 0) == seen).all()


def test_sphere(device):
    steps = 200
    theta, phi = torch.meshgrid(
        torch.linspace(0, math.pi, steps), torch.linspace(0, math.tau, 2 * steps), indexing="ij"
    )
    vertices = 3 * torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], -1).view(-1, 3)
    corner = (torch.arange(steps - 1)[:, None] * 2 * steps + torch.arange(2 * steps - 1)).reshape(-1)
    triangles = torch.cat(
        [
            torch.stack([corner, corner + 1, corner + 2 * steps], 1),
            torch.stack([corner + 1, corner + 2 * steps + 1, corner + 2 * steps], 1),
        ]
    )
    hits = Mesh(vertices, triangles, device).cast(torch.zeros(3, device=device), unit_vectors(2000).to(device), 10.0)
    # Chords of the facets lie inside the sphere by at most r (1 - cos(step / 2)).
    sagitta = 3 * (1 - math.cos(math.pi / steps))
    assert hits.range.min() >= 3 - 2 * sagitta - METRES
    assert hits.range.max() <= 3 + METRES
    assert hits.cosine.min() > 0.99


def test_rays_along_the_axes_hit(device):
    axes = torch.cat([torch.eye(3), -torch.eye(3)]).to(device)
    hits = Mesh(*box(), device).cast(torch.zeros(3, device=device), axes, 10.0)
    torch.testing.assert_close(hits.range, torch.ones(6, device=device))
    torch.testing.assert_close(hits.cosine, torch.ones(6, device=device))
    # From outside, through the same axes and a whole row of origins in the plane of an edge.
    hits = Mesh(*box(), device).cast(-3 * axes, axes, 10.0)
    torch.testing.assert_close(hits.range, torch.full((6,), 2.0, device=device))


def test_elevation_zero_and_azimuth_ninety_hit_a_town_like_grid(device):
    walls = [box(0.5) for _ in range(64)]
    vertices = torch.cat([v + torch.tensor([5.0 * (i % 8), 5.0 * (i // 8), 0]) for i, (v, _) in enumerate(walls)])
    triangles = torch.cat([t + 8 * i for i, (_, t) in enumerate(walls)])
    mesh = Mesh(vertices, triangles, device)
    origins = torch.stack([torch.arange(8.0) * 5, torch.full((8,), -10.0), torch.zeros(8)], 1).to(device)
    hits = mesh.cast(origins, torch.tensor([0.0, 1.0, 0.0], device=device), 100.0)
    torch.testing.assert_close(hits.range, torch.full((8,), 9.5, device=device))


def test_matches_brute_force_on_a_triangle_soup(device, poisoned):
    vertices, triangles = soup(300)
    origins = (torch.rand(3000, 3, generator=torch.Generator().manual_seed(1)) - 0.5) * 20
    directions = unit_vectors(3000, seed=2) * torch.linspace(0.01, 100, 3000)[:, None]
    rays = origins.to(device), directions.to(device), 8.0
    hits, every = (Mesh(vertices, triangles, device).cast(*rays, backend=backend) for backend in ("warp", "torch"))
    # Rays within rounding of a triangle's rim or of the maximum range may go either way.
    same = hits.triangle == every.triangle
    assert (~same).sum() <= 3
    torch.testing.assert_close(hits.range[same], every.range[same], rtol=1e-4, atol=METRES)
    torch.testing.assert_close(hits.cosine[same], every.cosine[same], rtol=0, atol=1e-3)
    assert (every.range > 0).float().mean() > 0.1  # enough hits to mean something


def test_the_reference_agrees_with_a_ray_by_hand():
    hits = Mesh(*plane(z=2.0)).cast(torch.zeros(3), torch.tensor([[0.0, 3, 4], [0, 0, -1]]), 9.0, backend="torch")
    torch.testing.assert_close(hits.range, torch.tensor([2.5, 0.0]))
    torch.testing.assert_close(hits.cosine, torch.tensor([0.8, 0.0]))
    assert hits.triangle[0] >= 0
    assert hits.triangle[1] == -1


def test_far_from_the_origin_of_a_map_millimetres_remain(device):
    """UTM coordinates, in float64."""
    east_north = torch.tensor([691_000.3, 5_336_000.7, 520.25], dtype=torch.float64)
    vertices, triangles = box(3.3)
    mesh = Mesh(vertices.double() + east_north, triangles, device)
    hits = mesh.cast(east_north.to(device), torch.eye(3, dtype=torch.float64, device=device), 9.0)
    torch.testing.assert_close(hits.range, torch.full((3,), 3.3, device=device), rtol=0, atol=METRES)


@pytest.mark.parametrize("length", [1e-30, 1e-3, 1e30])
def test_the_length_of_a_direction_does_not_matter(length, device):
    down = torch.tensor([0.0, 0.6, -0.8], device=device) * length
    hit = Mesh(*plane(), device).cast(torch.tensor([0.0, 0.0, 4.0], device=device), down, 9.0)
    assert hit.range.item() == pytest.approx(5.0, abs=METRES)


def test_back_faces_count(device):
    vertices, triangles = plane(z=1.0)
    up = torch.tensor([0.1, 0.2, 1.0], device=device)
    origin = torch.zeros(3, device=device)
    hits = [Mesh(vertices, t, device).cast(origin, up, 10.0) for t in (triangles, triangles.flip(1))]
    assert hits[0].range > 0
    torch.testing.assert_close(hits[0].range, hits[1].range)
    torch.testing.assert_close(hits[0].cosine, hits[1].cosine)


def test_degenerate_triangles_do_no_harm(device):
    vertices, triangles = plane()
    points = torch.tensor([[0.0, 0, 1], [0, 0, 1], [0, 0, 1], [1, 0, 1], [2, 0, 1]])
    vertices = torch.cat([vertices, points])
    degenerate = torch.tensor([[4, 5, 6], [4, 7, 8], [4, 4, 7]])
    mesh = Mesh(vertices, torch.cat([degenerate, triangles]), device)
    down = torch.tensor([0.0, 0.0, -1.0], device=device)
    hits = mesh.cast(torch.tensor([[0.0, 0, 3], [1, 0, 3], [0.5, 0, 3]], device=device), down, 10.0)
    assert hits.range.tolist() == [3, 3, 3]
    assert (hits.triangle >= 3).all()


@pytest.mark.parametrize("integer", [np.uint8, np.int16, np.uint16, np.uint32, np.int64, np.uint64])
def test_accepts_numpy_integers_of_any_width_and_keeps_a_copy(integer, device):
    vertices, triangles = (a.numpy() for a in plane())
    mesh = Mesh(vertices.astype(np.float64), triangles.astype(integer), device)
    vertices += 1000
    hit = mesh.cast(torch.tensor([0.0, 0, 2], device=device), torch.tensor([0.0, 0, -1], device=device), 5.0)
    assert hit.range == 2
    assert hit.range.shape == ()


def test_shapes_broadcast_and_no_rays(device):
    mesh = Mesh(*plane(), device)
    hits = mesh.cast(torch.ones(5, 1, 3, device=device), -torch.ones(4, 3, device=device), 9.0)
    assert hits.range.shape == hits.triangle.shape == hits.cosine.shape == (5, 4)
    assert mesh.cast(torch.ones(0, 3, device=device), torch.ones(3, device=device), 9.0).range.shape == (0,)


def test_a_mesh_may_go_before_its_rays_have_come_home(device):
    """As the traffic of one scan does: on CUDA its rays are still on their way when it is dropped."""
    vertices, triangles = soup(2000)
    directions = unit_vectors(200_000).to(device)
    origin = torch.zeros(3, device=device)
    kept = Mesh(vertices, triangles, device)
    expected = kept.cast(origin, directions, 50.0).range
    for _ in range(5):
        dropped = Mesh(vertices, triangles, device).cast(origin, directions, 50.0).range
        Mesh(vertices + 100.0, triangles, device).cast(origin, directions[:10], 50.0)  # takes the memory that is free
        assert torch.equal(dropped, expected)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_mesh_made_on_one_stream_serves_another():
    origin, down = torch.tensor([0.0, 0.0, 2.0], device="cuda"), torch.tensor([0.0, 0.0, -1.0], device="cuda")
    pose = torch.eye(4)
    pose[2, 3] = 2.0
    made, used = torch.cuda.Stream(), torch.cuda.Stream()
    for engine in ("tree", "clusters"):
        torch.cuda.synchronize()
        with torch.cuda.stream(made):
            torch.cuda._sleep(500_000_000)  # a few tenths of a second
            mesh = Mesh(*plane(), "cuda")
        with torch.cuda.stream(used):
            if engine == "tree":
                assert mesh.cast(origin, down, 5.0).range == 2
            else:
                assert mesh.project(pose, torch.tensor([-1.5]), torch.zeros(1), 5.0) > 2


def test_a_range_may_be_any_real_number(device):
    mesh = Mesh(*plane(), device)
    down = torch.tensor([0.0, 0.0, -1.0], device=device)
    for limit in (9, 9.0, np.float32(9), np.float64(9), np.int64(9), math.inf):
        assert mesh.cast(torch.tensor([0.0, 0.0, 2.0], device=device), down, limit).range == 2
        assert mesh.project(torch.eye(4), torch.zeros(1), torch.zeros(1), limit).shape == (1, 1)


@pytest.mark.parametrize("part", ["_build_tree", "cluster_triangles"])
def test_threads_that_use_a_new_mesh_together_make_its_tree_once(part, monkeypatch):
    made = []
    module = mesh_module if part == "cluster_triangles" else Mesh
    make = getattr(module, part)

    def slow(*arguments):
        made.append(part)
        time.sleep(0.2)
        return make(*arguments)

    monkeypatch.setattr(module, part, slow)
    mesh = Mesh(*plane())
    origin, down = torch.tensor([0.0, 0.0, 2.0]), torch.tensor([0.0, 0.0, -1.0])
    used = []

    def use():
        used.append((mesh.cast(origin, down, 5.0).range.item(), mesh.projects_faster(origin, 10, 5.0)))

    threads = [threading.Thread(target=use) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert used == [(2.0, False)] * 4
    assert made == [part]


def bad_meshes():
    vertices, triangles = plane()
    torn = vertices.clone()
    torn[1, 2] = math.nan
    return {
        r"vertices has shape \(0, 3\)": (vertices[:0], triangles),
        r"triangles has shape \(0, 3\)": (vertices, triangles[:0]),
        r"vertices has shape \(4, 2\)": (vertices[:, :2], triangles),
        "vertices holds 1 NaN or infinite of 4": (torn, triangles),
        r"triangles runs from 0 to 4; it should lie in 0\.\.3": (vertices, triangles + (triangles == 3)),
        "triangles runs from -1": (vertices, triangles - 1),
        "triangles is torch.float32": (vertices, triangles.float()),
        "vertices is torch.int64": (vertices.long(), triangles),
    }


@pytest.mark.parametrize("message", bad_meshes())
def test_bad_meshes_are_refused(message):
    with pytest.raises((TypeError, ValueError), match=message):
        Mesh(*bad_meshes()[message])


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_a_device_that_is_not_there_is_named():
    with pytest.raises(ValueError, match="device is 'cuda'; it should be a device of this machine"):
        Mesh(*plane(), device="cuda")


@pytest.mark.parametrize(
    ("origins", "directions", "max_range", "message"),
    [
        (torch.zeros(3), torch.zeros(2, 3), 5.0, "directions holds a direction of length 0"),
        (torch.zeros(3), torch.tensor([1.0, math.nan, 0]), 5.0, "directions holds NaN"),
        (torch.tensor([0, 0, math.inf]), torch.ones(3), 5.0, "origins holds NaN or infinite"),
        (torch.zeros(2), torch.ones(3), 5.0, r"origins has shape \(2,\)"),
        (torch.zeros(3), torch.ones(3).int(), 5.0, "directions is torch.int32"),
        (torch.zeros(2, 3), torch.ones(5, 3), 5.0, "do not broadcast: origins"),
        (torch.zeros(3), torch.ones(3), None, "max_range is None"),
        (torch.zeros(3), torch.ones(3), 0.0, r"max_range is 0\.0"),
        (torch.zeros(3), torch.ones(3), math.nan, "max_range is nan"),
        (torch.zeros(3), torch.ones(3), "9", "max_range is 9"),
        ([0.0, 0.0, 0.0], torch.ones(3), 5.0, "origins is list"),
        (torch.zeros(3, device="meta"), torch.ones(3), 5.0, "origins is on meta; it should be on cpu"),
        (torch.zeros(3), torch.ones(3, device="meta"), 5.0, "directions is on meta; it should be on cpu"),
    ],
)
def test_bad_rays_are_refused(origins, directions, max_range, message):
    with pytest.raises((TypeError, ValueError), match=message):
        Mesh(*plane()).cast(origins, directions, max_range)
