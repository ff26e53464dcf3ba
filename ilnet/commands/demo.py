"""The command `demo`: a scan, its upsampled versions, their figures and pictures."""

from pathlib import Path
from typing import Any

from ilnet import models, scan_files
from ilnet.commands import plot
from ilnet.learning import metrics
from ilnet.scan import Pair, Scan
from ilnet.sensor import PAPER_INPUT, PAPER_TARGET
from ilnet.world import places, simulate

__all__ = ["METHODS", "TOWN", "from_town", "run"]

METHODS = ("nearest", "bilinear", "bilinear-inverse", "planes", "liif", "iln", "iln-surfaces")
# A test town: no network was trained and nothing was chosen in it.
TOWN = "town10"
_WAYPOINT = 1400


def from_town() -> Pair:
    """Returns a scan of 16×1024 rays in the town, and one of 128×2048 rays at the same pose."""
    place = places.town(TOWN, device=simulate.best_device())
    pose = place.pose(_WAYPOINT)
    world = place.world(pose[:3, 3], seed=0)
    return simulate.scan(world, PAPER_INPUT, pose), simulate.scan(world, PAPER_TARGET, pose)


def run(scan: Scan, truth: Scan, out: Path, source: str) -> dict[str, Any]:
    """Upsamples a scan with every method, measures and draws the results.

    Args:
        scan: The scan that the methods see.
        truth: The scan that they should predict.
        out: Folder for the pictures and the point cloud; made if it is missing.
        source: Name of the scene, for titles.

    Returns:
        A dict: `methods` holds the figures of `metrics.compare` by method; `input` and `output` are the sizes.
    """
    out.mkdir(parents=True, exist_ok=True)
    figures, upsampled = {}, {}
    for name in METHODS:
        ranges = models.load(name).to(scan.ranges.device).ranges(scan, truth.sensor)
        figures[name] = metrics.compare(ranges, truth)
        upsampled[name] = models.returns(ranges, scan.sensor, truth.sensor)
    pictures = {f"input, {scan.sensor.size}": scan, **upsampled, f"truth, {truth.sensor.size}": truth}
    plot.range_images(pictures, out / "range_images.png", f"{source}: range images")
    plot.range_images(pictures, out / "range_images_sector.png", f"{source}: 90° of them", sector=90)
    plot.point_clouds({n: s for n, s in pictures.items() if n != "nearest"}, out / "points.png")
    scan_files.write(out / "iln-surfaces.ply", upsampled["iln-surfaces"])
    return {"methods": figures, "input": scan.sensor.size, "output": truth.sensor.size}
