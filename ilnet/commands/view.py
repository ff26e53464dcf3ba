"""The command `view`: a scan, a denser one, how they differ and how sure it is, as a page or a picture."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from ilnet import scan_files
from ilnet.commands import viewer
from ilnet.scan import Scan
from ilnet.sensor import Sensor

__all__ = ["difference", "panels", "run"]

# Differences of this much have the strongest colours [m].
_MUCH = 1.0


def run(files: Sequence[Path], out: Path, sensor: Sensor | None = None) -> None:
    """Writes a page, or a picture of the same.

    Args:
        files: One to three scans: what was measured, what was predicted from it, and the truth. With two, the second is
            compared with the first; with three, with the third.
        out: An `.html` or a `.png` file.
        sensor: The sensor of the files other than `.npz`.

    Raises:
        OSError: If a file is missing or unreadable.
        ValueError: If there are more files, one is damaged, or `out` has another suffix.
    """
    if not 1 <= len(files) <= 3:
        raise ValueError(f"there are {len(files)} files; they should be a scan, perhaps a denser one, and the truth")
    if out.suffix not in (".html", ".png"):
        raise ValueError(f"out is {out}; it should end in .html, a page, or in .png, a picture")
    # An .npz file holds its angles, so that the sensor of a denser .ply can be named beside it.
    own = {path: None if path.suffix.lower() == ".npz" else sensor for path in files}
    found = panels({path.name: scan_files.read(path, sensor) for path, sensor in own.items()})
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.suffix == ".html":
        out.write_text(viewer.page(found))
    else:
        _picture(found, out)


def panels(scans: dict[str, Scan]) -> list[viewer.Panel]:
    """Returns what to show of scans by their names, see `run`."""
    names = list(scans)
    found = [viewer.height(name, scans[name]) for name in names[:2]]
    dense = scans[names[min(1, len(names) - 1)]]
    if len(names) > 1:
        reference = names[2] if len(names) > 2 else names[0]
        away = difference(dense, scans[reference])
        title = f"{names[1]}: difference from {reference}"
        found.append(viewer.Panel(title, dense, away, (-_MUCH, _MUCH), colours="coolwarm"))
    if dense.confidence is not None:
        found.append(viewer.trust(names[min(1, len(names) - 1)], dense))
    elif dense.intensity is not None and len(names) == 1:
        found.append(viewer.Panel(f"{names[0]}: intensity", dense, dense.intensity, (0.0, 1.0), ""))
    return found


def difference(scan: Scan, reference: Scan) -> torch.Tensor:
    """Returns how much farther each return is than the reference at its nearest ray, (H, W) [m]; NaN without one."""
    pixels = reference.sensor.grid_queries(scan.sensor)
    inside = reference.sensor.contains(pixels)
    rows, columns = reference.sensor.shape
    row, column = pixels.round().long().unbind(-1)
    column = column % columns if reference.sensor.wrap else column.clamp(0, columns - 1)
    there = reference.ranges[row.clamp(0, rows - 1), column]
    return (scan.ranges - there).where(inside & (there > 0) & (scan.ranges > 0), torch.nan)


def _picture(found: Sequence[viewer.Panel], path: Path) -> None:
    """Draws panels side by side, from one camera above and behind the sensor."""
    import pyvista  # here and not above: it takes a second to import

    with pyvista.vtk_verbosity("off"):  # without a screen VTK warns of its absence, then renders all the same
        columns = min(2, len(found))
        rows = -(-len(found) // columns)
        plotter = pyvista.Plotter(
            off_screen=True, shape=(rows, columns), window_size=[800 * columns, 560 * rows], border=False
        )
        for number, panel in enumerate(found):
            plotter.subplot(number // columns, number % columns)
            plotter.add_text(panel.title, font_size=10, color="black", position="upper_left")
            measured = panel.scan.ranges > 0
            if measured.any():
                cloud = pyvista.PolyData(panel.scan.points().numpy())
                bar = f"[{panel.unit}]" + " " * number if panel.unit else " " * (number + 1)  # titles must differ
                cloud[bar] = np.asarray(panel.values[measured])
                plotter.add_mesh(
                    cloud,
                    scalars=bar,
                    cmap=panel.colours,
                    clim=panel.limits,
                    point_size=2,
                    nan_color="grey",
                    scalar_bar_args={
                        "title": bar,
                        "n_labels": 3,
                        "height": 0.06,
                        "width": 0.35,
                        "position_x": 0.03,
                        "position_y": 0.03,
                        "color": "black",
                    },
                )
            plotter.camera_position = [(-32.0, -12.0, 19.0), (7.0, 0.0, -1.0), (0, 0, 1)]
            plotter.camera.view_angle = 38
        plotter.screenshot(path)
        plotter.close()
