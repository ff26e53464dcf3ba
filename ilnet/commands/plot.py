"""Pictures: range images side by side, and scans as coloured points."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ilnet.scan import Scan
from ilnet.sensor import Sensor

__all__ = ["point_clouds", "range_images"]

# Readable in print and for the colour-blind; far is dark, no return is white.
_COLOURS = "viridis_r"


def _top_down(scan: Scan) -> tuple:
    """Returns the range image as one sees it, highest beam first, azimuth falling, 0 as NaN; and its extent [deg]."""
    image = scan.ranges.cpu().numpy()
    if scan.sensor.elevations[0] < scan.sensor.elevations[-1]:
        image = image[::-1]
    if scan.sensor.azimuths[0] < scan.sensor.azimuths[-1]:
        image = image[:, ::-1]
    image = image.copy()
    image[image == 0] = float("nan")
    return image, _degrees(scan.sensor)


def _degrees(sensor: Sensor) -> list[float]:
    """Returns left, right, bottom and top of the picture [deg]."""
    azimuths, elevations = np.rad2deg(sensor.azimuths), np.rad2deg(sensor.elevations)
    return [azimuths.max(), azimuths.min(), elevations.min(), elevations.max()]


def range_images(scans: dict[str, Scan], path: Path, title: str, sector: float | None = None) -> None:
    """Draws range images below each other.

    Args:
        scans: Scans by their captions.
        path: A picture file; its suffix decides the format.
        title: Title of the whole figure.
        sector: Azimuth to show [deg], centred on the sensor's middle column; None for all.
    """
    figure = Figure(figsize=(12, 1.35 * len(scans) + 0.8), layout="constrained")
    axes = figure.subplots(len(scans), 1, sharex=True, squeeze=False)[:, 0]
    farthest = min(max(float(scan.ranges.max()) for scan in scans.values()), 60.0)
    for axis, (caption, scan) in zip(axes, scans.items(), strict=True):
        image, extent = _top_down(scan)
        picture = axis.imshow(
            image, extent=extent, aspect="auto", interpolation="nearest", cmap=_COLOURS, vmin=0, vmax=farthest
        )
        axis.set_title(caption, loc="left", fontsize=10)
        axis.set_ylabel("elevation [°]", fontsize=8)
        if sector is not None:
            middle = (extent[0] + extent[1]) / 2
            axis.set_xlim(middle + sector / 2, middle - sector / 2)
    axes[-1].set_xlabel("azimuth [°]")
    figure.colorbar(picture, ax=list(axes), label="range [m]", fraction=0.02, pad=0.01)
    figure.suptitle(title)
    figure.savefig(path, dpi=110)


def point_clouds(scans: dict[str, Scan], path: Path, reach: float = 35.0) -> None:
    """Draws scans as points coloured by height, side by side, from one camera above and behind the sensor.

    Args:
        scans: Scans by their captions.
        path: A `.png` file.
        reach: Distance around the sensor to show [m].
    """
    import pyvista  # here and not above: it takes a second to import

    # Without a screen VTK warns of its absence, then renders all the same.
    with pyvista.vtk_verbosity("off"):
        columns = min(
            (3, 4, 5), key=lambda count: -len(scans) % count
        )  # the number that leaves the fewest places empty
        rows = -(-len(scans) // columns)
        window = [600 * columns, 480 * rows]
        plotter = pyvista.Plotter(off_screen=True, shape=(rows, columns), window_size=window, border=False)
        for number, (caption, scan) in enumerate(scans.items()):
            plotter.subplot(number // columns, number % columns)
            points = scan.points().cpu()
            points = points[points[:, :2].norm(dim=1) < reach]
            plotter.add_text(caption, font_size=12, color="black", position="upper_edge")
            if len(points):
                cloud = pyvista.PolyData(points.numpy())
                cloud["height [m]"] = points[:, 2].numpy()
                plotter.add_mesh(
                    cloud, scalars="height [m]", cmap="viridis", clim=(-2, 4), point_size=2, show_scalar_bar=False
                )
            plotter.camera_position = [(-0.9 * reach, -0.35 * reach, 0.55 * reach), (0.2 * reach, 0.0, -1.0), (0, 0, 1)]
            plotter.camera.view_angle = 38
        plotter.screenshot(path)
        plotter.close()
