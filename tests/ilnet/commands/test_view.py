"""The page and the picture of scans."""

import base64
import json
import re

import matplotlib.image
import numpy as np
import pytest
import torch

from ilnet import scan_files, sensor_files
from ilnet.commands import view
from ilnet.scan import Scan
from ilnet.sensor import preset
from ilnet.world import simulate
from ilnet.world.simulate import pose

TRUTH = preset("paper-16x1024").resize(16, 128)


@pytest.fixture
def files(yard, tmp_path):
    """A scan, a denser one that is 0.5 m too far, and the truth."""
    truth = simulate.scan(yard, TRUTH, pose((0.0, 0.0, 1.8)))
    there = truth.ranges > 0
    dense = Scan((truth.ranges + 0.5) * there, TRUTH, confidence=there * torch.linspace(0, 1, 128))
    for name, scan in {"in": truth.decimate(8), "dense": dense, "truth": truth}.items():
        scan_files.write(tmp_path / f"{name}.npz", scan)
    return truth.decimate(8), dense, truth


def scene(path):
    return json.loads(re.search(r'id="scene">(.*?)</script>', path.read_text(), re.DOTALL)[1])


def array(text, kind):
    return np.frombuffer(base64.b64decode(text), kind)


def test_a_page_of_a_scan_a_denser_one_and_the_truth(command, files, tmp_path):
    assert command("view", "in.npz", "dense.npz", "truth.npz")[:2] == (0, "view.html: open it in a browser\n")
    found = scene(tmp_path / "view.html")
    assert [panel["title"] for panel in found["panels"]] == [
        "in.npz, 8x128: height",
        "dense.npz, 16x128: height",
        "dense.npz: difference from truth.npz",
        "dense.npz: confidence",
    ]
    for cloud, scan in zip(found["clouds"], files[:2], strict=True):
        places = array(cloud["places"], "<i2").reshape(-1, 3) * cloud["scale"]
        np.testing.assert_allclose(places, scan.points(), atol=0.002)
    _, _, away, trust = found["panels"]
    assert set(array(away["values"], "u1")) <= {190, 191}  # three quarters of 254: 0.5 m in -1 to 1
    shown = array(trust["values"], "u1") / 254  # 255 is unknown
    np.testing.assert_allclose(shown, files[1].confidence[files[1].ranges > 0], atol=0.005)
    assert len(array(found["colours"]["viridis"], "u1")) == 3 * 256


def test_without_the_truth_a_scan_is_compared_with_what_was_measured(files):
    sparse, _, truth = files
    away = view.difference(truth, sparse)
    rows = sparse.sensor.decimation(8)[0]
    measured = truth.sensor.decimation(8)[0]
    assert torch.equal(away[measured].nan_to_num(0), torch.zeros(len(rows), 128))
    assert away.isfinite().sum() > measured.size * 30
    assert bool(away[truth.ranges == 0].isnan().all())
    assert len(view.panels({"in": sparse, "dense": truth})) == 3


def test_points_beside_a_scan_that_holds_its_angles(command, files, tmp_path):
    scan_files.write(tmp_path / "dense.ply", files[1])
    sensor_files.write(tmp_path / "sensor.json", TRUTH)
    assert command("view", "in.npz", "dense.ply", "--from", "sensor.json")[0] == 0
    first, second, *_ = scene(tmp_path / "view.html")["clouds"]
    assert (first["count"], second["count"]) == tuple(int((scan.ranges > 0).sum()) for scan in files[:2])


def test_one_file_alone(command, files, tmp_path):
    assert command("view", "in.npz", "--out", "deep/one.html")[0] == 0
    assert len(scene(tmp_path / "deep" / "one.html")["panels"]) == 1


def test_a_name_cannot_leave_the_data_of_the_page(command, files, tmp_path):
    (tmp_path / "in.npz").rename(tmp_path / "<b>&.npz")
    assert command("view", "<b>&.npz")[0] == 0
    assert scene(tmp_path / "view.html")["panels"][0]["title"].startswith("<b>&.npz")
    assert "<b>&" not in (tmp_path / "view.html").read_text()


def test_a_picture(command, files, tmp_path):
    assert command("view", "in.npz", "dense.npz", "truth.npz", "--out", "a.png")[:2] == (0, "a.png\n")
    picture = matplotlib.image.imread(tmp_path / "a.png")[..., :3]
    height, width, _ = picture.shape
    for rows in (slice(0, height // 2), slice(height // 2, None)):
        for columns in (slice(0, width // 2), slice(width // 2, None)):
            assert picture[rows, columns].reshape(-1, 3).std(0).max() > 0.05


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("none.npz",), "none.npz: there is no such file"),
        (("in.npz",) * 4, "there are 4 files; they should be a scan, perhaps a denser one, and the truth"),
        (("in.npz", "--out", "a.jpg"), "out is a.jpg; it should end in .html, a page, or in .png, a picture"),
        (("points.ply",), "--from NAME"),
    ],
)
def test_bad_input_is_one_line(command, files, tmp_path, arguments, message):
    scan_files.write(tmp_path / "points.ply", files[0])
    code, out, [error] = command("view", *arguments)
    assert (code, out) == (2, "")
    assert message in error
