"""Cars, vans, lorries, buses, bicycles and people.

Each stands at the origin on z = 0 and faces +x, in metres. Copies are placed by `traffic.py`.
"""

from collections.abc import Sequence

import numpy as np

from ilnet.world.towns.parts import Part, boxes, loft, merge, polyline_tubes, shift, tubes

__all__ = ["bicycle", "bus", "car", "cyclist", "lorry", "pedestrian", "van", "wheels"]

# Side profiles from the tail to the nose, in metres: x, height of the belt line, height of the roof or bonnet, half the
# width at the belt line, half the width at the top.
_HATCHBACK = [
    (-2.02, 0.72, 0.80, 0.76, 0.62),
    (-1.98, 0.86, 0.98, 0.84, 0.66),
    (-1.62, 0.93, 1.36, 0.87, 0.58),
    (-0.90, 0.93, 1.48, 0.89, 0.57),
    (0.05, 0.92, 1.45, 0.89, 0.57),
    (0.30, 0.91, 1.35, 0.89, 0.61),
    (0.95, 0.86, 0.96, 0.88, 0.72),
    (1.60, 0.74, 0.84, 0.87, 0.72),
    (1.95, 0.62, 0.70, 0.80, 0.64),
    (2.05, 0.52, 0.58, 0.68, 0.56),
]
_SALOON = [
    (-2.30, 0.75, 0.84, 0.74, 0.62),
    (-2.22, 0.88, 0.98, 0.83, 0.68),
    (-1.70, 0.93, 1.03, 0.88, 0.70),
    (-1.00, 0.94, 1.38, 0.90, 0.58),
    (-0.60, 0.93, 1.44, 0.90, 0.56),
    (0.15, 0.92, 1.42, 0.90, 0.56),
    (0.42, 0.91, 1.32, 0.90, 0.60),
    (1.10, 0.85, 0.95, 0.89, 0.72),
    (1.85, 0.73, 0.81, 0.87, 0.72),
    (2.22, 0.60, 0.67, 0.80, 0.64),
    (2.32, 0.50, 0.56, 0.68, 0.56),
]
_SUV = [
    (-2.25, 0.85, 0.98, 0.80, 0.66),
    (-2.20, 1.02, 1.20, 0.88, 0.70),
    (-2.00, 1.08, 1.58, 0.91, 0.64),
    (-1.20, 1.08, 1.70, 0.93, 0.62),
    (0.10, 1.06, 1.68, 0.93, 0.62),
    (0.38, 1.05, 1.56, 0.93, 0.66),
    (0.95, 1.00, 1.12, 0.92, 0.76),
    (1.75, 0.90, 1.02, 0.91, 0.76),
    (2.12, 0.78, 0.88, 0.85, 0.70),
    (2.25, 0.60, 0.70, 0.74, 0.62),
]
_VAN = [
    (-2.70, 1.20, 2.20, 0.92, 0.82),
    (-2.66, 1.30, 2.34, 0.97, 0.86),
    (-1.00, 1.30, 2.38, 0.98, 0.86),
    (0.90, 1.30, 2.36, 0.98, 0.86),
    (1.30, 1.28, 2.22, 0.98, 0.84),
    (2.02, 1.16, 1.28, 0.97, 0.84),
    (2.50, 0.98, 1.08, 0.93, 0.80),
    (2.70, 0.70, 0.78, 0.82, 0.70),
]


def wheels(x: list[float], half_width: float, radius: float, width: float = 0.22) -> Part:
    """Returns a pair of wheels at each x, their outer sides at `half_width` to the left and right; all in metres."""
    at = np.array([[px, side * half_width, radius] for px in x for side in (-1, 1)])
    inward = np.array([[0, -side * width, 0] for _ in x for side in (-1, 1)])
    return merge([tubes(at + inward, at, radius, sides=8)])


def _body(profile: Sequence[tuple[float, ...]], axles: tuple[float, float], radius: float, clearance: float) -> Part:
    """Returns the skin over a side profile, with arches over the wheels.

    Args:
        profile: One of the tables above.
        axles: x of the axles, metres.
        radius: Radius of the wheels, metres.
        clearance: Height of the underside, metres.
    """
    table = np.array(profile)
    arch = np.array([w + step for w in axles for step in (-1.18, -0.85, 0.85, 1.18)])
    near = np.array([w for w in axles for _ in range(4)])
    x = np.unique(np.concatenate([table[:, 0], near + (arch - near) * radius]))
    belt, top, wide, narrow = (np.interp(x, table[:, 0], table[:, k]) for k in range(1, 5))
    gap = np.min([np.abs(x - w) for w in axles], axis=0) / radius
    low = clearance + np.interp(gap, [0.85, 1.18], [1.7 * radius - clearance, 0.0])
    low = np.where(gap > 1.18, clearance, low)
    ends = np.minimum(x - x[0], x[-1] - x)
    low = np.where(gap > 1.18, low + 0.15 * np.clip(1 - ends / 0.2, 0, 1), low)
    shoulder = 0.6 * belt + 0.4 * np.maximum(low, clearance)
    side = np.stack(
        [
            np.stack([0.94 * wide, low], 1),
            np.stack([wide, np.maximum(shoulder, low + 0.01)], 1),
            np.stack([0.98 * wide, belt], 1),
            np.stack([narrow, top], 1),
        ],
        axis=1,
    )
    ring = np.concatenate([side, side[:, ::-1] * (-1, 1)], axis=1)
    return loft(np.concatenate([np.broadcast_to(x[:, None, None], (*ring.shape[:2], 1)), ring], axis=2))


def _mirrors(x: float, y: float, z: float) -> Part:
    """Returns a mirror on each side, at `y` and -`y`; all in metres."""
    low = np.array([[x - 0.05, side * y - 0.11, z] for side in (-1, 1)])
    return boxes(low, np.add(low, (0.12, 0.22, 0.15)))


def car(kind: int) -> Part:
    """Returns a car of 4.1 to 4.6 m; `kind` is 0 for a hatchback, 1 for a saloon, 2 for an SUV."""
    profile, axles, mirror = (
        (_HATCHBACK, (-1.25, 1.30), 0.92),
        (_SALOON, (-1.38, 1.42), 0.92),
        (_SUV, (-1.35, 1.40), 1.06),
    )[kind]
    radius = 0.36 if kind == 2 else 0.32
    half = profile[4][3]
    rails = (
        []
        if kind < 2
        else [tubes([[-1.6, -0.55, 1.74], [-1.6, 0.55, 1.74]], [[0.1, -0.55, 1.74], [0.1, 0.55, 1.74]], 0.025)]
    )
    x_mirror = profile[6][0] - 0.25
    return merge(
        [
            _body(profile, axles, radius, 0.2 + 0.04 * (kind == 2)),
            wheels(list(axles), half, radius),
            _mirrors(x_mirror, half + 0.08, mirror),
            *rails,
        ]
    )


def van() -> Part:
    """Returns a panel van, 5.4 m long and 2.4 m high."""
    body = _body(_VAN, (-1.6, 1.75), 0.36, 0.28)
    return merge([body, wheels([-1.6, 1.75], 0.98, 0.36), _mirrors(1.55, 1.1, 1.35)])


def lorry() -> Part:
    """Returns a box lorry, 8.4 m long and 3.5 m high, with a gap between cab and box."""
    cab = [
        (2.45, 1.7, 2.75, 1.15, 1.05),
        (2.60, 1.7, 2.95, 1.20, 1.08),
        (3.55, 1.7, 2.85, 1.20, 1.08),
        (4.00, 1.6, 1.80, 1.20, 1.12),
        (4.15, 1.1, 1.30, 1.18, 1.10),
    ]
    frame = boxes(
        [[-4.2, -0.45, 0.62], [-4.2, -1.15, 0.45], [-3.9, -1.0, 0.75]],
        [[3.6, 0.45, 0.95], [-4.1, 1.15, 0.6], [-3.8, 1.0, 0.98]],
    )
    guard = tubes([[-1.2, -1.12, 0.6], [-1.2, 1.12, 0.6]], [[1.9, -1.12, 0.6], [1.9, 1.12, 0.6]], 0.05)
    cargo = boxes([-4.2, -1.22, 1.0], [2.25, 1.22, 3.45])
    tyres = wheels([-2.6, 3.2], 1.18, 0.48, 0.3)
    return merge([_body(cab, (3.2, 3.2), 0.48, 0.5), frame, guard, cargo, tyres, _mirrors(3.75, 1.4, 1.9)])


def bus() -> Part:
    """Returns a city bus, 11 m long and 3.1 m high."""
    body = [
        (-5.50, 1.3, 2.85, 1.18, 1.08),
        (-5.42, 1.3, 3.02, 1.25, 1.14),
        (-2.00, 1.3, 3.10, 1.25, 1.14),
        (4.90, 1.3, 3.08, 1.25, 1.14),
        (5.35, 1.2, 2.90, 1.24, 1.12),
        (5.50, 1.0, 1.60, 1.18, 1.10),
    ]
    vents = boxes([[-4.0, -0.7, 3.05], [0.5, -0.7, 3.05]], [[-2.2, 0.7, 3.25], [2.3, 0.7, 3.25]])
    return merge(
        [_body(body, (-3.0, 3.0), 0.48, 0.32), wheels([-3.0, 3.0], 1.25, 0.48, 0.3), vents, _mirrors(5.4, 1.4, 2.3)]
    )


def bicycle() -> Part:
    """Returns an upright bicycle, 1.75 m long."""
    turn = np.linspace(0, 2 * np.pi, 13)
    hoop = np.stack([0.34 * np.cos(turn), np.zeros(13), 0.34 + 0.34 * np.sin(turn)], axis=1)
    rims = [shift(polyline_tubes(hoop, 0.022), x) for x in (-0.53, 0.53)]
    start = np.array([[-0.53, 0, 0.34], [-0.53, 0, 0.34], [-0.1, 0, 0.28], [-0.1, 0, 0.28], [-0.22, 0, 0.72]])
    end = np.array([[-0.1, 0, 0.28], [-0.2, 0, 0.75], [-0.25, 0, 0.92], [0.4, 0, 0.72], [0.38, 0, 0.8]])
    bars = tubes([[0.53, 0, 0.34], [0.34, -0.28, 1.0]], [[0.36, 0, 1.0], [0.34, 0.28, 1.0]], 0.018)
    saddle = boxes([-0.38, -0.07, 0.9], [-0.14, 0.07, 0.96])
    return merge([*rims, tubes(start, end, 0.02, caps=False), bars, saddle])


def cyclist() -> Part:
    """Returns a rider on a bicycle."""
    hip, shoulder, hand = np.array([-0.2, 0.0, 0.98]), np.array([0.1, 0.0, 1.45]), np.array([0.34, 0.0, 1.0])
    side = np.array([[0.0, -0.1, 0.0], [0.0, 0.1, 0.0]])
    knee, foot = np.array([[0.18, 0.0, 0.78], [0.1, 0.0, 0.62]]), np.array([[0.02, 0.0, 0.42], [-0.12, 0.0, 0.15]])
    limbs = tubes(
        np.concatenate([hip + side, knee + side, shoulder + 1.9 * side]),
        np.concatenate([knee + side, foot + side, hand + 2.6 * side]),
        np.repeat([0.09, 0.06, 0.05], 2),
        np.repeat([0.065, 0.045, 0.04], 2),
        sides=5,
        caps=False,
    )
    torso = tubes(hip, shoulder, 0.15, 0.19, sides=7)
    head = tubes([0.16, 0, 1.52], [0.18, 0, 1.76], 0.09, 0.08, sides=7)
    return merge([bicycle(), limbs, torso, head])


def pedestrian(stride: float, swing: float, height: float = 1.75) -> Part:
    """Returns a walking person.

    Args:
        stride: Distance from foot to foot, metres.
        swing: How far the hands swing, metres.
        height: Body height, metres.
    """
    start = [[0, -0.1, 0.88], [0, 0.1, 0.88], [stride / 4, -0.1, 0.46], [-stride / 5, 0.1, 0.46]]
    end = [[stride / 4, -0.1, 0.46], [-stride / 5, 0.1, 0.46], [stride / 2, -0.1, 0.03], [-stride / 2, 0.1, 0.06]]
    start += [[0, -0.22, 1.42], [0, 0.22, 1.42], [-swing / 3, -0.26, 1.12], [swing / 3, 0.26, 1.12]]
    end += [[-swing / 3, -0.26, 1.12], [swing / 3, 0.26, 1.12], [-swing / 2, -0.25, 0.85], [swing, 0.25, 0.9]]
    limbs = tubes(
        start,
        end,
        [0.09, 0.09, 0.065, 0.065, 0.06, 0.06, 0.045, 0.045],
        [0.065, 0.065, 0.05, 0.05, 0.045, 0.045, 0.04, 0.04],
        sides=5,
        caps=False,
    )
    feet = boxes(
        [[stride / 2 - 0.08, -0.15, 0], [-stride / 2 - 0.08, 0.05, 0]],
        [[stride / 2 + 0.2, -0.05, 0.08], [-stride / 2 + 0.2, 0.15, 0.08]],
    )
    torso = tubes([[0, 0, 0.85], [0, 0, 1.1]], [[0, 0, 1.1], [0, 0, 1.48]], [0.17, 0.16], [0.16, 0.2], sides=8)
    torso.vertices[:, 0] *= 0.7
    head = tubes(
        [[0, 0, 1.46], [0.01, 0, 1.53], [0.01, 0, 1.66]],
        [[0, 0, 1.53], [0.01, 0, 1.66], [0, 0, 1.75]],
        [0.06, 0.09, 0.1],
        [0.06, 0.1, 0.05],
        sides=7,
    )
    body = merge([limbs, feet, torso, head])
    return Part(body.vertices * (height / 1.75), body.triangles)
