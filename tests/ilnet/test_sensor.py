"""The sensor model: its frame, its tables, and angles to pixel coordinates."""

import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ilnet.sensor import (
    PRESETS,
    SOURCES,
    Sensor,
    angles_to_directions,
    directions_to_angles,
    format_size,
    parse_size,
    preset,
)

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]

# Pixel coordinates are float32: half a unit in the last place at 4096 is 2.4e-4.
PIXEL_TOLERANCE = 2.5e-4
DIRECTION_TOLERANCE = 1e-6  # float32 unit vectors


def deg(*values: float) -> np.ndarray:
    return np.deg2rad(values)


def partial(**changes) -> Sensor:
    """4 uneven falling rows, 5 uneven rising columns over 100 deg across the rear, where azimuths jump by 360 deg."""
    return Sensor(
        **{"elevations": deg(10, 4, 1, -20), "azimuths": deg(130, 140, 160, -170, -130), "name": "part", **changes}
    )


def full(**changes) -> Sensor:
    """2 rising rows, 4 falling columns 80 to 100 deg apart, all around from 170 deg; the seam stretch is 85 deg."""
    return Sensor(**{"elevations": deg(-1, 3), "azimuths": deg(170, 75, -25, -105), **changes})


def wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


# Frame


@pytest.mark.parametrize(
    ("elevation", "azimuth", "direction"),
    [
        (0, 0, (1, 0, 0)),  # ahead
        (0, 90, (0, 1, 0)),  # left
        (0, -90, (0, -1, 0)),  # right
        (0, 180, (-1, 0, 0)),  # behind
        (90, 0, (0, 0, 1)),  # up
        (30, 90, (0, math.sqrt(0.75), 0.5)),
        (-45, 45, (0.5, 0.5, -math.sqrt(0.5))),
    ],
)
def test_frame(elevation, azimuth, direction):
    angles = torch.tensor(deg(elevation, azimuth))
    found = angles_to_directions(*angles)
    torch.testing.assert_close(found, torch.tensor(direction, dtype=torch.float64), atol=1e-15, rtol=0)
    back = torch.stack(directions_to_angles(7.5 * found))
    if elevation == 90:
        back[1] = 0.0  # straight up has no azimuth
    torch.testing.assert_close(back, angles, atol=1e-15, rtol=0)


def test_directions_lie_along_the_tables():
    sensor = partial()
    directions = sensor.directions()
    assert directions.shape == (4, 5, 3)
    assert directions.dtype == torch.float32
    e, a = sensor.elevations[3], sensor.azimuths[4]
    expected = torch.tensor([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)], dtype=torch.float32)
    torch.testing.assert_close(directions[3, 4], expected, atol=DIRECTION_TOLERANCE, rtol=0)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(4, 5), atol=DIRECTION_TOLERANCE, rtol=0)


# Tables


def test_wrap():
    assert full().wrap
    assert not partial().wrap
    assert not full(azimuths=deg(0, 50, 100, 150)).wrap
    # The limit is 1.5 spacings: columns 100 deg apart leave 60 of 360 deg; 4 columns 79 deg apart leave 123 > 118.5.
    assert full(azimuths=deg(0, 100, 200, 300)).wrap
    assert not full(azimuths=deg(0, 79, 158, 237)).wrap
    assert full(azimuths=deg(0, 81, 162, 243)).wrap  # leaves 117 <= 121.5


def test_azimuths_are_stored_unwrapped_and_nearest_to_zero():
    np.testing.assert_allclose(np.rad2deg(partial().azimuths), [130, 140, 160, 190, 230])
    falling = partial(azimuths=deg(-179, 179, 170, 160, 150))
    np.testing.assert_allclose(np.rad2deg(falling.azimuths), [181, 179, 170, 160, 150])


@pytest.mark.parametrize("kind", [list, torch.tensor, np.float32])
def test_tables_of_any_kind(kind):
    sensor = Sensor(kind(np.array([0.0, 0.25])), kind(np.array([0.0, 0.5, 1.0])))
    assert sensor.shape == (2, 3)
    assert sensor.elevations.dtype == np.float64
    assert sensor == Sensor([0, 0.25], [0, 0.5, 1.0])


def test_tables_are_a_private_read_only_copy():
    table = np.array([0.0, 0.1])
    sensor = Sensor(table, [0.0, 0.1])
    table[0] = 0.05
    assert sensor.elevations[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        sensor.elevations[0] = 1.0


def test_equality():
    assert full() == full(name="another name")
    assert hash(full()) == hash(full(name="another name"))
    assert full() == pickle.loads(pickle.dumps(full()))
    assert full() == full(elevations=np.deg2rad(np.rad2deg(full().elevations)))
    assert full() != full(elevations=deg(-1, 3.001))
    assert full() != full(azimuths=deg(170, 75, -25, -104))
    assert full() != full(max_range=70)
    assert full() != "full"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"elevations": [0.1]}, "elevations has 1 beam.*at least 2, to interpolate between"),
        ({"azimuths": [0.1]}, "azimuths has 1 column.*at least 2"),
        ({"elevations": [0.1, 0.2, 0.2]}, "elevations is not sorted; it should strictly rise"),
        ({"elevations": [0.1, 0.3, 0.2]}, "elevations is not sorted; it should strictly rise"),
        ({"elevations": [0.1, math.nan]}, "elevations has 1 NaN or infinite entries"),
        ({"azimuths": [0.1, math.inf, math.nan]}, "azimuths has 2 NaN or infinite entries"),
        ({"elevations": [-15, 15]}, "elevations reaches 15 rad; it should lie within.*are these degrees"),
        ({"azimuths": [0.1, 0.3, 0.2]}, "azimuths is not sorted; it should strictly rise"),
        (
            {"azimuths": np.linspace(-np.pi, np.pi, 9)},
            "azimuths spans 6.28319 rad; it should span less than 2 pi.*repeat the first",
        ),
        ({"azimuths": np.arange(0, 360, 2.0)}, "azimuths spans 358 rad"),
        ({"elevations": [[0.1, 0.2]]}, r"elevations has shape \(1, 2\); it should be a list of angles"),
        ({"elevations": "vlp-16"}, "elevations is of type str; it should be a list of angles"),
        ({"min_range": -1}, "min_range is -1, .*should be 0 <= min_range < max_range < norm_range"),
        ({"min_range": 80}, "0 <= min_range < max_range"),
        ({"norm_range": 79}, "norm_range is 79"),
        ({"max_range": math.nan}, "max_range is nan; it should be finite"),
        ({"max_range": "far"}, "max_range is 'far'; it should be a number of metres"),
    ],
)
def test_refusals(changes, message):
    with pytest.raises(ValueError, match=message) as caught:
        full(**changes)
    assert "\n" not in str(caught.value)


# Pixel coordinates


def test_locate_by_hand_on_a_partial_circle():
    sensor = partial()
    cases = {
        (10, 130): (0, 0),
        (-20, -130): (3, 4),
        (4, 190): (1, 3),  # 190 is -170
        (7, 135): (0.5, 0.5),
        (3, 150): (1 + 1 / 3, 1.5),
        (-9.5, 175): (2.5, 2.5),
        (16, 125): (-1, -0.5),  # beyond: 6 deg a row, 10 deg a column
        (-41, -110): (4, 4.5),  # beyond: 21 deg a row, 40 deg a column
    }
    angles = torch.tensor(np.deg2rad(list(cases)))
    torch.testing.assert_close(sensor.locate(*angles.T), torch.tensor(list(cases.values())), atol=1e-5, rtol=0)
    # The middle of the table is 180 deg: azimuth 1 deg is nearer to its low end, -1 deg to its high end.
    assert sensor.locate(0.0, math.radians(1))[1] == pytest.approx(-12.9, abs=1e-4)
    assert sensor.locate(0.0, math.radians(-1))[1] == pytest.approx(4 + 129 / 40, abs=1e-4)


def test_locate_by_hand_across_the_seam():
    sensor = full()
    cases = {
        (-1, 170): (0, 0),
        (3, 122.5): (1, 0.5),
        (1, 75): (0.5, 1),
        (-1, -65): (0, 2.5),
        (-1, -105): (0, 3),
        (-1, -147.5): (0, 3.5),  # halfway from -105 to 170 - 360
        (-1, -190 + 8.5): (0, 3.9),
        (-1, 170 + 720): (0, 0),
        (-3, 75 - 360): (-0.5, 1),
        (5, 0): (1.5, 1.75),
    }
    angles = torch.tensor(np.deg2rad(list(cases)))
    torch.testing.assert_close(sensor.locate(*angles.T), torch.tensor(list(cases.values())), atol=1e-5, rtol=0)


@pytest.mark.parametrize("turns", [0, 7])
@pytest.mark.parametrize("name", PRESETS)
def test_table_entries_are_integers(name, turns):
    sensor = preset(name)
    rows, columns = sensor.shape
    expected = torch.cartesian_prod(torch.arange(rows).float(), torch.arange(columns).float()).view(rows, columns, 2)
    found = sensor.locate(
        torch.tensor(sensor.elevations)[:, None], torch.tensor(sensor.azimuths + turns * 2 * np.pi)[None]
    )
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(sensor.grid_queries(sensor), expected, atol=0, rtol=0)


def test_column_never_reaches_w():
    for azimuths in (
        np.linspace(-np.pi, np.pi, 1024, endpoint=False),
        np.linspace(3, 3 - 2 * np.pi, 7, endpoint=False),
    ):
        sensor = full(azimuths=azimuths)
        toward = np.sign(azimuths[0] - azimuths[1])
        just_before = torch.tensor(azimuths[0] + toward * np.array([0, 1e-16, 1e-15, 1e-12, 1e-8, 1e-4]))
        column = sensor.locate(0.0, just_before)[:, 1]
        assert ((column >= 0) & (column < len(azimuths))).all()
        assert column[-1] > len(azimuths) - 1  # and the seam stretch is real
        assert (column[:4] == 0).all()


@st.composite
def sensors(draw) -> Sensor:
    """Uneven tables in both directions, full and partial circles, from any start.

    At least 4 columns: fewer can lie half a turn apart, and then a table modulo a turn does not tell its direction.
    """

    def table(start: float, span: float) -> np.ndarray:
        steps = np.array(draw(st.lists(st.floats(0.5, 1), min_size=4, max_size=9)))
        fractions = np.cumsum(steps) / steps.sum()
        sign = draw(st.sampled_from((1, -1)))
        return (
            start + sign * span * np.concatenate(([0], fractions[:-1])) if span > 6 else start + sign * span * fractions
        )

    elevations = table(0, draw(st.floats(0.05, 1.5)))
    azimuths = table(draw(st.floats(-10, 10)), draw(st.one_of(st.just(2 * np.pi), st.floats(0.1, 2.5))))
    return Sensor(elevations, wrapped(azimuths))


@settings(max_examples=100, deadline=None)
@given(sensors(), st.floats(-0.5, 1.5), st.floats(0, 1), st.integers(-2, 2))
def test_locate_inverts_interpolation_in_the_tables(sensor, down, across, turns):
    rows, columns = sensor.shape
    row = down * (rows - 1)
    table = np.append(sensor.azimuths, sensor.azimuths[0] + np.copysign(2 * np.pi, np.diff(sensor.azimuths)[0]))
    column = across * (columns if sensor.wrap else columns - 1)
    # The inverse in its own words: follow the straight piece that the coordinate lies on.
    i, j = min(max(math.floor(row), 0), rows - 2), min(math.floor(column), len(table) - 2)
    elevation = sensor.elevations[i] + (row - i) * (sensor.elevations[i + 1] - sensor.elevations[i])
    azimuth = table[j] + (column - j) * (table[j + 1] - table[j])
    found = sensor.locate(float(elevation), float(azimuth + turns * 2 * np.pi))
    assert found[0].item() == pytest.approx(row, abs=PIXEL_TOLERANCE)
    miss = abs(found[1].item() - column)
    assert min(miss, columns - miss if sensor.wrap else miss) == pytest.approx(0, abs=PIXEL_TOLERANCE)


@pytest.mark.parametrize("device", DEVICES)
def test_locate_broadcasts_on_its_device(device):
    sensor = preset("os1-128")
    elevation = torch.zeros(6, 1, 5, device=device).transpose(0, 2)  # not contiguous
    found = sensor.locate(elevation, torch.linspace(-3, 3, 4, device=device)[:, None])
    assert found.shape == (5, 4, 6, 2)
    assert found.device.type == device
    assert found.dtype == torch.float32
    assert sensor.locate(torch.tensor(0.0, device=device), 0.0).tolist() == [63.5, 512.0]
    assert sensor.locate(0.0, 0.0).tolist() == [63.5, 512.0]


def test_grid_queries_of_the_paper():
    """16x1024 to 128x2048: rows 0..15 in 127 equal steps, columns in half steps from 0."""
    queries = preset("paper-16x1024").grid_queries(preset("paper-128x2048"))
    assert queries.shape == (128, 2048, 2)
    torch.testing.assert_close(queries[:, 7, 0], torch.linspace(0, 15, 128), atol=1e-5, rtol=0)
    torch.testing.assert_close(queries[9, :, 1], torch.arange(2048) / 2, atol=1e-4, rtol=0)


def test_grid_queries_between_opposite_directions():
    low_first, top_first = preset("paper-16x1024"), preset("os1-32")
    queries = low_first.grid_queries(top_first)
    torch.testing.assert_close(
        queries, low_first.locate(*directions_to_angles(top_first.directions())), atol=1e-3, rtol=0
    )
    assert (queries[1:, 0, 0] < queries[:-1, 0, 0]).all()
    assert queries[0, :3, 1].tolist() == pytest.approx([0, 1023, 1022], abs=1e-3)


def test_contains():
    edges = torch.tensor([[-0.5, 1], [-0.51, 1], [3.5, 1], [3.51, 1], [1, -0.5], [1, -0.51], [1, 4.5], [1, 4.51]])
    assert partial().contains(edges).tolist() == [True, False] * 4
    edges = torch.tensor([[-0.5, 1], [-0.51, 1], [1.5, 1], [1.51, 1], [1, 0], [1, 3.99]])
    assert full().contains(edges).tolist() == [True, False, True, False, True, True]
    assert not full().contains(torch.tensor([math.nan, 0.0]))


# Other resolutions


def test_decimate_keeps_true_angles_and_both_outer_beams():
    sensor = preset("hdl-64e")
    rows, columns = sensor.decimation(5, 512)
    assert rows.tolist() == [0, 16, 32, 47, 63]  # 63 / 4 = 15.75: 0, 15.75, 31.5 (to even), 47.25, 63
    assert columns.tolist() == list(range(0, 2048, 4))
    few = sensor.decimate(5, 512)
    np.testing.assert_array_equal(few.elevations, sensor.elevations[rows])
    np.testing.assert_array_equal(few.azimuths, sensor.azimuths[::4])
    assert few.wrap
    assert (few.min_range, few.max_range, few.norm_range) == (0.9, 120, 150)
    # The kept rays are found where they were.
    queries = sensor.grid_queries(few)
    torch.testing.assert_close(queries[:, 0, 0], torch.tensor(rows).float(), atol=0, rtol=0)
    torch.testing.assert_close(queries[0, :, 1], torch.tensor(columns).float(), atol=0, rtol=0)


def test_decimate_nothing():
    assert partial().decimate() == partial()
    assert partial().decimate(rows=2).shape == (2, 5)
    assert full().decimate(columns=2).shape == (2, 2)


@pytest.mark.parametrize(
    ("rows", "columns", "message"),
    [
        (1, None, "rows is 1; it should be 2 to 64"),
        (65, None, "rows is 65; it should be 2 to 64"),
        (None, 1000, "columns is 1000; it should be at least 2 and divide 2048"),
        (None, 1, "it should be at least 2 and divide"),
        (None, 4096, "divide 2048"),
        (None, -2, "it should be at least 2 and divide"),
    ],
)
def test_decimate_refusals(rows, columns, message):
    with pytest.raises(ValueError, match=message):
        preset("hdl-64e").decimate(rows, columns)


def test_resize_full_circle():
    sensor = full().resize(5, 8)
    np.testing.assert_allclose(np.rad2deg(sensor.elevations), [-1, 0, 1, 2, 3])
    np.testing.assert_allclose(np.rad2deg(sensor.azimuths), 170 - 45 * np.arange(8))
    assert sensor.wrap
    assert preset("paper-16x1024").resize(128, 2048) == preset("paper-128x2048")


def test_resize_partial_circle():
    sensor = partial(max_range=50).resize(4, 11)
    np.testing.assert_allclose(np.rad2deg(sensor.elevations), [10, 0, -10, -20])
    np.testing.assert_allclose(np.rad2deg(sensor.azimuths), np.linspace(130, 230, 11))
    assert sensor.max_range == 50
    with pytest.raises(ValueError, match="rows and columns are 1 and 11; each should be at least 2"):
        partial().resize(1, 11)


# Presets


@pytest.mark.parametrize(
    ("name", "shape", "top", "bottom", "row_0", "column_step"),
    [
        ("paper-16x1024", (16, 1024), 15, -15, "bottom", 360 / 1024),
        ("paper-64x1024", (64, 1024), 15, -15, "bottom", 360 / 1024),
        ("paper-128x2048", (128, 2048), 15, -15, "bottom", 360 / 2048),
        ("paper-256x4096", (256, 4096), 15, -15, "bottom", 360 / 4096),
        ("vlp-16", (16, 1800), 15, -15, "bottom", 0.2),
        ("hdl-64e", (64, 2048), 2, -24.333, "top", -360 / 2048),
        ("os0-32", (32, 1024), 45, -45, "top", -360 / 1024),
        ("os0-128", (128, 1024), 45, -45, "top", -360 / 1024),
        ("os1-32", (32, 1024), 22.5, -22.5, "top", -360 / 1024),
        ("os1-64", (64, 1024), 22.5, -22.5, "top", -360 / 1024),
        ("os1-128", (128, 1024), 22.5, -22.5, "top", -360 / 1024),
        ("os2-128", (128, 2048), 11.25, -11.25, "top", -360 / 2048),
        ("hdl-32e", (32, 2170), 10.67, -30.67, "top", -360 / 2170),
        ("vlp-32c", (32, 1800), 15, -25, "top", -0.2),
        ("vls-128", (128, 1800), 15, -25, "top", -0.2),
        ("os0-64", (64, 1024), 45, -45, "top", -360 / 1024),
        ("os2-32", (32, 2048), 11.25, -11.25, "top", -360 / 2048),
        ("os2-64", (64, 2048), 11.25, -11.25, "top", -360 / 2048),
        ("os1-32-gradient", (32, 1024), 12.75, -15.32, "top", -360 / 1024),
        ("pandar40p", (40, 1800), 15, -25, "top", -0.2),
        ("pandar64", (64, 1800), 15, -25, "top", -0.2),
        ("xt32", (32, 2000), 15, -16, "top", -0.18),
        ("qt64", (64, 600), 52.133, -52.121, "top", -0.6),
        ("ot128", (128, 1800), 15.139, -24.71, "top", -0.2),
        ("rs-helios-5515", (32, 1800), 15, -55, "top", -0.2),
        ("rs-ruby-plus", (128, 1800), 15.03, -25.05, "top", -0.2),
    ],
)
def test_preset(name, shape, top, bottom, row_0, column_step):
    sensor = preset(name)
    assert sensor.name == name
    assert sensor.shape == shape
    assert sensor.wrap
    elevations = np.rad2deg(sensor.elevations)
    assert elevations[0] == pytest.approx(top if row_0 == "top" else bottom, abs=1e-3)
    assert elevations[-1] == pytest.approx(bottom if row_0 == "top" else top, abs=1e-3)
    np.testing.assert_allclose(np.diff(np.rad2deg(sensor.azimuths)), column_step, atol=1e-9)
    # Straight ahead is the middle column.
    assert sensor.azimuths[shape[1] // 2] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "finest"),
    [
        ("hdl-32e", 1.33),
        ("vlp-32c", 0.333),
        ("vls-128", 0.11),
        ("os1-32-gradient", 0.33),
        ("pandar40p", 1 / 3),
        ("pandar64", 1 / 6),
        ("xt32", 1.0),
        ("qt64", 1.45),
        ("rs-ruby-plus", 0.09),
    ],
)
def test_the_finest_spacing_of_a_preset_is_that_of_its_data_sheet(name, finest):
    assert np.abs(np.diff(np.rad2deg(preset(name).elevations))).min() == pytest.approx(finest, abs=2e-3)


def test_preset_details():
    assert set(PRESETS) == {preset(name).name for name in PRESETS}
    assert set(SOURCES) == set(PRESETS)
    assert all(SOURCES.values())
    paper = preset("paper-16x1024")
    assert (paper.min_range, paper.max_range, paper.norm_range) == (2, 80, 100)
    np.testing.assert_allclose(np.rad2deg(preset("vlp-16").elevations), np.arange(-15, 16, 2))
    rows = np.rad2deg(preset("hdl-64e").elevations)
    np.testing.assert_allclose(rows[[0, 1, 31, 32, 33, 63]], [2, 1.667, -8.333, -8.833, -9.333, -24.333], atol=1e-3)


@pytest.mark.parametrize("name", ["paper-16x1024", "vls-128", "os1-32-gradient"])
def test_a_table_in_degrees_gives_the_sensor_back(name):
    sensor = preset(name)
    table = sensor.table()
    assert Sensor.from_table(table) == Sensor.from_table(
        {**table, "column_azimuth_deg": np.array(table["column_azimuth_deg"])}
    )
    np.testing.assert_allclose(Sensor.from_table(table).elevations, sensor.elevations, atol=1e-8)
    np.testing.assert_allclose(Sensor.from_table(table).azimuths, sensor.azimuths, atol=1e-8)
    assert Sensor.from_table(table).max_range == sensor.max_range


def test_a_table_may_name_the_number_of_even_columns():
    sensor = Sensor.from_table({"elevation_deg": [1, -1], "columns": 1024, "min_range": 1, "source": "ignored"})
    np.testing.assert_allclose(sensor.azimuths, preset("os1-128").azimuths, atol=1e-12)
    assert (sensor.min_range, sensor.max_range) == (1, 80)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"elevation_deg": None}, "it lacks elevation_deg"),
        ({"column_azimuth_deg": None}, "it lacks column_azimuth_deg"),
        ({"column_azimuth_deg": None, "columns": 10**9}, "columns is 1000000000; it should be .* from 2 to 65536"),
        ({"column_azimuth_deg": None, "columns": 8.5}, "columns is 8.5"),
        ({"elevation_deg": [10**400, 1]}, "elevation_deg is of type list"),
        ({"max_range": 10**400}, "max_range is 1000.*it should be a number of metres"),
        ({"elevation_deg": np.deg2rad(np.linspace(22.5, -22.5, 64))}, "elevation_deg spans 0.785 deg.*radians"),
        ({"column_azimuth_deg": np.deg2rad(np.arange(360.0))}, "column_azimuth_deg spans 6.27 deg.*radians"),
        ({"column_azimuth_deg": np.deg2rad(np.arange(0, 360, 22.5))}, "column_azimuth_deg spans 5.89 deg.*radians"),
        ({"column_azimuth_deg": np.deg2rad(np.arange(0, 90, 0.2))}, "column_azimuth_deg spans 1.57 deg.*radians"),
    ],
)
def test_what_is_no_table(changes, message):
    with pytest.raises(ValueError, match=message):
        Sensor.from_table({**preset("vlp-16").table(), **changes})


@pytest.mark.parametrize("name", PRESETS)
def test_no_preset_is_taken_for_radians(name):
    Sensor.from_table(preset(name).table())
    Sensor.from_table(preset(name).resize(512, 8192).table())


def test_unknown_preset():
    with pytest.raises(ValueError, match=r"sensor is 'vlp-32'; it should be one of paper-16x1024, .*vlp-16.*os1-128"):
        preset("vlp-32")


def test_a_size_is_text_both_ways():
    assert preset("paper-16x1024").size == "16x1024"
    assert parse_size("16x1024") == preset("paper-16x1024").shape
    assert format_size((128, 2048)) == "128x2048"


@pytest.mark.parametrize("size", ["16", "x", "16x", "1x64", "64x1", "-16x1024", "16x1024x2", "16.0x1024", "a x b", ""])
def test_what_is_no_size(size):
    with pytest.raises(ValueError, match=f"size is '{size}'; it should be rows x columns, at least 2 of each"):
        parse_size(size)


def test_an_upright_sensor_has_the_same_rays_in_rising_order():
    hung = preset("os1-32")
    upright = hung.upright()
    assert np.array_equal(upright.elevations, hung.elevations[::-1])
    assert np.array_equal(upright.azimuths, hung.azimuths[::-1])
    assert (upright.name, upright.max_range, upright.wrap) == (hung.name, hung.max_range, hung.wrap)
    assert upright.upright() == upright


def test_angles_are_made_once_and_serve_training_after_inference():
    sensor = preset("os1-32").resize(4, 16)
    with torch.inference_mode():
        elevations, azimuths = sensor.angles()
    assert np.allclose(elevations.numpy(), sensor.elevations, atol=1e-6)
    assert np.allclose(azimuths.numpy(), sensor.azimuths, atol=1e-6)
    assert all(again is table for again, table in zip(sensor.angles(), (elevations, azimuths), strict=True))
    scale = torch.ones((), requires_grad=True)
    (scale * elevations).sum().backward()
    assert scale.grad.item() == pytest.approx(sensor.elevations.sum(), abs=1e-5)
    assert {table.device.type for table in sensor.angles("meta")} == {"meta"}
    sent = pickle.loads(pickle.dumps(sensor))  # its tensors stay behind: there may be no such device
    assert sent == sensor
    assert sent._tensors == {}
