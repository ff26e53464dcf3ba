"""Places: where a sensor stands, and what surrounds it there."""

import math
import pickle

import numpy as np
import pytest
import torch

from ilnet.sensor import preset
from ilnet.world import places, simulate, towns

SENSOR = preset("paper-16x1024")


def test_a_sensor_stands_above_its_waypoint_and_looks_ahead(quiet_place):
    place = quiet_place([[1.0, 2.0, 3.0], [4.0, 5.0, -6.0]])
    place.headings[1] = math.pi / 2
    assert place.position(0).tolist() == pytest.approx([1, 2, 3 + towns.SENSOR_HEIGHT])
    assert place.position(1, lift=-0.5).tolist() == pytest.approx([4, 5, -6 + towns.SENSOR_HEIGHT - 0.5])
    assert torch.equal(place.pose(1)[:3, 3], place.position(1))
    assert place.pose(0)[:3, 0].tolist() == pytest.approx([1, 0, 0])
    assert place.pose(1)[:3, 0].tolist() == pytest.approx([0, 1, 0], abs=1e-6)


def test_nothing_moves_where_there_is_no_town(quiet_place):
    place = quiet_place([[0.0, 0.0, 0.0]])
    assert place.world(place.position(0), seed=3) == [place.mesh]


def test_a_place_is_the_same_in_another_process(quiet_place):
    place = quiet_place([[3.0, 0.0, 0.0]])
    scan = simulate.scan(place.mesh, SENSOR, place.pose(0))  # its mesh, and the mesh's tree, stay behind
    sent = pickle.loads(pickle.dumps(place))
    assert torch.equal(simulate.scan(sent.mesh, SENSOR, sent.pose(0)).ranges, scan.ranges)


def test_in_a_mesh_file_a_sensor_stands_where_it_is_told(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    pyvista.Plane(i_size=100, j_size=100).triangulate().save(tmp_path / "ground.ply")
    place = places.mesh(tmp_path / "ground.ply", [[5.0, 6.0, 2.5], [0.0, 0.0, 1.0]])
    assert place.position(0).tolist() == pytest.approx([5, 6, 2.5])
    down = torch.tensor([[0.0, 0.0, -1.0]])
    assert simulate.cast(place.mesh, place.pose(1), down, 80.0).item() == pytest.approx(1)
    for wrong in ([[math.nan, 0, 0]], [[1, 2]], [1, 2, 3]):
        with pytest.raises(ValueError, match=r"positions is .*; it should be rows of three finite numbers"):
            places.mesh(tmp_path / "ground.ply", wrong)


def test_waypoints_are_spread_evenly_and_leave_out_the_ends(quiet_place):
    place = quiet_place(np.zeros((101, 3)))
    assert place.spread(3) == [25, 50, 75]
    assert place.spread(1) == [50]


def test_held_out_scans_come_from_waypoints_spread_over_the_town():
    street = places.town("town01", 0)
    pairs = places.held_out_scans(street, 3, [SENSOR, preset("paper-64x1024")])
    assert [[s.ranges.shape for s in pair] for pair in pairs] == [[(16, 1024), (64, 1024)]] * 3
    for scan, dense in pairs:
        assert (scan.ranges > 0).float().mean() > 0.5
        # The outermost beams are the same beams, and other engines may have cast them.
        for few, many in ((0, 0), (15, 63)):
            assert ((scan.ranges[few] - dense.ranges[many]).abs() > 1e-3).double().mean() < 1e-3
    assert not torch.equal(pairs[0][0].ranges, pairs[1][0].ranges)


def test_every_scan_meets_other_traffic():
    """A sensor that stays where it is measures another world, unless the seed is the same."""
    street = places.town("town01")
    pose = street.pose(400)
    first, again, other = (simulate.scan(street.world(pose[:3, 3], seed), SENSOR, pose).ranges for seed in (0, 0, 1))
    empty = simulate.scan(street.mesh, SENSOR, pose).ranges
    assert torch.equal(first, again)
    assert 0.002 < (first != other).double().mean() < 0.4
    nearer = (first > 0) & ((empty == 0) | (first < empty))
    assert nearer.any()
    assert ((first == empty) | nearer).all()
