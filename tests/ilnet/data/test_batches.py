import math

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from ilnet import data
from ilnet.sensor import preset
from ilnet.world import places, simulate, towns

SENSOR = preset("paper-16x1024")


@pytest.fixture(scope="module")
def streets(quiet_place):
    """Two flat worlds whose ground lies at different heights, so that a ray tells where it was cast."""
    corners = torch.tensor([[-500.0, -500, 0], [500, -500, 0], [500, 500, 0], [-500, 500, 0]])
    triangles = torch.tensor([[0, 1, 2], [0, 2, 3]])
    lifts = (torch.tensor([0.0, 0, z]) for z in (0, 7))
    waypoints = torch.tensor([[-100.0, 0, 0], [100, 0, 0]])
    return [quiet_place(waypoints + lift, (corners + lift, triangles)) for lift in lifts]


def rays(streets, seed=0):
    return data.ContinuousRays(streets, SENSOR, crops=6, columns=64, queries=100, seed=seed)


def test_sensors_are_turned_upright(streets):
    hung = data.ContinuousRays(streets, preset("os1-32"), crops=6, columns=64, queries=100, seed=0)
    batch = next(iter(hung))
    assert batch.sensor.elevations[0] < batch.sensor.elevations[-1]
    assert batch.sensor.azimuths[0] < batch.sensor.azimuths[-1]
    assert batch.image[:, 0].mean() < batch.image[:, -1].mean()  # the ground is nearer than the sky


def test_a_crop_fits_its_sensor_and_has_room_for_queries(streets):
    for columns, sensors, most in ((17, SENSOR, 1024), (1025, SENSOR, 1024), (513, (), 512)):
        with pytest.raises(ValueError, match=f"columns is {columns}; it should be 18 to {most}"):
            data.ContinuousRays(streets, sensors, crops=2, columns=columns, queries=5, seed=0)


def test_a_batch_moves_as_a_whole(streets):
    batch = next(iter(rays(streets)))
    moved = batch.to("meta")
    assert {tensor.device.type for tensor in moved[:3]} == {"meta"}
    assert moved[3:] == batch[3:]


def test_a_batch_is_what_the_model_takes(streets):
    batch = next(iter(rays(streets)))
    assert batch.image.shape == (6, 16, 64)
    assert batch.queries.shape == (6, 100, 2)
    assert batch.ranges.shape == (6, 100)
    assert batch.image.dtype == batch.queries.dtype == batch.ranges.dtype == torch.float32
    assert batch.queries[..., 0].min() >= 0
    assert batch.queries[..., 0].max() <= 15
    assert batch.queries[..., 1].min() >= 8
    assert batch.queries[..., 1].max() <= 55


def test_ranges_lie_within_the_limits_or_are_filled(streets):
    batch = next(iter(rays(streets)))
    for ranges in (batch.image, batch.ranges):
        seen = ranges != SENSOR.norm_range
        assert seen.any()
        assert (~seen).any()  # above the horizon
        assert ranges[seen].min() >= SENSOR.min_range
        assert ranges[seen].max() <= SENSOR.max_range


def test_queries_are_the_rays_that_were_cast(streets):
    # Ranges to a plane are smooth in the pixel coordinate: interpolating inverse range nearly hits the truth.
    from ilnet.models import create

    batch = next(iter(rays(streets)))
    predicted = create("bilinear-inverse")(batch.image, batch.queries, wrap=False)
    near = (batch.ranges < 15) & (predicted < 20)
    assert near.sum() > 40
    assert (predicted - batch.ranges)[near].abs().max() < 0.05


def test_the_seed_decides(streets):
    first, again, other = (list(zip(range(3), rays(streets, seed), strict=False)) for seed in (1, 1, 2))
    for (_, a), (_, b) in zip(first, again, strict=True):
        assert all(torch.equal(x, y) for x, y in zip(a[:3], b[:3], strict=True))
    assert not torch.equal(first[0][1].ranges, other[0][1].ranges)
    assert not torch.equal(first[0][1].ranges, first[1][1].ranges)


def test_a_stream_can_start_anywhere(streets):
    batches = [batch for _, batch in zip(range(4), rays(streets), strict=False)]
    later = data.ContinuousRays(streets, SENSOR, crops=6, columns=64, queries=100, seed=0, start=3)
    assert torch.equal(next(iter(later)).ranges, batches[3].ranges)


def test_sensors_sway_and_stand_at_their_height(streets):
    """Straight ahead and down the range tells the height; its spread the pitch and the jitter."""
    heights = []
    for _, batch in zip(range(20), rays(streets), strict=False):
        lowest = batch.image[:, 0].mean(1)
        heights.append(lowest * math.sin(math.radians(15)))
    heights = torch.cat(heights)
    assert heights.mean() == pytest.approx(towns.SENSOR_HEIGHT, abs=0.15)
    assert 0.1 < heights.std() < 0.6


def test_continuous_rays_meet_the_traffic_of_their_own_crop(monkeypatch):
    """What crops measure is what one crop alone measures in the world it stands in."""
    street = places.town("town01")
    drawn, casts = [], []
    draw, cast, hits = places.towns.traffic, simulate.cast, simulate.hits
    monkeypatch.setattr(places.towns, "traffic", lambda *args, **sector: drawn.append(args) or draw(*args, **sector))
    monkeypatch.setattr(simulate, "hits", lambda *args: casts.append(args) or hits(*args))
    batch = next(iter(data.ContinuousRays([street], SENSOR, crops=5, columns=96, queries=300, seed=3)))
    monkeypatch.undo()
    assert len({seed for _, _, seed in drawn}) == 5
    mesh, poses, rays, limit = casts[-1]
    assert mesh is street.mesh
    met = 0
    for crop, (_, position, seed) in enumerate(drawn):
        world = street.world(torch.from_numpy(position), seed)
        alone = simulate.nearest([cast(mesh, poses[crop], rays[crop], limit) for mesh in world])
        measured = torch.cat((batch.image[crop].flatten(), batch.ranges[crop]))
        expected = alone.where(alone >= SENSOR.min_range, SENSOR.norm_range)
        assert ((measured - expected).abs() > 1e-3).double().mean() < 1e-3
        met += int((alone != cast(street.mesh, poses[crop], rays[crop], limit)).sum())
    assert met > 50


@pytest.mark.parametrize("workers", [1, 3])
def test_any_number_of_workers_gives_the_same_batches(streets, workers):
    alone = [batch for _, batch in zip(range(5), rays(streets), strict=False)]
    loader = iter(DataLoader(rays(streets), batch_size=None, num_workers=workers))
    for batch in alone:
        for tensor, expected in zip(next(loader)[:3], batch[:3], strict=True):
            assert torch.equal(tensor, expected)


def test_parts_of_a_batch_make_up_the_whole():
    street = places.town("town01")

    def first(part):
        return next(iter(data.ContinuousRays([street], SENSOR, 4, 64, 50, seed=2, start=3, part=part)))

    whole, halves = first((0, 1)), [first((number, 2)) for number in range(2)]
    assert torch.equal(whole.queries, torch.cat([half.queries for half in halves]))
    for field in ("image", "ranges"):  # traffic stands elsewhere in the mesh of a part: millimetres, at edges more
        difference = getattr(whole, field) - torch.cat([getattr(half, field) for half in halves])
        assert (difference.abs() > 1e-3).double().mean() < 1e-3
    with pytest.raises(ValueError, match="batch has 4 scans; their number should be a multiple of 3"):
        first((0, 3))


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """Five scans of two sizes, whose ranges tell the scan and the pixel."""
    sensors = {size: SENSOR.resize(*map(int, size.split("x"))) for size in ("4x16", "8x32")}
    made = data.Archive.create(tmp_path_factory.mktemp("archive") / "a", 5, sensors, {"towns": ["somewhere"]})
    images = {}
    for size, sensor in sensors.items():
        pixels = torch.arange(sensor.shape[0] * sensor.shape[1]).view(sensor.shape) / 16
        images[size] = made.quantise(size, torch.stack([10 + 10 * scan + pixels for scan in range(5)]).clamp(max=79))
    zeros = np.zeros(5, np.int32)
    made.write(0, images, zeros, zeros, np.tile(np.eye(4), (5, 1, 1)))
    return made


def stored(archive, **options):
    return data.StoredImages(archive, "4x16", "8x32", **{"scans": 2, "queries": 30, "seed": 0, **options})


def test_stored_images_give_pixels_of_the_dense_image_where_they_lie_in_the_sparse_one(archive):
    batch = next(iter(stored(archive)))
    assert batch.wrap
    assert [tuple(tensor.shape) for tensor in batch[:3]] == [(2, 4, 16), (2, 30, 2), (2, 30)]
    for image, queries, ranges in zip(*batch[:3], strict=True):
        assert len(queries.unique(dim=0)) == 30
        scan = next(k for k in range(5) if torch.equal(archive.scan(k, "4x16").ranges, image))
        row, column = (queries * torch.tensor([7 / 3, 2.0])).round().long().unbind(-1)
        assert torch.equal(archive.scan(scan, "8x32").ranges[row, column], ranges)


def test_an_epoch_draws_each_scan_once_and_the_next_in_another_order(archive):
    batches = [batch for _, batch in zip(range(10), stored(archive, scans=1), strict=False)]
    drawn = [int((batch.image[0, 0, 0] - 10) / 10) for batch in batches]
    assert sorted(drawn[:5]) == sorted(drawn[5:]) == list(range(5))
    assert drawn[:5] != drawn[5:]
    assert not torch.equal(batches[0].queries, batches[1].queries)
    later = next(iter(stored(archive, scans=1, start=7)))
    assert torch.equal(later.queries, batches[7].queries)
    whole = next(iter(stored(archive)))
    halves = [next(iter(stored(archive, part=(number, 2)))) for number in range(2)]
    assert torch.equal(whole.ranges, torch.cat([half.ranges for half in halves]))


def test_an_archive_without_the_size_is_refused(archive):
    with pytest.raises(ValueError, match="no scans of size 9x9; it has 4x16, 8x32"):
        data.StoredImages(archive, "9x9", "8x32", 1, 1, 0)
    with pytest.raises(ValueError, match="queries is 257; it should be at most 256, the pixels of 8x32"):
        stored(archive, queries=257)


def test_a_sector_is_cut_from_both_images_at_one_place_and_goes_over_the_seam(archive):
    batches = [batch for _, batch in zip(range(20), stored(archive, scans=1, queries=80, sector=5), strict=False)]
    firsts = set()
    for batch in batches:
        scan = int((batch.image.min() - 10) / 10)
        sparse, dense = (archive.scan(scan, size).ranges for size in ("4x16", "8x32"))
        [first] = [k for k in range(16) if torch.equal(sparse.roll(-k, 1)[:, :5], batch.image[0])]
        row, column = (batch.queries[0] * torch.tensor([7 / 3, 2.0])).round().long().unbind(-1)
        assert (row.max(), column.max()) == (7, 9)
        assert torch.equal(dense.roll(-2 * first, 1)[row, column], batch.ranges[0])
        firsts.add(first)
    assert len(firsts) > 5
    assert max(firsts) > 11
    with pytest.raises(ValueError, match="queries is 81; it should be at most 80, the pixels of 8x32"):
        stored(archive, queries=81, sector=5)
    with pytest.raises(
        ValueError, match="target is 4x16; for a sector its columns should be a multiple of those of 8x32"
    ):
        data.StoredImages(archive, "8x32", "4x16", 1, 1, 0, sector=3)
