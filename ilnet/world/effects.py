"""What a real sensor does to a scan: noise, lost returns, wide beams, staggered columns, and its own motion.

A beam is cast as a bundle of sub-rays. Their hits are grouped into returns, of which the sensor reports one:

- The beam is an evenly lit disc of the full angle `divergence`. Its 19 sub-rays, one in the middle and two rings of 6
  and 12, stand for equal parts of it: each has the energy e = 1/19.
- A hit at range r, under an angle whose cosine is c, sends back e c / r² (Lambert's law, the same albedo everywhere).
- Hits closer to each other than `RANGE_RESOLUTION` are one return, since their pulses overlap. Its range is the mean of
  their ranges, weighted with the energy they send back: surfaces too close to tell apart give a range between them.
  Hits nearer than the sensor's minimum range send nothing back.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch

from ilnet.scan import Scan
from ilnet.sensor import Sensor, angles_to_directions
from kernels import Mesh

__all__ = ["RANGE_RESOLUTION", "REFERENCE_RANGE", "Effects", "nearer", "simulate_with", "spoil"]

RANGE_RESOLUTION = 0.5
"""Least distance between two returns of a beam [m]: half the length of a pulse of 3.3 ns."""
REFERENCE_RANGE = 10.0
"""Range at which a surface that faces the sensor has intensity 1 [m]."""

# Rings of sub-rays around the one in the middle: their number, and the part of their spacing that they are turned by,
# so that few meet an edge at once. The share of sub-rays behind an edge differs from that of the beam by about 0.03,
# and by at most 0.11.
_RINGS = ((6, 0.0), (12, 0.25))
_SUB_RAYS = 19
# Rays cast at a time, at about 200 bytes each: this bounds the memory.
_CHUNK = 2**19
# Least cosine of a hit: energies are divided by their sum, which must not be 0.
_LEAST_COSINE = 1e-6
_MOST_DIVERGENCE = 0.1


@dataclass(frozen=True)
class Effects:
    """What a sensor does to its measurements. By default it does nothing.

    Args:
        range_noise: Standard deviation of the range [m], the same near and far.
        range_noise_growth: Standard deviation added per metre of range [m/m]. At range r the noise is Gaussian with the
            standard deviation `range_noise + range_noise_growth * r`.
        dropout: Probability of losing any return, whatever it comes from: dust, interference, a lost packet.
        dropout_range: Probability of losing a return at the sensor's maximum range R; at r it is
            `dropout_range * (r / R)**2`.
        dropout_incidence: Probability of losing a return from a surface seen edge-on; where c is the cosine between
            beam and normal, it is `dropout_incidence * (1 - c)**2`. The two losses are independent.
        intensity: Whether the scan has an intensity: the sum of `e * c * (REFERENCE_RANGE / r)**2` over the hits of the
            return, at most 1. Noise does not change it.
        divergence: Full angle of a beam [rad]; 0 is a beam without width.
        returns: Which return is reported: "first" (the nearest), "last" or "strongest" (the one with most energy).
        azimuth_offsets: For each row the azimuth of its beam minus that of the column [rad], as the lasers are mounted;
            empty for none. Ranges stay in the nominal column, as drivers store them.
        velocity: Velocity of the sensor in its own frame [m/s].
        angular_velocity: Angular velocity of the sensor about the axes of its own frame [rad/s].
        turn_time: Time of a full turn [s], in which columns are fired one after the other.

    Raises:
        ValueError: If a value is of the wrong kind, not finite, or out of its limits.
    """

    range_noise: float = 0.0
    range_noise_growth: float = 0.0
    dropout: float = 0.0
    dropout_range: float = 0.0
    dropout_incidence: float = 0.0
    intensity: bool = False
    divergence: float = 0.0
    returns: str = "strongest"
    azimuth_offsets: Sequence[float] = ()
    velocity: Sequence[float] = (0.0, 0.0, 0.0)
    angular_velocity: Sequence[float] = (0.0, 0.0, 0.0)
    turn_time: float = 0.1

    def __post_init__(self) -> None:
        for name, most, meaning in (
            ("range_noise", math.inf, "a standard deviation [m]"),
            ("range_noise_growth", math.inf, "metres of standard deviation per metre of range"),
            ("dropout", 1.0, "a probability"),
            ("dropout_range", 1.0, "a probability"),
            ("dropout_incidence", 1.0, "a probability"),
            ("divergence", _MOST_DIVERGENCE, "an angle in radians; real beams have some thousandths"),
            ("turn_time", math.inf, "seconds; a sensor at 10 Hz takes 0.1"),
        ):
            (value,) = _numbers(name, [getattr(self, name)], meaning)
            if not 0 <= value <= most:
                raise ValueError(f"{name} is {value:g}; it should lie from 0 to {most:g}: {meaning}")
            object.__setattr__(self, name, value)
        if self.turn_time == 0:
            raise ValueError("turn_time is 0; it should be above 0: to stop the motion set the velocities to 0")
        if not isinstance(self.intensity, bool):
            raise ValueError(f"intensity is {self.intensity!r}; it should be True or False")
        if self.returns not in _CHOICES:
            raise ValueError(f"returns is {self.returns!r}; it should be one of {', '.join(_CHOICES)}")
        for name, meaning in (("velocity", "m/s along x, y and z"), ("angular_velocity", "rad/s about x, y and z")):
            vector = _numbers(name, getattr(self, name), meaning)
            if len(vector) != 3:
                raise ValueError(f"{name} has {len(vector)} numbers; it should have three: {meaning}")
            object.__setattr__(self, name, vector)
        offsets = _numbers("azimuth_offsets", self.azimuth_offsets, "rad, one for each row")
        if any(abs(offset) > math.pi for offset in offsets):
            raise ValueError(
                f"azimuth_offsets reaches {max(offsets, key=abs):g} rad; it should be at most half a turn: are these "
                "degrees?"
            )
        object.__setattr__(self, "azimuth_offsets", offsets)


def simulate_with(
    effects: Effects, meshes: Sequence[Mesh], sensor: Sensor, pose: torch.Tensor, generator: torch.Generator
) -> Scan:
    """Casts every ray of a sensor at some meshes, and does to the ranges what a real sensor does.

    While it turns, the sensor moves with constant velocity and constant angular velocity in its own frame. The motion
    is integrated exactly, with the exponential map of SE(3). The columns are fired in the order of the table, each when
    the head looks along its azimuth; the pose is that in the middle of the table. Ranges are reported at the sensor's
    nominal angles, as by a driver that ignores the motion.

    Ranges below the sensor's minimum or beyond its maximum, noise included, are no returns.

    Args:
        effects: What to do to the ranges; with `Effects()` they are those of `Mesh.cast`.
        meshes: The world, in metres, all on one device; the nearest hit counts.
        sensor: The sensor whose rays are cast.
        pose: (4, 4) transform from the sensor frame to the world in the middle of the turn.
        generator: Source of random numbers, on the CPU, so that they are the same for every device.

    Returns:
        The scan, on the device of the meshes; 0 where nothing returned.

    Raises:
        ValueError: If there is no mesh, or not one azimuth offset for each row.
    """
    if not meshes:
        raise ValueError("meshes is empty; it should hold at least one Mesh to cast rays at")
    device, (height, width) = meshes[0].device, sensor.shape
    # Always drawn, so that switching one effect on does not change the random numbers of the others.
    noise, luck = torch.randn(height, width, generator=generator), torch.rand(height, width, generator=generator)

    origins, axes = _beams(effects, sensor, pose, device)
    pattern = _footprint(effects.divergence, device)
    rows = max(_CHUNK // (width * len(pattern)), 1)
    images = []
    for origin, axis in zip(origins.split(rows), axes.split(rows), strict=True):
        directions = axis[..., None, 0, :] + pattern @ axis[..., 1:, :]
        ranges, cosines = _nearest(meshes, origin[..., None, :], directions, sensor.max_range)
        images.append(_report(ranges.where(ranges >= sensor.min_range, 0.0), cosines, effects.returns))
    ranges, cosines, energy = (torch.cat(image) for image in zip(*images, strict=True))

    ranges = spoil(effects, ranges, cosines, sensor, noise.to(device), luck.to(device))
    intensity = (energy * (REFERENCE_RANGE**2 / len(pattern))).clamp(max=1.0) if effects.intensity else None
    return Scan(ranges, sensor, intensity)


def spoil(
    effects: Effects,
    ranges: torch.Tensor,
    cosines: torch.Tensor,
    sensor: Sensor,
    noise: torch.Tensor,
    luck: torch.Tensor,
) -> torch.Tensor:
    """Adds noise to clean ranges, and loses some of them.

    Args:
        effects: Its noise and its three dropouts are applied; its other effects happen while rays are cast.
        ranges: (...) clean ranges [m], 0 where nothing returned.
        cosines: (...) cosines of the angles between beam and surface normal, 0 to 1.
        sensor: The sensor that measures. Ranges outside its limits, noise included, become no returns.
        noise: (...) numbers from the standard normal distribution.
        luck: (...) numbers drawn evenly from 0 to 1. A return is lost where its number is below the probability.

    Returns:
        (...) ranges [m] on the device of `ranges`, 0 where nothing returned.
    """
    lost_far = effects.dropout_range * (ranges / sensor.max_range) ** 2
    lost_grazing = effects.dropout_incidence * (1 - cosines) ** 2
    seen = (ranges > 0) & (luck >= 1 - (1 - effects.dropout) * (1 - lost_far) * (1 - lost_grazing))
    ranges = ranges + noise * (effects.range_noise + effects.range_noise_growth * ranges)
    return ranges.where(seen & sensor.sees(ranges), 0.0)


def _beams(
    effects: Effects, sensor: Sensor, pose: torch.Tensor, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns where each beam starts, (H, W, 3) [m], and its axes, (H, W, 3, 3), both float64 in the world.

    The axes are unit vectors: along the beam, to its left, and to its top.
    """
    elevations, azimuths = torch.tensor(sensor.elevations)[:, None], torch.tensor(sensor.azimuths)[None, :]
    offsets = torch.tensor(effects.azimuth_offsets or [0.0] * len(elevations), dtype=torch.float64)[:, None]
    if len(offsets) != len(elevations):
        raise ValueError(
            f"azimuth_offsets has {len(offsets)} entries; it should have {len(elevations)}, one for each beam"
        )
    looks = azimuths + offsets
    ahead = angles_to_directions(elevations, looks)
    left = angles_to_directions(torch.zeros(()), looks + math.pi / 2).expand_as(ahead)
    # Rounded to float32, like `Sensor.directions`.
    axes = torch.stack((ahead.float().double(), left, torch.linalg.cross(ahead, left)), 2)

    # The sensor's frame when column j is fired, in its frame in the middle of the turn.
    sweep = math.copysign(effects.turn_time / math.tau, azimuths[0, -1] - azimuths[0, 0])
    times = (azimuths[0] - (azimuths[0, 0] + azimuths[0, -1]) / 2) * sweep
    wx, wy, wz = effects.angular_velocity
    vx, vy, vz = effects.velocity
    twist = torch.tensor([[0.0, -wz, wy, vx], [wz, 0.0, -wx, vy], [-wy, wx, 0.0, vz], [0.0] * 4], dtype=torch.float64)
    motion = torch.linalg.matrix_exp(times[:, None, None] * twist)

    pose, motion = pose.double().to(device), motion.to(device)
    axes = axes.to(device) @ motion[:, :3, :3].mT @ pose[:3, :3].mT
    return (motion[:, :3, 3] @ pose[:3, :3].mT + pose[:3, 3]).expand(*sensor.shape, 3), axes


def _footprint(divergence: float, device: torch.device) -> torch.Tensor:
    """Returns the sub-rays of a beam, (K, 2): tangents of the angles to its left and to its top."""
    rings, inside = [torch.zeros(1, 2, dtype=torch.float64, device=device)], 1
    if divergence == 0:
        return rings[0]
    for count, turn in _RINGS:
        # The root mean square of the radii that the ring stands for.
        radius = math.tan(divergence / 2) * math.sqrt((inside + count / 2) / _SUB_RAYS)
        angle = (torch.arange(count, dtype=torch.float64, device=device) + turn) * (math.tau / count)
        rings.append(radius * torch.stack((angle.cos(), angle.sin()), 1))
        inside += count
    return torch.cat(rings)


def nearer(ranges: torch.Tensor, than: torch.Tensor) -> torch.Tensor:
    """Returns where some ranges [m] are nearer than others of the same rays; 0 is no return, farther than any."""
    return (ranges > 0) & ((than == 0) | (ranges < than))


def _nearest(
    meshes: Sequence[Mesh], origins: torch.Tensor, directions: torch.Tensor, max_range: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns range [m] and cosine of the nearest hit in any mesh; 0 for none."""
    ranges, _, cosines = meshes[0].cast(origins, directions, max_range)
    for mesh in meshes[1:]:
        other = mesh.cast(origins, directions, max_range)
        front = nearer(other.range, ranges)
        ranges, cosines = other.range.where(front, ranges), other.cosine.where(front, cosines)
    return ranges, cosines


def _report(
    ranges: torch.Tensor, cosines: torch.Tensor, returns: str
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Groups the hits of each beam's sub-rays into returns, and picks one.

    Args:
        ranges: (..., K) metres, 0 for no hit.
        cosines: (..., K) cosines of the incidence.
        returns: A key of `_CHOICES`.

    Returns:
        For the picked return, each (...): its range [m], 0 for none; its cosine; and the sum of c / r² [1/m²] over its
        hits.
    """
    ranges, order = ranges.where(ranges > 0, torch.inf).sort(-1)
    hit = ranges.isfinite()
    cosines = cosines.gather(-1, order)
    energy = cosines.clamp(min=_LEAST_COSINE) / ranges.square()
    # Number of the return that a hit belongs to: a gap begins the next one. Misses come last, without energy.
    group = torch.nn.functional.pad(ranges.diff(dim=-1) > RANGE_RESOLUTION, (1, 0)).cumsum(-1)
    member = hit & (group == _CHOICES[returns](group, hit, energy))
    energy = energy.where(member, 0.0)
    total = energy.sum(-1)
    share = energy / total.clamp(min=torch.finfo(total.dtype).tiny)[..., None]
    # Relative to the nearest hit, so that a single hit keeps its range to the last bit.
    nearest = ranges.where(member, torch.inf).amin(-1, keepdim=True)
    behind = (share * (ranges - nearest).where(member, 0.0)).sum(-1)
    return (nearest.squeeze(-1) + behind).where(total > 0, 0.0), (share * cosines).sum(-1), total


def _first(group: torch.Tensor, hit: torch.Tensor, energy: torch.Tensor) -> torch.Tensor:
    return torch.zeros_like(group[..., :1])


def _last(group: torch.Tensor, hit: torch.Tensor, energy: torch.Tensor) -> torch.Tensor:
    return group.where(hit, 0).amax(-1, keepdim=True)


def _strongest(group: torch.Tensor, hit: torch.Tensor, energy: torch.Tensor) -> torch.Tensor:
    # Summed for each hit over its return: a scatter would add in another order in each run on CUDA.
    sums = (energy[..., None, :] * (group[..., :, None] == group[..., None, :])).sum(-1)
    return group.gather(-1, sums.argmax(-1, keepdim=True))


_CHOICES = {"first": _first, "strongest": _strongest, "last": _last}


def _numbers(name: str, values: Iterable[float], meaning: str) -> tuple[float, ...]:
    """Returns the numbers in a list, an array or a tensor.

    Raises:
        ValueError: If something in it is no number, or not finite.
    """
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {values!r}; it should hold numbers: {meaning}") from None
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name} is {', '.join(map(str, numbers))}; it should be finite: {meaning}")
    return numbers
