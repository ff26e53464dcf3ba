import math

import pytest
import torch

from ilnet.sensor import preset
from kernels import gather_blend, gather_neighbours, interpolate_planes
from kernels.planes import _interpolate_planes

# Metres below 60 m: a float32 range is the reciprocal of a sum of reciprocals.
TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-9}
# Metres: between rows 2° apart an inverse range is not quite linear in the pixel coordinate, even on a plane.
PLANE = 2e-2


def draw(device, dtype=torch.float32, batch=2, count=3000):
    """Images of surfaces with jumps between them, and queries on, between and beyond the pixels."""
    generator = torch.Generator().manual_seed(0)
    smooth = torch.rand(batch, 1, 8, generator=generator).expand(batch, 6, 8).cumsum(1) + 3
    jumps = torch.randint(1, 4, (batch, 6, 8), generator=generator)
    queries = torch.rand(batch, count, 2, generator=generator) * torch.tensor([8.0, 12.0]) - 2
    queries[:, ::5] = queries[:, ::5].round()
    return (smooth * jumps).to(device, dtype), queries.to(device, dtype)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("wrap", [True, False])
def test_matches_the_reference(dtype, wrap, device, poisoned):
    image, queries = draw(device, dtype)
    ours, reference = (interpolate_planes(image, queries, wrap, backend=b) for b in ("warp", "torch"))
    assert ours.dtype == dtype
    torch.testing.assert_close(ours, reference, rtol=0, atol=TOLERANCE[dtype])


def scene(device):
    """A road, a house front and the sky, in a LiDAR's column order; where each direction meets which."""
    sensor = preset("paper-16x1024")
    generator = torch.Generator().manual_seed(0)
    row = torch.rand(4000, generator=generator) * 15
    queries = torch.stack((row, 500 + torch.rand(4000, generator=generator) * 24), -1)
    elevation = torch.deg2rad(-15 + 2 * row)
    azimuth = torch.deg2rad(-180 + queries[:, 1] * 360 / 1024)

    def ranges(elevation, azimuth):
        road = 1.8 / (-elevation.sin()).clamp(min=1e-6)
        front = 11.0 / (elevation.cos() * azimuth.cos())
        top = elevation > 0.12
        return torch.where(top, 100.0, torch.minimum(road, front)), top

    image, _ = ranges(torch.tensor(sensor.elevations)[:, None], torch.tensor(sensor.azimuths)[None])
    return image.float().to(device), queries.to(device), [x.to(device) for x in ranges(elevation, azimuth)]


def test_planes_and_the_crease_between_them_are_exact(device):
    image, queries, (truth, top) = scene(device)
    error = (interpolate_planes(image, queries) - truth).abs()
    last = 10  # the last row of the front, above which the sky begins
    below = queries[:, 0] <= last
    assert not top[below].any()
    assert error[below].max() < PLANE
    linear = gather_blend(image, queries, queries.new_zeros(len(queries), 4), "perspective")
    assert (linear - truth).abs()[below].max() > 0.2  # cuts the corner


def test_at_an_edge_no_point_floats(device):
    image, queries, _ = scene(device)
    at_edge = (queries[:, 0] > 10) & (queries[:, 0] < 11)
    ranges = interpolate_planes(image, queries)[at_edge]
    on_front, in_sky = ranges < 12, ranges > 99
    assert (on_front | in_sky).all()
    assert torch.equal(on_front, queries[at_edge, 0] < 10.5)
    turned = interpolate_planes(image.T.contiguous(), queries.flip(-1), wrap=False)[at_edge]  # an edge between columns
    assert torch.equal(turned < 12, on_front)
    assert ((turned < 12) | (turned > 99)).all()


def test_measured_pixels_stay_and_others_lie_between_their_neighbours(device):
    image, queries = draw(device)
    inside = queries.round().clamp(min=0).remainder(torch.tensor([6.0, 8.0], device=device))
    row, column = inside.long().unbind(-1)
    measured = image[torch.arange(2, device=device).unsqueeze(1), row, column]
    torch.testing.assert_close(interpolate_planes(image, inside), measured)
    around = gather_neighbours(image.unsqueeze(1), queries)[0].squeeze(-1)
    ranges = interpolate_planes(image, queries)
    assert (ranges > around.amin(-1) - TOLERANCE[torch.float32]).all()
    assert (ranges < around.amax(-1) + TOLERANCE[torch.float32]).all()


def test_columns_wrap_at_the_seam(device):
    image, queries = (tensor.double() for tensor in draw(device))
    turned = queries + torch.tensor([0.0, 8.0], device=device)
    ranges = interpolate_planes(image, queries)
    torch.testing.assert_close(interpolate_planes(image, turned), ranges, rtol=0, atol=TOLERANCE[torch.float64])


def test_nan_pixels_and_nan_queries_give_nan_as_in_the_reference(device):
    image, queries = draw(device)
    image[0, 2, 3] = math.nan
    queries[1, ::7, 0] = math.nan
    queries[1, ::5, 1] = math.nan
    ours, reference = (interpolate_planes(image, queries, backend=backend) for backend in ("warp", "torch"))
    torch.testing.assert_close(ours, reference, rtol=0, atol=TOLERANCE[torch.float32], equal_nan=True)
    beside_nan = gather_neighbours(image.unsqueeze(1), queries)[0].isnan().any((-1, -2))
    assert beside_nan.any()
    assert torch.equal(ours.isnan(), beside_nan | queries.isnan().any(-1))


def test_opcheck_compile_and_vmap(device):
    image, queries = draw(device, count=9)
    torch.library.opcheck(_interpolate_planes, (image, queries, True))
    compiled = torch.compile(interpolate_planes, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(image, queries), interpolate_planes(image, queries))
    mapped = torch.vmap(lambda i, q: interpolate_planes(i, q))(image, queries)
    assert torch.equal(mapped, interpolate_planes(image, queries))


def test_shapes_broadcast_and_no_query_is_fine(device):
    image, queries = draw(device)
    assert interpolate_planes(image[0], queries).shape == (2, 3000)
    assert interpolate_planes(image, queries[:, :0]).shape == (2, 0)
    assert interpolate_planes(image[:0], queries[:0]).shape == (0, 3000)
    assert not interpolate_planes(image.requires_grad_(), queries).requires_grad


def test_bad_arguments_are_named(device):
    image, queries = draw(device)
    with pytest.raises(ValueError, match=r"image has shape \(8,\)"):
        interpolate_planes(image[0, 0], queries)
    with pytest.raises(TypeError, match=r"image is torch\.float16"):
        interpolate_planes(image.half(), queries)
    with pytest.raises(ValueError, match=r"queries has shape \(3,\)"):
        interpolate_planes(image, torch.zeros(3))
    with pytest.raises(ValueError, match="backend"):
        interpolate_planes(image, queries, backend="cuda")
