"""What all models share: one call, and the path from a scan to a denser scan."""

import itertools
import threading
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import nn

from ilnet.scan import Scan
from ilnet.sensor import Sensor

__all__ = ["OFFSET_SCALE", "PRECISIONS", "Model", "Upsampler", "normalised", "returns"]

# The authors measure offsets in half pixels; the factor lets their checkpoints load.
OFFSET_SCALE = 2.0

PRECISIONS = ("float32", "bfloat16")

# How many queries are decoded at a time: on a CPU, their activations fit the cache of a core.
_TILE = {"cpu": 4096, "cuda": 65536}


class Model(nn.Module):
    """A function r̂ = f(I, q) of a range image and query directions (paper, Eq. 1).

    The networks were trained with the lowest beam in row 0 and with rising azimuths. `ranges` and `upsample` flip scans
    that are stored in another order.

    A subclass defines `decode`. It defines `encode` if it extracts features, `check_sensors` if it cannot predict every
    sensor, and `loss` if it learns from another one.
    """

    norm_range = 0.0
    """The range [m] that the network sees as +1, and the least that no return is filled with. 0 means that no return is
    filled with the sensor's own."""

    backend = "warp"
    """The backend of the ops: "warp", or "torch" for their plain twins (`kernels.reference`)."""

    def check_sensors(self, source: Sensor, target: Sensor) -> None:
        """Raises a ValueError if the model cannot predict what `target` would measure from scans of `source`."""

    def encode(self, image: torch.Tensor, wrap: bool, sensor: Sensor | None = None) -> Any:
        """Computes what all queries of an image share; the image itself if there is nothing to extract.

        Args:
            image: (B, H, W) metres, no return filled.
            wrap: Whether column W-1 meets column 0.
            sensor: The sensor of the image, for models that need its angles.

        Returns:
            The first argument of `decode`: features (B, C, H, W), perhaps with more, or the image.
        """
        return image

    def decode(self, encoded: Any, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Returns the ranges (B, Q) [m] of queries (B, Q, 2), given what `encode` returned for the image."""
        raise NotImplementedError

    def is_fused(self, encoded: Any) -> bool:
        """Returns whether `decode` needs almost no memory per query, so that `Upsampler` need not cut tiles."""
        return False

    def forward(
        self, image: torch.Tensor, queries: torch.Tensor, wrap: bool = True, sensor: Sensor | None = None
    ) -> torch.Tensor:
        """Predicts the range along each queried direction.

        Args:
            image: (B, H, W) float32 ranges in metres, no return filled with the sensor's `norm_range` (`Scan.filled`);
                lowest beam first, azimuths rising.
            queries: (B, Q, 2) float32 pixel coordinates (row, column) in that image (`Sensor.locate`).
            wrap: Whether column W-1 meets column 0 (`Sensor.wrap`).
            sensor: The sensor of the image, for models that need its angles.

        Returns:
            (B, Q) float32 metres.

        Raises:
            ValueError: If the shapes do not fit, or the model needs the sensor.
        """
        if image.ndim != 3:
            raise ValueError(f"image has shape {tuple(image.shape)}; it should be (B, H, W)")
        if queries.ndim != 3 or queries.shape[0] != len(image) or queries.shape[2] != 2:
            raise ValueError(f"queries has shape {tuple(queries.shape)}; it should be ({len(image)}, Q, 2)")
        return self.decode(self.encode(image, wrap, sensor), image, queries, wrap)

    def loss(
        self,
        image: torch.Tensor,
        queries: torch.Tensor,
        ranges: torch.Tensor,
        wrap: bool = True,
        sensor: Sensor | None = None,
    ) -> torch.Tensor:
        """Returns what training minimises: L1 of ranges scaled to [-1, 1] (paper, Sec. III-B).

        Args:
            image: As in `forward`.
            queries: As in `forward`.
            ranges: (B, Q) metres that a laser would measure along the queries, no return filled.
            wrap: As in `forward`.
            sensor: As in `forward`.

        Returns:
            The mean over all queries, a scalar.

        Raises:
            ValueError: As in `forward`.
        """
        predicted = self(image, queries, wrap=wrap, sensor=sensor)
        return (predicted - ranges).abs().mean() * (2 / self.norm_range)

    def ranges(self, scan: Scan, sensor: Sensor, precision: str = "float32") -> torch.Tensor:
        """Predicts what `sensor` would measure at the place of a scan, as the raw output of the network.

        Args:
            scan: The scan that was measured, on the model's device.
            sensor: The rays to predict; any tables within the field of view of the scan's sensor.
            precision: See `Upsampler`.

        Returns:
            (H, W) float32 metres on the scan's device; near `norm_range` means no return. Rays outside the field of
            view get the range of the outermost beam next to them.

        Raises:
            ValueError: If the model is not on the scan's device, the precision is unknown, or the model cannot predict
                that sensor.
        """
        return Upsampler(self, scan.sensor, sensor, precision, scan.ranges.device).ranges(scan)

    def upsample(self, scan: Scan, sensor: Sensor, precision: str = "float32") -> Scan:
        """Predicts the scan that `sensor` would measure at the place of a scan.

        For many scans of one sensor, keep an `Upsampler`.

        Args:
            scan: The scan that was measured, on the model's device.
            sensor: The sensor whose scan is wanted, in the same frame: any resolution, any tables.
            precision: See `Upsampler`.

        Returns:
            A scan of `sensor`. Rays outside the field of view of the scan's sensor, those predicted beyond the maximum
            range of either, and those below the minimum range of `sensor`, hold no return.

        Raises:
            ValueError: If the model is not on the scan's device, the precision is unknown, or the model cannot predict
                that sensor.
        """
        return Upsampler(self, scan.sensor, sensor, precision, scan.ranges.device)(scan)


class Upsampler:
    """Makes scans of one sensor from scans of another, frame after frame.

    What all frames share is prepared once. A frame is encoded once, and its queries are decoded in tiles, so that the
    memory needed beyond the output does not grow with their number. On CUDA the second frame is recorded as a graph,
    and later frames replay it without waiting for the host; a single frame is not worth a recording. Several threads
    may share an upsampler.

    Args:
        model: The model that predicts. Its weights are used as they are at each call; they may change, but not move.
        source: The sensor that measures.
        target: The sensor whose scans are wanted.
        precision: "float32", or "bfloat16" for the layers that are faster in it; the ranges themselves stay float32.
        device: The device of the scans and of the model's weights; "cuda" is the current CUDA device. By default it is
            that of the weights, and the CPU for a model without weights.

    Raises:
        ValueError: If the precision is unknown, the model is on another device, or it cannot predict that sensor.
    """

    def __init__(
        self,
        model: Model,
        source: Sensor,
        target: Sensor,
        precision: str = "float32",
        device: torch.device | str | None = None,
    ):
        if precision not in PRECISIONS:
            raise ValueError(f"precision is {precision!r}; it should be one of {', '.join(PRECISIONS)}")
        self.device = _numbered(device or next((weight.device for weight in _weights(model)), "cpu"))
        _check_device(model, self.device)
        model.check_sensors(source, target)
        self.model, self.source, self.target = model, source, target
        self._half = precision == "bfloat16"
        # Networks were trained on upright images; a sensor may store its beams and columns in either order.
        tables = {-2: source.elevations, -1: source.azimuths}
        self._flips = [axis for axis, table in tables.items() if table[0] > table[-1]]
        self._upright = upright = source.upright()
        queries = upright.grid_queries(target)
        self._seen = upright.contains(queries).to(self.device)
        self._queries = queries.view(1, -1, 2).to(self.device)
        self._warm = False
        self._recording: _Recording | None = None
        self._lock = threading.Lock()

    @torch.no_grad()
    def ranges(self, scan: Scan) -> torch.Tensor:
        """Predicts (H, W) float32 metres, the raw output of the network; see `Model.ranges`.

        Raises:
            ValueError: If the scan is not one of the source sensor, or the scan or the model is on another device.
        """
        if scan.sensor != self.source:
            raise ValueError(f"scan is of {scan.sensor!r}; it should be of {self.source!r}, as this upsampler expects")
        if scan.ranges.device != self.device:
            raise ValueError(
                f"scan is on {scan.ranges.device}; it should be on {self.device}, the device of this upsampler: "
                f"call scan.to('{self.device}')"
            )
        _check_device(self.model, self.device)
        image = scan.filled(self.model.norm_range).flip(self._flips).unsqueeze(0)
        answer = self._replay(image) if self.device.type == "cuda" else self._answer(image)
        return answer.view(self.target.shape)

    def __call__(self, scan: Scan) -> Scan:
        """Predicts the target sensor's scan; see `Model.upsample`."""
        return _returns(self.ranges(scan), self._seen, self.source, self.target)

    def _answer(self, image: torch.Tensor) -> torch.Tensor:
        model, wrap = self.model, self.source.wrap
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self._half):
            encoded = model.encode(image, wrap, self._upright)
            count = self._queries.shape[1]
            answer = image.new_empty(1, count)
            tile = count if model.is_fused(encoded) else _TILE[self.device.type]
            for begin in range(0, count, tile):
                part = slice(begin, begin + tile)
                answer[:, part] = model.decode(encoded, image, self._queries[:, part], wrap)
        return answer

    def _replay(self, image: torch.Tensor) -> torch.Tensor:
        with self._lock:
            if not self._warm:  # perhaps the only frame
                answer = self._answer(image)
                self._warm = True
                return answer
            if self._recording is None:
                self._recording = _Recording(self._answer, image)
            return self._recording.replay(image)


class _Recording:
    """The work for one frame as a CUDA graph."""

    def __init__(self, work: Callable[[torch.Tensor], torch.Tensor], image: torch.Tensor):
        self._image = image.clone()
        self._graph = torch.cuda.CUDAGraph()
        # A stream of this device, which need not be the current one.
        stream, current = torch.cuda.Stream(image.device), torch.cuda.current_stream(image.device)
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            work(self._image)  # loads kernels and sets up libraries for this thread, which a recording may not do
        current.wait_stream(stream)
        # Other threads may allocate memory meanwhile.
        with torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local"):
            self._answer = work(self._image)
        self._free = torch.cuda.Event()

    def replay(self, image: torch.Tensor) -> torch.Tensor:
        stream = torch.cuda.current_stream(image.device)
        stream.wait_event(self._free)  # the frame before may still be under way on another stream
        self._image.copy_(image)
        self._graph.replay()
        answer = self._answer.clone()
        stream.record_event(self._free)
        return answer


def _weights(model: Model) -> Iterator[torch.Tensor]:
    return itertools.chain(model.parameters(), model.buffers())


def _numbered(device: torch.device | str) -> torch.device:
    """Returns the device as tensors on it name it: "cuda" is the current CUDA device."""
    return torch.empty(0, device=device).device


def _check_device(model: Model, device: torch.device) -> None:
    """Raises a ValueError unless all weights are on the device; a model without weights is at home anywhere."""
    for weight in _weights(model):
        if weight.device != device:
            raise ValueError(
                f"model is on {weight.device}; it should be on {device}, where the scans are: call model.to('{device}')"
            )


def normalised(image: torch.Tensor, norm_range: float) -> torch.Tensor:
    """Returns ranges (B, H, W) [m] as the encoder's input (B, 1, H, W) in [-1, 1]; beyond `norm_range` all is 1."""
    return (image.clamp(max=norm_range) * (2 / norm_range) - 1).unsqueeze(1)


def returns(ranges: torch.Tensor, source: Sensor, sensor: Sensor) -> Scan:
    """Tells returns from no return in predicted ranges.

    Args:
        ranges: (H, W) metres, predicted for the rays of `sensor`.
        source: The sensor whose scan the ranges were predicted from.
        sensor: The sensor that the ranges were predicted for.

    Returns:
        A scan of `sensor`. It holds 0 outside the field of view of `source`, outside the range limits of `sensor`,
        and beyond the maximum range of `source`, where only blends of a return with no return lie.
    """
    return _returns(ranges, source.contains(source.grid_queries(sensor)).to(ranges.device), source, sensor)


def _returns(ranges: torch.Tensor, seen: torch.Tensor, source: Sensor, sensor: Sensor) -> Scan:
    valid = seen & (ranges >= sensor.min_range) & (ranges <= min(sensor.max_range, source.max_range))
    return Scan(ranges.where(valid, 0.0), sensor)
