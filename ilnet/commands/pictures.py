"""Draws pictures of towns: each from above, from the street and as a scan, and one sheet of all."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ilnet.commands import plot
from ilnet.sensor import preset
from ilnet.world import places, simulate
from ilnet.world.towns import Town

__all__ = ["draw"]

# Which waypoint each town is seen and scanned from, as a share of all; chosen for the view.
_VIEWPOINTS = {
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
# Width and height of the two views [pixels].
_ABOVE, _STREET = (1200, 900), (1200, 600)
# Towns per row of the sheet, and width of each [pixels].
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
    """Builds towns with seed 0, draws them and scans them.

    Args:
        names: Names of the towns.
        out: Folder for the pictures; it is made if it is missing.

    Returns:
        The files: two views of each town, the scans as range images and as points, and a sheet of all views.

    Raises:
        ValueError: If one of `names` is not a town.
    """
    files, scans, panels = [], {}, []
    for name in names:
        place = places.town(name, device=simulate.best_device())
        town = place.town
        assert town is not None
        out.mkdir(parents=True, exist_ok=True)
        number = int(_VIEWPOINTS[name] * len(town.waypoints))
        at = place.position(number)
        scans[name] = simulate.scan(place.world(at, 0), _SENSOR, place.pose(number))
        above = _from_above(town)
        street = _from_the_street(town, place.traffic(at, 0), at.numpy(), float(town.headings[number]))
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


def _surface(vertices: np.ndarray, triangles: np.ndarray, paint: np.ndarray):
    """Returns a surface to draw, in one colour (3,) or a colour per triangle (F, 3)."""
    import pyvista  # It takes a second to import, so only those who draw do.

    surface = pyvista.PolyData.from_regular_faces(vertices, triangles)
    surface.cell_data["paint"] = np.broadcast_to(paint, (len(triangles), 3)).astype(np.uint8)
    return surface


def _near(spots: np.ndarray, xy: np.ndarray, reach: int) -> np.ndarray:
    """Returns which of points `xy` (N, 2) [m] are within about `reach` metres of a spot (M, 2), as (N,) bool."""
    low = np.minimum(spots.min(0), xy.min(0)) - reach - 2
    cells = np.zeros(np.ceil(np.maximum(spots.max(0), xy.max(0)) + reach + 2 - low).astype(int), dtype=bool)
    i, j = np.round(spots - low).astype(int).T
    for x in range(-reach, reach + 1):
        for y in range(-reach, reach + 1):
            if x * x + y * y <= reach * reach:
                cells[i + x, j + y] = True
    i, j = np.round(xy - low).astype(int).T
    return cells[i, j]


def _painted(town: Town):
    """Returns a town in colours that its shapes suggest, as its mesh does not tell walls from leaves."""
    vertices, triangles = town.vertices, town.triangles
    a, b, c = (vertices[triangles[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    twice = np.linalg.norm(normal, axis=1)
    upright = np.abs(normal[:, 2]) / np.maximum(twice, 1e-9)
    lone = np.bincount(triangles.ravel())[triangles].max(1) == 1  # Leaves and ground share no corners.
    paint = np.full((len(triangles), 3), _COLOURS["wall"], dtype=np.uint8)
    paint[lone & (upright > 0.9)] = _COLOURS["ground"]
    middle = ((a + b + c) / 3)[:, :2]
    kerbs = middle[lone & (upright > 0.98) & (np.abs(twice - 1) < 0.05)]  # The ground has cells of 1 m there.
    paved = _near(kerbs, middle, 6) | _near(town.waypoints[:, :2], middle, 7) | _near(town.walks[:, :2], middle, 4)
    paint[lone & (upright > 0.9) & (twice > 12) & ~paved] = _COLOURS["lawn"]
    paint[lone & (twice < 0.8) & (upright < 0.99)] = _COLOURS["leaf"]
    paint[~lone & (twice > 8) & (upright > 0.45) & (upright < 0.97)] = _COLOURS["roof"]
    return _surface(vertices, triangles, paint)


def _lanes(town: Town):
    """Returns the lanes as dark ribbons just above the carriageway."""
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
    """Returns a picture of surfaces with sun, sky and soft shade in the corners.

    Args:
        surfaces: What to draw.
        camera: Position, the point it looks at, and the upward direction, metres.
        angle: Vertical field of view, degrees.
        size: Width and height, pixels; it is drawn at twice the size and then shrunk.
        reach: Nearest and farthest distance that is drawn, metres.
        occlusion: How far the soft shade reaches, metres.
    """
    import pyvista

    # Without a screen VTK warns, but renders.
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
    """Returns a picture of the whole town from the south-west."""
    low, high = town.waypoints.min(0), town.waypoints.max(0)
    centre, reach = 0.5 * (low + high), 0.5 * float((high - low)[:2].max())
    eye = centre + reach * np.array([-0.75, -1.75, 1.75])
    camera = [tuple(eye), tuple(centre - (0, 0.12 * reach, 0)), (0, 0, 1)]
    surfaces = [_painted(town), _lanes(town)]
    return _render(surfaces, camera, 36, _ABOVE, (reach, 8 * reach), 8.0)


def _from_the_street(town: Town, traffic: tuple[np.ndarray, np.ndarray], at: np.ndarray, heading: float) -> Image.Image:
    """Returns a picture of what lies ahead of the sensor at `at` (3,) [m], with its traffic."""
    surfaces = [_painted(town), _lanes(town)]
    if len(traffic[1]):
        surfaces.append(_surface(*traffic, np.array(_COLOURS["traffic"])))
    ahead = at + 10 * np.array([np.cos(heading), np.sin(heading), 0])
    return _render(surfaces, [tuple(at), tuple(ahead), (0, 0, 1)], 52, _STREET, (0.3, 900), 1.0)


def _sheet(panels: list[tuple[str, Image.Image, Image.Image]]) -> Image.Image:
    """Returns a sheet with both views of each town under its title."""
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
    return sheet.quantize(160)  # With a palette the file is a third as large.
