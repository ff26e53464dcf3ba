"""Buildings, from sheds to churches.

In a building's own frame the front runs along x, centred, at y = 0 and faces -y. The ground is z = 0. Lengths are in
metres.
"""

import numpy as np
from numpy.typing import ArrayLike

from ilnet.world.towns.furniture import railing
from ilnet.world.towns.parts import Part, boxes, loft, merge, place, quads, shift, tubes

__all__ = ["barn", "block", "church", "hall", "house", "shed", "tower"]

_FOOTING = 4.0  # Walls go this deep [m], so that sloping ground opens no gap under them.
_SEEN = (
    24.0  # Walls have no openings above this [m]: no ray of a LiDAR in the street meets them there within its range.
)


def _wall(width: float, low: float, high: float, openings: ArrayLike, depth: ArrayLike) -> Part:
    """Returns a wall along +x from the origin that faces -y, with recessed openings.

    Args:
        width: Length along x, metres.
        low: Height of its foot, metres.
        high: Height of its top, metres.
        openings: (K, 4) bounds x0, x1, z0, z1 of openings that do not overlap, metres.
        depth: Scalar or (K,) depth of the openings, metres.
    """
    openings = np.asarray(openings, dtype=np.float64).reshape(-1, 4)
    depth = np.broadcast_to(np.asarray(depth, dtype=np.float64), (len(openings),))
    x = np.unique(np.concatenate([[0, width], openings[:, :2].ravel()]))
    z = np.unique(np.concatenate([[low, high], openings[:, 2:].ravel()]))
    mid_x, mid_z = 0.5 * (x[:-1] + x[1:]), 0.5 * (z[:-1] + z[1:])
    inside = (
        (mid_x[None, :, None] > openings[:, 0, None, None])
        & (mid_x[None, :, None] < openings[:, 1, None, None])
        & (mid_z[None, None] > openings[:, 2, None, None])
        & (mid_z[None, None] < openings[:, 3, None, None])
    )
    back = (inside * depth[:, None, None]).sum(0)
    solid = (back == 0).all(0)
    i, j = np.nonzero(np.broadcast_to(~solid, back.shape))
    k = np.nonzero(solid)[0]
    x0 = np.concatenate([x[i], np.zeros(len(k))])
    x1 = np.concatenate([x[i + 1], np.full(len(k), width)])
    z0, z1 = np.concatenate([z[j], z[k]]), np.concatenate([z[j + 1], z[k + 1]])
    y = np.concatenate([back[i, j], np.zeros(len(k))])
    faces = [np.stack([np.stack(c, 1) for c in ((x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1))], 1)]
    padded = np.pad(back, ((1, 1), (0, 0)))
    i, j = np.nonzero(padded[1:] != padded[:-1])
    p, q, xs = padded[i, j], padded[i + 1, j], x[i]
    corners = ((xs, p, z[j]), (xs, q, z[j]), (xs, q, z[j + 1]), (xs, p, z[j + 1]))
    faces.append(np.stack([np.stack(c, 1) for c in corners], 1))
    padded = np.pad(back, ((0, 0), (1, 1)))
    i, j = np.nonzero(padded[:, 1:] != padded[:, :-1])
    p, q, zs = padded[i, j], padded[i, j + 1], z[j]
    corners = ((x[i], p, zs), (x[i + 1], p, zs), (x[i + 1], q, zs), (x[i], q, zs))
    faces.append(np.stack([np.stack(c, 1) for c in corners], 1))
    return quads(np.concatenate(faces))


def _windows(width: float, pitch: float, size: tuple[float, float], sill: float) -> np.ndarray:
    """Returns the openings (K, 4) of one storey, evenly spread over a wall, as `_wall` takes them.

    Args:
        width: Length of the wall, metres.
        pitch: Smallest distance from one opening to the next, metres.
        size: Width and height of an opening, metres.
        sill: Height of the lower edge, metres.
    """
    count = max(int((width - 0.8) / pitch), 0)
    centre = (np.arange(count) + 0.5) * width / max(count, 1)
    one = np.ones(count)
    return np.column_stack([centre - size[0] / 2, centre + size[0] / 2, sill * one, (sill + size[1]) * one])


def _around(walls: list[Part], width: float, depth: float, front: float = 0.0) -> Part:
    """Returns four walls (front, right, back, left) around a footprint whose front is at y = `front`; all in metres."""
    half = width / 2
    at = [(-half, front, 0), (half, front, 0), (half, depth, 0), (-half, depth, 0)]
    return merge([place(w, p, k * np.pi / 2) for k, (w, p) in enumerate(zip(walls, at, strict=True))])


def _trim(openings: np.ndarray, rich: int) -> Part:
    """Returns sills for the openings (K, 4) of a wall along +x, and mullions where `rich` is 2."""
    x0, x1, z0, z1 = openings.T
    zero = np.zeros(len(x0))
    low, high = np.column_stack([x0 - 0.1, zero, z0 - 0.08]), np.column_stack([x1 + 0.1, zero, z0])
    out = np.array([0.0, -0.1, 0.0])
    across = (high - low) * (1, 0, 0)
    faces = [(high - across, high, high + out, high - across + out), (low, low + across, low + across + out, low + out)]
    faces.append((low + out, low + across + out, high + out, high - across + out))
    parts = [quads(np.concatenate([np.stack(f, 1) for f in faces]))]
    if rich == 2:
        mid = 0.5 * (x0 + x1)
        parts.append(
            boxes(
                np.column_stack([mid - 0.03, zero + 0.1, z0]), np.column_stack([mid + 0.03, zero + 0.2, z1]), ends=False
            )
        )
    return merge(parts)


def _flat_roof(width: float, depth: float, z: float, parapet: float) -> Part:
    """Returns a flat roof at height `z` with a wall of height `parapet` around it; all in metres."""
    h, t, e = width / 2, 0.25, 0.06
    low = [[-h - e, -e, z], [-h - e, depth - t, z], [-h - e, t, z], [h - t, t, z]]
    high = [[h + e, t, z], [h + e, depth + e, z], [-h + t, depth - t, z], [h + e, depth - t, z]]
    roof = quads([[[-h, 0, z], [h, 0, z], [h, depth, z], [-h, depth, z]]])
    return merge([roof, boxes(low, np.add(high, (0, 0, parapet)))])


def _gable_roof(width: float, depth: float, z: float, rise: float, eaves: float, verge: float) -> Part:
    """Returns two slopes with the ridge along x, gables and gutters.

    Args:
        width: Length of the house along the ridge, metres.
        depth: Length of the house across the ridge, metres.
        z: Height of the walls, metres.
        rise: Height of the ridge above the walls, metres.
        eaves: Overhang beyond front and back, metres.
        verge: Overhang beyond the gables, metres.
    """
    slope, t, mid = rise / (depth / 2), 0.16, depth / 2
    out = z - eaves * slope
    section = np.array(
        [
            [mid, z + rise],
            [-eaves, out],
            [-eaves, out + t],
            [mid, z + rise + t],
            [depth + eaves, out + t],
            [depth + eaves, out],
        ]
    )
    x = np.array([-width / 2 - verge, width / 2 + verge])
    rings = np.concatenate([np.broadcast_to(x[:, None, None], (2, 6, 1)), np.broadcast_to(section, (2, 6, 2))], axis=2)
    ends = np.array(
        [[[s * width / 2, 0, z], [s * width / 2, depth, z], [s * width / 2, mid, z + rise]] for s in (-1, 1)]
    )
    gutter = tubes(
        [[x[0], y, out] for y in (-eaves - 0.06, depth + eaves + 0.06)],
        [[x[1], y, out] for y in (-eaves - 0.06, depth + eaves + 0.06)],
        0.07,
        sides=5,
    )
    return merge([loft(rings), Part(ends.reshape(-1, 3), np.arange(6).reshape(2, 3)), gutter])


def _hip_roof(width: float, depth: float, z: float, rise: float, eaves: float) -> Part:
    """Returns four slopes with an overhang `eaves` on all sides; arguments as for `_gable_roof`."""
    h, e = width / 2, eaves
    low = z - 0.1
    inset = min(depth / 2, 0.8 * h)
    v = [[-h - e, -e, low], [h + e, -e, low], [h + e, depth + e, low], [-h - e, depth + e, low]]
    v += [[-h + inset, depth / 2, z + rise], [h - inset, depth / 2, z + rise]]
    f = [[0, 1, 5], [0, 5, 4], [1, 2, 5], [2, 3, 4], [2, 4, 5], [3, 0, 4], [0, 2, 1], [0, 3, 2]]
    return Part(np.array(v), np.array(f))


def _chimney(x: float, y: float, z: float, height: float) -> Part:
    """Returns a chimney with two pots that rises `height` above z; all in metres."""
    stack = boxes([x - 0.35, y - 0.3, z - 1.5], [x + 0.35, y + 0.3, z + height])
    pots = tubes(
        [[x - 0.15, y, z + height], [x + 0.15, y, z + height]],
        [[x - 0.15, y, z + height + 0.4], [x + 0.15, y, z + height + 0.4]],
        0.1,
        0.08,
        sides=6,
    )
    return merge([stack, pots])


def _balcony(width: float, out: float, solid: bool) -> Part:
    """Returns a balcony in front of a wall at y = 0, centred on x = 0, with its floor at z = 0.

    Args:
        width: Length along the wall, metres.
        out: How far it projects from the wall, metres.
        solid: Whether it has a parapet instead of a railing.
    """
    slab = boxes([-width / 2, -out, -0.16], [width / 2, 0, 0])
    if solid:
        low = [[-width / 2, -out, 0], [-width / 2, -out, 0], [width / 2 - 0.08, -out, 0]]
        high = [[width / 2, -out + 0.08, 0.95], [-width / 2 + 0.08, 0, 0.95], [width / 2, 0, 0.95]]
        return merge([slab, boxes(low, high)])
    front = shift(railing(width, gap=0.2), -width / 2, -out + 0.05)
    sides = place(
        railing(out - 0.05, gap=0.2),
        [[-width / 2 + 0.03, -out + 0.05, 0], [width / 2 - 0.03, -out + 0.05, 0]],
        np.pi / 2,
    )
    return merge([slab, front, sides])


def shed(rng: np.random.Generator, width: float, depth: float, height: float) -> Part:
    """Returns a garage or a shed, with one storey, a wide door and a low roof; all in metres."""
    door = [[width * 0.15, width * 0.8, 0, min(2.3, height - 0.2)]]
    walls = [
        _wall(w, -_FOOTING, height, door if k == 0 else [], 0.2) for k, w in enumerate((width, depth, width, depth))
    ]
    roof = (
        _flat_roof(width, depth, height, 0.12)
        if rng.random() < 0.5
        else _gable_roof(width, depth, height, 0.2 * depth, 0.25, 0.2)
    )
    return merge([_around(walls, width, depth), roof])


def house(rng: np.random.Generator, width: float, depth: float, floors: int, detached: bool) -> Part:
    """Returns a house with a pitched roof, a door and windows; it may have a porch, a chimney or dormers.

    Args:
        rng: Source of the variety.
        width: Length along the street, metres.
        depth: From the front to the back, metres.
        floors: Number of storeys below the roof.
        detached: Whether it stands free, with windows and eaves on all sides.
    """
    storey = rng.uniform(2.7, 3.0)
    base = rng.uniform(0.15, 0.5)
    top = base + storey * floors
    size = (rng.uniform(0.9, 1.5), rng.uniform(1.2, 1.55))
    recess = rng.uniform(0.12, 0.28)
    pitch = rng.uniform(2.2, 2.9)
    sides = (width, depth, width, depth)
    rich = int(rng.integers(0, 3))
    walls: list[Part] = []
    door_x = 0.0
    for k, length in enumerate(sides):
        rows = []
        for floor in range(floors):
            row = _windows(length, pitch if k % 2 == 0 else 3.6, size, base + floor * storey + 0.9)
            if k == 0 and floor == 0 and len(row):
                column = int(rng.integers(0, len(row)))
                door_x = row[column, :2].mean()
                row[column] = door_x - 0.5, door_x + 0.5, base, base + 2.15
            rows.append(row)
        openings = np.concatenate(rows)
        if not detached and k % 2 == 1:
            openings = openings[:0]
        part = _wall(length, -_FOOTING, top, openings, recess)
        walls.append(merge([part, _trim(openings, rich)]) if rich and len(openings) and k == 0 else part)
    parts = [_around(walls, width, depth)]
    door_x -= width / 2
    rise = depth / 2 * np.tan(np.radians(rng.uniform(28, 46)))
    kind = rng.random()
    if detached and kind < 0.35:
        parts.append(_hip_roof(width, depth, top, 0.8 * rise, 0.55))
    elif detached and kind < 0.6:  # gable to the street
        turned = _gable_roof(depth, width, top, 0.8 * rise * width / depth, 0.5, 0.45)
        parts.append(place(turned, (width / 2, depth / 2, 0), np.pi / 2))
    else:
        parts.append(_gable_roof(width, depth, top, rise, 0.45, 0.35 if detached else 0.0))
        for x in np.arange(-width / 2 + 2.0, width / 2 - 1.8, 3.2)[: int(rng.integers(0, 4))]:
            y = 0.22 * depth
            z = top + 0.44 * rise
            front = _wall(1.5, z - 0.8, z + 1.3, [[0.25, 1.25, z + 0.1, z + 1.1]], 0.12)
            cheeks = boxes(
                [[x, y + 0.01, z - 0.8], [x + 1.45, y + 0.01, z - 0.8]],
                [[x + 0.05, depth / 2, z + 1.3], [x + 1.5, depth / 2, z + 1.3]],
            )
            parts += [shift(front, x, y), cheeks, boxes([x - 0.15, y - 0.2, z + 1.3], [x + 1.65, depth / 2, z + 1.42])]
    if rng.random() < 0.7:
        parts.append(
            _chimney(
                rng.uniform(-0.3, 0.3) * width, depth * rng.uniform(0.45, 0.65), top + 0.8 * rise, rng.uniform(0.9, 1.6)
            )
        )
    steps = boxes([door_x - 0.7, -0.45, -0.6], [door_x + 0.7, 0, base])
    parts += [steps, boxes([door_x - 0.8, -0.85, -0.6], [door_x + 0.8, -0.4, 0.5 * base])]
    style = rng.random()
    if style < 0.35:  # a canopy
        parts.append(boxes([door_x - 0.9, -0.9, base + 2.35], [door_x + 0.9, 0, base + 2.45]))
    elif detached and style < 0.7:  # a porch on posts
        posts = [[door_x + s, -1.5, -0.5] for s in (-1.1, 1.1)]
        parts.append(tubes(posts, np.add(posts, (0, 0, base + 2.9)), 0.07, sides=6))
        parts.append(shift(_gable_roof(2.6, 3.4, base + 2.4, 0.7, 0.1, 0.1), door_x, -1.75))
        parts.append(place(railing(1.0, 0.95), (door_x - 1.1, -1.5, base), 0.0))
    if detached and rng.random() < 0.4:  # a bay window
        x = -np.sign(door_x) * 0.27 * width if door_x else 0.27 * width
        bay = _wall(2.2, -_FOOTING, base + 2.6, [[0.25, 1.95, base + 0.8, base + 2.2]], 0.1)
        parts += [
            shift(bay, x - 1.1, -0.8),
            boxes([[x - 1.1, -0.79, -1], [x + 1.04, -0.79, -1]], [[x - 1.04, 0, base + 2.6], [x + 1.1, 0, base + 2.6]]),
        ]
        parts.append(boxes([x - 1.25, -0.95, base + 2.6], [x + 1.25, 0, base + 2.72]))
    pipe_x = width / 2 - 0.2
    parts.append(tubes([pipe_x, -0.08, 0], [pipe_x, -0.08, top - 0.2], 0.045, sides=5))
    return merge(parts)


def block(rng: np.random.Generator, width: float, depth: float, floors: int, ground_floor: str, roof: str) -> Part:
    """Returns a block of flats, offices or shops.

    Args:
        rng: Source of the variety.
        width: Length along the street, metres.
        depth: From the front to the back, metres.
        floors: Number of storeys with the ground floor.
        ground_floor: "shops", "arcade", "passage" or "flats".
        roof: "flat" or "pitched".
    """
    storey = rng.uniform(2.9, 3.4)
    first = rng.uniform(3.6, 4.4) if ground_floor in ("shops", "arcade") else storey + 0.4
    top = first + storey * (floors - 1)
    size = (rng.uniform(1.0, 1.9), rng.uniform(1.3, 1.9))
    pitch = size[0] + rng.uniform(1.1, 1.9)
    recess = rng.uniform(0.14, 0.32)
    rich = int(rng.integers(0, 3)) if floors < 7 else 0
    front_y = 2.8 if ground_floor == "arcade" else 0.0
    sides = (width, depth, width, depth)
    parts: list[Part] = []
    lower: list[Part] = []
    upper: list[Part] = []
    row = _windows(width, pitch, size, 0.9)
    for k, length in enumerate(sides):
        length_low = length - front_y if k % 2 else length
        openings = _windows(length_low, pitch, size, 1.1)
        depths = np.full(len(openings), recess)
        if k == 0 and ground_floor in ("shops", "arcade"):
            openings = _windows(length_low, 4.2, (3.2, 2.5), 0.35)
            depths = rng.choice([0.2, 0.35, 1.4], len(openings))
            openings[:, 2] = np.where(depths > 1, 0.02, openings[:, 2])
        elif k == 0 and len(openings):
            column = len(openings) // 2
            centre = openings[column, :2].mean()
            half, height, deep = (1.25, 3.0, 0.75 * depth) if ground_floor == "passage" else (0.7, 2.3, 0.5)
            keep = np.abs(openings[:, :2].mean(1) - centre) > half + size[0] / 2 + 0.05
            openings = np.concatenate([openings[keep], [[centre - half, centre + half, 0.02, height]]])
            depths = np.concatenate([depths[keep], [deep]])
        lower.append(_wall(length_low, -_FOOTING, first, openings, depths))
        openings = row if k == 0 else _windows(length, 2.2 * pitch, size, 0.9)
        part = _wall(length, 0.0, storey, openings, recess)
        upper.append(merge([part, _trim(openings, rich)]) if rich and len(openings) and k == 0 else part)
    parts.append(_around(lower, width, depth, front_y))
    levels = first + storey * np.arange(floors - 1)
    detailed = levels[levels < _SEEN]
    parts.append(place(_around(upper, width, depth), np.column_stack([np.zeros((len(detailed), 2)), detailed])))
    if len(detailed) < len(levels):
        bare = [_wall(length, levels[len(detailed)], top, [], 0.0) for length in sides]
        parts.append(_around(bare, width, depth))
    if front_y:
        h = width / 2
        ceiling = quads([[[-h, 0, first], [h, 0, first], [h, front_y, first], [-h, front_y, first]]])
        x = np.linspace(-h + 0.3, h - 0.3, max(2, round(width / 3.6) + 1))
        low = np.column_stack([x - 0.28, 0 * x + 0.02, 0 * x - _FOOTING])
        parts += [ceiling, boxes(low, np.column_stack([x + 0.28, 0 * x + 0.55, 0 * x + first]))]
        parts.append(boxes([-h, 0, first - 0.45], [h, 0.5, first]))
    if ground_floor != "flats" and rng.random() < 0.6:  # a sign on a bracket
        plate = boxes([-0.04, -0.95, -0.3], [0.04, -0.25, 0.6])
        bracket = tubes([0, 0, 0.5], [0, -0.3, 0.5], 0.02, sides=3, caps=False)
        parts.append(shift(merge([plate, bracket]), rng.uniform(-0.4, 0.4) * width, 0.0, first))
    if ground_floor == "shops" and rng.random() < 0.7:  # a shop sign and awnings
        parts.append(boxes([-width / 2 + 0.3, -0.18, first - 0.75], [width / 2 - 0.3, 0, first - 0.2]))
        for x in np.arange(-width / 2 + 1.0, width / 2 - 3.4, 4.4)[: int(rng.integers(0, 4))]:
            z = first - 0.8
            parts.append(quads([[[x, -0.05, z], [x + 3, -0.05, z], [x + 3, -1.1, z - 0.45], [x, -1.1, z - 0.45]]]))
            parts.append(
                quads([[[x, -1.1, z - 0.45], [x + 3, -1.1, z - 0.45], [x + 3, -1.1, z - 0.65], [x, -1.1, z - 0.65]]])
            )
    if len(row) > 2 and rng.random() < (0.7 if ground_floor in ("flats", "passage") else 0.35):
        proto = _balcony(min(pitch - 0.3, 3.4), rng.uniform(1.0, 1.5), solid=rng.random() < 0.5)
        x = row[:, :2].mean(1) - width / 2
        pick = np.arange(len(x)) % int(rng.integers(3, 5)) == 1
        seen = levels[:3]  # Rays do not reach higher balconies.
        at = np.stack(np.meshgrid(x[pick], [0.0], seen + 0.05, indexing="ij"), -1).reshape(-1, 3)
        parts.append(place(proto, at))
    if roof == "flat":
        parts.append(_flat_roof(width, depth, top, rng.uniform(0.3, 1.0)))
        box = rng.uniform((-0.3, 0.3), (0.2, 0.5)) * (width, depth)
        parts.append(boxes([box[0], box[1], top], [box[0] + 3.2, box[1] + 3.0, top + 2.4]))
    else:
        rise = depth / 2 * np.tan(np.radians(rng.uniform(25, 40)))
        parts.append(_gable_roof(width, depth, top, rise, 0.5, 0.1))
        for x in rng.uniform(-0.42, 0.42, 2) * width:
            parts.append(_chimney(x, depth * 0.5, top + rise, 1.2))
    if rng.random() < 0.6:
        parts.append(boxes([-width / 2 - 0.08, -0.12, first - 0.12], [width / 2 + 0.08, 0.0, first + 0.1]))
    x = np.array([-width / 2 + 0.15, width / 2 - 0.15])
    parts.append(
        tubes(np.column_stack([x, x * 0 - 0.08, x * 0]), np.column_stack([x, x * 0 - 0.08, x * 0 + top]), 0.05, sides=5)
    )
    return merge(parts)


def hall(rng: np.random.Generator, width: float, depth: float, height: float) -> Part:
    """Returns a warehouse or factory hall with roller doors, ribs, high windows, and docks or a canopy.

    Args:
        rng: Source of the variety.
        width: Length along the street, metres.
        depth: From the front to the back, metres.
        height: Height of the walls, metres.
    """
    doors = _windows(width, rng.uniform(6, 9), (rng.uniform(3.2, 4.2), rng.uniform(3.6, 4.4)), 0.05)
    doors = doors[rng.random(len(doors)) < 0.7]
    dock = rng.random() < 0.5
    if dock:  # A lorry backs up to these doors.
        doors[:, 2:] += (1.1, 0.0)
    depths = rng.choice([0.25, 0.5, 7.0], len(doors), p=[0.5, 0.3, 0.2])
    high = _windows(width, 5.0, (3.4, 1.1), height - 1.9)
    if height < 7.5:
        high = high[:0]
    walls = [
        _wall(width, -_FOOTING, height, np.concatenate([doors, high]), np.append(depths, np.full(len(high), 0.15)))
    ]
    for length in (depth, width, depth):
        row = _windows(length, 6.0, (3.0, 1.2), height - 2.4)
        walls.append(_wall(length, -_FOOTING, height, row, 0.15))
    parts = [_around(walls, width, depth)]
    x = np.arange(-width / 2 + 0.1, width / 2, 5.0)
    free = ~((x[:, None] > doors[:, 0] - width / 2 - 0.3) & (x[:, None] < doors[:, 1] - width / 2 + 0.2)).any(1)
    low = np.column_stack([x, 0 * x - 0.12, 0 * x - 1.0])[free]
    parts.append(boxes(low, np.add(low, (0.2, 0.14, height + 1.0))))
    kind = rng.random()
    if kind < 0.35:
        parts.append(_flat_roof(width, depth, height, rng.uniform(0.4, 1.2)))
        low = np.column_stack([rng.uniform(-0.4, 0.3, 3) * width, rng.uniform(0.2, 0.7, 3) * depth, np.full(3, height)])
        parts.append(boxes(low, np.add(low, (2.4, 1.8, 1.5))))
    elif kind < 0.7:
        parts.append(_gable_roof(width, depth, height, 0.09 * depth, 0.3, 0.2))
    else:  # saw teeth
        count = max(2, round(width / 8))
        edge = np.linspace(-width / 2, width / 2, count + 1)
        tooth = np.zeros((count, 2, 3, 3))
        tooth[:, 1, :, 1] = depth
        tooth[..., 0] = np.stack([edge[:-1], edge[1:], edge[1:]], 1)[:, None]
        tooth[..., 2] = height + np.array([0.0, 0.0, 2.2])
        a, b, c = tooth[:, :, 0], tooth[:, :, 1], tooth[:, :, 2]
        parts.append(quads(np.stack([a[:, 0], c[:, 0], c[:, 1], a[:, 1]], 1)))
        parts.append(quads(np.stack([b[:, 0], c[:, 0], c[:, 1], b[:, 1]], 1)))
        parts.append(Part(tooth.reshape(-1, 3), np.arange(6 * count).reshape(-1, 3)))
    if dock:
        buffers = np.column_stack([doors[:, :2].mean(1) - width / 2, 0 * doors[:, 0], 0 * doors[:, 0]])
        parts.append(place(boxes([[-2.1, -0.35, 0.6], [1.7, -0.35, 0.6]], [[-1.7, 0, 1.1], [2.1, 0, 1.1]]), buffers))
    elif rng.random() < 0.6:
        reach = rng.uniform(2.0, 4.5)
        parts.append(boxes([-width / 2 + 1, -reach, 5.0], [width / 2 - 1, 0, 5.3]))
        x = np.arange(-width / 2 + 1.5, width / 2 - 1, 7.0)
        posts = np.column_stack([x, 0 * x - reach + 0.3, 0 * x - 0.5])
        parts.append(tubes(posts, np.add(posts, (0, 0, 5.5)), 0.1, sides=6))
    return merge(parts)


def barn(rng: np.random.Generator, width: float, depth: float) -> Part:
    """Returns a barn with a steep roof: with a tall gate and slits, or with posts and an open front; all in metres."""
    height = rng.uniform(3.6, 5.0)
    roof = _gable_roof(width, depth, height, rng.uniform(0.3, 0.42) * depth, 0.5, 0.4)
    if rng.random() < 0.35:
        back = [_wall(w, -_FOOTING, height, [], 0.0) for w in (depth, width, depth)]
        at = [(width / 2, 0, 0), (width / 2, depth, 0), (-width / 2, depth, 0)]
        walls = [place(w, p, (k + 1) * np.pi / 2) for k, (w, p) in enumerate(zip(back, at, strict=True))]
        x = np.linspace(-width / 2 + 0.2, width / 2 - 0.2, max(3, round(width / 4.5)))
        posts = np.column_stack([x, 0 * x + 0.15, 0 * x - 1.0])
        bales = tubes([[0, 0, 0.7]], [[0, 1.2, 0.7]], 0.7, sides=10)
        stack = np.column_stack([np.arange(4) * 1.5 - width / 4, np.full(4, depth - 3.0), np.zeros(4)])
        return merge(
            [*walls, tubes(posts, np.add(posts, (0, 0, height + 1)), 0.13, sides=6), roof, place(bales, stack)]
        )
    gate = [[width / 2 - 1.9, width / 2 + 1.9, 0.0, height - 0.3]]
    slits = _windows(width, 3.2, (0.25, 1.0), 1.8)
    slits = slits[np.abs(slits[:, :2].mean(1) - width / 2) > 2.3]
    front = _wall(
        width, -_FOOTING, height, np.concatenate([gate, slits]), [rng.choice([0.3, 5.0]), *([0.3] * len(slits))]
    )
    others = [_wall(w, -_FOOTING, height, _windows(w, 3.4, (0.25, 1.0), 1.8), 0.3) for w in (depth, width, depth)]
    return merge([_around([front, *others], width, depth), roof])


def church(rng: np.random.Generator) -> Part:
    """Returns a church: a tower with a porch and a spire, and behind it a nave with buttresses and tall windows."""
    side, width, depth = rng.uniform(6.0, 7.5), rng.uniform(11, 14), rng.uniform(24, 30)
    top, height = rng.uniform(17, 22), rng.uniform(8.0, 9.5)
    belfry = [[side / 2 - 1.0, side / 2 + 1.0, top - 4.5, top - 1.5]]
    porch = [[side / 2 - 1.2, side / 2 + 1.2, 0.3, 4.0]]
    slit = [[side / 2 - 0.3, side / 2 + 0.3, 7.0, 9.5]]
    tower = _around(
        [
            _wall(
                side,
                -_FOOTING,
                top,
                [*(porch if k == 0 else []), *slit, *belfry],
                [*([1.5] if k == 0 else []), 0.4, 0.8],
            )
            for k in range(4)
        ],
        side,
        side,
    )
    spire = tubes([0, side / 2, top], [0, side / 2, top + 14], side / 2 * 1.35, 0.05, sides=8)
    windows = _windows(depth, 4.2, (1.3, 4.2), 2.2)
    nave = [
        _wall(w, -_FOOTING, height, windows if k % 2 else [], 0.5) for k, w in enumerate((width, depth, width, depth))
    ]
    roof = place(_gable_roof(depth, width, height, 0.55 * width, 0.4, 0.2), (width / 2, depth / 2, 0), np.pi / 2)
    y = np.linspace(0.3, depth - 0.9, len(windows) + 1)
    low = np.concatenate(
        [np.column_stack([np.full(len(y), s), y, np.full(len(y), -1.0)]) for s in (-width / 2 - 0.9, width / 2)]
    )
    buttresses = boxes(low, np.add(low, (0.9, 0.6, height - 0.5)))
    steps = boxes([[-3, -1.8, -0.6], [-2.6, -1.2, -0.6]], [[3, 0, 0.15], [2.6, 0, 0.3]])
    return merge([tower, spire, steps, shift(merge([_around(nave, width, depth), roof, buttresses]), y=side - 0.5)])


def tower(rng: np.random.Generator, width: float, depth: float, floors: int, ground_floor: str) -> Part:
    """Returns an office tower: a shaft with bands and no windows, set back on a podium of shops.

    Args:
        rng: Source of the variety.
        width: Length along the street, metres.
        depth: From the front to the back, metres.
        floors: Number of storeys in all.
        ground_floor: As for `block`.
    """
    podium = block(rng, width, depth, int(rng.integers(2, 6)), ground_floor, "flat")
    base = float(podium.vertices[:, 2].max())
    top, inset = 3.2 * floors, rng.uniform(1.5, 4.0, 3)
    low, high = (
        np.array([-width / 2 + inset[0], inset[1], 5.0]),
        np.array([width / 2 - inset[0], depth - inset[2], top]),
    )
    z = np.arange(base + 0.5, top, rng.choice([3.2, 6.4, 9.6]))[:, None]
    out = np.array([0.25, 0.25, 0.0])
    bands = boxes(
        np.column_stack([np.repeat((low - out)[None, :2], len(z), 0), z]),
        np.column_stack([np.repeat((high + out)[None, :2], len(z), 0), z + 0.9]),
    )
    cap = boxes([low[0] + 3, low[1] + 3, top], [high[0] - 3, high[1] - 3, top + rng.uniform(2, 5)])
    return merge([podium, boxes(low, high), bands, cap])
