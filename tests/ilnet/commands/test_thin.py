import csv
import types

import numpy as np
import pytest
import torch

from ilnet import models
from ilnet.commands import study, thin
from ilnet.sensor import PAPER_INPUT
from ilnet.world import simulate, towns

from ..crossing import crossing


@pytest.fixture
def quiet(monkeypatch):
    """The crossing without traffic, seen from its middle, with less than the finest sensors."""
    place = crossing()
    nothing = towns.draw(place.town, (0, 0, 1.8), 0).some(np.zeros(0, int))
    monkeypatch.setattr(thin.towns, "draw", lambda *_: nothing)
    monkeypatch.setattr(thin, "TARGET", PAPER_INPUT.resize(64, 1024))
    monkeypatch.setattr(thin, "_FINE", PAPER_INPUT.resize(128, 1024))
    monkeypatch.setattr(simulate, "best_device", lambda: torch.device("cpu"))
    return place


MIDDLE = 67  # of the waypoints along the lane
POLE = np.array([10.0, 3.0])


def off_by(metres, place):
    """Predicts the truth, so much too far."""
    pose = place.pose(MIDDLE)
    truth = simulate.scan(place.mesh, thin.TARGET, pose).ranges
    return types.SimpleNamespace(ranges=lambda scan: truth + metres)


def test_points_on_a_pole_are_counted_by_hand(quiet):
    frames = {"right": off_by(0.0, quiet), "nearly": off_by(0.04, quiet), "wrong": off_by(0.06, quiet)}
    kinds, away, found = thin._counted(quiet, MIDDLE, frames)
    assert kinds.tolist() == [0]
    at = quiet.waypoints[MIDDLE, :2]
    near = np.linalg.norm(POLE - at)
    assert away[0] == pytest.approx(near, abs=0.4)
    # It is 4 m high; its side of 0.2 m is seen at an angle of a few columns.
    height = PAPER_INPUT.resize(128, 1024).elevations
    rows = ((np.tan(height) * near + 1.8 > 0) & (np.tan(height) * near + 1.8 < 4)).sum() / 2
    columns = 0.2 / near / (2 * np.pi / 1024)
    [dense] = found["128 beams"]
    assert rows * columns * 0.7 < dense < rows * columns * 2.0
    assert dense / 6 < found["16 beams"][0] < dense / 2.5
    assert (found["right"], found["nearly"], found["wrong"]) == ([dense], [dense], [0])


def test_people_are_told_from_poles_and_from_cars(monkeypatch, quiet):
    monkeypatch.undo()
    monkeypatch.setattr(thin, "_FINE", PAPER_INPUT.resize(64, 1024))
    place = crossing()
    everything = towns.draw(place.town, (0, 0, 1.8), 3)
    spot = np.array([[8.0, -4.0, 0, 0], [12.0, -6.0, 0, 1.0], [15.0, 8.0, 0, 0]])
    kind = np.array([towns.PEOPLE[0], towns.BICYCLES[1], 0])  # and a car, which is not thin
    ones = np.ones((3, 3))
    things = towns.Things(spot, np.zeros(3), kind, np.zeros(3), np.zeros(3, bool), ones)
    assert everything._fields == things._fields
    monkeypatch.setattr(thin.towns, "draw", lambda *_: things)
    kinds, away, found = thin._counted(place, MIDDLE, {})
    assert kinds.tolist() == [0, 1, 2]
    np.testing.assert_allclose(
        away, np.linalg.norm(np.stack([POLE, *spot[:2, :2]]) - place.waypoints[MIDDLE, :2], axis=1), atol=0.6
    )
    assert (found["128 beams"] > found["16 beams"]).all()


def test_shares_by_hand():
    kinds, ranges = np.array([0, 0, 1, 2]), np.array([5.0, 15.0, 15.0, 70.0])
    counts = {"16 beams": np.array([10, 9, 0, 0]), "128 beams": np.array([99, 30, 10, 3])}
    found = {(row["things"], row["range"]): row for row in thin._rows(kinds, ranges, counts)}
    poles = {"things": "poles", "range": "all", "in_sight": 2, "16 beams": 0.5, "128 beams": 1.0}
    assert found["poles", "all"] == poles
    assert found["bicycles", "all"]["128 beams"] == 0.0
    assert found["all", "10 to 20 m"]["in_sight"] == 2
    assert found["all", "10 to 20 m"]["16 beams"] == 0.0
    assert ("all", "20 to 40 m") not in found
    assert found["all", "all"] == {"things": "all", "range": "all", "in_sight": 4, "16 beams": 0.25, "128 beams": 0.75}


def test_the_experiment_writes_a_table_and_a_figure(quiet, monkeypatch, tmp_path):
    monkeypatch.setattr(thin.places, "town", lambda *_, **options: quiet)
    monkeypatch.setattr(thin, "loaded", lambda files: {name: models.create("planes") for name in files})
    thin.thin(study.Study(None, tmp_path, scans=3))
    with open(tmp_path / "thin.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[3:] == ["16 beams", "128 beams", "planes", "iln", "iln-surfaces"]
    assert int(rows[-1]["in_sight"]) >= 2  # the pole, in both towns
    assert (tmp_path / "thin.png").read_bytes()[:4] == b"\x89PNG"
    assert study.made_with(tmp_path)["thin"]["networks"] == "the networks that ship"
