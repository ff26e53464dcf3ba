"""Barriers, and what stands on highways, yards, farms and squares.

Each structure stands at the origin on z = 0, in metres; its front faces +x. Copies are placed in the town.
"""

import numpy as np

from ilnet.world.towns.furniture import railing
from ilnet.world.towns.parts import Panel, Part, boxes, loft, merge, place, quads, shift, tubes
from ilnet.world.towns.vehicles import pedestrian, wheels

__all__ = [
    "PYLON_ARMS",
    "TRAM_WIRE_HEIGHT",
    "bale",
    "bank",
    "concrete_barrier",
    "container",
    "fountain",
    "gantry",
    "guard_rail",
    "mesh_fence",
    "noise_wall",
    "overpass",
    "parasol",
    "post_and_rail",
    "pylon",
    "scaffold",
    "silo",
    "stall",
    "statue",
    "stone_wall",
    "tank",
    "trailer",
    "tram_mast",
]


# Reach and height of the crossarms of a pylon [m]; wires hang 0.2 m below.
PYLON_ARMS = ((3.2, 13.0), (4.0, 15.5), (2.8, 18.0))
# Height of the wire over a tram [m].
TRAM_WIRE_HEIGHT = 5.6


def _extrude(section: list[tuple[float, float]], length: float) -> Part:
    """Returns a closed section of points (y, z) extruded along +x from the origin; all in metres."""
    yz = np.array(section, dtype=np.float64)
    rings = np.zeros((2, len(yz), 3))
    rings[1, :, 0] = length
    rings[:, :, 1:] = yz
    return loft(rings)


def guard_rail() -> Panel:
    """Returns 4 m of guard rail: posts, and a folded steel beam on the side of -y."""
    beam = [
        (0.0, 0.45),
        (-0.08, 0.5),
        (-0.08, 0.56),
        (0.0, 0.61),
        (-0.08, 0.66),
        (-0.08, 0.72),
        (0.0, 0.77),
        (0.02, 0.6),
    ]
    posts = boxes([[x, 0.02, -0.6] for x in (0.5, 2.5)], [[x + 0.1, 0.14, 0.75] for x in (0.5, 2.5)])
    return Panel(merge([_extrude(beam, 4.0), posts]), 4.0)


def concrete_barrier() -> Panel:
    """Returns 4 m of the low wall between two carriageways, with a gap before the next piece."""
    section = [
        (-0.32, -0.3),
        (-0.32, 0.08),
        (-0.18, 0.33),
        (-0.1, 0.9),
        (0.1, 0.9),
        (0.18, 0.33),
        (0.32, 0.08),
        (0.32, -0.3),
    ]
    return Panel(_extrude(section, 3.94), 4.0)


def noise_wall(height: float) -> Panel:
    """Returns 4 m of noise wall: a post, and planks of which every other one is recessed; `height` in metres."""
    z = np.arange(0.0, height - 0.2, 0.5)
    back = 0.05 * (np.arange(len(z)) % 2)
    zero = np.zeros(len(z))
    planks = boxes(
        np.column_stack([zero + 0.1, back - 0.06, z - 0.4 * (z == 0)]),
        np.column_stack([zero + 3.9, back + 0.06, z + 0.5]),
    )
    post = boxes([-0.12, -0.14, -0.5], [0.12, 0.14, height + 0.1])
    return Panel(merge([planks, post]), 4.0)


def mesh_fence() -> Panel:
    """Returns 3 m of wire fence, 2.2 m high: a post, rails, and every fourth upright of its mesh."""
    post = tubes([0, 0, -0.4], [0, 0, 2.2], 0.035, sides=5)
    arm = tubes([0, 0, 2.2], [0, -0.3, 2.5], 0.03, sides=4)
    rails = tubes([[0, 0, z] for z in (0.08, 1.1, 2.15)], [[3, 0, z] for z in (0.08, 1.1, 2.15)], 0.022, caps=False)
    x = np.arange(0.2, 3.0, 0.2)
    rods = tubes([[v, 0, 0.08] for v in x], [[v, 0, 2.15] for v in x], 0.006, sides=3, caps=False)
    return Panel(merge([post, arm, rails, rods]), 3.0)


def post_and_rail() -> Panel:
    """Returns 2.5 m of paddock fence."""
    post = boxes([-0.06, -0.06, -0.4], [0.06, 0.06, 1.25])
    rails = boxes([[0, 0.05, z] for z in (0.35, 0.7, 1.05)], [[2.5, 0.09, z + 0.12] for z in (0.35, 0.7, 1.05)])
    return Panel(merge([post, rails]), 2.5)


def stone_wall(rng: np.random.Generator, height: float) -> Panel:
    """Returns 3 m of dry stone wall with uneven coping; `height` in metres."""
    x = np.arange(0.0, 3.0, 0.3)
    top = height + rng.uniform(-0.05, 0.05, len(x))
    out = rng.uniform(0.22, 0.27, len(x))
    stones = boxes(np.column_stack([x, -out, np.full(len(x), -0.4)]), np.column_stack([x + 0.3, out, top]))
    return Panel(stones, 3.0)


def bank(height: float) -> Panel:
    """Returns 4 m of earth bank; `height` in metres."""
    section = [
        (-1.1, -0.3),
        (-0.9, 0.15 * height),
        (-0.35, height),
        (0.35, 0.95 * height),
        (0.9, 0.2 * height),
        (1.1, -0.3),
    ]
    return Panel(_extrude(section, 4.0), 4.0)


def gantry(span: float) -> Part:
    """Returns a lattice beam with signs that face -x and +x; it spans `span` metres along y, centred."""
    half = span / 2
    corners = np.array([[x, z] for x in (-0.35, 0.35) for z in (6.2, 7.2)])
    chords = tubes([[x, -half, z] for x, z in corners], [[x, half, z] for x, z in corners], 0.06)
    y = np.linspace(-half, half, max(4, round(span / 1.4)))
    low, high = np.where(np.arange(len(y)) % 2, 7.2, 6.2), np.where(np.arange(len(y)) % 2, 6.2, 7.2)
    lattice = [
        tubes(
            np.column_stack([0 * y[1:] + x, y[:-1], low[:-1]]), np.column_stack([0 * y[1:] + x, y[1:], high[:-1]]), 0.03
        )
        for x in (-0.35, 0.35)
    ]
    legs = tubes(
        [[x, s * half, -0.8] for x in (-0.3, 0.3) for s in (-1, 1)],
        [[x, s * half, 7.2] for x in (-0.3, 0.3) for s in (-1, 1)],
        0.13,
        sides=6,
    )
    signs = []
    for side in (-1, 1):
        for at in (0.2, 0.6):
            y0 = side * at * half
            signs.append(
                boxes(
                    [-side * 0.5 - 0.04, min(y0, y0 + side * 4.2), 5.9],
                    [-side * 0.5 + 0.04, max(y0, y0 + side * 4.2), 8.4],
                )
            )
    return merge([chords, *lattice, legs, *signs])


def overpass(span: float) -> Part:
    """Returns a bridge along y, centred: its deck is 5.6 m above the ground, on piers, with a sloping bank at each end.

    Args:
        span: Distance between the abutments, metres.
    """
    half, top = span / 2, 6.4
    deck = boxes([[-3.8, -half - 1, 5.6], [-4.0, -half - 1, 6.2]], [[3.8, half + 1, top], [4.0, half + 1, 6.3]])
    piers = tubes([[x, 0, -2] for x in (-2.6, 0, 2.6)], [[x, 0, 5.6] for x in (-2.6, 0, 2.6)], 0.4, sides=10)
    parts = [deck, piers, boxes([-3.5, -0.5, 5.0], [3.5, 0.5, 5.6])]
    rail = place(railing(span + 2, 1.1, 0.2), [[-3.9, -half - 1, top], [3.9, -half - 1, top]], np.pi / 2)
    for side in (-1, 1):
        high = [[-4.6, half, top], [4.6, half, top], [8.0, half + 0.6, -3.0], [-8.0, half + 0.6, -3.0]]
        low = [[-4.6, half + 60, 0.0], [4.6, half + 60, 0.0], [5.0, half + 60, -3.0], [-5.0, half + 60, -3.0]]
        parts.append(loft(np.array([high, low]) * (1, side, 1)))
    return merge([*parts, rail])


def container(length: float = 6.06) -> Part:
    """Returns a shipping container with folded sides, `length` metres long along x and centred."""
    count = int(length / 0.28) * 2
    x = np.linspace(-length / 2 + 0.1, length / 2 - 0.1, count + 1)
    y = np.where(np.arange(count + 1) // 2 % 2, 1.22, 1.18)
    sides = []
    for side in (-1, 1):
        a = np.column_stack([x, side * y])
        low = np.column_stack([a, np.full(count + 1, 0.15)])
        high = np.column_stack([a, np.full(count + 1, 2.5)])
        sides.append(quads(np.stack([low[:-1], low[1:], high[1:], high[:-1]], 1)))
    h = length / 2
    frame = boxes(
        [[-h, -1.22, 0.0], [-h, -1.22, 2.48], [-h, -1.22, 0.15], [h - 0.1, -1.22, 0.15]],
        [[h, 1.22, 0.16], [h, 1.22, 2.6], [-h + 0.1, 1.22, 2.48], [h, 1.22, 2.48]],
    )
    bars = tubes(
        [[h + 0.03, v, 0.2] for v in (-0.8, -0.3, 0.3, 0.8)],
        [[h + 0.03, v, 2.45] for v in (-0.8, -0.3, 0.3, 0.8)],
        0.025,
    )
    return merge([*sides, frame, bars])


def trailer() -> Part:
    """Returns a parked semi-trailer, 12.6 m long along x, with its doors at -x."""
    cargo = boxes([-6.3, -1.25, 1.2], [6.3, 1.25, 3.9])
    frame = boxes(
        [[-6.2, -0.5, 0.85], [3.0, -0.9, 0.0], [3.0, 0.8, 0.0], [-6.25, -1.2, 0.5]],
        [[6.2, 0.5, 1.2], [3.15, -0.8, 1.2], [3.15, 0.9, 1.2], [-6.15, 1.2, 0.62]],
    )
    return merge([cargo, frame, wheels([-5.2, -3.9, -2.6], 1.2, 0.5, 0.35)])


def tank(radius: float, height: float) -> Part:
    """Returns an upright tank with a low cone, a ladder and a rail around its top; all in metres."""
    shell = tubes([0, 0, -1.5], [0, 0, height], radius, sides=20, caps=False)
    roof = tubes([0, 0, height], [0, 0, height + 0.18 * radius], radius, 0.15, sides=20)
    turn = np.linspace(0, 2 * np.pi, 21)
    ring = np.column_stack([np.cos(turn), np.sin(turn)]) * (radius - 0.05)
    top = np.column_stack([ring, np.full(21, height + 1.0)])
    rail = tubes(top[:-1], top[1:], 0.025, sides=3, caps=False)
    stanchions = tubes(top[:-1] - (0, 0, 1.0), top[:-1], 0.02, sides=3, caps=False)
    ladder = boxes(
        [[radius + 0.12, v, 0.2] for v in (-0.25, 0.2)], [[radius + 0.18, v + 0.05, height + 1] for v in (-0.25, 0.2)]
    )
    z = np.arange(0.4, height, 0.35)
    rungs = tubes(
        [[radius + 0.15, -0.2, v] for v in z], [[radius + 0.15, 0.2, v] for v in z], 0.015, sides=3, caps=False
    )
    pipes = tubes([[0.7 * radius, 0.8 * radius, 0.5]], [[0.7 * radius, 0.8 * radius + 6, 0.5]], 0.15, sides=8)
    return merge([shell, roof, rail, stanchions, ladder, rungs, pipes])


def silo(radius: float, height: float) -> Part:
    """Returns a tower silo with a dome, hoops and a filling pipe; all in metres."""
    shell = tubes([0, 0, -1.5], [0, 0, height], radius, sides=18, caps=False)
    dome = [
        tubes([0, 0, height + a * radius], [0, 0, height + b * radius], radius * c, radius * d, sides=18, caps=False)
        for a, b, c, d in ((0.0, 0.35, 1.0, 0.85), (0.35, 0.6, 0.85, 0.5), (0.6, 0.7, 0.5, 0.05))
    ]
    z = np.arange(1.2, height, 1.5)
    hoops = tubes([[0, 0, v] for v in z], [[0, 0, v + 0.12] for v in z], radius + 0.06, sides=18)
    pipe = tubes([radius + 0.3, 0, 0], [radius + 0.3, 0, height + 0.5 * radius], 0.15, sides=6)
    return merge([shell, *dome, hoops, pipe])


def scaffold(width: float, lifts: int) -> Part:
    """Returns a scaffold in front of a wall at y = 0, centred and 1.1 m deep: standards, ledgers, braces, boards.

    Args:
        width: Length along x, metres.
        lifts: Number of decks, 2 m apart.
    """
    x = np.linspace(-width / 2, width / 2, max(2, round(width / 2.4) + 1))
    top, z = 2.0 * lifts + 1.1, 2.0 * np.arange(1, lifts + 1)
    uprights = np.array([[v, y, -0.3] for v in x for y in (-1.2, -0.25)])
    standards = tubes(uprights, uprights * (1, 1, 0) + (0, 0, top), 0.025, sides=5)
    bars = [(y, v) for v in z for y in (-1.2, -0.25)] + [(-1.2, v + h) for v in z for h in (0.5, 1.0)]
    ledgers = tubes([[x[0], y, v] for y, v in bars], [[x[-1], y, v] for y, v in bars], 0.025, sides=4, caps=False)
    foot = np.array([[a, -1.2, 2.0 * k] for k in range(lifts) for a in x[:-1:2]])
    braces = tubes(foot, np.add(foot, (x[1] - x[0], 0, 2.0)), 0.022, caps=False)
    boards = boxes([[x[0], -1.15, v] for v in z], [[x[-1], -0.3, v + 0.05] for v in z])
    return merge([standards, ledgers, braces, boards])


def bale() -> Part:
    """Returns a round bale of straw."""
    return tubes([-0.6, 0, 0.68], [0.6, 0, 0.68], 0.7, sides=14)


def stall(rng: np.random.Generator) -> Part:
    """Returns a market stall, 3 m long along y and open towards +x, with goods on its table."""
    posts = [[x, y, -0.1] for x in (-1.0, 1.0) for y in (-1.45, 1.45)]
    frame = tubes(posts, np.add(posts, (0, 0, 2.25)), 0.03, sides=5)
    ridge = 2.9
    roof = quads(
        [
            [[1.3, -1.6, 2.15], [1.3, 1.6, 2.15], [0, 1.6, ridge], [0, -1.6, ridge]],
            [[-1.3, -1.6, 2.15], [-1.3, 1.6, 2.15], [0, 1.6, ridge], [0, -1.6, ridge]],
            [[1.3, -1.6, 2.15], [1.3, 1.6, 2.15], [1.3, 1.6, 1.9], [1.3, -1.6, 1.9]],
        ]
    )
    table = boxes([0.1, -1.4, 0.0], [1.0, 1.4, 0.85])
    low = np.column_stack([rng.uniform(0.15, 0.6, 8), np.linspace(-1.35, 1.0, 8), np.full(8, 0.85)])
    goods = boxes(low, low + np.column_stack([np.full(8, 0.35), np.full(8, 0.28), rng.uniform(0.08, 0.4, 8)]))
    crates = boxes([[-0.9, -1.2, 0], [-0.8, 0.4, 0]], [[-0.3, -0.6, 0.5], [-0.3, 1.0, 0.9]])
    return merge([frame, roof, table, goods, crates])


def parasol(open_: bool) -> Part:
    """Returns a café table with four chairs under a parasol, which is open or folded."""
    pole = tubes([0, 0, -0.1], [0, 0, 2.7], 0.03, sides=5)
    shade = (
        tubes([0, 0, 2.2], [0, 0, 2.7], 1.5, 0.05, sides=8, caps=False)
        if open_
        else tubes([0, 0, 1.2], [0, 0, 2.7], 0.18, 0.04, sides=6)
    )
    table = merge([tubes([0, 0, 0.7], [0, 0, 0.74], 0.42, sides=10), tubes([0, 0, 0], [0, 0, 0.05], 0.3, sides=8)])
    seat = boxes([[-0.2, -0.2, 0.43], [-0.2, -0.2, 0.43]], [[0.2, 0.2, 0.47], [-0.16, 0.2, 0.88]])
    legs = tubes(
        [[x, y, 0] for x in (-0.18, 0.18) for y in (-0.18, 0.18)],
        [[x, y, 0.43] for x in (-0.18, 0.18) for y in (-0.18, 0.18)],
        0.015,
        sides=3,
    )
    turn = np.pi / 2 * np.arange(4) + 0.4
    chairs = place(
        merge([seat, legs]), np.column_stack([0.85 * np.cos(turn), 0.85 * np.sin(turn), np.zeros(4)]), turn + np.pi
    )
    return merge([pole, shade, table, chairs])


def fountain() -> Part:
    """Returns a fountain: a round basin of 4 m radius with a bowl on a column."""
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    profile = [(4.0, -0.3), (4.0, 0.55), (4.1, 0.6), (3.6, 0.62), (3.6, 0.35), (0.6, 0.35)]
    rings = np.stack([np.column_stack([r * np.cos(turn), r * np.sin(turn), np.full(24, z)]) for r, z in profile])
    column = tubes(
        [[0, 0, 0.3], [0, 0, 1.5], [0, 0, 1.9]],
        [[0, 0, 1.5], [0, 0, 1.9], [0, 0, 2.6]],
        [0.5, 0.35, 0.25],
        [0.35, 1.4, 0.15],
        sides=12,
    )
    return merge([loft(rings), column])


def statue() -> Part:
    """Returns a statue of twice a person's height on a stepped plinth."""
    steps = boxes(
        [[-2.2, -2.2, -0.4], [-1.7, -1.7, 0.2], [-1.0, -1.0, 0.4], [-1.15, -1.15, 2.6]],
        [[2.2, 2.2, 0.2], [1.7, 1.7, 0.4], [1.0, 1.0, 2.6], [1.15, 1.15, 2.8]],
    )
    return merge([steps, shift(pedestrian(0.3, 0.3, 3.4), z=2.8)])


def tram_mast(arm: float) -> Part:
    """Returns a mast whose arm, `arm` metres along +x, carries the overhead wire at its end."""
    return merge(
        [
            tubes([0, 0, -0.4], [0, 0, 7.4], 0.13, 0.09, sides=8),
            tubes([[0, 0, 6.0], [0, 0, 7.2]], [[arm, 0, 6.0], [arm, 0, 6.05]], [0.04, 0.015], sides=5),
            tubes([arm, 0, TRAM_WIRE_HEIGHT], [arm, 0, 6.0], 0.02),
        ]
    )


def pylon() -> Part:
    """Returns a lattice pylon, 19 m high, with crossarms along y at `PYLON_ARMS`."""
    z = np.array([0.0, 3.5, 6.5, 9.0, 11.0, 13.0, 15.0, 17.0, 19.0])
    half = np.interp(z, [0, 11, 19], [1.7, 0.6, 0.25])
    corner = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    knots = np.concatenate([half[:, None, None] * corner, np.broadcast_to(z[:, None, None], (len(z), 4, 1))], axis=2)
    legs = tubes(knots[:-1].reshape(-1, 3), knots[1:].reshape(-1, 3), 0.07)
    turned = np.roll(knots, 1, axis=1)
    braces = [
        tubes(knots[:-1].reshape(-1, 3), turned[1:].reshape(-1, 3), 0.035, caps=False),
        tubes(turned[:-1].reshape(-1, 3), knots[1:].reshape(-1, 3), 0.035, caps=False),
    ]
    arms = tubes(
        [[0, -a, v] for a, v in PYLON_ARMS],
        [[0, a, v] for a, v in PYLON_ARMS],
        0.09,
    )
    stays = tubes(
        [[0, s * a, v] for a, v in PYLON_ARMS for s in (-1, 1)],
        [[0, 0, v + 1.2] for _, v in PYLON_ARMS for _ in (-1, 1)],
        0.04,
    )
    return merge([legs, *braces, arms, stays])
