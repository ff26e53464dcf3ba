"""Mesh files, through PyVista's many readers.

VTK's readers write to stderr, return empty meshes, or crash the process when a file is damaged. So they run in a
process of their own, `python -m ilnet.meshes FILE OUT.npz`, which may do all that.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

__all__ = ["read"]


def read(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads the triangles of any mesh file that PyVista reads; other polygons are cut into triangles.

    Args:
        path: The file; metres, z up.

    Returns:
        vertices: (V, 3) float32, or float64 where the file holds that.
        triangles: (F, 3) int32.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a whole mesh, holds no triangle, or holds NaN.
    """
    path = Path(path)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "there is no such file"
        raise FileNotFoundError(f"{path}: {what}; give the path of a mesh")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "mesh.npz"
        command = [sys.executable, "-m", "ilnet.meshes", str(path), str(out)]
        reader = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        if reader.returncode:
            reason = (reader.stderr.strip().splitlines() or ["it crashed"])[-1]
            raise ValueError(f"{path}: not a mesh that PyVista reads, or cut short; its reader said: {reason}")
        with np.load(out) as arrays:
            vertices, triangles = arrays["vertices"], arrays["triangles"]
    if len(triangles) == 0:
        raise ValueError(
            f"{path}: holds no triangle; give a mesh with faces, not a point cloud or another kind of file"
        )
    if not np.isfinite(vertices).all():
        raise ValueError(f"{path}: holds NaN or infinite vertices; clean the mesh first")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError(f"{path}: its triangles name vertices that are not there; the file is damaged")
    return vertices, triangles


def _convert(path: str, out: str) -> None:
    import pyvista

    mesh = pyvista.wrap(pyvista.read(path)).extract_surface(algorithm=None).triangulate()
    triangles = mesh.regular_faces if mesh.n_cells else np.empty((0, 3))
    np.savez(out, vertices=np.asarray(mesh.points), triangles=np.asarray(triangles, np.int32))


if __name__ == "__main__":
    _convert(*sys.argv[1:])
