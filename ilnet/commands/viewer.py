"""The page that shows scans as points to turn: in a file that needs nothing else, or served while a stream runs."""

import base64
import json
import threading
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Literal, NamedTuple

import matplotlib
import numpy as np
import torch

from ilnet.scan import Scan

__all__ = ["Panel", "Server", "height", "page", "trust"]

_PAGE = Path(__file__).with_name("viewer.html")
# The shade of a value that is not known; the others are 0 to 254.
_UNKNOWN = 255


class Panel(NamedTuple):
    """A scan as points of one colouring.

    Args:
        title: What it shows.
        scan: The scan.
        values: (H, W) what is coloured; NaN is grey.
        limits: Values of the first and the last colour.
        unit: Unit of the values.
        colours: A colour map of matplotlib.
    """

    title: str
    scan: Scan
    values: torch.Tensor
    limits: tuple[float, float]
    unit: str = "m"
    colours: Literal["viridis", "coolwarm"] = "viridis"


def height(title: str, scan: Scan) -> Panel:
    """Returns a scan coloured by the height of its points above the sensor."""
    values = scan.ranges * torch.sin(torch.tensor(scan.sensor.elevations, dtype=torch.float32))[:, None]
    return Panel(f"{title}, {scan.sensor.size}: height", scan, values, (-2.0, 4.0))


def trust(title: str, scan: Scan) -> Panel:
    """Returns a scan coloured by its confidence."""
    assert scan.confidence is not None
    return Panel(f"{title}: confidence", scan, scan.confidence, (0.0, 1.0), "")


def page(panels: Sequence[Panel]) -> str:
    """Returns a page of HTML that shows panels side by side, seen by one camera."""
    return _filled(_scene(panels))


def _filled(scene: dict[str, Any]) -> str:
    # "</script>" in a title would end the data.
    return _PAGE.read_text().replace("/*SCENE*/", json.dumps(scene).replace("<", "\\u003c"))


def _scene(panels: Sequence[Panel]) -> dict[str, Any]:
    """Returns what the page draws. Points are in 16 bits, values in 8: a page of a dense scan then has 3 MB."""
    scans: list[Scan] = []
    for panel in panels:
        if not any(panel.scan is scan for scan in scans):
            scans.append(panel.scan)
    return {
        "clouds": [_cloud(scan) for scan in scans],
        "panels": [
            {
                "title": panel.title,
                "cloud": next(number for number, scan in enumerate(scans) if scan is panel.scan),
                "values": _shades(panel.values[panel.scan.ranges > 0].numpy(), *panel.limits),
                "low": panel.limits[0],
                "high": panel.limits[1],
                "unit": panel.unit,
                "colours": panel.colours,
            }
            for panel in panels
        ],
        "colours": {name: _map(name) for name in {panel.colours for panel in panels}},
    }


def _cloud(scan: Scan) -> dict[str, Any]:
    points = scan.points().numpy()
    scale = max(float(np.abs(points).max(initial=0.0)), 1.0) / 32767
    cloud: dict[str, Any] = {"count": len(points), "scale": scale, "places": _text((points / scale).round(), "<i2")}
    if scan.confidence is not None:
        cloud["confidence"] = _text(scan.confidence[scan.ranges > 0].numpy() * 255, "u1")
    return cloud


def _shades(values: np.ndarray, low: float, high: float) -> str:
    shades = np.clip((values - low) / (high - low), 0, 1) * (_UNKNOWN - 1)
    return _text(np.where(np.isnan(shades), _UNKNOWN, shades), "u1")


def _map(name: str) -> str:
    return _text(matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3] * 255, "u1")


def _text(values: np.ndarray, kind: str) -> str:
    return base64.b64encode(values.astype(kind).tobytes()).decode()


class Server:
    """Serves the page on this machine, with the newest panels that `show` was given; a context manager.

    Args:
        port: The port; 0 is any that is free.

    Raises:
        OSError: If the port is taken.
    """

    def __init__(self, port: int):
        self._newest, self._number = "", 0
        self._changed = threading.Condition()
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path == "/":
                    self._answer(200, "text/html; charset=utf-8", _filled({"live": True}))
                elif self.path.startswith("/scene"):
                    scene = server._after(self.path.rpartition("=")[2])
                    self._answer(200 if scene else 204, "application/json", scene)
                else:
                    self._answer(404, "text/plain", "")

            def _answer(self, status: int, kind: str, text: str) -> None:
                self.send_response(status)
                self.send_header("Content-Type", kind)
                if status != 204:
                    self.send_header("Content-Length", str(len(text.encode())))
                self.end_headers()
                self.wfile.write(text.encode())

            def log_message(self, *_: object) -> None:
                """Says nothing: a page asks several times a second."""

        self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self._server.daemon_threads = True
        self.address = f"http://127.0.0.1:{self._server.server_port}/"

    def __enter__(self) -> "Server":
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def show(self, panels: Sequence[Panel]) -> None:
        """Replaces what is shown."""
        scene = _scene(panels)
        with self._changed:
            self._number += 1
            self._newest = json.dumps(scene | {"number": self._number})
            self._changed.notify_all()

    def _after(self, number: str) -> str:
        """Returns the newest scene once it is another than the one of that number, or nothing after a while."""
        with self._changed:
            self._changed.wait_for(lambda: self._newest and str(self._number) != number, timeout=5)
            return self._newest if str(self._number) != number else ""
