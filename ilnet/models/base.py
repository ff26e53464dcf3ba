"""What all models share: one call, and the path from a scan to a denser scan."""

import itertools
import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import nn

from ilnet.scan import Scan
from ilnet.sensor import Sensor
from kernels import gather_blend, gather_neighbours

__all__ = ["OFFSET_SCALE", "PRECISIONS", "Answer", "Model", "Upsampler", "normalised", "returns"]

# The authors measure offsets in half pixels; the factor lets their checkpoints load.
OFFSET_SCALE = 2.0

PRECISIONS = ("float32", "bfloat16")

# How many queries are answered at a time: on a CPU, their activations fit the cache of a core. A fused decoder has no
# activations: it gets so many times larger tiles, to launch it less often.
_TILE = {"cpu": 4096, "cuda": 65536}
_FUSED = 16

# Joint bilateral weights (`_blend`): the standard deviation of the logarithm of the range, and the least bilinear area,
# so that a query on a pixel without a return can have the value of a neighbour. Of 0.01 to 0.2 and no bound, 0.2 gave
# the smallest error of the intensity in simulated scans; in measured ones 0.4 was better by half a percent.
_WIDTH, _AREA_FLOOR = 0.2, 1e-3
# Metres, and a probability. Smaller ones are taken as these, so that they have a logarithm.
_LEAST_RANGE, _LEAST_SUPPORT = 1e-3, 1e-30
# The score of a neighbour without a return: any other is larger.
_NEVER = -1e9


class Answer(NamedTuple):
    """What a model tells of queries."""

    ranges: torch.Tensor
    """(B, Q) metres; near the sensor's `norm_range` means no return."""
    support: torch.Tensor | None = None
    """(B, Q, 4), the probability that each neighbour's surface is the one met; None if the model does not tell."""
    confidence: torch.Tensor | None = None
    """(B, Q), the probability that the answer is right to 10 cm; None if the model does not tell."""


class Model(nn.Module):
    """A function r̂ = f(I, q) of a range image and query directions (paper, Eq. 1).

    The networks were trained with the lowest beam in row 0 and with rising azimuths, or with falling ones if they are
    `falling`. `ranges` and `upsample` flip scans that are stored in another order.

    A subclass defines `decode`. It defines `encode` if it extracts features, `answer` if it tells more than ranges,
    `check_sensors` if it cannot predict every sensor, and `loss` if it learns from another one.
    """

    norm_range = 0.0
    """The range [m] that the network sees as +1, and the least that no return is filled with. 0 means that no return is
    filled with the sensor's own."""

    tells_confidence = False
    """Whether `answer` tells a confidence."""

    falling = False
    """Whether the network was trained on images whose azimuths fall, as those of the paper's authors do. `ranges` and
    `upsample` show it such images."""

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

    def answer(self, encoded: Any, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> Answer:
        """Returns the ranges that `decode` returns, and what else the model tells of queries (B, Q, 2)."""
        return Answer(self.decode(encoded, image, queries, wrap))

    def is_fused(self, encoded: Any) -> bool:
        """Returns whether `answer` needs almost no memory per query, so that `Upsampler` cuts larger tiles."""
        return False

    def forward(
        self, image: torch.Tensor, queries: torch.Tensor, wrap: bool = True, sensor: Sensor | None = None
    ) -> torch.Tensor:
        """Predicts the range along each queried direction.

        Args:
            image: (B, H, W) float32 ranges in metres, no return filled with the sensor's `norm_range` (`Scan.filled`);
                lowest beam first, azimuths rising or, for a model that is `falling`, falling.
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
            A scan of `sensor`. Holes of `scan` are bridged first (`Scan.bridged`), and answered like other pixels. Rays
            outside the field of view of the scan's sensor, those predicted beyond the maximum range of either, and
            those below the minimum range of `sensor`, hold no return. It has an intensity if `scan` has one, and a
            confidence if the model tells it.

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
        self._flips = source.flips(model.falling)
        self._upright = upright = source.upright(model.falling)
        queries = upright.grid_queries(target)
        self._seen = upright.contains(queries).to(self.device)
        self._queries = queries.view(1, -1, 2).to(self.device)
        self._warm = False
        self._recordings: dict[bool, _Recording] = {}  # without and with intensity
        self._lock = threading.Lock()

    def ranges(self, scan: Scan) -> torch.Tensor:
        """Predicts (H, W) float32 metres, the raw output of the network; see `Model.ranges`.

        Raises:
            ValueError: If the scan is not one of the source sensor, or the scan or the model is on another device.
        """
        return self._predict(scan, bright=False).ranges.view(self.target.shape)

    def __call__(self, scan: Scan) -> Scan:
        """Predicts the target sensor's scan; see `Model.upsample`."""
        frame = self._predict(scan, bright=scan.intensity is not None).map(lambda image: image.view(self.target.shape))
        return _returns(frame, self._seen, self.source, self.target)

    @torch.no_grad()
    def _predict(self, scan: Scan, bright: bool) -> "_Frame":
        if scan.sensor != self.source:
            raise ValueError(f"scan is of {scan.sensor!r}; it should be of {self.source!r}, as this upsampler expects")
        if scan.ranges.device != self.device:
            raise ValueError(
                f"scan is on {scan.ranges.device}; it should be on {self.device}, the device of this upsampler: "
                f"call scan.to('{self.device}')"
            )
        _check_device(self.model, self.device)
        scan = scan.bridged()
        images = [scan.filled(self.model.norm_range)]
        if bright and scan.intensity is not None:
            images.append(scan.intensity)
        images = [image.flip(self._flips).unsqueeze(0) for image in images]
        return self._replay(*images) if self.device.type == "cuda" else self._answer(*images)

    def _answer(self, image: torch.Tensor, intensity: torch.Tensor | None = None) -> "_Frame":
        model, wrap, count = self.model, self.source.wrap, self._queries.shape[1]
        frame = _Frame(
            image.new_empty(1, count),
            None if intensity is None else image.new_empty(1, count),
            image.new_empty(1, count) if model.tells_confidence else None,
        )
        far = max(model.norm_range, self.source.norm_range)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self._half):
            encoded = model.encode(image, wrap, self._upright)
            tile = _TILE[self.device.type] * (_FUSED if model.is_fused(encoded) else 1)
            for begin in range(0, count, tile):
                part = slice(begin, begin + tile)
                queries = self._queries[:, part]
                answer = model.answer(encoded, image, queries, wrap)
                frame.ranges[:, part] = answer.ranges
                if frame.confidence is not None and answer.confidence is not None:
                    frame.confidence[:, part] = answer.confidence
                if frame.intensity is not None and intensity is not None:
                    blended = _blend(intensity, image, queries, answer, wrap, far, model.backend)
                    frame.intensity[:, part] = blended.clamp(0, 1)  # weights may sum to more than 1 by rounding
        return frame

    def _replay(self, *images: torch.Tensor) -> "_Frame":
        with self._lock:
            if not self._warm:  # perhaps the only frame
                frame = self._answer(*images)
                self._warm = True
                return frame
            bright = len(images) > 1
            if bright not in self._recordings:
                self._recordings[bright] = _Recording(self._answer, images)
            return self._recordings[bright].replay(images)


class _Frame(NamedTuple):
    """What is predicted for the queries of a frame, each of one shape."""

    ranges: torch.Tensor
    intensity: torch.Tensor | None = None
    confidence: torch.Tensor | None = None

    def map(self, change: Callable[[torch.Tensor], torch.Tensor]) -> "_Frame":
        """Returns the frame with each tensor changed."""
        intensity, confidence = (None if image is None else change(image) for image in self[1:])
        return _Frame(change(self.ranges), intensity, confidence)


class _Recording:
    """The work for one frame as a CUDA graph."""

    def __init__(self, work: Callable[..., _Frame], images: tuple[torch.Tensor, ...]):
        self._images = [image.clone() for image in images]
        self._graph = torch.cuda.CUDAGraph()
        # A stream of this device, which need not be the current one.
        device = images[0].device
        stream, current = torch.cuda.Stream(device), torch.cuda.current_stream(device)
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            work(*self._images)  # loads kernels and sets up libraries for this thread, which a recording may not do
        current.wait_stream(stream)
        # Other threads may allocate memory meanwhile.
        with torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local"):
            self._frame = work(*self._images)
        self._free = torch.cuda.Event()

    def replay(self, images: tuple[torch.Tensor, ...]) -> _Frame:
        stream = torch.cuda.current_stream(images[0].device)
        stream.wait_event(self._free)  # the frame before may still be under way on another stream
        for kept, image in zip(self._images, images, strict=True):
            kept.copy_(image)
        self._graph.replay()
        frame = self._frame.map(torch.Tensor.clone)
        stream.record_event(self._free)
        return frame


def _blend(
    values: torch.Tensor,
    image: torch.Tensor,
    queries: torch.Tensor,
    answer: Answer,
    wrap: bool,
    far: float,
    backend: str,
) -> torch.Tensor:
    """Blends values of the 4 neighbours of each query: of those whose surface the answer is on.

    Where the model tells the support of each neighbour, that is its weight. Else weights are those of joint bilateral
    upsampling: the bilinear area, times a Gaussian of how much the neighbour's range differs from the answer.

    Args:
        values: (B, H, W), 0 where nothing returned.
        image: (B, H, W) metres, no return filled.
        queries: (B, Q, 2) pixel coordinates (row, column).
        answer: The answer to the queries.
        wrap: Whether column W-1 meets column 0.
        far: What no return is filled with [m].
        backend: That of the ops.

    Returns:
        (B, Q), without a meaning where the answer is no return.

    Source: J. Kopf et al., "Joint bilateral upsampling", SIGGRAPH 2007, Eq. (3).
    """
    if answer.support is not None:  # a neighbour without a return supports no range
        scores = answer.support.clamp(min=_LEAST_SUPPORT).log()
        return gather_blend(values, queries, scores, "none", wrap, backend=backend)
    ranges = gather_neighbours(image.unsqueeze(1), queries, wrap, backend)[0].squeeze(-1)
    away = (ranges / answer.ranges.clamp(min=_LEAST_RANGE).unsqueeze(-1)).log() / _WIDTH
    scores = (-0.5 * away.square()).where(ranges < far, _NEVER)
    return gather_blend(values, queries, scores, "bilinear", wrap, area_floor=_AREA_FLOOR, backend=backend)


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
    seen = source.contains(source.grid_queries(sensor)).to(ranges.device)
    return _returns(_Frame(ranges), seen, source, sensor)


def _returns(frame: _Frame, seen: torch.Tensor, source: Sensor, sensor: Sensor) -> Scan:
    farthest = min(sensor.max_range, source.max_range)
    valid = seen & (frame.ranges >= sensor.min_range) & (frame.ranges <= farthest)
    ranges, intensity, confidence = frame.map(lambda image: image.where(valid, 0.0))
    return Scan(ranges, sensor, intensity, confidence)
