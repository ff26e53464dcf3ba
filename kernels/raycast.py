"""A mesh and its rays: nearest hits through Warp's bounding volume hierarchy, one thread a ray."""

from typing import NamedTuple

import numpy as np
import torch
import warp as wp

from kernels.launch import initialise, launch

__all__ = ["Hits", "Mesh"]

# Metres. A hit nearer than this is the sensor's own surface to float32; it also keeps "0 = none" unambiguous.
_LEAST_RANGE = 1e-6


class Hits(NamedTuple):
    """What rays met; all tensors have the rays' batch shape."""

    range: torch.Tensor
    """float32 [m], distance along the unit direction; 0 = nothing within the maximum range."""
    triangle: torch.Tensor
    """int32, number of the triangle that was hit; -1 = none."""
    cosine: torch.Tensor
    """float32 in [0, 1], of the angle between ray and surface normal, whichever way it points; 0 = none."""


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
    direction = wp.normalize(wp.vec3(directions[i, 0], directions[i, 1], directions[i, 2]))
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

    Both sides of a triangle are hit; triangles without an area never are. The mesh need not be watertight nor wound
    consistently.

    Args:
        vertices: (V, 3) floating-point, metres, in any frame; copied to float32.
        triangles: (F, 3) integer, numbers of the vertices.
        device: Where the mesh is kept and the rays are cast; a torch device or its name.

    Raises:
        TypeError: If an argument is not an array of numbers of the right kind.
        ValueError: If the mesh is empty, a vertex is NaN or infinite, or an index is out of bounds.
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
        if not (finite := points.isfinite().all(1)).all():
            raise ValueError(
                f"vertices holds {int((~finite).sum())} NaN or infinite of {len(points)}; remove them first"
            )
        if faces.min() < 0 or faces.max() >= len(points):
            raise ValueError(
                f"triangles runs from {int(faces.min())} to {int(faces.max())}; it should lie in 0..{len(points) - 1}"
            )
        initialise()
        self.device = torch.device(device)
        name = str(self.device)
        self._mesh = wp.Mesh(
            points=wp.array(points.detach().cpu().float().numpy(), dtype=wp.vec3, device=name, copy=True),
            indices=wp.array(faces.detach().cpu().int().numpy().reshape(-1), dtype=wp.int32, device=name, copy=True),
        )

    def cast(self, origins: torch.Tensor, directions: torch.Tensor, max_range: float) -> Hits:
        """Finds the nearest hit of each ray.

        Args:
            origins: (..., 3) floating-point, metres, in the frame of the vertices, on the mesh's device.
            directions: (..., 3) of any length but 0; leading dimensions broadcast against those of `origins`.
            max_range: Metres; farther surfaces are not seen.

        Returns:
            Hits of the broadcast shape (...).

        Raises:
            TypeError: If rays are not floating-point tensors.
            ValueError: If a shape or device does not fit, a ray is not finite, a direction has length 0, or
                `max_range` is not positive.
        """
        for name, rays in (("origins", origins), ("directions", directions)):
            if not isinstance(rays, torch.Tensor) or not rays.is_floating_point():
                kind = getattr(rays, "dtype", type(rays).__name__)
                raise TypeError(f"{name} is {kind}; it should be a floating-point tensor (..., 3)")
            if rays.ndim == 0 or rays.shape[-1] != 3:
                raise ValueError(f"{name} has shape {tuple(rays.shape)}; it should be (..., 3)")
            if rays.device.type != self.device.type:
                raise ValueError(f"{name} is on {rays.device}, the mesh on {self.device}; they should be on one device")
            if not rays.isfinite().all():
                raise ValueError(f"{name} holds NaN or infinite values")
        if not (directions != 0).any(-1).all():
            raise ValueError("directions holds a direction of length 0; each should point somewhere")
        if not max_range > 0:
            raise ValueError(f"max_range is {max_range}; it should be above 0 m")
        origins, directions = torch.broadcast_tensors(origins.detach().float(), directions.detach().float())
        batch = origins.shape[:-1]
        origins, directions = origins.reshape(-1, 3), directions.reshape(-1, 3)
        ranges = origins.new_empty(len(origins))
        triangles = torch.empty_like(ranges, dtype=torch.int32)
        cosines = torch.empty_like(ranges)
        launch(
            _cast_rays_kernel,
            len(origins),
            [self._mesh.id, origins, directions, float(max_range)],
            [ranges, triangles, cosines],
        )
        return Hits(ranges.view(batch), triangles.view(batch), cosines.view(batch))
