"""A sensor, a pose and a mesh make a scan."""

import math
from pathlib import Path

import numpy as np
import torch

from ilnet.scan import Scan
from ilnet.sensor import Sensor
from kernels import Mesh

__all__ = ["pose", "read_mesh", "simulate"]


def pose(position: torch.Tensor | tuple[float, float, float], yaw=0.0, pitch=0.0, roll=0.0) -> torch.Tensor:
    """Builds the transform from the sensor frame to the world.

    Args:
        position: (..., 3) metres, of the sensor in the world.
        yaw: (...) rad, counter-clockwise about z, applied last.
        pitch: (...) rad about y; positive lowers the nose.
        roll: (...) rad about x, applied first.

    Returns:
        (..., 4, 4) float64.
    """
    position = torch.as_tensor(position, dtype=torch.float64)
    yaw, pitch, roll = (torch.as_tensor(a, dtype=torch.float64) for a in (yaw, pitch, roll))
    (cy, sy), (cp, sp), (cr, sr) = ((a.cos(), a.sin()) for a in (yaw, pitch, roll))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, position[..., 0]],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, position[..., 1]],
        [-sp, cp * sr, cp * cr, position[..., 2]],
        [torch.zeros(()), torch.zeros(()), torch.zeros(()), torch.ones(())],
    ]
    entries = torch.broadcast_tensors(*(torch.as_tensor(e, dtype=torch.float64) for row in rows for e in row))
    return torch.stack(entries, -1).unflatten(-1, (4, 4))


def simulate(mesh: Mesh, sensor: Sensor, pose: torch.Tensor) -> Scan:
    """Casts every ray of a sensor at a mesh.

    Args:
        mesh: The world, in metres.
        sensor: Whose rays are cast.
        pose: (4, 4) transform from the sensor frame to the world.

    Returns:
        The scan; 0 where nothing is met between the sensor's minimum and maximum range.
    """
    pose = pose.to(mesh.device)
    directions = (sensor.directions().to(mesh.device).double() @ pose[:3, :3].T).float()
    ranges = mesh.cast(pose[:3, 3].float(), directions, sensor.max_range).range
    return Scan(ranges.where(ranges >= sensor.min_range, 0.0), sensor)


def read_mesh(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Reads the triangles of any mesh file that PyVista reads; other polygons are cut into triangles.

    Args:
        path: The file; metres, z up.

    Returns:
        vertices: (V, 3) float32.
        triangles: (F, 3) int32.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a mesh, or holds no triangle.
    """
    import pyvista  # here and not above: it takes a second to import

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give the path of a mesh")
    try:
        with pyvista.vtk_verbosity("off"):  # VTK writes to stderr and carries on with an empty mesh
            mesh = pyvista.wrap(pyvista.read(path)).extract_surface(algorithm=None).triangulate()
    except Exception as error:  # PyVista and its readers raise whatever they like
        raise ValueError(f"{path}: not a mesh that PyVista reads ({type(error).__name__}: {error})") from error
    triangles = np.asarray(mesh.regular_faces if mesh.n_cells else np.empty((0, 3)), dtype=np.int32)
    vertices = np.asarray(mesh.points, dtype=np.float32)
    if len(triangles) == 0:
        raise ValueError(f"{path}: holds no triangle; give a mesh with faces, not a point cloud or another kind of file")
    if not math.isfinite(float(vertices.sum())):
        raise ValueError(f"{path}: holds NaN or infinite vertices; clean the mesh first")
    return vertices, triangles
