"""The command `sensor`, and the warning about a sensor that does not fit."""

import json
import logging

import numpy as np
import pytest
from click.testing import CliRunner

from ilnet import scan_files, sensor_files
from ilnet.commands.cli import cli
from ilnet.scan import Scan
from ilnet.scan_files import points as of_points
from ilnet.sensor import PRESETS, Sensor, preset

SENSOR = Sensor(preset("vlp-32c").elevations, preset("vlp-32c").azimuths[::4], 0.5, 100, 120, "few columns")


def run(*arguments) -> str:
    found = CliRunner().invoke(cli, ["sensor", *map(str, arguments)], catch_exceptions=False)
    assert found.exit_code == 0, found.output
    return found.output


@pytest.fixture
def scan() -> Scan:
    """Ranges of 15 to 25 m, the highest two rows and a tenth of the others lost."""
    rng = np.random.default_rng(0)
    ranges = np.where(rng.random(SENSOR.shape) < 0.1, 0.0, rng.uniform(15, 25, SENSOR.shape))
    ranges[:2] = 0.0
    return Scan(ranges, SENSOR)


def test_every_preset_is_listed_with_its_source():
    lines = run("list").splitlines()
    assert [line.split()[0] for line in lines[1:]] == list(PRESETS)
    assert "ros-drivers/velodyne params/VLS128.yaml" in next(line for line in lines if line.startswith("vls-128"))


def test_a_preset_and_a_table_are_shown(tmp_path):
    shown = run("show", "vlp-16", "--out", tmp_path / "new" / "rows.png")
    assert "vlp-16: 16x1800, a full circle in steps of 0.200°" in shown
    assert shown.splitlines()[-1].split() == ["15", "15.000"]
    assert (tmp_path / "new" / "rows.png").stat().st_size > 1000
    (tmp_path / "mine.json").write_text(run("show", "os1-32-gradient", "--json"))
    assert "os1-32-gradient: 32x1024" in run("show", tmp_path / "mine.json")


@pytest.mark.parametrize("kind", ["ring.ply", "bare.npy", "organised.npy", "scan.npz"])
def test_the_table_that_is_estimated_reads_the_file(tmp_path, scan, kind):
    path, table = tmp_path / kind, tmp_path / "table.json"
    if kind == "organised.npy":
        image = np.zeros((*SENSOR.shape, 3), np.float32)
        image[scan.ranges.numpy() > 0] = scan.points()
        np.save(path, image)
    elif kind == "bare.npy":
        np.save(path, scan.points().numpy())
    else:
        scan_files.write(path, scan)
    said = run("estimate", path, "--out", table, "--picture", tmp_path / "rows.png")
    assert "30x450: 30 rows from 7.000° to -25.000°" in said
    assert "the rows are those of the preset vlp-32c, 2 without returns" in said
    assert (tmp_path / "rows.png").stat().st_size > 1000
    sensor = sensor_files.named(str(table))
    np.testing.assert_allclose(sensor.elevations, SENSOR.elevations[2:], atol=np.deg2rad(0.02))
    if kind != "scan.npz":
        back = scan_files.read(path, sensor) if kind != "organised.npy" else Scan.from_points(scan.points(), sensor)
        assert (back.ranges > 0).sum() == (scan.ranges > 0).sum()


def test_a_row_without_returns_is_suspected(tmp_path, scan):
    ranges = scan.ranges.clone()
    ranges[12] = 0
    np.save(tmp_path / "points.npy", Scan(ranges, SENSOR).points().numpy())
    assert "there may be one between 0.00° and -0.67°" in run("estimate", tmp_path / "points.npy")
    np.save(tmp_path / "more.npy", scan.points().numpy())
    assert "there may be" not in run("estimate", tmp_path / "points.npy", tmp_path / "more.npy")


def test_millimetres_are_noticed(tmp_path, scan, caplog):
    np.save(tmp_path / "points.npy", 1000 * scan.points().numpy())
    with caplog.at_level(logging.WARNING):
        assert "30x450" in run("estimate", tmp_path / "points.npy")
    assert "points are taken as millimetres" in caplog.text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["estimate", "none.ply"], "none.ply: there is no such file"),
        (["estimate", "points.npy", "--out", "table.csv"], "table.csv: its suffix is '.csv'"),
        (["estimate", "flat.npy"], r"flat.npy: \d row\(s\) stand out"),
        (["estimate", "text.npy"], "text.npy: it is not a whole .npy file"),
        (["estimate", "image.npy"], r"image.npy: its shape \(4, 2\) is neither points"),
        (["show", "velodyne"], "sensor is 'velodyne'; it should be one of"),
    ],
)
def test_what_cannot_be_is_one_line(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    angle = np.linspace(0, 6, 500)
    np.save("flat.npy", 9 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1))
    np.save("image.npy", np.ones((4, 2)))
    (tmp_path / "text.npy").write_text("x y z")
    with pytest.raises((ValueError, OSError), match=message):
        run(*arguments)


def test_a_wrong_sensor_is_said_once(tmp_path, scan, caplog, monkeypatch):
    monkeypatch.setattr(of_points, "_doubted", set())
    np.save(tmp_path / "points.npy", scan.points().numpy())
    with caplog.at_level(logging.WARNING, "ilnet"):
        scan_files.read(tmp_path / "points.npy", SENSOR)
        assert caplog.text == ""
        scan_files.read(tmp_path / "points.npy", preset("os1-128"))
        scan_files.read(tmp_path / "points.npy", preset("os1-128"))
    [record] = caplog.records
    assert "points.npy: " in record.getMessage()
    assert "% of the points lie off the rows of os1-128; is it the right sensor? `ilnet sensor estimate` finds" in (
        record.getMessage()
    )
    caplog.clear()
    few = Sensor(SENSOR.elevations, SENSOR.azimuths[::4], name="fewer columns")
    with caplog.at_level(logging.WARNING, "ilnet"):
        scan_files.read(tmp_path / "points.npy", few)
    assert "of the points share a pixel of fewer columns with a nearer one" in caplog.text


def test_the_json_of_show_is_a_table():
    assert json.loads(run("show", "vls-128", "--json"))["elevation_deg"][0] == 15
