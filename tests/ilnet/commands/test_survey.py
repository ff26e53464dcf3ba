"""Statistics of scans whose surroundings are known in closed form, and the comparison as a user runs it."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from ilnet import scan_files
from ilnet.commands.cli import cli
from ilnet.commands.survey import RANGE_BINS, SLOPE_BINS, compare, ground_height, statistics
from ilnet.scan import Scan
from ilnet.sensor import Sensor
from ilnet.world import simulate
from ilnet.world.simulate import pose
from kernels import Mesh

HEIGHT = 2.0
# Beams that look down, unevenly spaced as a real sensor's, and some that look up.
DOWN = np.deg2rad(np.concatenate((np.linspace(-24, -10, 40), np.linspace(-9.5, -4, 10))))
UP = np.deg2rad(np.linspace(4, 24, 25))
CIRCLE = Sensor(np.concatenate((DOWN, UP)), np.linspace(math.pi, -math.pi, 720, endpoint=False), 2, 80, 100)
SECTOR = Sensor(np.linspace(-0.2, 0.2, 40), np.linspace(-0.4, 0.4, 90), 2, 80, 100)


def rays(sensor):
    return sensor.directions().double().unbind(-1)


def wall(sensor, distance):
    """What a sensor measures of a wall across its x axis."""
    return distance / rays(sensor)[0]


def noisy(ranges, metres):
    return ranges + metres * torch.randn(ranges.shape, generator=torch.Generator().manual_seed(0)) * (ranges > 0)


def bin_of(value, borders):
    return int(np.searchsorted(borders, value, side="right")) - 1


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("slope", [0, 3, 12, 33])
def test_a_plane_below_is_one_surface_of_its_slope(slope, noise):
    x, _, z = rays(CIRCLE)
    # It falls towards +x, HEIGHT away from the sensor.
    away = -z * math.cos(math.radians(slope)) - x * math.sin(math.radians(slope))
    ranges = (HEIGHT / away).where(away > HEIGHT / 79, 0.0)
    found = statistics(Scan(noisy(ranges, noise), CIRCLE))
    assert found.return_rate == pytest.approx(float((ranges > 0).double().mean()))
    assert found.edges == 0 if noise == 0 else found.edges < 0.01
    assert found.smooth > 0.7
    near = bin_of(slope, SLOPE_BINS)
    # The steepest plane is but 2 m away, where noise is as large as the surroundings that are fitted.
    around, most = (3, 0.95) if slope == 33 else (1, 0.99)
    assert sum(found.slopes[max(near - around, 0) : near + around + 1]) > most
    if noise == 0:
        assert found.slopes[near] == pytest.approx(1)
        assert found.median_range == pytest.approx(float(ranges[ranges > 0].median()))
        assert found.ranges[bin_of(7, RANGE_BINS)] == pytest.approx(
            float(((ranges >= 6) & (ranges < 8)).sum() / (ranges > 0).sum()), abs=1e-4
        )
        assert sum(found.ranges) == pytest.approx(1)


def test_a_full_circle_has_no_border_at_its_seam():
    down = replace(CIRCLE, elevations=DOWN)
    # The window reaches 2 rows up and down: 0.75 degrees of some 0.4 each.
    assert statistics(Scan(-HEIGHT / rays(down)[2], down)).smooth == pytest.approx((50 - 6) / 50, abs=0.03)


def test_height_above_the_ground():
    x, _, z = rays(CIRCLE)
    ranges = (HEIGHT / -z).where(z < 0, 0.0)
    block = (x > 0.9) & (ranges > 4)
    assert ground_height(Scan(noisy(ranges, 0.02).where(~block, 4.0), CIRCLE)) == pytest.approx(HEIGHT, abs=0.01)
    assert ground_height(Scan(wall(SECTOR, 10), SECTOR)) is None


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_wall_is_upright(noise):
    found = statistics(Scan(noisy(wall(SECTOR, 10), noise), SECTOR)).summary()
    assert found["upright"] > 0.99
    assert found["flat"] == 0
    assert found["edges"] == 0
    assert found["return_rate"] == 1


def test_a_step_is_an_edge_one_pixel_to_either_side():
    ranges = wall(SECTOR, 10)
    ranges[:, 30:] += 3
    # Columns 29 and 30, of those that have neighbours to both sides or, in rows with rows around them, any column.
    assert statistics(Scan(ranges, SECTOR)).edges == pytest.approx(2 * 40 / (40 * 90 - 4))
    gentle = wall(SECTOR, 10)
    gentle[:, 30:] += 0.3  # 0.15 m off the mean of its neighbours
    assert statistics(Scan(gentle, SECTOR)).edges == 0
    far = wall(SECTOR, 60)
    far[:, 30:] += 1.5  # 0.75 m off, less than 1/40 of the range
    assert statistics(Scan(far, SECTOR)).edges == 0


def test_limits_and_what_carries_the_sensor():
    ranges = wall(SECTOR, 10)
    ranges[:10] = 1.0  # nearer than the sensor measures
    ranges[10:15] = 90.0  # beyond
    ranges[15:20] = 0
    found = statistics(Scan(ranges, SECTOR))
    assert found.return_rate == pytest.approx(20 / 30)
    assert found.edges == 0  # beside a missing return there is nothing to compare with
    # A row and a column less for their neighbours, and another for their window.
    assert found.smooth == pytest.approx(16 * 86 / (20 * 90))
    with pytest.raises(ValueError, match="no return between 2 and 80 m: are its ranges metres"):
        statistics(Scan(torch.full((40, 90), 7000.0), SECTOR))


def test_two_beams_have_no_surfaces_but_all_the_rest():
    pair = Sensor(np.deg2rad([-5, 5]), SECTOR.azimuths)
    found = statistics(Scan(wall(pair, 10), pair))
    assert found.smooth == 0
    assert sum(found.slopes) == 0
    assert found.return_rate == 1


# The comparison


@pytest.fixture
def files(tmp_path):
    """A scan of the yard from 2.5 m above the ground, the yard as a mesh, and the place where the scan was taken."""
    pyvista = pytest.importorskip("pyvista")
    ground = pyvista.Plane(i_size=160, j_size=160)
    blocks = [pyvista.Cube(center=(x, y, 2), x_length=4, y_length=4, z_length=4) for x, y in ((12, 3), (-8, 15))]
    mesh = pyvista.merge([part.triangulate() for part in (ground, *blocks)]).extract_surface(algorithm=None)
    mesh.save(tmp_path / "yard.ply")
    sensor = replace(CIRCLE, elevations=np.deg2rad(np.linspace(-25, 15, 48)), azimuths=CIRCLE.azimuths[::2])
    surroundings = Mesh(mesh.points, mesh.regular_faces)
    scan_files.write(tmp_path / "measured.npz", simulate.scan(surroundings, sensor, pose((3.0, -2.0, 2.5))))
    place = {"sensor_height_m": 1.2, "positions": [[3.0, -2.0, 1.2], [3.0, -2.0, 1.2]]}
    (tmp_path / "yard.json").write_text(json.dumps(place))
    return tmp_path


def test_a_mesh_is_seen_from_the_height_of_the_measured_scan(files):
    measured, simulated = compare([files / "measured.npz"], [(files / "yard.ply", files / "yard.json")], [])
    assert (measured.kind, simulated.kind) == ("measured", "mesh")
    assert (measured.sensor, simulated.sensor) == ("measured", "measured")
    assert simulated.source == "yard"
    assert len(simulated.scans) == 2
    there, again = measured.mean, simulated.mean
    assert again.return_rate == pytest.approx(there.return_rate, abs=1e-3)
    assert again.median_range == pytest.approx(there.median_range, abs=0.05)
    np.testing.assert_allclose(again.ranges, there.ranges, atol=0.02)  # rows of ground lie at borders of bins
    np.testing.assert_allclose(again.slopes, there.slopes, atol=0.02)


def test_two_sources_of_one_name_are_refused(files):
    (files / "more").mkdir()
    scan, mesh, positions = (files / name for name in ("measured.npz", "yard.ply", "yard.json"))
    scans = [scan, (files / "more" / "measured.npz")]
    for arguments in ((scans, [], []), ([], [(mesh, positions)] * 2, []), ([], [], ["town01", "town01"])):
        with pytest.raises(ValueError, match=r"two sources are called (measured|yard|town01); rename a file"):
            compare(*arguments)


def test_survey_prints_a_table_and_draws(files):
    options = ["survey", "--scan", "measured.npz", "--mesh", "yard.ply", "--at", "yard.json", "--town", "town01"]
    done = CliRunner().invoke(cli, [*(str(files / o) if "." in o else o for o in options), "--out", str(files / "new")])
    assert done.exit_code == 0, done.output
    rows = {line.split()[0]: line.split()[1:] for line in done.output.splitlines() if line.strip()}
    entries = {entry["source"]: entry for entry in json.loads((files / "new" / "survey.json").read_text())}
    assert set(entries) == {"measured", "yard", "town01"}
    for source, entry in entries.items():
        assert [float(cell) for cell in rows[source]] == pytest.approx(list(entry["mean"].values()), abs=0.05)
        for key, mean in entry["mean"].items():
            assert entry["lowest"][key] <= mean + 1e-9
            assert entry["highest"][key] >= mean - 1e-9
    assert entries["town01"]["scans"] == 10
    assert (files / "new" / "survey.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", 'bad.json: should be JSON like {"positions": '),
        ('{"positions": [[1, 2, 3]]}', "lacks 'sensor_height_m'"),
        ('{"positions": [[1, 2]], "sensor_height_m": 1.8}', "not a list of .x, y, z."),
        ('{"positions": [], "sensor_height_m": 1.8}', "not a list of .x, y, z."),
        ('{"positions": [[900, 0, 1.8]], "sensor_height_m": 1.8}', "yard, position 0: the scan has no return between"),
    ],
)
def test_bad_positions(files, content, message):
    (files / "bad.json").write_text(content)
    with pytest.raises(ValueError, match=message):
        compare([], [(files / "yard.ply", files / "bad.json")], [])


def test_options_that_do_not_fit():
    runner = CliRunner()
    assert "--mesh FILE and --at JSON go together" in runner.invoke(cli, ["survey", "--mesh", "a.ply"]).output
    assert "give at least one" in runner.invoke(cli, ["survey"]).output
