"""A town of two streets that cross, for tests of drives and of what stands beside them."""

import numpy as np

from ilnet.world import places, towns
from ilnet.world.towns import parts
from ilnet.world.towns.town import WAYPOINT_SPACING

REACH = 120.0


def crossing():
    """Flat ground, a lane eastwards, one northwards, houses beside them, and a pole 10 m east of where they cross."""
    at = np.arange(-REACH, REACH, WAYPOINT_SPACING)
    zero = np.zeros_like(at)
    lanes = np.column_stack([at, zero, zero]), np.column_stack([zero, at + 90, zero])
    along = np.arange(-REACH, 2 * REACH, 6.0)
    along = along[np.abs(along) > 30]
    rng = np.random.default_rng(0)
    rows = []
    for side in (1, -1):
        near, height = rng.uniform(5, 9, len(along)), rng.uniform(3, 12, len(along))
        low, high = side * near - 2, side * near + 2
        rows += [parts.boxes(np.stack([along, low, 0 * low], 1), np.stack([along + 4, high, height], 1))]
        rows += [parts.boxes(np.stack([low, along, 0 * low], 1), np.stack([high, along + 4, height], 1))]
    ground = parts.quads([[-300, -300, 0], [300, -300, 0], [300, 300, 0], [-300, 300, 0]])
    pole = parts.boxes([9.9, 2.9, 0], [10.1, 3.1, 4])
    whole = parts.merge([ground, *rows, pole])
    count = len(whole.triangles)
    town = towns.Town(
        "crossing",
        0,
        whole.vertices.astype(np.float32),
        whole.triangles.astype(np.int32),
        np.concatenate(lanes).astype(np.float32),
        np.repeat(np.float32([0, np.pi / 2]), len(at)),
        np.float32([[-40, -4, 0, 0], [60, -4, 0, 0]]),
        np.float32([[20, 5, 0, 0], [8, -5, 0, 0], [5, 40, 0, 0]]),
        np.int32([[count - len(pole.triangles), count]]),
    )
    return places.Place(town.vertices, town.triangles, town.waypoints, town.headings, town)
