"""The command `upsample`, in this process."""

import fcntl
import os
import re

import numpy as np
import pytest
import torch

from ilnet import models, scan_files
from ilnet.scan import Scan
from ilnet.sensor import Sensor, preset
from ilnet.world import simulate
from ilnet.world.simulate import pose

SENSOR = preset("paper-16x1024").resize(8, 128)


@pytest.fixture
def run(command):
    def run(*arguments):
        code, out, lines = command("upsample", *arguments)
        return code, out, [line for line in lines if line.startswith("error: ")]

    return run


@pytest.fixture
def seen(tmp_path, yard):
    seen = simulate.scan(yard, SENSOR, pose((0.0, 0.0, 1.8)))
    scan_files.write(tmp_path / "in.npz", seen)
    return seen


def test_one_file_by_size(run, seen, tmp_path):
    assert run("in.npz", "out/dense.npz", "--size", "20x300") == (0, "1 scan(s) written to out/dense.npz\n", [])
    dense = scan_files.read(tmp_path / "out" / "dense.npz")
    expected = models.load("iln-surfaces").upsample(seen, SENSOR.resize(20, 300))
    assert dense.sensor == expected.sensor
    assert torch.allclose(dense.ranges, expected.ranges.cpu(), atol=1e-3)


def test_one_file_for_a_sensor_by_another_model(run, seen, tmp_path):
    assert run("in.npz", "dense.ply", "--sensor", "vlp-16", "--model", "bilinear")[0] == 0
    expected = models.load("bilinear").upsample(seen, preset("vlp-16"))
    assert torch.allclose(scan_files.read(tmp_path / "dense.ply", preset("vlp-16")).ranges, expected.ranges, atol=1e-3)


def test_a_folder_of_several_sensors(run, seen, tmp_path):
    (tmp_path / "in" / "deeper").mkdir(parents=True)
    scan_files.write(tmp_path / "in" / "a.npz", seen)
    scan_files.write(tmp_path / "in" / "b.npz", seen.decimate(4))
    (tmp_path / "in" / ".hidden").write_text("")
    code, out, errors = run("in", "out", "--size", "16x256", "--model", "bilinear")
    assert (code, out, errors) == (0, "2 scan(s) written to out\n", [])
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.npz", "b.npz"]
    for name, rows in (("a.npz", 8), ("b.npz", 4)):
        expected = models.load("bilinear").upsample(seen.decimate(rows), SENSOR.resize(16, 256))
        assert torch.equal(scan_files.read(tmp_path / "out" / name).ranges, expected.ranges)


def test_points_by_the_angles_of_their_sensor(run, yard, tmp_path):
    (tmp_path / "in").mkdir()
    seen = simulate.scan(yard, preset("paper-16x1024"), pose((0.0, 0.0, 1.8)))
    scan_files.write(tmp_path / "in" / "a.pcd", seen)
    options = ("--sensor", "paper-64x1024", "--model", "bilinear", "--from", "paper-16x1024", "--format", "ply")
    assert run("in", "out", *options)[0] == 0
    dense = scan_files.read(tmp_path / "out" / "a.ply", preset("paper-64x1024"))
    expected = models.load("bilinear").upsample(seen, preset("paper-64x1024"))
    assert torch.allclose(dense.ranges, expected.ranges, atol=1e-3)


def test_a_bad_file_does_not_keep_the_others_from_being_done(run, seen, tmp_path):
    (tmp_path / "in").mkdir()
    scan_files.write(tmp_path / "in" / "a.npz", seen)
    (tmp_path / "in" / "b.npz").write_bytes((tmp_path / "in" / "a.npz").read_bytes()[:500])
    scan_files.write(tmp_path / "in" / "c.pcd", seen)
    scan_files.write(tmp_path / "in" / "d.npz", seen)
    np.save(tmp_path / "in" / "d.npy", seen.ranges.numpy())
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "before.npz").write_text("kept")
    (tmp_path / "out" / "b.npz").write_text("kept")
    code, out, errors = run("in", "out", "--size", "16x256", "--model", "nearest")
    assert code == 2
    assert out == "2 scan(s) written to out, 3 could not be: see above\n"
    assert [error.split(":")[1].strip() for error in errors] == ["in/b.npz", "in/c.pcd", "in/d.npy"]
    assert errors[1].endswith("such as the preset os1-128: --from NAME")
    assert (tmp_path / "out" / "before.npz").read_text() == (tmp_path / "out" / "b.npz").read_text() == "kept"
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a.npz", "b.npz", "before.npz", "d.npz"]


def test_of_two_files_with_one_name_the_first_is_kept(run, tmp_path):
    (tmp_path / "in").mkdir()
    sensor = preset("hdl-64e")
    scan_files.write(tmp_path / "in" / "a.npz", Scan(torch.full(sensor.shape, 5.0), sensor))
    np.array([[9.0, 0.0, 0.0, 0.0]], np.float32).tofile(tmp_path / "in" / "a.bin")
    code, _, [error] = run("in", "out", "--size", "64x512", "--model", "nearest")
    assert code == 2
    assert "in/a.npz: another file" in error
    assert scan_files.read(tmp_path / "out" / "a.npz").ranges.max() == 9


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nowhere.npz", "out.npz", "--size", "16x256"), "nowhere.npz: there is no such file"),
        (("in.npz", "out.npz"), "--size ROWSxCOLUMNS or --sensor NAME"),
        (("in.npz", "out.npz", "--size", "16x256", "--sensor", "vlp-16"), "--size ROWSxCOLUMNS or --sensor NAME"),
        (("in.npz", "out.npz", "--sensor", "vlp-61"), "sensor is 'vlp-61'; it should be one of"),
        (("in.npz", "out.npz", "--size", "16x256", "--model", "ilm"), "name is 'ilm'; it should be one of"),
        (("in.npz", "out.npz", "--size", "16x256", "--format", "ply"), "--format goes with a folder"),
        (("in.npz", "out.xyz", "--size", "16x256"), "its suffix is '.xyz'"),
        (("in.npz", "in.npz", "--size", "16x256"), "out is in.npz, the file to be read"),
        ((".", ".", "--size", "16x256"), "out is ., the folder to be read"),
        (("empty", "out", "--size", "16x256"), "there is no file in this folder"),
        ((".", "in.npz", "--size", "16x256"), "in.npz"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(run, seen, tmp_path, arguments, message):
    (tmp_path / "empty").mkdir()
    before = (tmp_path / "in.npz").read_bytes()
    code, out, [error] = run(*arguments)
    assert (code, out) == (2, "")
    assert message in error
    assert (tmp_path / "in.npz").read_bytes() == before


def test_what_takes_too_much_memory_does_not_keep_the_others_from_being_done(run, seen, tmp_path):
    (tmp_path / "in").mkdir()
    for name in ("a", "c"):
        scan_files.write(tmp_path / "in" / f"{name}.npz", seen)
    (tmp_path / "in" / "b.bin").touch()
    os.truncate(tmp_path / "in" / "b.bin", 3 << 30)
    code, out, [error] = run("in", "out", "--size", "16x256", "--model", "nearest")
    assert (code, out) == (2, "2 scan(s) written to out, 1 could not be: see above\n")
    expected = "error: in/b.bin: it would take about 40.3 GB of memory; the limit is 2 GB: --max-memory GB"
    assert error == expected
    limit = ("--max-memory", "1e-5")
    code, _, errors = run("in", "new", "--size", "16x256", "--model", "nearest", *limit)
    assert code == 2
    assert len(errors) == 3
    assert errors[0].endswith("the limit is 1e-05 GB: --max-memory GB")


@pytest.mark.parametrize(
    "message", [None, "DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes."]
)
def test_memory_that_runs_out_ends_one_file(run, seen, tmp_path, monkeypatch, message):
    (tmp_path / "in").mkdir()
    for name in ("a", "b"):
        scan_files.write(tmp_path / "in" / f"{name}.npz", seen)
    called = []

    def write(path, scan):
        called.append(path)
        if len(called) == 1:
            raise RuntimeError(message) if message else MemoryError
        path.write_text("whole")

    monkeypatch.setattr(scan_files, "write", write)
    code, out, [error] = run("in", "out", "--size", "16x256", "--model", "nearest")
    assert (code, out) == (2, "1 scan(s) written to out, 1 could not be: see above\n")
    assert error.startswith("error: in/a.npz: there is not enough memory: ")
    assert (tmp_path / "out" / "b.npz").read_text() == "whole"


@pytest.mark.parametrize("size", ["1000000000x1000000000", "1000000x1000000"])
def test_an_absurd_size_is_one_line(run, seen, size):
    code, out, [error] = run("in.npz", "out.npz", "--size", size, "--model", "nearest")
    assert (code, out) == (2, "")
    assert error.startswith(f"error: in.npz: a scan of {size} rays would take ")
    assert error.endswith("of memory; the limit is 2 GB: --max-memory GB")


def test_what_a_killed_run_left_unfinished_is_removed(run, seen, tmp_path):
    (tmp_path / "out").mkdir()
    killed = tmp_path / "out" / ".0123456789abcdef.ilnet-partial"
    killed.write_bytes(b"half of it")
    other = tmp_path / "out" / ".fedcba9876543210.ilnet-partial"
    with other.open("wb") as file:  # that of a run that is still at it
        file.write(b"half of it")
        file.flush()
        fcntl.flock(file, fcntl.LOCK_EX)
        assert run("in.npz", "out/a.npz", "--size", "16x256", "--model", "nearest")[0] == 0
        assert not killed.exists()
        assert other.exists()


def test_the_number_of_columns_can_be_given(run, tmp_path):
    sensor = preset("paper-16x1024")
    rng = np.random.default_rng(0)
    table = np.concatenate([Scan(5 + 9 * torch.rand(sensor.shape), sensor).points().numpy()], axis=1)
    np.concatenate((table, rng.random((len(table), 3))), axis=1).astype("<f4").tofile(tmp_path / "a.bin")
    options = ("--size", "16x256", "--model", "nearest", "--from", "paper-16x1024")
    assert run("a.bin", "a.npz", *options, "--columns", 6)[0] == 0
    assert (scan_files.read(tmp_path / "a.npz").ranges > 0).all()
    code, _, [error] = run("a.bin", "b.npz", *options, "--columns", 7)
    assert code == 2
    assert "--columns" in error


@pytest.fixture
def surfaces(tmp_path):
    """A file of weights that tell a confidence."""
    torch.manual_seed(0)
    arguments = {"features": 16, "blocks": 1}
    model = models.create("iln-surfaces", **arguments)
    torch.nn.init.normal_(model.head[1].weight, std=0.5)
    models.save(model, tmp_path / "small.safetensors", "iln-surfaces", arguments)
    return "small.safetensors"


def test_only_what_the_model_trusts_is_written(run, seen, surfaces, tmp_path):
    options = ("--size", "16x256", "--model", surfaces)
    assert run("in.npz", "all.npz", *options)[0] == 0
    whole = scan_files.read(tmp_path / "all.npz")
    least = float(whole.confidence[whole.ranges > 0].median())
    assert run("in.npz", "some.npz", *options, "--min-confidence", least)[0] == 0
    some = scan_files.read(tmp_path / "some.npz")
    trusted = whole.confidence >= least
    assert 100 < trusted.sum() < (whole.ranges > 0).sum() - 100
    assert torch.equal(some.ranges, whole.ranges.where(trusted, 0.0))
    assert torch.equal(some.confidence, whole.confidence.where(trusted, 0.0))


def test_a_scan_that_would_be_empty_is_not_written(run, seen, surfaces, tmp_path):
    code, _, [error] = run("in.npz", "out.npz", "--size", "16x256", "--model", surfaces, "--min-confidence", 1)
    assert code == 2
    assert re.fullmatch(r"error: in.npz: none of its returns has a confidence of 1.0; the largest is 0\.\d\d", error)
    assert not (tmp_path / "out.npz").exists()


def test_intensity_goes_along(run, seen, tmp_path):
    scan_files.write(tmp_path / "in.npz", Scan(seen.ranges, SENSOR, torch.full(SENSOR.shape, 0.4)))
    assert run("in.npz", "out.pcd", "--size", "16x256", "--model", "planes")[0] == 0
    dense = scan_files.read(tmp_path / "out.pcd", SENSOR.resize(16, 256))
    torch.testing.assert_close(dense.intensity, (dense.ranges > 0) * 0.4)


@pytest.mark.parametrize(
    ("model", "value", "message"),
    [
        ("small.safetensors", "1.5", "--min-confidence is 1.5; it should be from 0 to 1"),
        ("small.safetensors", "nan", "--min-confidence is nan; it should be from 0 to 1"),
        ("small.safetensors", "half", "Invalid value for '--min-confidence': 'half' is not a valid float."),
        ("planes", "0.5", "--min-confidence needs a model that tells its confidence, such as --model iln-surfaces"),
    ],
)
def test_a_bad_confidence_is_one_line_before_anything_is_written(run, seen, surfaces, tmp_path, model, value, message):
    options = ("--size", "16x256", "--model", model, "--min-confidence", value)
    assert run("in.npz", "new/out.npz", *options) == (2, "", [f"error: {message}"])
    assert not (tmp_path / "new").exists()


def test_an_uneven_sensor_keeps_its_field_of_view(run, tmp_path, yard):
    uneven = Sensor(np.deg2rad([-15.0, -8.0, -3.0, 0.0, 2.0]), np.deg2rad(np.arange(0.0, 90.0, 1.0)))
    scan_files.write(tmp_path / "in.npz", simulate.scan(yard, uneven, pose((0.0, 0.0, 1.8))))
    assert run("in.npz", "out.npz", "--size", "10x180", "--model", "bilinear")[0] == 0
    assert scan_files.read(tmp_path / "out.npz").sensor == uneven.resize(10, 180)
