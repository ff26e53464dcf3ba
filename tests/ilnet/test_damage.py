"""Damaged files: each either still reads, or is one short line; quickly, and without taking memory.

`ILNET_MUTATIONS=500 pytest -s tests/ilnet/test_damage.py` tries 500 of each format instead of 200, and prints what
became of them.
"""

import json
import logging
import os
import re
import resource
import struct
import time
import zipfile

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ilnet import memory, models, scan_files
from ilnet.scan import Scan
from ilnet.world import meshes

from .toy import SENSOR, complete

MUTATIONS = int(os.environ.get("ILNET_MUTATIONS", 200))
# Seconds, bytes and characters.
SLOWEST, MOST, LONGEST = 10.0, 2e9, 900
NUMBERS = (b"0", b"-1", b"3", b"255", b"65536", b"4294967295", b"99999999999", b"1" + b"0" * 400, b"nan", b"1e999")


def points():
    """The toy's points by the names of their fields."""
    return scan_files.columns_of(complete())


def structured():
    columns = points()
    records = np.empty(len(columns["x"]), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        records[name] = values
    return records


def npy(path, array):
    np.save(path, array)


def text_ply(path):
    rows = structured()
    names = "".join(f"property float {name}\n" for name in rows.dtype.names)
    faces = "element face 2\nproperty list uchar int vertex_indices\n"
    body = "3 0 1 2\n4 0 1 2 3\n" + "".join(" ".join(map(str, row.tolist())) + "\n" for row in rows)
    path.write_text(f"ply\nformat ascii 1.0\n{faces}element vertex {len(rows)}\n{names}end_header\n{body}")


def faces_first(path):
    scan_files.write(path, complete())
    faces = b"element face 2\nproperty list uchar int vertex_indices\nelement vertex"
    body = struct.pack("<BiiiBiiii", 3, 0, 1, 2, 4, 0, 1, 2, 3)
    content = path.read_bytes().replace(b"element vertex", faces).replace(b"end_header\n", b"end_header\n" + body)
    path.write_bytes(content)


def pcd(path, data):
    rows = structured()
    kinds = [rows.dtype[name] for name in rows.dtype.names]
    header = (
        f"VERSION .7\nFIELDS {' '.join(rows.dtype.names)}\nSIZE {' '.join(str(kind.itemsize) for kind in kinds)}\n"
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}\nWIDTH {len(rows)}\nHEIGHT 1\nPOINTS {len(rows)}\n"
        f"DATA {data}\n"
    ).encode()
    if data == "ascii":
        body = "".join(" ".join(map(str, row.tolist())) + "\n" for row in rows).encode()
    else:
        columns = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names)
        runs = [columns[i : i + 32] for i in range(0, len(columns), 32)]
        packed = b"".join(bytes([len(run) - 1]) + run for run in runs)
        body = struct.pack("<II", len(packed), len(columns)) + packed
    path.write_bytes(header + body)


def five_columns(path):
    columns = points()
    rows = np.stack([columns[name] for name in ("x", "y", "z", "intensity", "ring")], axis=1)
    np.tile(rows, (8, 1)).astype("<f4").tofile(path)


def weights(path):
    torch.manual_seed(0)
    arguments = {"features": 8, "blocks": 1, "depth": 1}
    models.save(models.create("iln", **arguments), path, "iln", arguments)


def positions(path):
    path.write_text(json.dumps({"positions": [[1.5, 2, 3], [4, 5, 6]], "sensor_height_m": 1.5}))


def with_sensor(path):
    return scan_files.read(path, SENSOR)


def written(path):
    scan_files.write(path, complete())


# How a file of each kind is made, and what reads it.
KINDS = {
    "a.npz": (written, scan_files.read),
    "image.npy": (lambda path: npy(path, complete().ranges.numpy()), with_sensor),
    "points.npy": (lambda path: npy(path, structured()), with_sensor),
    "a.bin": (written, with_sensor),
    "five.bin": (five_columns, with_sensor),
    "binary.ply": (written, with_sensor),
    "faces.ply": (faces_first, with_sensor),
    "text.ply": (text_ply, with_sensor),
    "binary.pcd": (written, with_sensor),
    "text.pcd": (lambda path: pcd(path, "ascii"), with_sensor),
    "packed.pcd": (lambda path: pcd(path, "binary_compressed"), with_sensor),
    "a.laz": (written, with_sensor),
    "a.safetensors": (weights, models.load),
    "positions.json": (positions, lambda path: meshes.read_positions(path, 2.0)),
}


def mutated(whole, rng):
    """Bytes overwritten, cut off, doubled, left out, or numbers of a header that become others."""
    data = bytearray(whole)
    for _ in range(rng.integers(1, 4)):
        at, length = int(rng.integers(0, max(len(data), 1))), int(rng.integers(1, 40))
        match rng.integers(0, 7):
            case 0:
                data[at : at + 1] = rng.bytes(1)
            case 1:
                data[at : at + length] = rng.bytes(length)
            case 2:
                del data[at:]
            case 3:
                del data[at : at + length]
            case 4:
                data[at:at] = data[at : at + length]
            case 5:
                data[at : at + 4] = struct.pack("<I", rng.choice([0, 1, 255, 2**31 - 1, 2**31, 2**32 - 1]))
            case 6:
                numbers = list(re.finditer(rb"\d+", data[:2000]))
                if numbers:
                    start, end = numbers[rng.integers(len(numbers))].span()
                    data[start:end] = NUMBERS[rng.integers(len(NUMBERS))]
    return bytes(data)


def outcome(reader, path):
    """Whether a file was read; an error must be one short line that names it."""
    try:
        reader(path)
    except (ValueError, OSError) as error:
        line = str(error)
        assert line.startswith(str(path)), line
        assert "\n" not in line
        assert len(line) < LONGEST
        return False
    return True


@pytest.fixture(autouse=True)
def silent(caplog):
    caplog.set_level(logging.CRITICAL, "ilnet")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", KINDS)
def test_mutated_files(tmp_path, name):
    if name.endswith(".laz"):
        pytest.importorskip("laspy")
    make, reader = KINDS[name]
    path = tmp_path / name
    make(path)
    assert outcome(reader, path)
    whole = path.read_bytes()
    rng = np.random.default_rng(17)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    read, slowest = 0, 0.0
    for _ in range(MUTATIONS):
        path.write_bytes(mutated(whole, rng))
        start = time.perf_counter()
        read += outcome(reader, path)
        slowest = max(slowest, time.perf_counter() - start)
    taken = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    print(f"{name:15} {read:4} read {MUTATIONS - read:4} refused, slowest {slowest:.2f} s, {taken / 1e6:.0f} MB more")
    assert read < MUTATIONS
    assert slowest < SLOWEST
    assert taken < MOST


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(sorted(KINDS)), st.binary(max_size=200), st.booleans())
def test_any_bytes(tmp_path, name, content, magic):
    path = tmp_path / name
    start = {
        "npz": b"PK\x03\x04",
        "npy": b"\x93NUMPY\x01\x00",
        "ply": b"ply\n",
        "laz": b"LASF",
        "pcd": b"FIELDS x y z\n",
    }
    path.write_bytes((start.get(path.suffix[1:], b"") if magic else b"") + content)
    outcome(KINDS[name][1], path)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(-(10**30), 10**30), st.sampled_from(["binary.ply", "text.ply", "binary.pcd", "text.pcd"]))
def test_any_number_of_points(tmp_path, count, name):
    path = tmp_path / name
    KINDS[name][0](path)
    changed = path.read_bytes().replace(b"vertex 14", b"vertex %d" % count).replace(b"POINTS 14", b"POINTS %d" % count)
    path.write_bytes(changed)
    assert outcome(with_sensor, path) == (0 < count <= 14)


# Files that ask for more than there is


def sparse(path, start, size):
    path.write_bytes(start)
    os.truncate(path, size)


def huge_npz(path):
    """6.4 GB of zeros, in 6 MB."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file, file.open("range.npy", "w") as member:
        np.lib.format.write_array_header_1_0(member, dict(descr="<f4", fortran_order=False, shape=(40000, 40000)))
        member.write(bytes(4096))


PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
PCD = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA {1}\n"


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("a.bin", lambda p: sparse(p, b"", 3 << 30)),
        ("a.npy", lambda p: [np.save(p, np.ones((2, 2))), sparse(p, p.read_bytes()[:128], 3 << 30)]),
        ("a.npz", huge_npz),
        ("a.ply", lambda p: sparse(p, PLY.format("binary_little_endian", 2**27).encode(), 3 << 30)),
        ("b.ply", lambda p: sparse(p, PLY.format("ascii", 2**27).encode(), 3 << 30)),
        ("a.pcd", lambda p: sparse(p, PCD.format(2**27, "binary").encode(), 3 << 30)),
    ],
)
def test_what_takes_too_much_memory_is_refused_before(tmp_path, name, make):
    make(tmp_path / name)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=r"would take about [\d.]+ GB of memory; the limit is 2 GB$") as caught:
        scan_files.read(tmp_path / name, SENSOR)
    assert isinstance(caught.value.__cause__, memory.TooLarge)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


def test_the_limit_can_be_set(tmp_path):
    scan_files.write(tmp_path / "a.npz", complete())
    with memory.limited(1000), pytest.raises(ValueError, match=r"the limit is 1e-06 GB"):
        scan_files.read(tmp_path / "a.npz")
    assert isinstance(scan_files.read(tmp_path / "a.npz"), Scan)
    with pytest.raises(memory.TooLarge, match=r"a scan of 1000000000x1000000000 rays would take more than"):
        SENSOR.resize(10**9, 10**9)


def test_pipes_and_devices_are_refused(tmp_path):
    os.mkfifo(tmp_path / "a.npz")
    (tmp_path / "b.npz").symlink_to("/dev/zero")
    for name in ("a.npz", "b.npz"):
        with pytest.raises(OSError, match=f"{name}: it is a pipe or a device; it should be a file"):
            scan_files.read(tmp_path / name)


@pytest.mark.parametrize("layout", ["ascii", "binary_little_endian"])
def test_a_mesh_that_is_shorter_than_its_header_says(tmp_path, layout):
    faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(PLY.format(layout, 10**9).replace("end_header\n", faces) + "0 0 0\n" * 100)
    start = time.perf_counter()
    with pytest.raises(ValueError, match=r"a.ply: it was cut short: its elements take at least \d+ bytes"):
        meshes.read(tmp_path / "a.ply")
    assert time.perf_counter() - start < SLOWEST


@pytest.mark.parametrize("content", ["[" * 100_000 + "]" * 100_000, '{"positions": [[1' + "0" * 400 + ", 0, 0]]}"])
def test_positions_that_no_reader_should_follow(tmp_path, content):
    (tmp_path / "a.json").write_text(content)
    assert not outcome(meshes.read_positions, tmp_path / "a.json")


# Files of weights


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth": 10**6}, "depth is 1000000; parameters of these shapes allow"),
        ({"blocks": 10**7}, "blocks is 10000000; parameters of these shapes allow"),
        ({"features": 10**9}, "features is 1000000000; parameters of these shapes allow"),
        ({"norm_range": "x"}, "norm_range is x; it should be a number of metres above 0"),
        ({"norm_range": [1]}, r"norm_range is \[1\]; it should be a number of metres above 0"),
        ({"norm_range": 0}, "norm_range is 0; it should be a number of metres above 0"),
        ({"norm_range": float("nan")}, "norm_range is nan; it should be a number of metres above 0"),
        ({"norm_range": 10**400}, "norm_range is 10000"),
        ({"dropout": float("inf")}, "dropout is inf; it should be a finite number"),
        ({"heads": {"a": 1}}, "heads is {'a': 1}; it should be a finite number or a text"),
        ({"depth": -1}, "parameters are missing, unknown or of another shape"),
    ],
)
def test_arguments_that_fit_no_network(tmp_path, changes, message):
    weights(tmp_path / "a.safetensors")
    content = (tmp_path / "a.safetensors").read_bytes()
    header, body = json.loads(content[8:][: int.from_bytes(content[:8], "little")]), content[8:]
    body = body[int.from_bytes(content[:8], "little") :]
    arguments = {**json.loads(header["__metadata__"]["arguments"]), **changes}
    header["__metadata__"]["arguments"] = json.dumps(arguments)
    start = json.dumps(header).encode()
    (tmp_path / "a.safetensors").write_bytes(len(start).to_bytes(8, "little") + start + body)
    begun = time.perf_counter()
    with pytest.raises(ValueError, match=message) as caught:
        models.load(tmp_path / "a.safetensors")
    assert len(str(caught.value)) < LONGEST
    assert time.perf_counter() - begun < SLOWEST


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_no_numbers(tmp_path, value):
    model = models.create("iln", features=8, blocks=1)
    model.head[1].weight.data[0, 3] = value
    models.save(model, tmp_path / "a.safetensors", "iln", {"features": 8, "blocks": 1})
    with pytest.raises(ValueError, match=r"1 parameters hold NaN or infinite values, such as head\.1\.weight"):
        models.load(tmp_path / "a.safetensors")


def test_metadata_that_nests_too_deep(tmp_path):
    model = models.create("iln", features=8, blocks=1)
    state = {key: value.contiguous() for key, value in model.state_dict().items()}
    from safetensors.torch import save_file

    save_file(state, tmp_path / "a.safetensors", {"name": '"iln"', "arguments": "[" * 100_000 + "]" * 100_000})
    assert not outcome(models.load, tmp_path / "a.safetensors")
