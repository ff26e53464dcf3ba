"""Street furniture and fences.

Each piece stands at the origin on z = 0, in metres; its front or arm points along +x. Copies are placed in the town.
Lamps, signs, traffic lights, bollards and power poles are poles.
"""

import numpy as np

from ilnet.world.towns.parts import Panel, Part, boxes, merge, place, polyline_tubes, tubes

__all__ = [
    "POLE_HOOKS",
    "bench",
    "bin_",
    "bollard",
    "bus_shelter",
    "cabinet",
    "cycle_hoops",
    "fence",
    "lamp",
    "pole",
    "railing",
    "sign",
    "traffic_light",
    "wire",
]


# Where the wires of a power pole hang: y and z [m].
POLE_HOOKS = ((-1.0, 8.0), (0.35, 8.0), (1.0, 8.0))


def _pole(parts: list[Part]) -> Part:
    return merge(parts)._replace(is_pole=True)


def lamp(height: float, arm: float) -> Part:
    """Returns a lamp post; `height` of the lamp and reach of its `arm` along +x in metres."""
    bend = np.array([[0, 0, height - 0.6], [0.25 * arm, 0, height - 0.12], [arm, 0, height]])
    parts = [
        tubes([0, 0, -0.3], [0, 0, 1.1], 0.1, sides=8),
        tubes([0, 0, 1.1], [0, 0, height - 0.6], 0.075, 0.05, sides=8),
        polyline_tubes(bend, 0.035, sides=5),
        boxes([arm - 0.1, -0.13, height - 0.05], [arm + 0.55, 0.13, height + 0.07]),
    ]
    return _pole(parts)


def sign(shape: int, height: float = 2.4) -> Part:
    """Returns a traffic sign that faces +x on a thin pole.

    Args:
        shape: 0 for a disc, 1 for a triangle, 2 for a rectangle, 3 for a disc above a plate.
        height: Height of its middle, metres.
    """
    parts = [tubes([0, 0, -0.3], [0, 0, height + 0.35], 0.03, sides=6)]
    if shape in (0, 3):
        parts.append(tubes([0.035, 0, height], [0.05, 0, height], 0.31, sides=16))
    if shape == 1:
        parts.append(tubes([0.035, 0, height], [0.05, 0, height], 0.45, sides=3))
    if shape == 2:
        parts.append(boxes([0.035, -0.3, height - 0.35], [0.05, 0.3, height + 0.3]))
    if shape == 3:
        parts.append(boxes([0.035, -0.25, height - 0.62], [0.05, 0.25, height - 0.36]))
    return _pole(parts)


def traffic_light(arm: float) -> Part:
    """Returns a traffic light: signal heads that face +y, on a pole and on an arm along +x over the lanes.

    Args:
        arm: Reach of the arm, metres.
    """
    low = np.array([[-0.16, 0.07, 2.4], [arm - 0.16, 0.07, 5.3], [0.5 * arm - 0.16, 0.07, 5.25]])
    lens = low[:, None] + np.array([[0.16, 0.22, 0.17 + 0.28 * k] for k in range(3)])
    lens = lens.reshape(-1, 3)
    parts = [
        tubes([0, 0, -0.3], [0, 0, 6.0], 0.09, 0.06, sides=7),
        tubes([0, 0, 5.6], [arm, 0, 5.9], 0.06, 0.04, sides=6),
        boxes(low, np.add(low, (0.32, 0.22, 0.9))),
        tubes(lens, np.add(lens, (0, 0.16, 0)), 0.11, sides=8, caps=False),
        boxes([-0.12, -0.1, 0.95], [0.12, 0.14, 1.2]),
    ]
    return _pole(parts)


def bollard() -> Part:
    """Returns a bollard, 0.9 m high."""
    return _pole(
        [
            tubes([0, 0, -0.2], [0, 0, 0.85], 0.06, 0.055, sides=8),
            tubes([0, 0, 0.85], [0, 0, 0.93], 0.07, 0.03, sides=8),
        ]
    )


def bench() -> Part:
    """Returns a slatted bench along y that faces +x."""
    slats = boxes(
        [[-0.2 + 0.12 * k, -0.9, 0.43] for k in range(4)]
        + [[-0.27 - 0.03 * k, -0.9, 0.55 + 0.14 * k] for k in range(3)],
        [[-0.11 + 0.12 * k, 0.9, 0.46] for k in range(4)]
        + [[-0.24 - 0.03 * k, 0.9, 0.65 + 0.14 * k] for k in range(3)],
    )
    legs = boxes([[-0.22, y, -0.1] for y in (-0.7, 0.64)], [[0.2, y + 0.06, 0.43] for y in (-0.7, 0.64)])
    backs = tubes([[-0.24, y, 0.4] for y in (-0.67, 0.67)], [[-0.36, y, 0.98] for y in (-0.67, 0.67)], 0.025)
    return merge([slats, legs, backs])


def bin_(wheeled: bool) -> Part:
    """Returns a wheeled bin with a lid, or else a litter bin."""
    if not wheeled:
        return merge(
            [
                tubes([0, 0, 0], [0, 0, 0.85], 0.22, 0.25, sides=10),
                tubes([0, 0, 0.95], [0, 0, 1.0], 0.27, 0.1, sides=10),
            ]
        )
    body = tubes([0, 0, 0.06], [0, 0, 1.0], 0.34, 0.42, sides=4)
    return merge([body, boxes([-0.32, -0.32, 1.0], [0.34, 0.32, 1.06]), boxes([-0.42, -0.3, 0.95], [-0.36, 0.3, 1.0])])


def cabinet() -> Part:
    """Returns a cabinet for telephone or power lines."""
    return merge([boxes([-0.2, -0.6, 0], [0.2, 0.6, 1.25]), boxes([-0.24, -0.64, 1.25], [0.24, 0.64, 1.3])])


def cycle_hoops() -> Part:
    """Returns five hoops in a row along y to lean bicycles against."""
    hoop = [[-0.35, 0, 0], [-0.35, 0, 0.65], [-0.25, 0, 0.8], [0.25, 0, 0.8], [0.35, 0, 0.65], [0.35, 0, 0]]
    return place(polyline_tubes(hoop, 0.025, sides=5), [[0, y, 0] for y in (-1.6, -0.8, 0, 0.8, 1.6)])


def pole() -> Part:
    """Returns a wooden power pole with a crossarm along y and insulators; wires hang at `POLE_HOOKS`."""
    arms = boxes([[-0.05, -1.1, 7.7], [-0.05, -0.8, 7.0]], [[0.05, 1.1, 7.82], [0.05, 0.8, 7.1]])
    pins = tubes([[0, y, 7.82] for y, _ in POLE_HOOKS], [[0, y, z] for y, z in POLE_HOOKS], 0.04, sides=5)
    return _pole([tubes([0, 0, -0.5], [0, 0, 8.3], 0.15, 0.1, sides=8), arms, pins])


def wire(start: np.ndarray, end: np.ndarray, sag: float, radius: float = 0.02) -> Part:
    """Returns a wire that hangs between two points (3,) with a sag; all in metres."""
    t = np.linspace(0, 1, 10)[:, None]
    line = start + t * (end - start)
    line[:, 2] -= sag * (4 * t * (1 - t))[:, 0]
    return polyline_tubes(line, radius)


def fence(length: float, height: float, gap: float) -> Panel:
    """Returns a picket fence; `gap` is the distance from one picket to the next, metres."""
    count = max(2, int(length / gap))
    x = np.linspace(0, length - 0.08, count)
    zero = np.zeros(count)
    low = np.column_stack([x, zero, zero - 0.15 + 0.2])
    pickets = boxes(low, np.column_stack([x + 0.08, zero + 0.02, zero + height]), ends=False)
    posts_x = np.arange(0, length, 2.4)
    posts = boxes(
        np.column_stack([posts_x, 0 * posts_x + 0.06, 0 * posts_x - 0.4]),
        np.column_stack([posts_x + 0.1, 0 * posts_x + 0.16, 0 * posts_x + height]),
    )
    rails = boxes([[0, 0.02, 0.25], [0, 0.02, height - 0.25]], [[length, 0.06, 0.33], [length, 0.06, height - 0.17]])
    return Panel(merge([pickets, posts, rails]), length)


def railing(length: float, height: float = 1.05, gap: float = 0.14) -> Part:
    """Returns a metal railing along +x from the origin: bars `gap` metres apart between two rails."""
    count = max(2, round(length / gap) + 1)
    x = np.linspace(0, length, count)
    zero = np.zeros(count)
    bars = tubes(
        np.column_stack([x, zero, zero]), np.column_stack([x, zero, zero + height]), 0.013, sides=3, caps=False
    )
    rails = tubes([[0, 0, height], [0, 0, 0.1]], [[length, 0, height], [length, 0, 0.1]], [0.03, 0.02])
    return merge([bars, rails])


def bus_shelter() -> Part:
    """Returns a glazed bus shelter, 4 m long along y and open towards +x."""
    glass = boxes([[-0.75, -2, 0.15], [-0.75, -2, 0.15]], [[-0.72, 2, 2.2], [0.3, -1.97, 2.2]])
    roof = boxes([-0.85, -2.1, 2.35], [0.75, 2.1, 2.47])
    posts = tubes(
        [[x, y, -0.2] for x in (-0.7, 0.5) for y in (-1.95, 0, 1.95)],
        [[x, y, 2.4] for x in (-0.7, 0.5) for y in (-1.95, 0, 1.95)],
        0.04,
    )
    return merge([glass, roof, posts, boxes([-0.55, -1.3, 0.4], [-0.2, 1.3, 0.46])])
