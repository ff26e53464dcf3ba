"""Tables of angles in files, and what an option such as --sensor names."""

import json

import numpy as np
import pytest

from ilnet import scan_files, sensor_files
from ilnet.scan import Scan
from ilnet.sensor import preset


@pytest.mark.parametrize("suffix", [".json", ".npz"])
def test_a_sensor_is_written_and_read(tmp_path, suffix):
    sensor, path = preset("vls-128"), tmp_path / "new" / f"mine{suffix}"
    sensor_files.write(path, sensor)
    found = sensor_files.named(str(path))
    assert found.name == "vls-128"
    np.testing.assert_allclose(found.elevations, sensor.elevations, atol=1e-8)
    np.testing.assert_allclose(found.azimuths, sensor.azimuths, atol=1e-8)
    assert (found.min_range, found.max_range, found.norm_range) == (0.4, 300, 375)
    assert [file.name for file in path.parent.iterdir()] == [path.name]  # nothing partial stays


def test_a_table_by_hand(tmp_path):
    path = tmp_path / "four.JSON"
    path.write_text(json.dumps({"elevation_deg": [3, 1, -1, -3], "columns": 360}))
    sensor = sensor_files.named(str(path))
    assert (sensor.name, sensor.shape, sensor.wrap) == ("four", (4, 360), True)


def test_a_scan_with_its_angles_is_a_table(tmp_path):
    sensor = preset("os1-32-gradient").resize(4, 16)
    scan_files.write(tmp_path / "scan.npz", Scan(np.ones(sensor.shape), sensor))
    np.testing.assert_allclose(sensor_files.read(tmp_path / "scan.npz").elevations, sensor.elevations, atol=1e-8)


def test_a_name_is_a_preset_or_a_file(tmp_path):
    assert sensor_files.named("os1-128") is preset("os1-128")
    with pytest.raises(ValueError, match=r"sensor is 'os1'; it should be one of .*os1-128.*or a file of angles"):
        sensor_files.named("os1")
    with pytest.raises(FileNotFoundError, match=r"none.json: there is no such file"):
        sensor_files.named(str(tmp_path / "none.json"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "it is not JSON"),
        (b"[" * 100_000, "it is not JSON"),
        (b"[1, 2]", "it holds a list; it should hold an object with the key elevation_deg"),
        (b'{"columns": 8}', "it lacks elevation_deg"),
        (b'{"elevation_deg": "abc", "columns": 8}', "elevation_deg is of type str"),
        (b'{"elevation_deg": [[1], [2]], "columns": 8}', "elevation_deg has shape"),
        (b'{"elevation_deg": [1, NaN], "columns": 8}', "elevation_deg has 1 NaN"),
        (b'{"elevation_deg": [0.26, 0.13, 0, -0.13], "column_azimuth_deg": [3.1, 1.5, 0, -1.6]}', "are these radians"),
        (b'{"elevation_deg": [1, 0], "columns": 8, "max_range": "far"}', "max_range is 'far'"),
    ],
)
def test_a_damaged_table_is_one_line_that_names_it(tmp_path, content, message):
    path = tmp_path / "bad.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"bad.json: .*{message}") as error:
        sensor_files.read(path)
    assert len(str(error.value)) < 400


def test_a_damaged_archive(tmp_path):
    path = tmp_path / "bad.npz"
    path.write_bytes(b"PK nothing")
    with pytest.raises(ValueError, match=r"bad.npz: it cannot be unpacked"):
        sensor_files.read(path)
    np.savez_compressed(path, elevation_deg=np.zeros(3_000_000), column_azimuth_deg=np.zeros(3))
    with pytest.raises(ValueError, match=r"elevation_deg has 24000128 bytes; it should have at most"):
        sensor_files.read(path)
    np.savez(path, elevation_deg=np.array([1, None]), columns=4)  # pickled: never loaded
    with pytest.raises(ValueError, match="it cannot be unpacked"):
        sensor_files.read(path)
    with pytest.raises(ValueError, match=r"table.csv: its suffix is '.csv'; it should be one of .json, .npz"):
        sensor_files.write(tmp_path / "table.csv", preset("vlp-16"))
