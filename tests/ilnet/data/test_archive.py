import json
import os
import shutil

import numpy as np
import pytest
import torch

from ilnet.data.archive import UNIT, Archive, open_archive
from ilnet.sensor import Sensor, preset

SENSORS = {
    "16x1024": preset("paper-16x1024"),
    "8x64": Sensor(np.linspace(0.3, -0.4, 8) ** 3, np.linspace(3, -3, 64), 0),
}
ATTRIBUTES = {"towns": ["here", "there"], "seed": 3}
SCANS = UNIT + 2


def images(size, count=SCANS):
    rows, columns = SENSORS[size].shape
    ranges = torch.rand(count, rows, columns, generator=torch.Generator().manual_seed(count)) * 78 + 2
    return ranges.where(ranges < 70, 0)


def fill(archive, units=(0, 1)):
    for unit in units:
        scans = slice(unit * UNIT, min((unit + 1) * UNIT, SCANS))
        numbers = np.arange(SCANS)[scans]
        poses = np.eye(4) + numbers[:, None, None]
        ranges = {size: archive.quantise(size, images(size)[scans]) for size in archive.sizes}
        archive.write(unit, ranges, numbers % 2, numbers * 10, poses)


@pytest.fixture
def archive(tmp_path):
    made = Archive.create(tmp_path / "scans", SCANS, SENSORS, ATTRIBUTES)
    fill(made)
    return made


def test_what_was_written_is_read(archive):
    opened = open_archive(archive.path)
    assert len(opened) == SCANS
    assert opened.sizes == tuple(SENSORS)
    assert opened.towns == ("here", "there")
    for number in range(SCANS):
        for size, sensor in SENSORS.items():
            scan = opened.scan(number, size)
            truth = images(size)[number]
            assert scan.sensor == sensor
            assert np.array_equal(scan.sensor.elevations, sensor.elevations)
            assert scan.sensor.name == sensor.name
            assert torch.equal(scan.ranges == 0, truth == 0)
            assert (scan.ranges - truth).abs().max() <= 0.001  # half a step of 2^-9 m
        assert opened.town(number) == ("here", "there")[number % 2]
        assert torch.equal(opened.pose(number), torch.eye(4, dtype=torch.float64) + number)


def test_anyone_can_read_it_as_zarr(archive):
    import zarr

    group = zarr.open_group(archive.path, mode="r")
    ranges = group["range_8x64"]
    assert ranges.metadata.dimension_names == ("scan", "row_8x64", "column_8x64")
    metres = ranges[:] * ranges.attrs["scale_factor"]
    assert metres[3] == pytest.approx(images("8x64")[3].numpy(), abs=0.001)
    assert ranges.attrs["units"] == "m"
    assert group["elevation_8x64"][:].tolist() == SENSORS["8x64"].elevations.tolist()
    assert group["waypoint"][:].tolist() == [10 * k for k in range(SCANS)]
    assert group.attrs["seed"] == 3


@pytest.mark.parametrize(("limits", "step"), [((2, 80, 100), 2**-9), ((1, 400, 500), 2**-7), ((0.5, 100, 120), 2**-9)])
def test_ranges_stay_within_the_limits_and_fit_the_step(tmp_path, limits, step):
    least, most, _ = limits
    sensor = Sensor(np.array([0.0, 0.1]), np.array([0.0, 0.1]), *limits)
    archive = Archive.create(tmp_path / "x", 1, {"2x2": sensor}, ATTRIBUTES)
    ranges = torch.tensor([[least, most], [0.0, least + step * 1.4]])
    archive.write(0, {"2x2": archive.quantise("2x2", ranges)[None]}, np.zeros(1), np.zeros(1), np.eye(4)[None])
    assert archive.scan(0, "2x2").ranges.tolist() == [[least, most], [0, least + step]]


def test_the_nearest_hit_of_a_sensor_without_a_minimum_stays_a_hit(archive):
    assert archive.quantise("8x64", torch.tensor([1e-6, 0.0])).tolist() == [1, 0]


def test_an_empty_scan_is_as_complete_as_another(tmp_path):
    archive = Archive.create(tmp_path / "x", 1, {"8x64": SENSORS["8x64"]}, {"towns": ["a"]})
    archive.write(0, {"8x64": np.zeros((1, 8, 64), np.uint16)}, np.zeros(1), np.zeros(1), np.zeros((1, 4, 4)))
    assert archive.missing() == []
    assert not archive.scan(0, "8x64").ranges.any()


def test_an_incomplete_archive_is_read_as_far_as_it_goes(tmp_path):
    archive = Archive.create(tmp_path / "x", SCANS, SENSORS, ATTRIBUTES)
    fill(archive, units=[1])
    assert archive.missing() == [0]
    assert archive.scan(UNIT, "8x64").ranges.any()
    for read in (lambda: archive.scan(0, "8x64"), lambda: archive.pose(0), lambda: archive.town(0)):
        with pytest.raises(FileNotFoundError, match="scan 0 is not there yet"):
            read()


def test_what_is_not_there_is_refused(archive):
    with pytest.raises(IndexError, match=f"there is no scan {SCANS}; its {SCANS} scans"):
        archive.scan(SCANS, "8x64")
    with pytest.raises(IndexError, match="there is no scan -1"):
        archive.pose(-1)
    with pytest.raises(ValueError, match="no scans of size '9x9'; it has 16x1024, 8x64"):
        archive.scan(0, "9x9")


def test_a_damaged_file_is_refused_by_name_and_the_others_are_read(archive):
    file = archive.path / "range_8x64" / "c" / "0" / "0" / "0"
    whole = file.read_bytes()
    for damaged in (whole[: len(whole) // 2], whole[:30] + b"\xff" + whole[31:], b""):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"range_8x64/c/0/0/0: damaged .*; delete it") as error:
            archive.scan(0, "8x64")
        assert "\n" not in str(error.value)
    assert archive.scan(UNIT, "8x64").ranges.any()
    file.unlink()
    fill(archive, archive.missing())
    assert file.read_bytes() == whole


def test_one_archive_is_made_again_and_another_refused(archive):
    before = {file: file.stat().st_mtime_ns for file in archive.path.rglob("*") if file.is_file()}
    again = Archive.create(archive.path, SCANS, SENSORS, ATTRIBUTES)
    assert again.missing() == []
    assert before == {file: file.stat().st_mtime_ns for file in archive.path.rglob("*") if file.is_file()}
    other = {"8x64": preset("os1-64").resize(8, 64)}
    for scans, sensors, attributes, what in (
        (SCANS + 1, SENSORS, ATTRIBUTES, "its scans is 10, not 11"),
        (SCANS, SENSORS, {**ATTRIBUTES, "seed": 4}, "its seed is 3, not 4"),
        (SCANS, other, ATTRIBUTES, "its sizes is"),
        (SCANS, {**SENSORS, **other}, ATTRIBUTES, "8x64.* differs"),
    ):
        with pytest.raises(ValueError, match=what):
            Archive.create(archive.path, scans, sensors, attributes)
    assert before == {file: file.stat().st_mtime_ns for file in archive.path.rglob("*") if file.is_file()}


def test_an_archive_whose_making_was_interrupted_is_made_whole(archive):
    for name in ("zarr.json", "pose/zarr.json", "azimuth_8x64/c/0"):
        (archive.path / name).unlink()
    again = Archive.create(archive.path, SCANS, SENSORS, ATTRIBUTES)
    assert again.sensors == SENSORS
    assert again.missing() == []


def test_unfinished_files_of_some_units_are_removed(archive):
    left = ["pose/c/1/0/0.1f.partial", "town/c/1.2f.partial", "zarr.3f.partial", "pose/zarr.4f.partial"]
    for name in [*left, "pose/c/0/0/0.5f.partial"]:
        (archive.path / name).write_bytes(b"torn")
    archive.remove_unfinished({1})
    assert [file.name for file in archive.path.rglob("*.partial")] == ["0.5f.partial"]


def test_folders_that_are_none_are_refused(tmp_path, archive):
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    for name, what in (("nowhere", "no such folder"), ("file", "not a folder"), ("empty", "holds no scans")):
        with pytest.raises(OSError, match=what):
            open_archive(tmp_path / name)
    for name, content in (
        ("zarr.json", b"{"),
        ("zarr.json", (archive.path / "zarr.json").read_bytes().replace(b'"format": 1', b'"format": 2')),
        ("range_8x64/zarr.json", b""),
    ):
        copy = shutil.copytree(archive.path, tmp_path / "copy")
        (copy / name).write_bytes(content)
        with pytest.raises(ValueError, match=r"copy: not an archive of scans, or damaged: ") as error:
            open_archive(copy)
        assert "\n" not in str(error.value)
        shutil.rmtree(copy)


def test_the_description_does_not_depend_on_when_it_was_written(tmp_path, archive):
    again = Archive.create(tmp_path / "again", SCANS, SENSORS, ATTRIBUTES)
    fill(again, units=[1, 0])
    files = {file.relative_to(archive.path) for file in archive.path.rglob("*") if file.is_file()}
    assert files == {file.relative_to(again.path) for file in again.path.rglob("*") if file.is_file()}
    assert all((archive.path / file).read_bytes() == (again.path / file).read_bytes() for file in files)
    assert json.loads((again.path / "zarr.json").read_bytes())["attributes"]["scans"] == SCANS


@pytest.mark.skipif(os.name != "posix", reason="needs a limit on the size of files")
def test_a_full_disk_loses_nothing(tmp_path, archive):
    import resource

    full = Archive.create(tmp_path / "full", SCANS, SENSORS, ATTRIBUTES)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(OSError, match="full cannot be written: File too large; what is complete there is kept"):
            fill(full)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(full.path.rglob("*.partial")) == []
    assert full.missing() == [0, 1]
    fill(full)
    assert full.missing() == []
    for size in SENSORS:
        assert torch.equal(full.scan(0, size).ranges, archive.scan(0, size).ranges)
