"""Archives come out the same however the work was shared out and interrupted."""

import functools
import json
import math
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from ilnet.commands import cli, options
from ilnet.data import generate, open_archive
from ilnet.data.archive import UNIT
from ilnet.sensor import PAPER_INPUT, preset
from ilnet.world import places, simulate, towns
from ilnet.world.towns import SENSOR_HEIGHT
from kernels import Mesh

from ..conftest import yard_triangles

SIZES = ("4x64", "16x128")
SENSORS = [PAPER_INPUT.resize(4, 64), PAPER_INPUT.resize(16, 128)]
YARDS = {name: generate.Recipe(9, lambda: yard()) for name in ("yard", "yard again")}
SCANS = 3 * UNIT + 3
on_cpu = pytest.mark.skipif(torch.cuda.is_available(), reason="on CUDA one process does all")


@functools.cache
def yard():
    waypoints = np.array([[x, y, 0.0] for x in (-40, -20, 1) for y in (-30, 0, 30)])
    return places.Place(*(array.numpy() for array in yard_triangles()), waypoints, np.zeros(9))


def make(out, seed=5, **how):
    how = {"recipes": YARDS, "workers": 1, **how}
    return generate.generate(out, scans=SCANS, sensors=SENSORS, seed=seed, **how)


def files(folder):
    return {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    return make(tmp_path_factory.mktemp("undisturbed") / "scans")


def test_a_scan_is_what_the_sensor_measures_at_its_pose(undisturbed):
    archive = open_archive(undisturbed.path)
    assert len(archive) == SCANS
    assert archive.missing() == []
    for number in (0, UNIT, SCANS - 1):
        for size in SIZES:
            scan = archive.scan(number, size)
            truth = simulate.scan(Mesh(*yard_triangles()), scan.sensor, archive.pose(number)).ranges
            assert (scan.ranges - truth).abs().max() <= 0.001
            assert (scan.ranges > 0).float().mean() > 0.4


def test_poses_stand_over_waypoints_that_do_not_repeat_until_all_were_used(undisturbed):
    place = yard()
    poses = torch.stack([undisturbed.pose(k) for k in range(SCANS)])
    numbers = undisturbed._arrays["waypoint"][:]
    np.testing.assert_array_equal(poses[:, :2, 3], place.waypoints[numbers, :2])
    assert (poses[:, 2, 3] - SENSOR_HEIGHT).abs().max() <= 0.1
    assert len(poses[:, 2, 3].unique()) == SCANS
    assert poses[:, 2, 2].acos().max() <= math.radians(1.5)  # pitch and roll of one degree each
    yaw = torch.atan2(poses[:, 1, 0], poses[:, 0, 0])
    assert yaw.min() < -1.5
    assert yaw.max() > 1.5
    towns_of = [undisturbed.town(k) for k in range(SCANS)]
    assert towns_of == ["yard"] * (SCANS // 2) + ["yard again"] * (SCANS - SCANS // 2)
    assert sorted(numbers[:9]) == list(range(9))
    again = numbers[SCANS // 2 :]
    assert sorted(again[:9]) == list(range(9))
    assert list(again[:9]) != list(numbers[:9])


def test_the_seed_decides(undisturbed, tmp_path):
    other = make(tmp_path / "other", seed=6)
    assert not torch.equal(other.pose(0), undisturbed.pose(0))
    assert not torch.equal(other.scan(0, "4x64").ranges, undisturbed.scan(0, "4x64").ranges)


def test_all_sizes_see_the_same_traffic_and_each_scan_its_own(tmp_path):
    sensors = [PAPER_INPUT, preset("paper-64x1024")]
    archive = generate.generate(tmp_path / "scans", generate.town_places([("town01", 0)]), 3, sensors, seed=4)
    town = places.town("town01")
    for number in range(3):
        pose = archive.pose(number)
        own, other = (town.world(pose[:3, 3], [4, k]) for k in (number, number + 1))
        for size, sensor in archive.sensors.items():
            ranges = archive.scan(number, size).ranges
            difference = (ranges - simulate.ranges(own, sensor, pose)).abs()
            assert difference.max() <= 0.001
            assert ((ranges - simulate.ranges(other, sensor, pose)).abs() > 0.1).double().mean() > 1e-3


def test_effects_are_those_of_each_scan(tmp_path):
    effects = options.effects(["range_noise=0.05", "velocity=1,0,0"])
    noisy = make(tmp_path / "noisy", effects=effects)
    clean = simulate.ranges(Mesh(*yard_triangles()), noisy.sensors["16x128"], noisy.pose(0))
    error = [(noisy.scan(k, "16x128").ranges - clean) for k in (0, 1)]
    seen = (clean > 0) & (noisy.scan(0, "16x128").ranges > 0)
    assert 0.03 < error[0][seen].abs().median() < 0.2
    assert not torch.equal(*error)
    with pytest.raises(ValueError, match="holds another archive: its effects is"):
        make(tmp_path / "noisy")
    for wrong, message in (("fog=1", "--effect is 'fog=1'.*range_noise, "), ("dropout_range=2", "dropout_range is 2")):
        with pytest.raises(ValueError, match=message):
            options.effects([wrong])


def test_towns_take_scans_by_their_waypoints(tmp_path):
    """So that as many scans as there are waypoints take every one once."""
    fewer = replace(yard(), waypoints=yard().waypoints[:3], headings=np.zeros(3))
    recipes = {"nine": generate.Recipe(9, yard), "three": generate.Recipe(3, lambda: fewer)}
    archive = make(tmp_path / "scans", recipes=recipes)
    count = [archive.town(k) for k in range(SCANS)].count("nine")
    assert count == -(-SCANS * 9 // 12) or count == SCANS * 9 // 12
    assert sum(towns.WAYPOINTS[name] for name in towns.TRAIN) == 22_244
    assert sum(towns.WAYPOINTS[name] for name in towns.TEST) == 2_847


def test_several_workers_do_the_same(undisturbed, tmp_path):
    many = make(tmp_path / "many", workers=3)
    assert files(many.path) == files(undisturbed.path)


def test_without_fork_one_process_does_the_work(undisturbed, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(generate.multiprocessing, "get_all_start_methods", lambda: ["spawn"])
    monkeypatch.setattr(generate.multiprocessing, "get_context", lambda method: pytest.fail(f"asked for {method}"))
    assert files(make(tmp_path / "one", workers=3).path) == files(undisturbed.path)
    assert "this system cannot fork: one process does the work of 3 workers" in capsys.readouterr().err


def test_shards_merge_by_copying(undisturbed, tmp_path):
    parts = [make(tmp_path / str(i), shard=(i, 3)) for i in (1, 2, 3)]
    assert [part.missing() for part in parts] == [[1, 2], [0, 2, 3], [0, 1, 3]]
    for part in parts:
        shutil.copytree(part.path, tmp_path / "merged", dirs_exist_ok=True)
    assert files(tmp_path / "merged") == files(undisturbed.path)


def test_shards_share_a_folder(undisturbed, tmp_path):
    for i in (2, 1):
        archive = make(tmp_path / "shared", shard=(i, 2))
    assert archive.missing() == []
    assert files(archive.path) == files(undisturbed.path)


def test_only_towns_that_are_needed_are_built(tmp_path, undisturbed):
    out = shutil.copytree(undisturbed.path, tmp_path / "scans")
    (out / "pose" / "c" / "0" / "0" / "0").unlink()

    def never():
        raise AssertionError

    make(out, recipes=YARDS | {"yard again": generate.Recipe(9, never)})
    assert files(out) == files(undisturbed.path)
    make(out, recipes=dict.fromkeys(YARDS, generate.Recipe(9, never)))


def test_a_full_disk_stops_it_with_one_line_and_it_goes_on(tmp_path, undisturbed):
    out = tmp_path / "full"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8000, hard))
    try:
        with pytest.raises(OSError, match=r"full cannot be written: File too large; what is complete there is kept"):
            make(out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert files(make(out).path) == files(undisturbed.path)


@on_cpu
def test_a_worker_that_dies_is_reported(tmp_path, undisturbed, monkeypatch):
    parent, images = os.getpid(), generate._Plan.images

    def killed(plan, scan):
        if os.getpid() != parent and scan == 2 * UNIT:
            os.kill(os.getpid(), signal.SIGKILL)
        return images(plan, scan)

    monkeypatch.setattr(generate._Plan, "images", killed)
    with pytest.raises(ChildProcessError, match=r"a worker died.* what is complete is kept"):
        make(tmp_path / "x", workers=2)
    monkeypatch.undo()
    assert files(make(tmp_path / "x").path) == files(undisturbed.path)


@on_cpu
def test_a_worker_that_ctrl_c_ends_interrupts_the_whole(tmp_path, undisturbed, monkeypatch):
    """Ctrl-C reaches all processes, and this one may miss it."""
    parent, images = os.getpid(), generate._Plan.images

    def interrupted(plan, scan):
        if os.getpid() != parent and scan == 2 * UNIT:
            os.kill(os.getpid(), signal.SIGINT)
        return images(plan, scan)

    monkeypatch.setattr(generate._Plan, "images", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "x", workers=2)


@pytest.fixture
def mesh_file(tmp_path):
    vertices, triangles = yard_triangles()
    lines = [f"v {x} {y} {z}" for x, y, z in vertices.tolist()]
    lines += ["f " + " ".join(str(corner + 1) for corner in triangle) for triangle in triangles.tolist()]
    (tmp_path / "yard.obj").write_text("\n".join(lines))
    (tmp_path / "at.json").write_text(json.dumps({"positions": [[-20, -20, 1.8], [30, 30, 1.8]]}))
    return tmp_path / "yard.obj"


@on_cpu
def test_killed_three_times_it_ends_as_if_undisturbed(tmp_path, mesh_file):
    """The command itself: killed, killed with its workers, and stopped with Ctrl-C."""
    out, units = tmp_path / "killed", 6
    arguments = ["--mesh", mesh_file, "--at", tmp_path / "at.json", "--scans", units * UNIT - 1, "--workers", 2]
    arguments += ["--sizes", "16x256,128x2048", "--out"]
    command = [sys.executable, "-m", "ilnet", "simulate", *map(str, arguments)]

    def start(folder, *more):
        pipe = subprocess.PIPE
        return subprocess.Popen([*command, folder, *more], text=True, stdout=pipe, stderr=pipe, start_new_session=True)

    stops = [
        lambda run: os.kill(run.pid, signal.SIGKILL),
        lambda run: os.killpg(run.pid, signal.SIGKILL),
        lambda run: os.killpg(run.pid, signal.SIGINT),
    ]
    for some, stop in enumerate(stops, 1):
        run = start(out)
        while len(list(out.glob("range_128x2048/c/*/0/0"))) < some and run.poll() is None:
            time.sleep(0.005)
        stop(run)
        # Ends when the last process that could write to the pipe has: no worker outlives its parent.
        _, said = run.communicate(timeout=60)
    assert run.returncode == 130, said
    assert said.splitlines()[-2].startswith("interrupted: finished units stay in")
    assert "Traceback" not in said
    assert 0 < len(open_archive(out).missing()) < units
    (out / "pose" / "c" / "0" / "0" / "0.0123.partial").write_bytes(b"torn")
    # Two hosts go on together.
    runs = [start(out, "--shard", "1/2"), start(out, "--shard", "2/2"), start(tmp_path / "undisturbed")]
    for run in runs:
        said, errors = run.communicate(timeout=60)
        assert run.returncode == 0, errors
    assert said.splitlines()[-1].endswith("47 scans of 16x256, 128x2048: complete")
    assert "Mray/s" in errors
    assert files(out) == files(tmp_path / "undisturbed")


def ilnet(monkeypatch, capsys, *arguments):
    """What the command prints as its error; it must end with code 2."""
    monkeypatch.setattr(sys, "argv", ["ilnet", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    return capsys.readouterr().err.splitlines()[-1]


def test_a_mesh_is_scanned_from_positions(tmp_path, mesh_file, monkeypatch, capsys):
    out = tmp_path / "out"
    arguments = ["simulate", "--mesh", mesh_file, "--at", tmp_path / "at.json", "--scans", 4, "--sensor", "vlp-16"]
    monkeypatch.setattr(sys, "argv", ["ilnet", *map(str, arguments), "--out", str(out), "--workers", "1"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code in (None, 0)
    assert "4 scans of 16x1800: complete" in capsys.readouterr().out
    archive = open_archive(out)
    assert archive.sensors["16x1800"].name == "vlp-16"
    assert archive.town(0).startswith("yard.obj@")
    assert sorted(archive.pose(k)[0, 3].item() for k in range(4)) == [-20, -20, 30, 30]
    assert archive.pose(0)[2, 3] == pytest.approx(1.8, abs=0.1)
    # The same command with another mesh, or positions, is another archive.
    (tmp_path / "at.json").write_text(json.dumps({"positions": [[-20, -21, 1.8]]}))
    assert "holds another archive: its towns" in ilnet(monkeypatch, capsys, *arguments, "--out", out)


def test_a_mesh_that_does_not_serve_is_one_line(tmp_path, mesh_file, monkeypatch, capsys):
    def line(*more, at="at.json", mesh="yard.obj"):
        where = ["--mesh", tmp_path / mesh, "--at", tmp_path / at, "--out", tmp_path / "out"]
        return ilnet(monkeypatch, capsys, "simulate", "--scans", 4, "--sizes", "4x64", *where, *more)

    (tmp_path / "nan.obj").write_text(mesh_file.read_text().replace("v 14.0", "v nan", 1))
    assert "nan.obj: holds NaN" in line(mesh="nan.obj")
    assert "nowhere.obj: there is no such file" in line(mesh="nowhere.obj")
    (tmp_path / "off.json").write_text('{"positions": [[0, 0, 1.8], [500, 7.5, 1.8]]}')
    assert "no triangle under position 1 (500, 7.5, 1.8)" in line(at="off.json")
    for number, text in enumerate(
        ("{", "[]", '{"positions": []}', '{"positions": [[1, 2]]}', '{"positions": [[1, 2, NaN]]}')
    ):
        (tmp_path / f"{number}.json").write_text(text)
        assert f"{number}.json: should be JSON like" in line(at=f"{number}.json")
    assert "nowhere.json" in line(at="nowhere.json")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--towns", "town99"], "--towns names 'town99'; it should be one of town01"),
        (["--towns", "town01:x"], "--towns names 'town01:x'"),
        (["--towns", "town01,town01"], "wanted has town01 twice"),
        (["--sizes", "64"], "--sizes: size is '64'; it should be rows x columns"),
        (["--sizes", "1x64"], "size is '1x64'; it should be rows x columns, at least 2 of each"),
        (["--sizes", "4x64,4x64"], "two sensors have 4x64 rays"),
        (["--sensor", "vlp-61"], "sensor is 'vlp-61'; it should be one of"),
        (["--sensor", "vlp-16", "--sizes", "4x64"], "exclude each other"),
        (["--mesh", "x.ply"], "go together"),
        (["--mesh", "x.ply", "--at", "x.json", "--towns", "town01"], "exclude each other"),
        (["--shard", "0/2"], "--shard is '0/2'"),
        (["--shard", "3/2"], "--shard is '3/2'"),
        (["--shard", "half"], "--shard is 'half'"),
        (["--scans", "0"], "--scans"),
        (["--out", "/dev/null/x"], "/dev/null/x cannot be written: Not a directory"),
    ],
)
def test_a_wrong_command_is_one_line(tmp_path, monkeypatch, capsys, arguments, message):
    line = ilnet(monkeypatch, capsys, "simulate", "--scans", 4, "--out", tmp_path / "out", *arguments)
    assert message in line
    assert not (tmp_path / "out").exists()
