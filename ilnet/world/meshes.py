"""Mesh files, read by PyVista.

When a file is damaged, VTK's readers write to stderr, return an empty mesh, or crash their process. So they run in a
process of their own, `python -m ilnet.world.meshes FILE OUT.npz`.
"""

import contextlib
import json
import math
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from ilnet import memory

__all__ = ["read", "read_positions"]

# How long a reader may take at most: its start, and the file.
_SECONDS, _BYTES_A_SECOND = 120.0, 1e6
# The memory that PyVista itself takes [bytes].
_OF_PYVISTA = 2_000_000_000


def read(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads the triangles of any mesh file that PyVista reads; polygons are cut into triangles.

    Args:
        path: The file; metres, z up.

    Returns:
        vertices: (V, 3) float32, or float64 where the file holds that.
        triangles: (F, 3) int32.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a whole mesh, or holds no triangle or a vertex that is not finite.
    """
    path = Path(path)
    if not path.is_file():
        what = "is a folder, a pipe or a device" if path.exists() else "there is no such file"
        raise FileNotFoundError(f"{path}: {what}; it should be the path of a mesh")
    size = path.stat().st_size
    memory.check(str(path), size)
    if path.suffix.lower() == ".ply":
        from ilnet.scan_files import ply  # which imports torch; the process that reads does without

        try:
            ply.check_header(path)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "mesh.npz"
        command = [sys.executable, "-m", "ilnet.world.meshes", str(path), str(out)]
        longest = _SECONDS + size / _BYTES_A_SECOND
        try:
            reader = subprocess.run(
                [*command, str(memory.limit())],
                capture_output=True,
                text=True,
                errors="replace",
                check=False,
                timeout=longest,
            )
        except subprocess.TimeoutExpired:
            raise ValueError(f"{path}: its reader did not end within {longest:.0f} s; the file is damaged") from None
        if reader.returncode:
            reason = (reader.stderr.strip().splitlines() or ["it crashed"])[-1]
            raise ValueError(f"{path}: not a mesh that PyVista reads, or cut short; its reader said: {reason}")
        with np.load(out) as arrays:
            vertices, triangles = arrays["vertices"], arrays["triangles"]
    if len(triangles) == 0:
        raise ValueError(
            f"{path}: holds no triangle; it should be a mesh with faces, not a point cloud or another kind of file"
        )
    if not np.isfinite(vertices).all():
        raise ValueError(f"{path}: holds NaN or infinite vertices; clean the mesh first")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError(f"{path}: its triangles refer to vertices that are not there; the file is damaged")
    return vertices, triangles


def read_positions(path: str | Path, height: float | None = None) -> np.ndarray:
    """Reads the positions of a sensor in a mesh, from JSON such as `{"positions": [[x, y, z], ...]}`.

    Args:
        path: The file.
        height: Height above the ground to move the positions to [m]. The file then holds their own as
            `sensor_height_m`. None leaves them where they are.

    Returns:
        (N, 3) float64 metres, N > 0.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it holds anything else.
    """
    path = Path(path)
    if path.exists() and not path.is_file():  # a pipe would be waited for
        raise ValueError(f"{path} is a folder, a pipe or a device; it should be a JSON file")
    try:
        content = json.loads(path.read_bytes())
        positions = np.array(content["positions"], dtype=np.float64)
        lift = 0.0 if height is None else height - float(content["sensor_height_m"])
        if positions.ndim != 2 or positions.shape[1] != 3 or len(positions) == 0:
            raise ValueError("not a list of [x, y, z]")
        if not np.isfinite(positions).all() or not math.isfinite(lift):
            raise ValueError("NaN or infinite numbers")
    except (ValueError, TypeError, KeyError, ArithmeticError, RecursionError) as error:
        needed = '"positions": [[x, y, z], ...]' + ("" if height is None else ', "sensor_height_m": z')
        problem = f"lacks {error}" if isinstance(error, KeyError) else error
        raise ValueError(f"{path}: should be JSON like {{{needed}}}, metres in the mesh ({problem})") from None
    return positions + np.array([0, 0, lift])


def _convert(path: str, out: str, limit: str) -> None:
    import pyvista

    _confine(float(limit))
    mesh = pyvista.wrap(pyvista.read(path)).extract_surface(algorithm=None).triangulate()
    triangles = mesh.regular_faces if mesh.n_cells else np.empty((0, 3))
    np.savez(out, vertices=np.asarray(mesh.points), triangles=np.asarray(triangles, np.int32))


def _confine(limit: float) -> None:
    """Limits the memory of this process [bytes], and ends it with its parent, as far as the system can."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (int(limit + _OF_PYVISTA),) * 2)
    with contextlib.suppress(OSError, AttributeError):  # Linux has prctl
        import ctypes

        set_death_signal = 1
        ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)


if __name__ == "__main__":
    _convert(*sys.argv[1:])
