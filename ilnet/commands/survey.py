"""Simulated scans beside measured ones: how many rays return, from how far, across which edges, off which surfaces.

A scan depends on its rays at least as much as on its surroundings. So towns and meshes are scanned with the rays of
each measured scan: its beam tables, its range limits, and its height above the ground, which the scan itself shows.
Their ranges have the noise of `NOISE`, and no return is lost. Returns beyond a sensor's maximum range count as none.
Pixels with a return nearer than its minimum range are left out: there the sensor sees its own vehicle.

Measured scans are not levelled: a tilted sensor sees tilted ground.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ilnet import scan_files
from ilnet.scan import Scan
from ilnet.sensor import Sensor, preset
from ilnet.world import meshes, places, simulate, towns
from ilnet.world.effects import Effects

__all__ = ["Entry", "Statistics", "compare", "draw", "ground_height", "records", "statistics", "table"]

NOISE = Effects(range_noise=0.01, range_noise_growth=0.0005)
"""Noise of simulated scans: as in measured ones along smooth surfaces, 1 to 2 cm near and 3 to 6 cm far."""
RANGE_BINS = tuple(range(0, 81, 2))
"""Borders of the histogram of ranges [m]."""
SLOPE_BINS = tuple(range(0, 91, 5))
"""Borders of the histogram of slopes [degrees]."""
EDGE = (0.25, 0.025)
"""A pixel is at a range edge where its range differs from the one that its neighbours predict by more than this many
metres, and by more than this share of its range."""

# Slopes at which flat surfaces end and upright ones begin [degrees]; slanted ones lie between.
_FLAT, _UPRIGHT = 15, 75
# A pixel's surface is fitted over this angle to either side [degrees]: wide enough for noise to cancel.
_WINDOW = 0.75
# Number of positions in a town; a mesh has its own.
_POSITIONS = 10
# Used where no measured scan brings a sensor.
_SENSOR = preset("paper-64x1024")


@dataclass(frozen=True)
class Statistics:
    """Statistics of a scan, or the means over several.

    Attributes:
        return_rate: Share of the pixels that have a return within the sensor's limits.
        median_range: Median of the returns' ranges [m].
        edges: Share of pixels at range edges, of those whose two neighbours in their row or in their column returned.
        smooth: Share of the returns that lie on one surface with all pixels around: there is no edge and no missing
            return within 0.75 degrees.
        ranges: Shares of the returns in `RANGE_BINS`.
        slopes: Shares of the smooth returns whose surface is inclined to the horizontal as in `SLOPE_BINS`.
    """

    return_rate: float
    median_range: float
    edges: float
    smooth: float
    ranges: list[float]
    slopes: list[float]

    def summary(self) -> dict[str, float]:
        """Returns the numbers of a table: the histogram of slopes as three shares, that of ranges as the median."""
        flat, upright = SLOPE_BINS.index(_FLAT), SLOPE_BINS.index(_UPRIGHT)
        return {
            "return_rate": self.return_rate,
            "median_range": self.median_range,
            "edges": self.edges,
            "smooth": self.smooth,
            "flat": sum(self.slopes[:flat]),
            "slanted": sum(self.slopes[flat:upright]),
            "upright": sum(self.slopes[upright:]),
        }


class Entry(NamedTuple):
    """The scans of one source with the rays of one sensor."""

    sensor: str
    """The measured scan whose rays these are, or the sensor's preset."""
    source: str
    """The measured scan, the town or the mesh."""
    kind: str
    """"measured", "town" or "mesh"."""
    scans: list[Statistics]
    """One for each position."""

    @property
    def mean(self) -> Statistics:
        """The mean over the positions."""
        columns: dict[str, Any] = {
            field.name: np.mean([getattr(scan, field.name) for scan in self.scans], axis=0).tolist()
            for field in fields(Statistics)
        }
        return Statistics(**columns)


def statistics(scan: Scan) -> Statistics:
    """Returns the statistics of a scan.

    Along a plane the inverse range is nearly linear in the angles. So the inverse ranges of a pixel's neighbours
    predict its own where all lie on one surface, at any angle of incidence; `EDGE` is the tolerance. The plane through
    a pixel's surroundings is a linear fit to their inverse ranges.

    Args:
        scan: A scan with some return between its sensor's minimum and maximum range.

    Raises:
        ValueError: If there is no such return.
    """
    ranges, sensor = scan.ranges.cpu(), scan.sensor
    seen = _seen(scan)
    if not seen.any():
        raise ValueError(
            f"the scan has no return between {sensor.min_range:g} and {sensor.max_range:g} m: are its ranges metres?"
        )
    blocked = (ranges > 0) & (ranges < sensor.min_range)
    edge, judged, _ = _edges(scan)
    slope, _ = _surfaces(scan)
    return Statistics(
        return_rate=int(seen.sum()) / int((~blocked).sum()),
        median_range=float(ranges[seen].median()),
        edges=int(edge.sum()) / max(int(judged.sum()), 1),
        smooth=len(slope) / int(seen.sum()),
        ranges=_shares(ranges[seen], RANGE_BINS),
        slopes=_shares(slope, SLOPE_BINS),
    )


def ground_height(scan: Scan) -> float | None:
    """Returns the median height of the sensor above the flat surfaces below it [m]; None where it sees none."""
    slope, z = _surfaces(scan)
    ground = z[(slope < _FLAT) & (z < 0)]
    return -float(ground.median()) if len(ground) else None


def _seen(scan: Scan) -> torch.Tensor:
    ranges = scan.ranges.cpu()
    return scan.sensor.sees(ranges)


def _shares(values: torch.Tensor, borders: Sequence[int]) -> list[float]:
    counts, _ = np.histogram(values.numpy(), borders)
    return (counts / max(len(values), 1)).tolist()


def _edges(scan: Scan) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns (H, W) bool: pixels at edges, pixels with two neighbours in a direction, and those with all four."""
    sensor, ranges = scan.sensor, scan.ranges.cpu().double()
    inverse = (1 / ranges).where(_seen(scan), torch.nan)
    threshold = (EDGE[1] * ranges).clamp(min=EDGE[0])
    departs, known = [], []
    for image, table, wrap in (
        (inverse, sensor.azimuths, sensor.wrap),
        (inverse.mT, sensor.elevations, False),
    ):
        angles = torch.tensor(table)
        before = (torch.remainder(angles - angles.roll(1) + math.pi, math.tau) - math.pi).abs()
        after = before.roll(-1)
        expected = (image.roll(1, 1) * after + image.roll(-1, 1) * before) / (before + after)
        if not wrap:
            expected[:, [0, -1]] = torch.nan
        gap = 1 / expected - 1 / image  # NaN where one of the three did not return
        gap = gap if image is inverse else gap.mT
        departs.append(gap.abs() > threshold)
        known.append(gap.isfinite())
    return departs[0] | departs[1], known[0] | known[1], known[0] & known[1]


def _surfaces(scan: Scan) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the slopes (N,) [degrees] and z coordinates (N,) [m] of all pixels on smooth surfaces."""
    sensor, ranges = scan.sensor, scan.ranges.cpu().double()
    edge, _, surrounded = _edges(scan)
    inverse = (1 / ranges).where(_seen(scan), 0.0)
    rays = sensor.directions().double().movedim(-1, 0)
    # The plane n·x = 1 that fits 1/r = n·d best over a window of pixels takes the sums of d dᵀ and of d / r over it.
    products = torch.cat(((rays[:, None] * rays).flatten(0, 1), rays * inverse, (surrounded & ~edge)[None].double()))
    rows, columns = (
        max(1, round(math.radians(_WINDOW) / abs(table[-1] - table[0]) * (len(table) - 1)))
        for table in (sensor.elevations, sensor.azimuths)
    )
    if sensor.wrap:
        products = torch.cat((products[..., -columns:], products, products[..., :columns]), -1)
    if products.shape[1] <= 2 * rows or products.shape[2] <= 2 * columns:
        return torch.empty(0), torch.empty(0)
    sums = torch.nn.functional.avg_pool2d(products, (2 * rows + 1, 2 * columns + 1), 1).movedim(0, -1)
    inner = slice(rows, -rows), slice(None) if sensor.wrap else slice(columns, -columns)
    smooth = sums[..., 12] > 1 - 1e-6  # all pixels of the window
    normal = torch.linalg.solve(sums[smooth][:, :9].unflatten(1, (3, 3)), sums[smooth][:, 9:12])
    slope = (normal[:, 2].abs() / normal.norm(dim=1)).clamp(max=1.0).acos().rad2deg()
    return slope, (rays[2] * ranges)[inner][smooth]


def compare(files: Iterable[Path], mesh_files: Iterable[tuple[Path, Path]], town_names: Iterable[str]) -> list[Entry]:
    """Returns the statistics of measured scans, and of towns and meshes seen with the rays of each.

    Args:
        files: Scans that hold their angles, see `ilnet.scan_files.read`. Without any, the rays are those of the preset
            paper-64x1024.
        mesh_files: Mesh files (metres, z up), each with a JSON file of `positions`, a list of x, y, z [m], which are
            `sensor_height_m` above its ground.
        town_names: Names from `ilnet.world.towns.NAMES`. Each town is scanned from 10 waypoints in its traffic.

    Raises:
        OSError: If a file is missing.
        ValueError: If a file or a name is not of that kind, two scans or two of the rest have one name, or nothing is
            in range.
    """
    files, mesh_files, town_names = list(files), list(mesh_files), list(town_names)
    _refuse_doubles([path.stem for path in files])
    _refuse_doubles([path.stem for path, _ in mesh_files] + town_names)
    entries = []
    sensors: list[tuple[str, Sensor, float]] = []
    for path in files:
        scan = scan_files.read(path)
        entries.append(Entry(path.stem, path.stem, "measured", [_examined(path, scan)]))
        sensors.append((path.stem, scan.sensor, ground_height(scan) or towns.SENSOR_HEIGHT))
    sensors = sensors or [(_SENSOR.name, _SENSOR, towns.SENSOR_HEIGHT)]
    device = simulate.best_device()
    for name in town_names:
        place = places.town(name, device=device)
        entries += _simulated(name, "town", place, place.spread(_POSITIONS), sensors)
    for path, positions in mesh_files:
        place = places.mesh(path, meshes.read_positions(positions, towns.SENSOR_HEIGHT), device)
        entries += _simulated(path.stem, "mesh", place, range(len(place.waypoints)), sensors)
    return sorted(entries, key=lambda entry: [name for name, *_ in sensors].index(entry.sensor))


def _refuse_doubles(names: Sequence[str]) -> None:
    """Raises a ValueError where two sources have one name, by which results are told apart."""
    for number, name in enumerate(names):
        if name in names[:number]:
            raise ValueError(f"two sources are called {name}; rename a file, or leave one out")


def _simulated(
    source: str, kind: str, place: places.Place, waypoints: Iterable[int], sensors: Iterable[tuple[str, Sensor, float]]
) -> list[Entry]:
    # The same traffic for sensors at all heights.
    worlds = [(waypoint, place.world(place.position(waypoint), waypoint)) for waypoint in waypoints]
    entries = []
    for name, sensor, height in sensors:
        found = []
        for number, (waypoint, world) in enumerate(worlds):
            pose = place.pose(waypoint, height - towns.SENSOR_HEIGHT)
            scan = simulate.scan(world, sensor, pose, NOISE, seed=number)
            found.append(_examined(f"{source}, position {number}", scan))
        entries.append(Entry(name, source, kind, found))
    return entries


def _examined(source: Path | str, scan: Scan) -> Statistics:
    try:
        return statistics(scan)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


def records(entries: Iterable[Entry]) -> list[dict[str, Any]]:
    """Returns each entry as JSON values: the number of scans, the summary (mean, lowest, highest), the histograms."""

    def rounded(values: Iterable[float]) -> list[float]:
        return [round(value, 4) for value in values]

    found = []
    for entry in entries:
        summaries = [scan.summary() for scan in entry.scans]
        columns = {key: [summary[key] for summary in summaries] for key in _TITLES}
        found.append(
            {
                "sensor": entry.sensor,
                "source": entry.source,
                "kind": entry.kind,
                "scans": len(entry.scans),
                "mean": dict(zip(columns, rounded(map(np.mean, columns.values())), strict=True)),
                "lowest": dict(zip(columns, rounded(map(min, columns.values())), strict=True)),
                "highest": dict(zip(columns, rounded(map(max, columns.values())), strict=True)),
                "ranges": {"borders_m": RANGE_BINS, "shares": rounded(entry.mean.ranges)},
                "slopes": {"borders_deg": SLOPE_BINS, "shares": rounded(entry.mean.slopes)},
            }
        )
    return found


_TITLES = {
    "return_rate": "return rate",
    "median_range": "median range [m]",
    "edges": "at edges",
    "smooth": "smooth",
    "flat": "flat",
    "slanted": "slanted",
    "upright": "upright",
}


def table(entries: Sequence[Entry]) -> str:
    """Returns the means of all entries as a table, grouped by their rays."""
    wide = max(len(entry.source) for entry in entries) + 2
    lines = []
    for sensor in dict.fromkeys(entry.sensor for entry in entries):
        head = "".join(f"{title:>{max(len(title) + 2, 10)}}" for title in _TITLES.values())
        lines += ["", f"the rays of {sensor}", f"{'':{wide}}{head}"]
        for entry in entries:
            if entry.sensor == sensor:
                summary = entry.mean.summary()
                cells = (
                    f"{summary[key]:{max(len(title) + 2, 10)}.{1 if key == 'median_range' else 3}f}"
                    for key, title in _TITLES.items()
                )
                lines.append(f"{'measured' if entry.kind == 'measured' else entry.source:{wide}}" + "".join(cells))
    return "\n".join(lines[1:])


# Readable in print and by the colour-blind (Okabe and Ito).
_LOOKS: dict[str, dict[str, Any]] = {
    "town": {"color": "#0072B2", "linewidth": 1.0, "linestyle": "-"},
    "mesh": {"color": "#D55E00", "linewidth": 1.0, "linestyle": (0, (4, 2))},
    "measured": {"color": "black", "linewidth": 2.2, "linestyle": "-"},
}
_MARKERS = "osD^vPX*"


def draw(entries: Sequence[Entry], path: Path) -> None:
    """Draws the histograms for the rays of each sensor, and the summaries of all sources beside each other.

    Args:
        entries: Results of `compare`.
        path: A picture file; its suffix says the format.
    """
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    sensors = list(dict.fromkeys(entry.sensor for entry in entries))
    simulated = [entry for entry in entries if entry.kind != "measured"]
    sources = ["measured", *dict.fromkeys(entry.source for entry in simulated)]
    figure = Figure(figsize=(14, 6.5 + 0.3 * len(sources)), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[5, 1.5 + 0.3 * len(sources)])[:, 0]
    axes = upper.subplots(2, len(sensors), squeeze=False, sharey="row")
    for column, sensor in zip(axes.T, sensors, strict=True):
        for kind, look in _LOOKS.items():
            for entry in entries:
                if (entry.sensor, entry.kind) == (sensor, kind):
                    column[0].stairs(entry.mean.ranges, RANGE_BINS, **look)
                    column[1].stairs(entry.mean.slopes, SLOPE_BINS, **look)
        column[0].set_title(sensor, fontsize=9)
        column[0].set_xlabel("range [m]")
        column[1].set_xlabel("slope of the surface [°]")
        column[1].set_yscale("log")
        column[1].set_ylim(3e-4, 1)
    axes[0, 0].set_ylabel("share of returns in 2 m")
    axes[1, 0].set_ylabel("share of surfaces in 5°")

    panels = lower.subplots(1, len(_TITLES), sharey=True)
    for panel, (key, title) in zip(panels, _TITLES.items(), strict=True):
        for entry in entries:
            place = sensors.index(entry.sensor)
            row = sources.index("measured" if entry.kind == "measured" else entry.source)
            height = row + 0.7 * ((place + 0.5) / len(sensors) - 0.5)
            values = [scan.summary()[key] for scan in entry.scans]
            colour = _LOOKS[entry.kind]["color"]
            panel.plot([min(values), max(values)], [height, height], color=colour, linewidth=0.8, alpha=0.5)
            marker = _MARKERS[place % len(_MARKERS)]
            panel.plot(np.mean(values), height, marker=marker, color=colour, markersize=4, linestyle="none")
        panel.set_title(title, fontsize=9)
        panel.grid(axis="x", linewidth=0.4)
        panel.set_yticks(range(len(sources)), sources, fontsize=8)
        panel.set_ylim(len(sources) - 0.5, -0.5)
    handles = [Line2D([], [], label=kind, **look) for kind, look in _LOOKS.items()]
    handles += [
        Line2D([], [], label=sensor, color="grey", marker=_MARKERS[i % len(_MARKERS)], linestyle="none")
        for i, sensor in enumerate(sensors)
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    figure.suptitle("Simulated and measured scans with the same rays; below, means and extremes over the positions")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
