import shutil

import numpy as np
import pytest
import torch

from ilnet.data import StoredImages, open_archive
from ilnet.data.rimg import RangeImageTree

SPECIFICATION = """max_r: 80.0  # metres
min_r: 2.0
norm_r: 100.0
max_v: 15.0
min_v: -15.0
max_h: 180.0
min_h: -180.0
"""


def write(file, ranges):
    """As the authors' tools do: the transposed image's columns and rows, then the transposed image."""
    file.parent.mkdir(parents=True, exist_ok=True)
    header = np.array(ranges.shape, "<u8").tobytes()
    file.write_bytes(header + np.ascontiguousarray(ranges.T, dtype="<f2").tobytes())


def image(rows, columns, seed=0):
    ranges = np.random.default_rng(seed).uniform(2, 80, (rows, columns)).astype(np.float16)
    ranges[0, :3] = [0, 100, 80]
    return ranges


@pytest.fixture
def tree(tmp_path):
    root = tmp_path / "download"
    for town, numbers in {"Town01": (2, 10), "Town02": (1,)}.items():
        for number in numbers:
            write(root / town / "4_32" / f"{number}.rimg", image(4, 32, number))
            write(root / town / "8_32" / f"{number}.rimg", image(8, 32, number))
    (root / "lidar_specification.yaml").write_text(SPECIFICATION)
    (root / "Town01" / "4_32" / "._2.rimg").write_text("an archive tool's own")
    return root


def test_scans_come_by_town_and_number(tree):
    scans = open_archive(tree)
    assert len(scans) == 3
    assert scans.sizes == ("4x32", "8x32")
    assert [scans.town(k) for k in range(3)] == ["Town01", "Town01", "Town02"]
    for k, number in enumerate((2, 10, 1)):
        truth = image(8, 32, number).astype(np.float32)
        truth[truth > 80] = 0
        assert scans.scan(k, "8x32").ranges.numpy() == pytest.approx(truth)


def test_points_lie_where_the_authors_formula_puts_them(tree):
    scan = open_archive(tree).scan(0, "8x32")
    v = np.deg2rad(np.linspace(-15, 15, 8))[:, None]
    h = np.deg2rad(np.linspace(-180, 180, 32, endpoint=False))[None]
    r = scan.ranges.numpy()
    xyz = np.stack([np.sin(h) * np.cos(v) * r, np.cos(h) * np.cos(v) * r, np.sin(v) * r], -1)
    np.testing.assert_allclose(scan.points().numpy(), xyz[r > 0], atol=1e-4)
    assert scan.sensor.wrap
    assert (scan.sensor.min_range, scan.sensor.max_range, scan.sensor.norm_range) == (2, 80, 100)


def test_a_town_or_a_folder_above_will_do_too(tree):
    town = open_archive(tree / "Town01")
    assert (len(town), town.towns) == (2, ("Town01",))
    above = open_archive(tree.parent)
    assert (len(above), above.towns) == (3, ("download/Town01", "download/Town02"))


def test_towns_may_be_links(tree, tmp_path):
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / "here").symlink_to(tree / "Town01")
    shutil.copy(tree / "lidar_specification.yaml", tmp_path / "links")
    scans = open_archive(tmp_path / "links")
    assert (len(scans), scans.towns) == (2, ("here",))
    assert scans.scan(0, "4x32").ranges.any()


def test_a_size_may_be_missing_from_some_scans(tree):
    (tree / "Town01" / "8_32" / "10.rimg").unlink()
    scans = open_archive(tree)
    assert scans.scan(1, "4x32").ranges.any()
    with pytest.raises(FileNotFoundError, match=r"8_32/10.rimg: there is no such file, though other sizes"):
        scans.scan(1, "8x32")


def test_what_is_not_there_is_refused(tree):
    scans = open_archive(tree)
    with pytest.raises(IndexError, match="there is no scan 3; its 3 scans"):
        scans.scan(3, "4x32")
    with pytest.raises(ValueError, match="no scans of size '4x4'"):
        scans.scan(0, "4x4")
    with pytest.raises(ValueError, match="hold no poses"):
        scans.pose(0)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda b: b[: len(b) // 2], "holds 264 bytes, 8x32 ranges take 528"),
        (lambda b: b[:7], "holds 7 bytes"),
        (lambda b: b + b"\0", "holds 529 bytes"),
        (lambda b: b[8:16] + b[:8] + b[16:], "its header says 32x8, its folder 8x32"),
        (lambda b: b[:16] + b"\0\x7e" + b[18:], "1 NaN"),
        (lambda b: b[:16] + b"\0\xc0" + b[18:], "1 negative"),
    ],
)
def test_a_damaged_file_is_one_line_that_names_it(tree, damage, message):
    file = tree / "Town01" / "8_32" / "2.rimg"
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(ValueError, match=message) as error:
        open_archive(tree).scan(0, "8x32")
    assert "2.rimg" in str(error.value)
    assert "\n" not in str(error.value)


def test_the_specification_is_needed_and_whole(tree, tmp_path):
    file = tree / "lidar_specification.yaml"
    for text, what in (("max_r: 80\n", "lacks min_v, max_v"), ("max_r: far\n", "lines like"), (None, "there is no")):
        file.unlink()
        if text:
            file.write_text(text)
            with pytest.raises(ValueError, match=what):
                open_archive(tree)
            continue
        with pytest.raises(FileNotFoundError, match=r"no lidar_specification.yaml beside or above its towns"):
            open_archive(tree)
    file.write_text(SPECIFICATION.replace("min_r: 2.0", "min_r: 90"))
    with pytest.raises(ValueError, match="makes no sensor of 4x32: min_range is 90"):
        open_archive(tree)


def test_the_authors_own_files(shared):
    scans = RangeImageTree(shared / "data" / "authors")
    assert (len(scans), scans.sizes, scans.towns) == (2, ("16x1024", "64x1024"), ("Town99",))
    sparse, dense = scans.scan(0, "16x1024"), scans.scan(0, "64x1024")
    # Their outermost beams are the same.
    assert torch.equal(sparse.ranges[0], dense.ranges[0])
    assert torch.equal(sparse.ranges[15], dense.ranges[63])
    # They stand 1.8 m above flat ground, roughly: a frame turned wrong would show elsewhere, this one shows in z.
    assert dense.points()[:, 2].quantile(0.1) == pytest.approx(-1.8, abs=0.3)


def test_a_copy_read_from_elsewhere_gives_the_same(tree, tmp_path):
    copy = shutil.copytree(tree, tmp_path / "copy")
    first, second = open_archive(tree), open_archive(copy)
    assert all(torch.equal(first.scan(k, "4x32").ranges, second.scan(k, "4x32").ranges) for k in range(len(first)))


def test_batches_hold_images_as_networks_see_them(tree):
    """Azimuths of the authors' images fall; every network is shown rising ones."""
    scans = open_archive(tree)
    batch = next(iter(StoredImages(scans, "4x32", "8x32", 1, 256, 0)))
    sensor = scans.sensors["4x32"].upright()
    assert batch.sensor == sensor
    assert sensor.azimuths[0] < sensor.azimuths[-1]
    found = [k for k in range(3) if torch.equal(scans.scan(k, "4x32").filled().flip(-1), batch.image[0])]
    assert len(found) == 1
    dense = scans.scan(found[0], "8x32")
    row, column = (batch.queries[0] * torch.tensor([7 / 3, 1.0])).round().long().unbind(-1)
    assert torch.equal(dense.filled().flip(-1)[row, column], batch.ranges[0])
    # A query names the same direction in the sensor's own order.
    where = dense.sensor.upright().azimuths[column]
    assert where == pytest.approx(dense.sensor.azimuths[31 - column])
