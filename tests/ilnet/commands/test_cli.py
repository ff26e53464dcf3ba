"""The command line as a user meets it."""

import json
import subprocess
import sys

import numpy as np
import pytest

from ilnet import models, scan_files
from ilnet.learning import metrics

METHODS = {"nearest", "bilinear", "bilinear-inverse", "planes", "liif", "iln", "iln-surfaces"}


def ilnet(*arguments, cwd):
    return subprocess.run(
        [sys.executable, "-m", "ilnet", *map(str, arguments)], cwd=cwd, capture_output=True, text=True, timeout=300
    )


def write_scan(path, ranges, elevations=None, azimuths=None):
    rows, columns = ranges.shape
    np.savez(
        path,
        range=ranges.astype(np.float32),
        elevation_deg=np.linspace(15, -15, rows) if elevations is None else elevations,
        column_azimuth_deg=np.linspace(180, -180, columns, endpoint=False) if azimuths is None else azimuths,
    )


@pytest.fixture
def scan_file(tmp_path):
    """A room of 8 m by 12 m: walls and a floor, seen by 32 beams."""
    elevation, azimuth = np.deg2rad(np.linspace(15, -15, 32))[:, None], np.linspace(np.pi, -np.pi, 256, endpoint=False)
    x, y, z = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    with np.errstate(divide="ignore"):
        ranges = np.minimum(np.minimum(4 / abs(x), 6 / abs(y)), np.where(z < 0, -1.5 / z, np.inf))
    write_scan(tmp_path / "room.npz", ranges)
    return tmp_path / "room.npz"


@pytest.fixture
def mesh_file(tmp_path):
    import pyvista

    cube = pyvista.Cube(center=(9, 2, 1), x_length=2, y_length=2, z_length=2)
    parts = [pyvista.Plane(i_size=100, j_size=100), cube, pyvista.Sphere(radius=1.5, center=(-5, 4, 1))]
    mesh = pyvista.merge([part.triangulate() for part in parts]).extract_surface(algorithm=None)
    mesh.save(tmp_path / "yard.ply")
    return tmp_path / "yard.ply"


def test_demo_of_the_town_prints_a_table_and_draws(tmp_path):
    done = ilnet("demo", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    table = {line.split()[0]: line.split()[1:] for line in done.stdout.splitlines() if line.split()[:1]}
    assert set(table) >= METHODS
    mae, iou = ({name: float(table[name][column]) for name in METHODS} for column in (0, 1))
    assert mae["iln"] < mae["bilinear"]
    assert mae["iln-surfaces"] < mae["bilinear"]
    assert iou["iln-surfaces"] > iou["bilinear"]
    pictures = tmp_path / "demo_output"
    for name in ("range_images.png", "range_images_sector.png", "points.png"):
        assert (pictures / name).read_bytes()[:4] == b"\x89PNG"
    assert (pictures / "iln-surfaces.ply").read_bytes()[:3] == b"ply"


def test_demo_of_a_mesh_prints_one_json_object(tmp_path, mesh_file):
    done = ilnet("demo", "--mesh", mesh_file, "--at", 0, 0, 1.8, "--json", "--out", "here", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["input"] == "16x1024"
    assert result["output"] == "128x2048"
    assert set(result["methods"]) == METHODS
    for figures in result["methods"].values():
        assert set(figures) >= {"mae", "iou", "precision", "recall", "f1", "floating", "edge_mae"}
        assert figures["mae"] >= 0
        assert all(0 <= figures[name] <= 1 for name in ("iou", "precision", "recall", "f1"))
    assert (tmp_path / "here" / "points.png").exists()


def test_demo_of_a_scan_is_judged_against_its_own_rows(tmp_path, scan_file):
    done = ilnet("demo", "--scan", scan_file, "--rows", 8, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["input"], result["output"]) == ("8x256", "32x256")
    # Walls are planes: inverse range keeps them, nearest does not.
    assert result["methods"]["bilinear-inverse"]["mae"] < result["methods"]["nearest"]["mae"]


EVALUATED = {"model", "size", "scans", "unseen"}
EVALUATED |= {"mae", "iou", "precision", "recall", "f1", "floating", "edge_mae", "chamfer"}


def test_evaluate_measures_models_at_positions_in_a_mesh(command, tmp_path, mesh_file):
    (tmp_path / "at.json").write_text(json.dumps({"mesh": "yard.ply", "positions": [[0, 0, 1.8], [3, 3, 1.8]]}))
    scene = ("evaluate", "--scene", mesh_file, "--at", "at.json", "--size", "32x512", "--json")
    done = ilnet(*scene, "--model", "nearest", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    nearest = json.loads(done.stdout)
    assert set(nearest) == EVALUATED | {"mae_interval", "iou_interval"}
    assert (nearest["model"], nearest["size"], nearest["scans"]) == ("nearest", "32x512", 2)
    assert "2/2" in done.stderr
    _, out, _ = command(*scene, "--model", "nearest", "--model", "bilinear-inverse", "--scans", 1)
    first, inverse = json.loads(out)
    assert first["scans"] == 1
    assert first["mae"] != nearest["mae"]
    assert inverse["iou"] > first["iou"]  # the ground is a plane
    assert inverse["floating"] > first["floating"]


def test_evaluate_of_a_scan_judges_at_its_own_size(command, scan_file):
    code, out, _ = command("evaluate", "--model", "bilinear", "--scan", scan_file, "--rows", 8, "--json")
    result = json.loads(out)
    assert code == 0
    assert set(result) == EVALUATED
    assert (result["size"], result["scans"]) == ("32x256", 1)
    truth = scan_files.read(scan_file)
    figures = metrics.compare(models.load("bilinear").ranges(truth.decimate(8), truth.sensor), truth)
    assert {name: result[name] for name in EVALUATED & set(figures)} == pytest.approx(
        {name: figures[name] for name in EVALUATED & set(figures)}, rel=1e-4
    )


def test_evaluate_in_a_town_prints_a_table(command):
    methods = ("--model", "iln-surfaces", "--model", "nearest")
    code, out, _ = command("evaluate", *methods, "--scene", "town01", "--size", "32x512", "--scans", 2)
    assert code == 0
    table = out.partition("95 % intervals")[0].strip().splitlines()[-2:]
    rows = {line.split()[0]: [float(word) for word in line.split()[1:]] for line in table}
    assert rows["iln-surfaces"][0] < rows["nearest"][0]


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".vtp"])
def test_demo_reads_other_mesh_formats(tmp_path, mesh_file, suffix):
    import pyvista

    from ilnet.world import meshes

    pyvista.read(mesh_file).save(tmp_path / f"yard{suffix}")
    vertices, triangles = meshes.read(tmp_path / f"yard{suffix}")
    assert vertices.min(0) == pytest.approx([-50, -50, -0.5], abs=0.01)
    assert len(triangles) == meshes.read(mesh_file)[1].shape[0]


def bad_files(folder):
    (folder / "text.ply").write_text("hello\n")
    (folder / "text.npz").write_text("hello\n")
    rows = np.full((8, 64), 5.0)
    np.savez(folder / "no_range.npz", elevation_deg=np.arange(8.0), column_azimuth_deg=np.arange(64.0))
    write_scan(folder / "zeros.npz", rows * 0)
    write_scan(folder / "one_beam.npz", rows[:1])
    write_scan(folder / "good.npz", rows)
    write_scan(folder / "micrometres.npz", np.full((32, 64), 2e7))
    (folder / "at.json").write_text('{"positions": [[0, 0, 1.8]]}')
    (folder / "far.json").write_text('{"positions": [[0, 0, 1.8], [900, 0, 1.8]]}')
    (folder / "flat.json").write_text('{"positions": [[0, 1.8]]}')
    (folder / "list.json").write_text("[[0, 0, 1.8]]")
    (folder / "none.json").write_text('{"positions": []}')
    nan = "nan 0 0\n0 1 0\n0 0 1\n3 0 1 2\n"
    (folder / "nan.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face 1\nproperty list uchar int vertex_indices\nend_header\n{nan}"
    )
    (folder / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n"
    )


SCENE = ["evaluate", "--model", "nearest", "--scene"]
BAD = {
    "missing mesh": (["demo", "--mesh", "nowhere.ply", "--at", "0", "0", "0"], "nowhere.ply: there is no such file"),
    "text called ply": (["demo", "--mesh", "text.ply", "--at", "0", "0", "0"], "text.ply: holds no triangle"),
    "points as mesh": (["demo", "--mesh", "points.ply", "--at", "0", "0", "0"], "points.ply: holds no triangle"),
    "cut mesh": (["demo", "--mesh", "cut.ply", "--at", "0", "0", "0"], "cut.ply: "),
    "mesh far away": (["demo", "--mesh", "yard.ply", "--at", "999", "0", "0"], "the mesh spans"),
    "at NaN": (["demo", "--mesh", "yard.ply", "--at", "nan", "0", "0"], "finite"),
    "mesh without at": (["demo", "--mesh", "yard.ply"], "go together"),
    "missing scan": (["demo", "--scan", "nowhere.npz"], "nowhere.npz"),
    "text called npz": (["demo", "--scan", "text.npz"], "text.npz"),
    "no range": (["demo", "--scan", "no_range.npz"], "lacks range"),
    "all zeros": (["demo", "--scan", "zeros.npz"], "holds no return"),
    "one beam": (["demo", "--scan", "one_beam.npz"], "it should have at least 2"),
    "no rows": (["demo", "--scan", "good.npz", "--rows", "0"], "; it should be 2 to 8"),
    "one row": (["demo", "--scan", "good.npz", "--rows", "1"], "; it should be 2 to 8"),
    "all rows": (["demo", "--scan", "good.npz", "--rows", "8"], "keep fewer"),
    "no rows without a scan": (["demo", "--rows", "0"], "--rows and --sensor go with --scan"),
    "micrometres": (["demo", "--scan", "micrometres.npz"], "neither metres nor millimetres"),
    "folder as mesh": (["demo", "--mesh", ".", "--at", "0", "0", "0"], "is a folder"),
    "points without sensor": (
        ["demo", "--scan", "points.ply"],
        "name the sensor that measured it, such as the preset os1-128: --sensor NAME",
    ),
    "unknown sensor": (
        ["demo", "--scan", "points.ply", "--sensor", "vlp-61"],
        "sensor is 'vlp-61'; it should be one of",
    ),
    "unwritable folder": (["demo", "--scan", "good.npz", "--rows", "4", "--out", "text.ply"], "text.ply"),
    "no scene": (["evaluate", "--model", "iln"], "--scene TOWN|MESH, --scan FILE, --data DIR or --protocol kitti FILE"),
    "no such scene": ([*SCENE, "town99"], "town99 is neither a town (town01"),
    "mesh without positions": ([*SCENE, "yard.ply"], "needs --at FILE"),
    "town with positions": ([*SCENE, "town01", "--at", "at.json"], "--at goes with a mesh"),
    "missing positions": ([*SCENE, "yard.ply", "--at", "x.json"], "x.json"),
    "positions of 2 numbers": ([*SCENE, "yard.ply", "--at", "flat.json"], "flat.json: should be"),
    "positions without a name": ([*SCENE, "yard.ply", "--at", "list.json"], "list.json: should be"),
    "no positions": ([*SCENE, "yard.ply", "--at", "none.json"], "none.json: should be JSON like"),
    "positions far away": ([*SCENE, "yard.ply", "--at", "far.json"], "(900.0, 0.0, 1.8); the mesh spans"),
    "too few positions": ([*SCENE, "yard.ply", "--at", "at.json", "--scans", "2"], "at.json holds 1 positions"),
    "NaN in the mesh": ([*SCENE, "nan.ply", "--at", "at.json"], "nan.ply: holds NaN"),
    "a size of one number": ([*SCENE, "town01", "--size", "128"], "size is '128'; it should be rows x columns"),
    "size of a scan": (["evaluate", "--model", "iln", "--scan", "good.npz", "--size", "9x9"], "go with --scene"),
    "rows of a scene": ([*SCENE, "town01", "--rows", "8"], "--rows and --sensor go with --scan"),
    "too many rows": (["evaluate", "--model", "iln", "--scan", "good.npz", "--rows", "9"], "; it should be 2 to 8"),
    "unknown model to evaluate": (
        ["evaluate", "--model", "ilm", "--scan", "good.npz"],
        "name is 'ilm'; it should be one of",
    ),
    "unknown model": (["train", "ilm"], "'ilm'"),
    "unknown preset": (["train", "iln", "--preset", "huge"], "is 'huge'; it should be one of"),
    "no steps": (["train", "iln", "--steps", "0"], "--steps"),
    "size of no images": (["train", "iln", "--size", "64x1024"], "--size goes with --data DIR"),
    "unknown sensor to train on": (["train", "iln", "--sensors", "os1-128,os9"], "sensor is 'os9'; it should be one"),
    "sensors of stored images": (["train", "iln", "--sensors", "any", "--data", "x"], "--sensors and --data exclude"),
    "lidar-sr on rays": (["train", "lidar-sr"], "lidar-sr with preset tiny learns from stored images"),
    "no experiment": (["experiment"], "name some experiments, or all"),
    "all without images": (["experiment", "all"], "rays needs --data DIR"),
    "real without scans": (["experiment", "table", "real"], "real needs --measured FILE"),
    "unknown command": (["dmeo"], "dmeo"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_exit_code_2(case, tmp_path, mesh_file, command):
    bad_files(tmp_path)
    (tmp_path / "cut.ply").write_bytes(mesh_file.read_bytes()[:2000])
    arguments, message = BAD[case]
    code, out, [*_, last] = command(*arguments)
    assert (code, out) == (2, "")
    assert last.startswith("error: ")
    assert message in last


def test_an_error_leaves_no_traceback(tmp_path):
    done = ilnet("demo", "--scan", "nowhere.npz", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == "error: nowhere.npz: there is no such file\n"


def test_without_a_command_the_help_is_shown(tmp_path):
    done = ilnet(cwd=tmp_path)
    assert done.returncode == 0
    assert "Commands:" in done.stdout


def test_without_a_home_it_still_runs(tmp_path, scan_file, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "nohome" / "none"))
    monkeypatch.delenv("WARP_CACHE_PATH", raising=False)
    (tmp_path / "nohome").write_text("a file, so that no folder can be made")
    done = ilnet("demo", "--scan", scan_file, "--rows", 8, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_help_comes_without_loading_torch(tmp_path):
    code = (
        "import sys, ilnet.commands.cli as c; c.cli(['demo', '--help'], standalone_mode=False); "
        "sys.exit('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0
    assert "--mesh" in done.stdout
