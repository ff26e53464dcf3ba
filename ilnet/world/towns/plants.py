"""Trees, bushes and hedges, whose leaves let some rays through.

Each plant stands at the origin on z = 0, in metres; copies of it are placed in the town.
"""

from dataclasses import dataclass

import numpy as np

from ilnet.world.towns.parts import Panel, Part, boxes, merge, tubes

__all__ = ["Greens", "greenery", "hedge"]


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Returns vectors (..., 3) scaled to length 1."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def _leaves(centres: np.ndarray, size: tuple[float, float], rng: np.random.Generator) -> Part:
    """Returns one triangle in a random attitude at each centre (N, 3) [m]; `size` is the range of its side [m]."""
    count = len(centres)
    u = _unit(rng.standard_normal((count, 3)))
    w = _unit(np.cross(u, rng.standard_normal((count, 3))))
    turn = 2 * np.pi * np.arange(3) / 3
    reach = rng.uniform(*size, count)[:, None, None] / np.sqrt(3)
    corners = centres[:, None] + reach * (np.cos(turn)[:, None] * u[:, None] + np.sin(turn)[:, None] * w[:, None])
    return Part(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def _branches(
    height: float, crown: float, clear: float, twigs: int, rng: np.random.Generator
) -> tuple[Part, np.ndarray]:
    """Returns trunk, boughs and twigs, and the points (N, 3) [m] around which leaves grow.

    Args:
        height: Height of the whole tree, metres.
        crown: Radius of the crown, metres.
        clear: Height of the lowest bough, metres.
        twigs: Number of twigs on each bough.
        rng: Source of the shape.
    """
    knots = np.linspace(0, 0.8 * height, 6)
    lean = np.cumsum(rng.normal(0, 0.12, (6, 2)), axis=0) * (knots / height)[:, None]
    trunk = np.column_stack([lean, knots])
    thick = 0.022 * height * (1 - 0.85 * knots / knots[-1]) + 0.02
    thick[0] *= 1.4
    parts = [tubes(trunk[:-1], trunk[1:], thick[:-1], thick[1:], sides=6, caps=False)]
    count = 9
    z = np.sort(rng.uniform(clear, 0.78 * height, count))
    root = np.column_stack([np.interp(z, knots, lean[:, k]) for k in range(2)] + [z])
    turn = 2.4 * np.arange(count) + rng.uniform(-0.4, 0.4, count)  # The golden angle spreads boughs evenly.
    level = (z - clear) / (height - clear)
    reach = crown * np.sqrt(np.clip(1 - (2 * level - 0.75) ** 2 * 0.6, 0.15, 1)) * rng.uniform(0.65, 0.95, count)
    rise = reach * rng.uniform(0.3, 0.7, count)
    tip = root + np.column_stack([reach * np.cos(turn), reach * np.sin(turn), rise])
    bend = 0.5 * (root + tip) + np.column_stack([np.zeros((count, 2)), 0.12 * reach])
    girth = np.interp(z, knots, thick) * 0.5
    parts.append(tubes(root, bend, girth, 0.7 * girth, sides=4, caps=False))
    parts.append(tubes(bend, tip, 0.7 * girth, 0.02, sides=3, caps=False))
    f = rng.uniform(0.35, 1.0, (count, twigs, 1))
    start = (bend[:, None] * (1 - f) + tip[:, None] * f).reshape(-1, 3)
    way = _unit(_unit(tip - bend)[:, None] + rng.normal(0, 0.7, (count, twigs, 3))).reshape(-1, 3)
    way[:, 2] = np.abs(way[:, 2])
    end = start + way * (crown * rng.uniform(0.25, 0.45, count * twigs))[:, None]
    parts.append(tubes(start, end, 0.022, 0.008, sides=3, caps=False))
    return merge(parts), np.concatenate([end, 0.5 * (start + end), tip, trunk[-1:]])


def _tree(
    rng: np.random.Generator,
    height: float,
    crown: float,
    clear: float,
    leaves: int,
    size: tuple[float, float],
    twigs: int = 4,
) -> Part:
    """Returns a broad-leaved tree.

    Args:
        rng: Source of the shape.
        height: Height of the tree, metres.
        crown: Radius of the crown, metres.
        clear: Height up to which there is only the trunk, metres.
        leaves: Number of leaf triangles; 0 for a bare tree.
        size: Range of a leaf's side, metres.
        twigs: Number of twigs on each bough.
    """
    wood, tips = _branches(height, crown, clear + 0.3, twigs, rng)
    if not leaves:
        return wood
    at = tips[rng.integers(0, len(tips), leaves)] + rng.normal(0, 0.17 * crown, (leaves, 3))
    at[:, 2] = np.clip(at[:, 2], clear + rng.uniform(0.1, 0.7, leaves), None)
    return merge([wood, _leaves(at, size, rng)])


def _conifer(rng: np.random.Generator, height: float, leaves: int) -> Part:
    """Returns a conifer: whorls of drooping branches with triangles as needles."""
    z = np.repeat(np.linspace(0.12, 0.95, 14), 6) * height
    turn = rng.uniform(0, 2 * np.pi, len(z))
    reach = (1 - z / height) * 0.24 * height + 0.15
    root = np.column_stack([np.zeros((len(z), 2)), z])
    tip = root + np.column_stack([reach * np.cos(turn), reach * np.sin(turn), -0.25 * reach])
    trunk = tubes([0, 0, 0], [0, 0, height], 0.018 * height + 0.03, 0.02, sides=6)
    i = rng.integers(0, len(z), leaves)
    at = root[i] + (tip - root)[i] * np.sqrt(rng.uniform(0.1, 1, leaves))[:, None] + rng.normal(0, 0.1, (leaves, 3))
    return merge([trunk, tubes(root, tip, 0.03, 0.01, sides=3, caps=False), _leaves(at, (0.2, 0.45), rng)])


def _bush(rng: np.random.Generator, radius: float, leaves: int) -> Part:
    """Returns a round bush with a few stems."""
    way = _unit(rng.standard_normal((leaves, 3)))
    way[:, 2] = np.abs(way[:, 2])
    at = way * (radius * rng.uniform(0.55, 1.0, leaves) ** 0.5)[:, None] * (1, 1, 1.1)
    tips = way[:7] * radius * 0.8
    return merge([tubes(np.zeros((7, 3)), tips, 0.025, 0.01, sides=3, caps=False), _leaves(at, (0.12, 0.3), rng)])


def hedge(rng: np.random.Generator, length: float, height: float, width: float) -> Panel:
    """Returns a clipped hedge: a dense core with leaves standing out of it; lengths in metres."""
    core = boxes([0.0, -width / 2 + 0.14, -0.3], [length, width / 2 - 0.14, height - 0.14])
    count = int(length * 38)
    face = rng.uniform(0, 2 * height + width, count)
    y = np.where(face < height, -width / 2, np.where(face > height + width, width / 2, face - height - width / 2))
    z = np.where(face < height, face, np.where(face > height + width, face - height - width, height))
    at = np.column_stack([rng.uniform(0, length, count), y, z]) + rng.normal(0, 0.05, (count, 3))
    return Panel(merge([core, _leaves(at, (0.14, 0.32), rng)]), length)


@dataclass(frozen=True)
class Greens:
    """The plants that a town copies.

    Attributes:
        kinds: Plants by kind: street trees ("tall"), garden plants ("small", "conifer", "bush"), trees in the distance
            ("far"), and trees without leaves ("bare").
    """

    kinds: dict[str, list[Part]]

    def pick(self, rng: np.random.Generator, *kinds: str) -> Part:
        """Returns a random plant of the given kinds."""
        plants = [plant for kind in kinds for plant in self.kinds[kind]]
        return plants[int(rng.integers(0, len(plants)))]


def greenery(rng: np.random.Generator) -> Greens:
    """Returns the plants of a town."""
    return Greens(
        {
            "tall": [
                _tree(rng, rng.uniform(8, 12), rng.uniform(2.4, 3.4), 3.4, 1000, (0.14, 0.33), twigs=4)
                for _ in range(5)
            ],
            "small": [
                _tree(rng, rng.uniform(4.5, 7.5), rng.uniform(1.6, 2.6), 1.6, 560, (0.13, 0.29)) for _ in range(4)
            ],
            "bare": [_tree(rng, rng.uniform(7, 10), rng.uniform(2.2, 3.0), 3.3, 0, (0, 0)) for _ in range(2)],
            "conifer": [_conifer(rng, rng.uniform(6, 11), 420) for _ in range(2)],
            "bush": [_bush(rng, rng.uniform(0.6, 1.1), 110) for _ in range(4)],
            "far": [
                _tree(rng, rng.uniform(9, 14), rng.uniform(3.2, 4.5), 1.5, 560, (0.34, 0.6), twigs=1) for _ in range(3)
            ],
        }
    )
