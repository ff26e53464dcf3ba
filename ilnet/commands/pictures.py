"""Pictures of towns: each from above and from the street, a scan of each, and a sheet of them all."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from ilnet.commands import plot
from ilnet.scan import Scan
from ilnet.sensor import preset
from ilnet.world import simulate
from ilnet.world.places import SENSOR_HEIGHT
from ilnet.world.towns import Town, build, traffic
from kernels import Mesh

__all__ = ["draw"]

# Where the street is drawn and scanned, as a share of the waypoints; chosen for the view.
_PLACES = {
    "town01": 0.2,
    "town02": 0.03,
    "town03": 0.12,
    "town04": 0.042,
    "town05": 0.5,
    "town06": 0.55,
    "town07": 0.2,
    "town10": 0.02,
}
_SENSOR = preset("paper-128x2048")
_ABOVE, _STREET = (1200, 900), (1200, 600)
_SHEET_COLUMNS, _SHEET_WIDTH = 4, 400
_COLOURS = {
    "ground": (208, 202, 186),
    "lawn": (184, 192, 148),
    "wall": (240, 230, 212),
    "roof": (178, 112, 92),
    "leaf": (124, 160, 88),
    "lane": (104, 105, 110),
    "traffic": (104, 146, 196),
    "sky": (216, 228, 240),
}


def draw(names: list[str], out: Path) -> list[Path]:
    """Builds towns with seed 0, draws and scans them.

    Args:
        names: Which towns.
        out: Folder for the pictures; made where missing.

    Returns:
        The files: two views of each town, the scans as range images and as points, and the sheet `towns.png`.

    Raises:
        ValueError: For an unknown name.
    """
    files, scans, panels = [], {}, []
    for name in names:
        town = build(name)
        out.mkdir(parents=True, exist_ok=True)
        number = int(_PLACES[name] * len(town.waypoints))
        at = town.waypoints[number] + np.array([0, 0, SENSOR_HEIGHT], dtype=np.float32)
        heading = float(town.headings[number])
        about = traffic(town, at, 0)
        above, street = _from_above(town), _from_the_street(town, about, at, heading)
        scans[name] = _scan(town, about, at, heading)
        panels.append((f"{name}: {len(town.triangles) / 1e6:.2f} M triangles", above, street))
        for view, picture in (("above", above), ("street", street)):
            files.append(out / f"{name}_{view}.jpg")
            picture.save(files[-1], quality=78)
    files += [out / "range_images.png", out / "points.png", out / "towns.png"]
    height, width = _SENSOR.shape
    plot.range_images(scans, files[-3], f"One scan of {height} by {width} rays in each town")
    plot.point_clouds(scans, files[-2])
    Image.open(files[-2]).convert("RGB").quantize(96).save(files[-2], optimize=True)
    _sheet(panels).save(files[-1], optimize=True)
    return files


def _scan(town: Town, about: tuple[np.ndarray, np.ndarray], at: np.ndarray, heading: float) -> Scan:
    """A scan of a town with its traffic."""
    vertices = np.concatenate([town.vertices, about[0]])
    triangles = np.concatenate([town.triangles, about[1] + len(town.vertices)])
    mesh = Mesh(vertices, triangles, simulate.best_device())
    return simulate.scan(mesh, _SENSOR, simulate.pose(torch.tensor(at), heading))


def _surface(vertices: np.ndarray, triangles: np.ndarray, paint: np.ndarray):
    """A surface to draw in colours (3,) or (F, 3)."""
    import pyvista  # here and not above: it takes a second to import

    surface = pyvista.PolyData.from_regular_faces(vertices, triangles)
    surface.cell_data["paint"] = np.broadcast_to(paint, (len(triangles), 3)).astype(np.uint8)
    return surface


def _near(places: np.ndarray, xy: np.ndarray, reach: int) -> np.ndarray:
    """Whether points (N, 2) are within about `reach` metres of any of the places (M, 2)."""
    low = np.minimum(places.min(0), xy.min(0)) - reach - 2
    cells = np.zeros(np.ceil(np.maximum(places.max(0), xy.max(0)) + reach + 2 - low).astype(int), dtype=bool)
    i, j = np.round(places - low).astype(int).T
    for x in range(-reach, reach + 1):
        for y in range(-reach, reach + 1):
            if x * x + y * y <= reach * reach:
                cells[i + x, j + y] = True
    i, j = np.round(xy - low).astype(int).T
    return cells[i, j]


def _painted(town: Town):
    """A town in the colours that its shapes suggest: the mesh does not say what is what."""
    vertices, triangles = town.vertices, town.triangles
    a, b, c = (vertices[triangles[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    twice = np.linalg.norm(normal, axis=1)
    upright = np.abs(normal[:, 2]) / np.maximum(twice, 1e-9)
    lone = np.bincount(triangles.ravel())[triangles].max(1) == 1  # leaves and ground share no corners
    paint = np.full((len(triangles), 3), _COLOURS["wall"], dtype=np.uint8)
    paint[lone & (upright > 0.9)] = _COLOURS["ground"]
    middle = ((a + b + c) / 3)[:, :2]
    kerbs = middle[lone & (upright > 0.98) & (np.abs(twice - 1) < 0.05)]  # where the ground has cells of 1 m
    paved = _near(kerbs, middle, 6) | _near(town.waypoints[:, :2], middle, 7) | _near(town.walks[:, :2], middle, 4)
    paint[lone & (upright > 0.9) & (twice > 12) & ~paved] = _COLOURS["lawn"]
    paint[lone & (twice < 0.8) & (upright < 0.99)] = _COLOURS["leaf"]
    paint[~lone & (twice > 8) & (upright > 0.45) & (upright < 0.97)] = _COLOURS["roof"]
    return _surface(vertices, triangles, paint)


def _lanes(town: Town):
    """The lanes as dark ribbons just above the carriageway."""
    start, end = town.waypoints[:-1].astype(np.float64), town.waypoints[1:].astype(np.float64)
    way = end - start
    length = np.hypot(way[:, 0], way[:, 1])
    joined = (length < 2.2) & (length > 1.4)
    start, end, way = start[joined], end[joined], way[joined] / length[joined, None]
    side = 1.65 * np.column_stack([-way[:, 1], way[:, 0], 0 * way[:, 0]])
    corners = np.stack([start - side, end - side, end + side, start + side], axis=1)
    corners[..., 2] += 0.04
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(start))[:, None, None]
    return _surface(corners.reshape(-1, 3).astype(np.float32), faces.reshape(-1, 3), np.array(_COLOURS["lane"]))


def _render(
    surfaces: list, camera: list, angle: float, size: tuple[int, int], reach: tuple[float, float], occlusion: float
) -> Image.Image:
    """Draws surfaces with sun, sky and soft shade in the corners, at twice the size and then shrunk."""
    import pyvista

    # Without a screen VTK warns of its absence, then renders all the same.
    with pyvista.vtk_verbosity("off"):
        plotter = pyvista.Plotter(off_screen=True, window_size=[2 * s for s in size], lighting="none")
        plotter.renderer.set_background(_COLOURS["sky"])
        for position, strength in (((-300, -500, 500), 0.5), ((500, 250, 250), 0.2), ((0, 0, 900), 0.1)):
            plotter.add_light(pyvista.Light(position=position, focal_point=(0, 0, 0), intensity=strength))
        plotter.add_light(pyvista.Light(light_type="headlight", intensity=0.22))
        for surface in surfaces:
            plotter.add_mesh(surface, scalars="paint", rgb=True, ambient=0.55, diffuse=0.75)
        plotter.camera_position = camera
        plotter.camera.view_angle = angle
        plotter.renderer.enable_ssao(radius=occlusion, bias=0.03 * occlusion, kernel_size=64)
        plotter.camera.clipping_range = reach
        picture = np.asarray(plotter.screenshot(return_img=True))
        plotter.close()
    return Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS)


def _from_above(town: Town) -> Image.Image:
    """The whole town, from the south-west."""
    low, high = town.waypoints.min(0), town.waypoints.max(0)
    centre, reach = 0.5 * (low + high), 0.5 * float((high - low)[:2].max())
    eye = centre + reach * np.array([-0.75, -1.75, 1.75])
    camera = [tuple(eye), tuple(centre - (0, 0.12 * reach, 0)), (0, 0, 1)]
    surfaces = [_painted(town), _lanes(town)]
    return _render(surfaces, camera, 36, _ABOVE, (reach, 8 * reach), 8.0)


def _from_the_street(town: Town, about: tuple[np.ndarray, np.ndarray], at: np.ndarray, heading: float) -> Image.Image:
    """What the sensor's car has before it."""
    surfaces = [_painted(town), _lanes(town)]
    if len(about[1]):
        surfaces.append(_surface(*about, np.array(_COLOURS["traffic"])))
    ahead = at + 10 * np.array([np.cos(heading), np.sin(heading), 0])
    return _render(surfaces, [tuple(at), tuple(ahead), (0, 0, 1)], 52, _STREET, (0.3, 900), 1.0)


def _sheet(panels: list[tuple[str, Image.Image, Image.Image]]) -> Image.Image:
    """Both views of each town under its name, side by side."""
    columns = min(_SHEET_COLUMNS, len(panels))
    caption, gap = 22, 6
    sizes = [(_SHEET_WIDTH, _SHEET_WIDTH * h // w) for w, h in (_ABOVE, _STREET)]
    height = caption + sum(h for _, h in sizes) + 2 * gap
    rows = -(-len(panels) // columns)
    sheet = Image.new("RGB", (columns * (_SHEET_WIDTH + gap) - gap, rows * height - gap), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
    for number, (title, *views) in enumerate(panels):
        x, y = number % columns * (_SHEET_WIDTH + gap), number // columns * height
        pen.text((x, y + 3), title, "black", font)
        y += caption
        for view, size in zip(views, sizes, strict=True):
            sheet.paste(view.resize(size, Image.Resampling.LANCZOS), (x, y))
            y += size[1] + gap // 2
    return sheet.quantize(160)  # a palette makes the file a third
