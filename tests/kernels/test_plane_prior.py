import math

import pytest
import torch

from ilnet.sensor import preset
from kernels import gather_blend, gather_neighbours, plane_prior
from kernels.plane_prior import _plane_prior

# Of logarithms of weights, some of them differences of nearly equal inverse ranges.
TOLERANCE = {torch.float32: 2e-3, torch.float64: 1e-9}
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


def blend(image, queries, wrap=True):
    return gather_blend(image, queries, plane_prior(image, queries, wrap), wrap=wrap)


@pytest.mark.parametrize("dtype", TOLERANCE)
@pytest.mark.parametrize("wrap", [True, False])
@pytest.mark.parametrize(("sharpness", "floor"), [(math.inf, 0.0), (4.0, 1e-3)])
def test_matches_the_reference(dtype, wrap, sharpness, floor, device, poisoned):
    image, queries = draw(device, dtype)
    options = {"sharpness": sharpness, "area_floor": floor}
    ours, reference = (plane_prior(image, queries, wrap, **options, backend=b) for b in ("warp", "torch"))
    assert ours.dtype == dtype
    torch.testing.assert_close(ours.exp(), reference.exp(), rtol=0, atol=TOLERANCE[dtype])
    assert ours.isfinite().all() == (floor > 0)


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
        return torch.where(top, 100.0, torch.minimum(road, front)), torch.minimum(road, front) == road, top

    image, _, _ = ranges(torch.tensor(sensor.elevations)[:, None], torch.tensor(sensor.azimuths)[None])
    return image.float().to(device), queries.to(device), [x.to(device) for x in ranges(elevation, azimuth)], row


def test_planes_and_the_crease_between_them_are_exact(device):
    image, queries, (truth, _, top), _ = scene(device)
    error = (blend(image, queries) - truth).abs()
    last = 10  # the last row of the front, above which the sky begins
    below = queries[:, 0] <= last
    assert not top[below].any()
    assert error[below].max() < PLANE
    linear = gather_blend(image, queries, queries.new_zeros(len(queries), 4), "perspective")
    assert (linear - truth).abs()[below].max() > 0.2  # cuts the corner


def test_at_an_edge_no_point_floats(device):
    image, queries, _, _ = scene(device)
    at_edge = (queries[:, 0] > 10) & (queries[:, 0] < 11)
    ranges = blend(image, queries)[at_edge]
    on_front, in_sky = ranges < 12, ranges > 99
    assert (on_front | in_sky).all()
    assert torch.equal(on_front, queries[at_edge, 0] < 10.5)
    soft = gather_blend(image, queries, plane_prior(image, queries, sharpness=4.0))[at_edge]
    f = queries[at_edge, 0] - 10
    step = f**4 / (f**4 + (1 - f) ** 4)
    torch.testing.assert_close(1 / soft, (1 - step) / ranges[on_front].mean() + step / 100, rtol=2e-2, atol=0)


def test_measured_pixels_stay_and_areas_sum_to_one(device):
    image, queries = draw(device)
    inside = queries.round().clamp(min=0).remainder(torch.tensor([6.0, 8.0], device=device))
    row, column = inside.long().unbind(-1)
    measured = image[torch.arange(2, device=device).unsqueeze(1), row, column]
    torch.testing.assert_close(blend(image, inside), measured)
    ranges, _ = gather_neighbours(image.unsqueeze(1), queries)
    areas = plane_prior(image, queries).exp() * ranges.squeeze(-1)
    torch.testing.assert_close(areas.sum(-1), torch.ones_like(areas[..., 0]), rtol=0, atol=1e-3)


def test_columns_wrap_at_the_seam(device):
    image, queries = draw(device)
    turned = queries + torch.tensor([0.0, 8.0], device=device)
    torch.testing.assert_close(plane_prior(image, queries).exp(), plane_prior(image, turned).exp(), rtol=0, atol=1e-4)


@pytest.mark.parametrize("floor", [0.0, 1e-3])
def test_nan_pixels_and_nan_queries_give_nan_as_in_the_reference(floor, device):
    image, queries = draw(device)
    image[0, 2, 3] = math.nan
    queries[1, ::7, 0] = math.nan
    queries[1, ::5, 1] = math.nan
    ours, reference = (plane_prior(image, queries, area_floor=floor, backend=backend) for backend in ("warp", "torch"))
    torch.testing.assert_close(ours.exp(), reference.exp(), rtol=0, atol=TOLERANCE[torch.float32], equal_nan=True)
    ranges, _ = gather_neighbours(image.unsqueeze(1), queries)
    beside_nan = ranges.squeeze(-1).isnan()
    assert beside_nan.any()
    assert ours[beside_nan].isnan().all()
    assert ours[queries.isnan().any(-1)].isnan().any(-1).all()
    assert ours.isfinite().any()


def test_opcheck_compile_and_vmap(device):
    image, queries = draw(device, count=9)
    torch.library.opcheck(_plane_prior, (image, queries, 4.0, 1e-3, True))
    compiled = torch.compile(plane_prior, fullgraph=True, backend="aot_eager")
    assert torch.equal(compiled(image, queries), plane_prior(image, queries))
    mapped = torch.vmap(lambda i, q: plane_prior(i, q))(image, queries)
    assert torch.equal(mapped, plane_prior(image, queries))


def test_shapes_broadcast_and_no_query_is_fine(device):
    image, queries = draw(device)
    assert plane_prior(image[0], queries).shape == (2, 3000, 4)
    assert plane_prior(image, queries[:, :0]).shape == (2, 0, 4)
    assert not plane_prior(image.requires_grad_(), queries).requires_grad


def test_bad_arguments_are_named(device):
    image, queries = draw(device)
    with pytest.raises(ValueError, match=r"image has shape \(8,\)"):
        plane_prior(image[0, 0], queries)
    with pytest.raises(TypeError, match=r"image is torch\.float16"):
        plane_prior(image.half(), queries)
    with pytest.raises(ValueError, match=r"area_floor is 0\.3"):
        plane_prior(image, queries, area_floor=0.3)
    with pytest.raises(ValueError, match=r"sharpness is 0\.5"):
        plane_prior(image, queries, sharpness=0.5)
    with pytest.raises(ValueError, match=r"queries has shape \(3,\)"):
        plane_prior(image, torch.zeros(3))
    with pytest.raises(ValueError, match="backend"):
        plane_prior(image, queries, backend="cuda")
