"""A sensor, a pose and a mesh make a scan."""

import torch

from ilnet.scan import Scan
from ilnet.sensor import Sensor
from kernels import Mesh

__all__ = ["best_device", "measure", "pose", "simulate"]


Angle = float | torch.Tensor


def best_device() -> torch.device:
    """CUDA where there is a device, else the CPU: those that the kernels run on."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def pose(
    position: torch.Tensor | tuple[float, float, float], yaw: Angle = 0.0, pitch: Angle = 0.0, roll: Angle = 0.0
) -> torch.Tensor:
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
    angles = (torch.as_tensor(a, dtype=torch.float64) for a in (yaw, pitch, roll))
    (cy, sy), (cp, sp), (cr, sr) = ((a.cos(), a.sin()) for a in angles)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, position[..., 0]],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, position[..., 1]],
        [-sp, cp * sr, cp * cr, position[..., 2]],
        [torch.zeros(()), torch.zeros(()), torch.zeros(()), torch.ones(())],
    ]
    entries = torch.broadcast_tensors(*(torch.as_tensor(e, dtype=torch.float64) for row in rows for e in row))
    return torch.stack(entries, -1).unflatten(-1, (4, 4))


def measure(mesh: Mesh, sensor: Sensor, pose: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Measures ranges along any directions, with the range limits of a sensor.

    Args:
        mesh: The world, in metres.
        sensor: Whose limits hold.
        pose: (..., 4, 4) transforms from the sensor frame to the world.
        directions: (..., N, 3) unit vectors in the sensor frame.

    Returns:
        (..., N) float32 metres on the mesh's device; 0 where nothing is met between minimum and maximum range.
    """
    pose = pose.to(mesh.device)
    turned = directions.to(mesh.device).double() @ pose[..., :3, :3].mT
    ranges = mesh.cast(pose[..., None, :3, 3], turned, sensor.max_range).range
    return ranges.where(ranges >= sensor.min_range, 0.0)


def simulate(mesh: Mesh, sensor: Sensor, pose: torch.Tensor) -> Scan:
    """Casts every ray of a sensor at a mesh.

    Args:
        mesh: The world, in metres.
        sensor: Whose rays are cast.
        pose: (4, 4) transform from the sensor frame to the world.

    Returns:
        The scan; 0 where nothing is met between the sensor's minimum and maximum range.
    """
    return Scan(measure(mesh, sensor, pose, sensor.directions().view(-1, 3)).view(sensor.shape), sensor)
