import csv
import sys

import numpy as np
import pytest
import torch

from ilnet import models
from ilnet.commands import odometry, study
from ilnet.sensor import PAPER_INPUT
from ilnet.world import simulate
from ilnet.world.towns import parts
from kernels import Mesh

from ..crossing import crossing


@pytest.fixture
def kiss():
    pytest.importorskip("kiss_icp", reason="needs kiss-icp: pip install '.[odometry]'")


def test_without_kiss_icp_it_says_what_to_install(command, monkeypatch):
    monkeypatch.setitem(sys.modules, "kiss_icp", None)
    monkeypatch.delitem(sys.modules, "kiss_icp.kiss_icp", raising=False)
    code, out, [error] = command("experiment", "table", "odometry")
    assert (code, out) == (2, "")
    assert "odometry needs it: pip install 'ilnet[odometry]'" in error


def test_errors_by_hand(kiss):
    truth = np.tile(np.eye(4), (300, 1, 1))
    truth[:, 0, 3] = np.arange(300)
    assert odometry.errors(truth, truth) == pytest.approx(
        {"translation_percent": 0, "rotation_deg_per_m": 0, "ate_m": 0}, abs=1e-6
    )
    long = truth.copy()
    long[:, 0, 3] *= 1.01
    found = odometry.errors(truth, long)
    assert found["translation_percent"] == pytest.approx(1.0, abs=0.02)
    assert found["rotation_deg_per_m"] == pytest.approx(0, abs=1e-6)
    assert found["ate_m"] == pytest.approx(2.99 / np.sqrt(12), rel=0.01)  # -1.5 to 1.5 m, evenly
    turned = truth.copy()
    angle = np.deg2rad(0.1) * np.arange(300)
    turned[:, 0, 0], turned[:, 0, 1] = np.cos(angle), -np.sin(angle)
    turned[:, 1, 0], turned[:, 1, 1] = np.sin(angle), np.cos(angle)
    assert odometry.errors(truth, turned)["rotation_deg_per_m"] == pytest.approx(0.1, rel=0.02)
    assert np.isnan(odometry.errors(truth[:50], long[:50])["translation_percent"])


def test_it_follows_a_car_past_floating_boxes(kiss):
    rng = np.random.default_rng(0)
    corners = rng.uniform((-30, -20, -6), (40, 20, 8), (1500, 3))
    corners = corners[np.abs(corners[:, 1]) > 2]
    boxes = Mesh(*parts.boxes(corners, corners + rng.uniform(0.5, 3, (len(corners), 3)))[:2])
    truth = simulate.pose(torch.tensor([[0.8 * k, 0.0, 0.0] for k in range(10)]), torch.arange(10) * 0.01)
    sensor = PAPER_INPUT.resize(64, 256)
    track = odometry._follow((simulate.scan(boxes, sensor, pose), 0.5) for pose in truth)
    assert np.abs(track.poses[:, :3, 3] - truth[:, :3, 3].numpy()).max() < 0.2
    assert np.abs(track.poses[:, :3, :3] - truth[:, :3, :3].numpy()).max() < 0.02
    assert track.upsampling == 0.5
    assert track.points > 1000
    assert track.odometry > 0


def test_every_drive_is_made_once(kiss, monkeypatch, tmp_path):
    place = crossing()
    monkeypatch.setattr(simulate, "best_device", lambda: torch.device("cpu"))
    monkeypatch.setattr(odometry.places, "town", lambda *_, **options: place)
    monkeypatch.setattr(odometry.towns, "TEST", ("town07",))
    monkeypatch.setattr(odometry, "loaded", lambda files: {name: models.create("planes") for name in files})
    monkeypatch.setattr(odometry, "SCANS", 8)
    monkeypatch.setattr(odometry, "TARGET", PAPER_INPUT.resize(64, 256))
    made = study.Study(None, tmp_path)
    odometry.odometry(made)
    with open(tmp_path / "odometry.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["input"] for row in rows] == ["16 beams", "64 beams", "planes", "iln-surfaces", "iln"]
    assert {(row["scans"], row["metres"]) for row in rows} == {("8", "7")}
    assert int(rows[1]["points"]) > int(rows[0]["points"]) > 1000
    assert (tmp_path / "odometry.png").read_bytes()[:4] == b"\x89PNG"
    assert study.made_with(tmp_path)["odometry"]["networks"] == "the networks that ship"

    def never(*_):
        raise AssertionError("a kept track is made again")

    monkeypatch.setattr(simulate, "scan", never)
    before = (tmp_path / "odometry.csv").read_bytes()
    odometry.odometry(made)
    assert (tmp_path / "odometry.csv").read_bytes() == before
    kept = sorted((tmp_path / "odometry-shipped" / "town07").iterdir())
    assert len(kept) == 5
    kept[0].unlink()
    with pytest.raises(AssertionError, match="made again"):  # that one alone
        odometry.odometry(made)
