"""The pattern of a LiDAR without rows."""

import math

import pytest
import torch

from ilnet.world import rosette, simulate
from kernels import Mesh


def test_rays_are_unit_vectors_that_fill_the_field_of_view():
    rays = rosette.directions(20_000)
    torch.testing.assert_close(rays.norm(dim=1), torch.ones(20_000, dtype=torch.float64))
    off = rays[:, 0].arccos().rad2deg()
    assert 19.1 < off.max() <= 19.2 + 1e-9
    assert off.min() < 0.1
    # All around, and not only in some petals.
    around = torch.atan2(rays[:, 2], rays[:, 1])
    assert torch.histc(around.float(), 36, -math.pi, math.pi).min() > 200


def test_the_pattern_goes_on_and_does_not_repeat():
    first, second = rosette.directions(10_000), rosette.directions(10_000, start=10_000)
    torch.testing.assert_close(torch.cat((first, second)), rosette.directions(20_000))
    nearest = torch.cdist(second[::50], first).min(dim=1).values
    assert (nearest > math.radians(0.05)).double().mean() > 0.3  # new directions, where a turning sensor has none
    with pytest.raises(ValueError, match="count and start are 1 and -1"):
        rosette.directions(1, -1)


def test_a_wall_is_met():
    wall = Mesh(torch.tensor([[5.0, -9, -9], [5, 9, -9], [5, 9, 9], [5, -9, 9]]), torch.tensor([[0, 1, 2], [0, 2, 3]]))
    rays = rosette.directions(500)
    found = simulate.cast(wall, simulate.pose((0.0, 0.0, 0.0)), rays, 50.0)
    torch.testing.assert_close(
        found.double() * rays[:, 0], torch.full((500,), 5.0, dtype=torch.float64), atol=1e-4, rtol=0
    )
