"""Measuring on stored scans: on a tree of the paper's authors, by `evaluate --data` and `experiment table --data`."""

import csv
import json

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from ilnet import models
from ilnet.commands.cli import cli
from ilnet.data import open_archive
from ilnet.learning import evaluate, metrics
from ilnet.world import simulate

SPECIFICATION = "max_r: 80\nmin_r: 2\nnorm_r: 100\nmax_v: 15\nmin_v: -15\nmax_h: 180\nmin_h: -180\n"


def write(tree, town, number, rows, columns):
    """Writes a room of 8 m by 12 m, as the authors' tools do."""
    v, h = np.deg2rad(np.linspace(-15, 15, rows))[:, None], np.linspace(-np.pi, np.pi, columns, endpoint=False)
    x, y = abs(np.sin(h) * np.cos(v)), abs(np.cos(h) * np.cos(v))
    ranges = np.minimum((4 + number) / x.clip(min=1e-3), 6 / y.clip(min=1e-3))
    folder = tree / town / f"{rows}_{columns}"
    folder.mkdir(parents=True, exist_ok=True)
    content = np.array(ranges.shape, "<u8").tobytes() + np.ascontiguousarray(ranges.T, dtype="<f2").tobytes()
    (folder / f"{number}.rimg").write_bytes(content)


@pytest.fixture
def tree(tmp_path, monkeypatch):
    monkeypatch.setattr(simulate, "best_device", lambda: torch.device("cpu"))
    for town, number in (("Town07", 1), ("Town07", 2), ("Town10", 1)):
        for rows, columns in ((4, 32), (8, 32), (16, 64)):
            write(tmp_path / "data", town, number, rows, columns)
    (tmp_path / "data" / "lidar_specification.yaml").write_text(SPECIFICATION)
    return tmp_path / "data"


def run(*arguments):
    result = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    if result.exception and not isinstance(result.exception, SystemExit):
        return type(result.exception), str(result.exception)
    return result.exit_code, result.stdout if result.exit_code == 0 else result.output


def test_a_tree_is_measured_at_each_size_from_its_smallest(tree):
    code, text = run("evaluate", "--data", tree, "--model", "nearest", "--model", "planes", "--json")
    assert code == 0
    found = json.loads(text[text.index("[") :])
    expected = [(name, size, 3) for size in ("8x32", "16x64") for name in ("nearest", "planes")]
    assert [(row["model"], row["size"], row["scans"]) for row in found] == expected
    stored, model = open_archive(tree), models.load("planes")
    truths = [stored.scan(k, "16x64") for k in range(3)]
    answers = [model.ranges(stored.scan(k, "4x32"), truths[k].sensor) for k in range(3)]
    iou = np.mean([metrics.compare(answer, truth)["iou"] for answer, truth in zip(answers, truths, strict=True)])
    assert found[3]["iou"] == pytest.approx(iou)


def test_input_size_and_number_of_scans_can_be_named(tree):
    [pairs] = evaluate.stored_pairs(tree, "8x32", "16x64", 2)
    assert [(scan.sensor.size, truth.sensor.size) for scan, truth in pairs] == [("8x32", "16x64")] * 2
    assert pairs.numbers == [0, 1]
    code, text = run(
        "evaluate", "--data", tree, "--model", "nearest", "--input", "8x32", "--size", "16x64", "--scans", 2
    )
    assert code == 0
    assert "2 scan(s) of 8x32 -> 16x64" in text


def test_what_is_wrong_with_a_tree_is_one_line(tree, tmp_path):
    def error(*options, data=tree):
        _, text = run("evaluate", "--data", data, "--model", "nearest", *options)
        assert "\n" not in text.strip()
        return text

    assert "holds no scans of size '64x1024'; it has 4x32, 8x32, 16x64" in error("--size", "64x1024")
    assert "holds no scans of size '2x8'" in error("--input", "2x8")
    assert "are both 4x32; they should differ" in error("--size", "4x32")
    assert "holds 3 scans; it should hold the 9" in error("--scans", 9)
    (tmp_path / "empty").mkdir()
    assert "holds no scans named like Town01/64_1024/1.rimg" in error(data=tmp_path / "empty")
    (tree / "Town07" / "16_64" / "2.rimg").unlink()
    assert "1 of 3 scans have no 16x64, such as" in error()
    assert "Town07/16_64/2.rimg" in error()
    for size in ("8_32", "16_64"):
        for file in tree.glob(f"*/{size}/*"):
            file.unlink()
    assert "holds scans of 4x32 only; it should hold two sizes" in error()


def test_the_papers_table_of_a_tree_has_the_models_that_are_named(tree, tmp_path):
    out = tmp_path / "out"
    code, text = run(
        "experiment", "table", "--data", tree, "--out", out, "--model", "bilinear", "--model", "planes", "--scans", 2
    )
    assert code == 0, text
    with open(out / "table.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    expected = [(name, size, "2") for size in ("8x32", "16x64") for name in ("bilinear", "planes")]
    assert [(row["model"], row["size"], row["scans"]) for row in rows] == expected
    page = (out / "RESULTS.md").read_text()
    assert "| bilinear | 8x32 |" in page
    assert "points-town" not in page
    _, text = run("experiment", "table", "--out", out, "--model", "planes")
    assert "models are named; that goes with a tree of .rimg files" in text
