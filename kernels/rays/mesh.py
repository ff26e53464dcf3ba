"""A mesh and its rays: nearest hits through Warp's bounding volume hierarchy, with one thread per ray.

`Mesh.cast` walks the hierarchy for any rays. `Mesh.project` finds the rays of a whole range image, which all start at
one point, with `kernels.rays.projection`.
"""

import math
import threading
from numbers import Real
from typing import NamedTuple

import numpy as np
import torch
import warp as wp

from kernels import reference
from kernels.checks import broadcast_batch, check_backend, check_floating
from kernels.launch import initialise, launch
from kernels.rays.projection import Clusters, cluster_triangles, project_triangles, within_reach

__all__ = ["Hits", "Mesh"]

# Metres. A nearer hit is reported at this range, since 0 means none.
_LEAST_RANGE = 1e-6
# Triangles. A larger mesh is expected to meet enough rays to be worth a better and slower tree.
_LARGE = 200_000
# How many rays `cast` can do in the time that `project` takes before its first.
_FEW_RAYS = 3000
# How far R Rᵀ may be from the identity: 1 cm at 100 m.
_ROTATION = 1e-4


class Hits(NamedTuple):
    """What rays met. All tensors have the rays' batch shape."""

    range: torch.Tensor
    """float32 [m], distance along the unit direction; 0 where nothing was hit within the maximum range."""
    triangle: torch.Tensor
    """int32, number of the triangle that was hit; -1 where none was."""
    cosine: torch.Tensor
    """float32 in [0, 1], of the angle between ray and surface normal, on either side; 0 where nothing was hit."""


@wp.kernel(enable_backward=False)
def _cast_rays_kernel(
    first: int,
    # in
    mesh: wp.uint64,
    origins: wp.array2d[float],
    directions: wp.array2d[float],
    max_range: float,
    # out
    ranges_out: wp.array[float],
    triangles_out: wp.array[wp.int32],
    cosines_out: wp.array[float],
):
    i = first + wp.tid()
    origin = wp.vec3(origins[i, 0], origins[i, 1], origins[i, 2])
    direction = wp.vec3(directions[i, 0], directions[i, 1], directions[i, 2])
    hit = wp.mesh_query_ray(mesh, origin, direction, max_range)
    if hit.result:
        ranges_out[i] = wp.max(hit.t, _LEAST_RANGE)
        triangles_out[i] = hit.face
        cosines_out[i] = wp.min(wp.abs(wp.dot(hit.normal, direction)), 1.0)
    else:
        ranges_out[i] = 0.0
        triangles_out[i] = -1
        cosines_out[i] = 0.0


class Mesh:
    """Triangles that rays can be cast at, kept on one device with a hierarchy of boxes around them.

    Rays hit both sides of a triangle, and never a triangle without an area. The mesh need be neither watertight nor
    wound consistently. Several threads may use one mesh.

    Args:
        vertices: (V, 3) floating-point, metres, in any frame. They are copied. Vertices far from the frame's origin
            (georeferenced meshes) keep their precision if they are float64.
        triangles: (F, 3) integer, numbers of the vertices.
        device: Torch device, or its name, on which the mesh is kept and the rays are cast.

    Raises:
        TypeError: If an argument is not an array of numbers of the right kind.
        ValueError: If the mesh is empty, a vertex is NaN or infinite, an index is out of bounds, or there is no such
            device.
    """

    def __init__(
        self,
        vertices: torch.Tensor | np.ndarray,
        triangles: torch.Tensor | np.ndarray,
        device: torch.device | str = "cpu",
    ):
        points, faces = torch.as_tensor(vertices), torch.as_tensor(triangles)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
            raise ValueError(f"vertices has shape {tuple(points.shape)}; it should be (V, 3) with V > 0")
        if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise ValueError(f"triangles has shape {tuple(faces.shape)}; it should be (F, 3) with F > 0")
        if not points.is_floating_point():
            raise TypeError(f"vertices is {points.dtype}; it should be floating-point, in metres")
        if faces.is_floating_point() or faces.is_complex() or faces.dtype == torch.bool:
            raise TypeError(f"triangles is {faces.dtype}; it should be an integer type")
        points, faces = points.detach(), faces.detach().to(torch.int64)
        if not (finite := points.isfinite().all(1)).all():
            raise ValueError(
                f"vertices holds {int((~finite).sum())} NaN or infinite of {len(points)}; it should be finite: remove"
                " them first"
            )
        if faces.min() < 0 or faces.max() >= len(points):
            raise ValueError(
                f"triangles runs from {int(faces.min())} to {int(faces.max())}; it should lie in 0..{len(points) - 1}"
            )
        try:
            self.device = torch.empty(0, device=device).device
        except (RuntimeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"device is {device!r}; it should be a device of this machine: {reason}") from None
        initialise()
        # Rays are cast in float32, which resolves millimetres only up to 10 km from the origin. So the middle of the
        # mesh becomes the origin.
        self._middle = ((points.amin(0) + points.amax(0)).double() / 2).round().to(self.device)
        self._vertices = (points.to(self.device).double() - self._middle).float()
        self._triangles = faces.to(self.device, torch.int32).contiguous()

        # Made when first asked for, since few meshes need both, and under a lock: if two threads made a tree each, one
        # tree would be dropped while rays are on their way through it.
        self._lock = threading.Lock()
        self._tree: wp.Mesh | None = None
        self._clusters: Clusters | None = None
        self._wait()

    def __del__(self) -> None:
        # Warp frees a tree at once, and torch gives clusters to the stream that made them, though rays may still be on
        # their way through either.
        if getattr(self, "_tree", None) is not None or getattr(self, "_clusters", None) is not None:
            self._wait()

    def _wait(self) -> None:
        # What the mesh keeps is made on one stream and used on any other, Warp's included.
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def _get_tree(self) -> wp.Mesh:
        with self._lock:
            if self._tree is None:
                self._tree = self._build_tree()
            return self._tree

    def _build_tree(self) -> wp.Mesh:
        # By default Warp builds a tree fast on CUDA, but rays take longer through it. That suits the mesh of one scan.
        constructor = "sah" if len(self._triangles) > _LARGE else None
        points = wp.from_torch(self._vertices, dtype=wp.vec3)
        indices = wp.from_torch(self._triangles.view(-1), dtype=wp.int32)
        if self.device.type != "cuda":
            return wp.Mesh(points, indices, bvh_constructor=constructor)
        with torch.cuda.device(self.device):  # Warp leaves another device as the current one
            tree = wp.Mesh(points, indices, bvh_constructor=constructor)
        self._wait()
        return tree

    def _get_clusters(self) -> Clusters:
        with self._lock:
            if self._clusters is None:
                self._clusters = cluster_triangles(self._vertices, self._triangles)
                self._wait()
            return self._clusters

    def cast(self, origins: torch.Tensor, directions: torch.Tensor, max_range: float, backend: str = "warp") -> Hits:
        """Finds the nearest hit of each ray.

        Args:
            origins: (..., 3) floating-point, metres, in the frame of the vertices, on the mesh's device.
            directions: (..., 3) of any length but 0. Leading dimensions broadcast against those of `origins`.
            max_range: Metres. Surfaces farther away are not seen.
            backend: "warp", or "torch" for the plain twin in `kernels.reference`, which tries every triangle.

        Returns:
            Hits of the broadcast shape (...).

        Raises:
            TypeError: If rays are not floating-point tensors.
            ValueError: If a shape, device or backend does not fit, a ray is not finite, a direction has length 0, or
                `max_range` is not a positive number.
        """
        check_backend(backend)
        for name, tensor in (("origins", origins), ("directions", directions)):
            check_floating(name, tensor, (torch.float32, torch.float64, torch.float16, torch.bfloat16), "(..., 3)")
            if tensor.ndim == 0 or tensor.shape[-1] != 3:
                raise ValueError(f"{name} has shape {tuple(tensor.shape)}; it should be (..., 3)")
            if tensor.device != self.device:
                raise ValueError(f"{name} is on {tensor.device}; it should be on {self.device}, where the mesh is")
            if not tensor.isfinite().all():
                raise ValueError(f"{name} holds NaN or infinite values; it should be finite")
        if not (directions != 0).any(-1).all():
            raise ValueError("directions holds a direction of length 0; every direction should have a length above 0")
        _check_range(max_range)
        batch, (origins, directions) = broadcast_batch(
            origins=(origins.detach(), 1), directions=(directions.detach(), 1)
        )
        origins = (origins.double() - self._middle).float()
        # Scaled before they become float32, which cannot hold the square of a very large or small length.
        directions = (directions / directions.abs().amax(-1, keepdim=True)).float()
        directions = torch.nn.functional.normalize(directions, dim=-1).contiguous()
        if backend == "torch":
            ranges, triangles, cosines = reference.cast_rays(
                self._vertices, self._triangles, origins, directions, float(max_range)
            )
        else:
            ranges = origins.new_empty(len(origins))
            triangles = torch.empty_like(ranges, dtype=torch.int32)
            cosines = torch.empty_like(ranges)
            inputs = [self._get_tree().id, origins, directions, float(max_range)]
            launch(_cast_rays_kernel, len(origins), inputs, [ranges, triangles, cosines])
        return Hits(ranges.view(batch), triangles.view(batch), cosines.view(batch))

    def project(
        self, pose: torch.Tensor, elevations: torch.Tensor, azimuths: torch.Tensor, max_range: float
    ) -> torch.Tensor:
        """Finds the range along each ray of a range image, whose rays all start at one point, without walking a tree.

        Gives the same ranges as `cast`, except for rays that graze an edge. The time grows with the number of triangles
        within reach, and hardly with that of rays; see `projects_faster`.

        Args:
            pose: (4, 4) transform from the sensor frame to that of the vertices, a rotation and a translation [m]; on
                any device, as are the tables.
            elevations: (H,) rad, of the rows, within ±90 degrees.
            azimuths: (W,) rad, of the columns, all different, within one turn.
            max_range: Metres. Surfaces farther away are not seen.

        Returns:
            (H, W) float32 metres, 0 where nothing is met, on the mesh's device.

        Raises:
            ValueError: If a shape does not fit, `pose` is not a rotation and a translation, a table is empty, not
                finite or out of bounds, or `max_range` is not a positive number.
        """
        _check_pose(pose)
        for name, table in (("elevations", elevations), ("azimuths", azimuths)):
            if table.ndim != 1 or len(table) == 0:
                raise ValueError(f"{name} has shape {tuple(table.shape)}; it should be (N,) with N > 0")
            if not table.isfinite().all():
                raise ValueError(f"{name} holds NaN or infinite values; it should be finite")
        _check_range(max_range)
        if (steepest := float(elevations.abs().max())) > math.pi / 2:
            raise ValueError(f"elevations reaches {steepest} rad; it should lie within ±π/2")
        rising = np.sort(azimuths.numpy(force=True).astype(np.float64))
        if rising[-1] - rising[0] > math.tau * (1 + 1e-6):
            raise ValueError(f"azimuths runs from {rising[0]} to {rising[-1]} rad; it should span at most one turn")
        if (np.diff(rising) == 0).any():
            raise ValueError(
                f"azimuths has {len(np.unique(rising))} values in {len(rising)} columns; they should differ"
            )
        pose = pose.to(self.device).double()
        origin, rotation = pose[:3, 3] - self._middle, pose[:3, :3]
        return project_triangles(self._get_clusters(), origin, rotation, elevations, azimuths, float(max_range))

    def projects_faster(self, position: torch.Tensor, rays: int, max_range: float) -> bool:
        """Tells whether `project` finds the ranges of many rays from one position sooner than `cast`.

        Args:
            position: (3,) metres, in the frame of the vertices.
            rays: How many rays there are.
            max_range: Metres, of the rays.

        Returns:
            Always False on CUDA. On a CPU, `cast` does a ray in the time in which `project` does about four triangles
            within reach.
        """
        if self.device.type != "cpu":
            return False
        return rays > _FEW_RAYS + within_reach(self._get_clusters(), position - self._middle, max_range) / 4


def _check_pose(pose: torch.Tensor) -> None:
    if pose.shape != (4, 4):
        raise ValueError(f"pose has shape {tuple(pose.shape)}; it should be (4, 4)")
    if not pose.isfinite().all():
        raise ValueError("pose holds NaN or infinite values; it should be finite")
    numbers = pose.numpy(force=True).astype(np.float64)
    rotation = numbers[:3, :3]
    skew = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if max(skew, np.abs(numbers[3] - (0, 0, 0, 1)).max()) > _ROTATION or np.linalg.det(rotation) < 0:
        raise ValueError(
            f"pose is {numbers.tolist()}; it should be a rotation and a translation, with last row 0 0 0 1"
        )


def _check_range(max_range: float) -> None:
    if not isinstance(max_range, Real) or not max_range > 0:
        raise ValueError(f"max_range is {max_range}; it should be a number of metres above 0")
