"""A sensor, a pose and a world of meshes make a scan."""

import math
from collections.abc import Sequence

import torch

from ilnet.scan import Scan
from ilnet.sensor import Sensor
from ilnet.world.effects import Effects, nearer, simulate_with
from kernels import Hits, Mesh

__all__ = ["World", "best_device", "cast", "hits", "nearest", "pose", "ranges", "scan"]

Angle = float | torch.Tensor
# One mesh or several: a town, and the traffic in it.
World = Mesh | Sequence[Mesh]
# On CUDA. They take about 200 bytes each on the way.
_RAYS_AT_ONCE = 1 << 22


def best_device() -> torch.device:
    """Returns the device that rays are cast on by default: CUDA where there is a GPU, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def pose(
    position: torch.Tensor | tuple[float, float, float], yaw: Angle = 0.0, pitch: Angle = 0.0, roll: Angle = 0.0
) -> torch.Tensor:
    """Builds the transform from the sensor frame to the world.

    Args:
        position: (..., 3) of the sensor in the world [m].
        yaw: (...) [rad], counter-clockwise about z, applied last.
        pitch: (...) [rad], about y; a positive one lowers the nose.
        roll: (...) [rad], about x, applied first.

    Returns:
        (..., 4, 4) float64, on the device of the position.
    """
    position = torch.as_tensor(position, dtype=torch.float64)
    angles = (torch.as_tensor(a, dtype=torch.float64, device=position.device) for a in (yaw, pitch, roll))
    (cy, sy), (cp, sp), (cr, sr) = ((a.cos(), a.sin()) for a in angles)
    rows: list[list[Angle]] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, position[..., 0]],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, position[..., 1]],
        [-sp, cp * sr, cp * cr, position[..., 2]],
        [0.0, 0.0, 0.0, 1.0],
    ]
    entries = torch.broadcast_tensors(
        *(torch.as_tensor(e, dtype=torch.float64, device=position.device) for row in rows for e in row)
    )
    return torch.stack(entries, -1).unflatten(-1, (4, 4))


def cast(mesh: Mesh, pose: torch.Tensor, directions: torch.Tensor, max_range: float) -> torch.Tensor:
    """Returns the ranges (..., N) [m] of `hits`, whose arguments it takes; 0 where nothing is met."""
    return hits(mesh, pose, directions, max_range).range


def hits(mesh: Mesh, pose: torch.Tensor, directions: torch.Tensor, max_range: float) -> Hits:
    """Casts rays along any directions.

    Args:
        mesh: What they may meet, in metres.
        pose: (..., 4, 4) transforms from the sensor frame to that of the mesh, on any device.
        directions: (..., N, 3) unit vectors in the sensor frame, on any device.
        max_range: Greatest range that is found [m].

    Returns:
        The nearest hits, each tensor (..., N), on the mesh's device.
    """
    pose = pose.to(mesh.device)
    turned = directions.to(mesh.device).double() @ pose[..., :3, :3].mT
    return mesh.cast(pose[..., None, :3, 3], turned, max_range)


def nearest(found: Sequence[torch.Tensor]) -> torch.Tensor:
    """Returns the nearest (...) of several ranges (...) [m] of the same rays, 0 where all are 0."""
    ranges, *others = found
    for other in others:
        ranges = other.where(nearer(other, ranges), ranges)
    return ranges


def _meshes(world: World) -> Sequence[Mesh]:
    meshes = [world] if isinstance(world, Mesh) else world
    if not meshes:
        raise ValueError("world is empty; it should be one mesh or several")
    return meshes


def ranges(world: World, sensor: Sensor, poses: torch.Tensor) -> torch.Tensor:
    """Casts every ray of a sensor at each of several poses, with the engine that is faster for each mesh.

    Args:
        world: Meshes in metres, all on one device; the nearest hit counts.
        sensor: The sensor whose rays are cast.
        poses: (..., 4, 4) transforms from the sensor frame to the world, on any device.

    Returns:
        (..., H, W) float32 ranges [m] on the meshes' device; 0 where nothing is met between the sensor's minimum and
        maximum range.

    Raises:
        ValueError: If there is no mesh, or a pose is not finite.
    """
    found = nearest([_images(mesh, sensor, poses.reshape(-1, 4, 4)) for mesh in _meshes(world)])
    return found.where(found >= sensor.min_range, 0.0).view(*poses.shape[:-2], *sensor.shape)


def _images(mesh: Mesh, sensor: Sensor, poses: torch.Tensor) -> torch.Tensor:
    """Returns the ranges (N, H, W) of one mesh from poses (N, 4, 4)."""
    tables = torch.tensor(sensor.elevations), torch.tensor(sensor.azimuths)
    directions, rays = sensor.directions().view(-1, 3), math.prod(sensor.shape)
    images = [torch.empty(0, *sensor.shape, device=mesh.device)]
    for some in poses.to(mesh.device).split(1 if mesh.device.type == "cpu" else max(1, _RAYS_AT_ONCE // rays)):
        if len(some) == 1 and mesh.projects_faster(some[0, :3, 3], rays, sensor.max_range):
            images.append(mesh.project(some[0], *tables, sensor.max_range).unsqueeze(0))
        else:
            images.append(cast(mesh, some, directions, sensor.max_range).view(-1, *sensor.shape))
    return torch.cat(images)


def scan(world: World, sensor: Sensor, pose: torch.Tensor, effects: Effects | None = None, seed: int = 0) -> Scan:
    """Simulates one scan: casts every ray of a sensor.

    Args:
        world: Meshes in metres, all on one device; the nearest hit counts.
        sensor: The sensor whose rays are cast.
        pose: (4, 4) transform from the sensor frame to the world, on any device; where the sensor moves, that in the
            middle of the turn.
        effects: What a real sensor does to its measurements; None for perfect ranges.
        seed: Seed of the effects' random numbers.

    Returns:
        The scan, on the meshes' device; 0 where nothing is met between the sensor's minimum and maximum range.

    Raises:
        ValueError: If there is no mesh, the pose is not finite, or the effects do not fit the sensor.
    """
    if effects is None:
        return Scan(ranges(world, sensor, pose), sensor)
    return simulate_with(effects, _meshes(world), sensor, pose, torch.Generator().manual_seed(seed))
