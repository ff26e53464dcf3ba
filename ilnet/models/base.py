"""What all models share: one call, and the path from a scan to a denser scan."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import nn

from ilnet.scan import Scan
from ilnet.sensor import Sensor

__all__ = ["OFFSET_SCALE", "PRECISIONS", "Model", "Upsampler", "normalised", "returns"]

# The authors measure offsets in half pixels; their checkpoints are worth the factor.
OFFSET_SCALE = 2.0

PRECISIONS = ("float32", "bfloat16")

# Queries decoded at a time: the activations of so many fit the cache of a CPU core.
_TILE = {"cpu": 4096, "cuda": 65536}


class Model(nn.Module):
    """A function r̂ = f(I, q) of a range image and query directions (paper, Eq. 1).

    Its networks were trained with the lowest beam in row 0 and azimuths that rise; `ranges` and `upsample` turn scans
    that are stored another way.

    A subclass brings `decode`, `encode` where it extracts features, and `check_sensors` where it cannot predict any.
    """

    norm_range = 0.0
    """Metres that the network sees as +1, and no return is filled with at least; 0 where it sees metres."""

    backend = "warp"
    """Of the ops: "warp", or "torch" for their plain twins (`kernels.reference`)."""

    def check_sensors(self, source: Sensor, target: Sensor) -> None:
        """Raises a ValueError where the model cannot predict what `target` would measure from scans of `source`."""

    def encode(self, image: torch.Tensor, wrap: bool) -> Any:
        """Computes once per image what all queries share; the image itself where there is nothing to extract.

        Args:
            image: (B, H, W) metres, no return filled.
            wrap: Whether column W-1 meets column 0.

        Returns:
            What `decode` takes: features (B, C, H, W) with what belongs to them, or the image.
        """
        return image

    def decode(self, encoded: Any, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Answers queries (B, Q, 2) with ranges (B, Q) [m], from what `encode` made of the image."""
        raise NotImplementedError

    def is_fused(self, encoded: Any) -> bool:
        """Whether `decode` holds next to nothing per query, so that `Upsampler` need not give it tiles."""
        return False

    def forward(self, image: torch.Tensor, queries: torch.Tensor, wrap: bool = True) -> torch.Tensor:
        """Predicts the range along each queried direction.

        Args:
            image: (B, H, W) float32 ranges in metres, no return filled with the sensor's `norm_range` (`Scan.filled`);
                lowest beam first, azimuths rising.
            queries: (B, Q, 2) float32 pixel coordinates (row, column) in that image (`Sensor.locate`).
            wrap: Whether column W-1 meets column 0 (`Sensor.wrap`).

        Returns:
            (B, Q) float32 metres.

        Raises:
            ValueError: If the shapes do not fit.
        """
        if image.ndim != 3:
            raise ValueError(f"image has shape {tuple(image.shape)}; it should be (B, H, W)")
        if queries.ndim != 3 or queries.shape[0] != len(image) or queries.shape[2] != 2:
            raise ValueError(f"queries has shape {tuple(queries.shape)}; it should be ({len(image)}, Q, 2)")
        return self.decode(self.encode(image, wrap), image, queries, wrap)

    def ranges(self, scan: Scan, sensor: Sensor, precision: str = "float32") -> torch.Tensor:
        """Predicts what `sensor` would measure at the place of a scan, as the raw output of the network.

        Args:
            scan: What was measured.
            sensor: The rays to predict; any tables within the field of view of the scan's sensor.
            precision: See `Upsampler`.

        Returns:
            (H, W) float32 metres on the scan's device; near `norm_range` means no return. Rays outside the field of
            view get the range of the outermost beam next to them.
        """
        return Upsampler(self, scan.sensor, sensor, precision, scan.ranges.device).ranges(scan)

    def upsample(self, scan: Scan, sensor: Sensor, precision: str = "float32") -> Scan:
        """Predicts the scan that `sensor` would measure at the place of a scan.

        For many scans of one sensor, keep an `Upsampler`.

        Args:
            scan: What was measured.
            sensor: The sensor whose scan is wanted, in the same frame: any resolution, any tables.
            precision: See `Upsampler`.

        Returns:
            A scan of `sensor`. Rays outside the field of view of the scan's sensor, those predicted beyond the maximum
            range of either, and those below the minimum range of `sensor`, hold no return.
        """
        return Upsampler(self, scan.sensor, sensor, precision, scan.ranges.device)(scan)


class Upsampler:
    """Makes scans of one sensor from scans of another, frame after frame.

    What frames have in common is prepared once. A frame is encoded once and its queries are decoded in tiles; beyond
    the output the memory needed does not grow with their number. On CUDA the second frame is recorded as a graph and
    the following ones replay it, without a word from the host in between; a single frame is not worth a recording.

    Args:
        model: Whose weights are used as they are at each call; on CUDA they may change, but not move.
        source: The sensor that measures.
        target: The sensor whose scans are wanted.
        precision: "float32", or "bfloat16" for the layers that are faster so; the ranges themselves stay float32.
        device: Where the scans and the model are.

    Raises:
        ValueError: If the precision is unknown, or the model cannot predict that sensor.
    """

    def __init__(
        self,
        model: Model,
        source: Sensor,
        target: Sensor,
        precision: str = "float32",
        device: torch.device | str = "cpu",
    ):
        if precision not in PRECISIONS:
            raise ValueError(f"precision is {precision!r}; it should be one of {', '.join(PRECISIONS)}")
        model.check_sensors(source, target)
        self.model, self.source, self.target = model, source, target
        self.device = torch.device(device)
        self._half = precision == "bfloat16"
        # The world is upright to a network as it was in training, whichever way a sensor stores its beams and columns.
        tables = {-2: source.elevations, -1: source.azimuths}
        self._flips = [axis for axis, table in tables.items() if table[0] > table[-1]]
        upright = replace(source, elevations=np.sort(source.elevations), azimuths=np.sort(source.azimuths))
        queries = upright.grid_queries(target)
        self._seen = upright.contains(queries).to(self.device)
        self._queries = queries.view(1, -1, 2).to(self.device)
        self._warm = False
        self._graph: torch.cuda.CUDAGraph | None = None

    @torch.no_grad()
    def ranges(self, scan: Scan) -> torch.Tensor:
        """Predicts (H, W) float32 metres, the raw output of the network; see `Model.ranges`.

        Raises:
            ValueError: If the scan is not one of the source sensor, or on another device.
        """
        if scan.sensor != self.source:
            raise ValueError(f"the scan is of {scan.sensor!r}, but this upsampler was made for {self.source!r}")
        if scan.ranges.device.type != self.device.type:
            raise ValueError(f"the scan is on {scan.ranges.device}, but this upsampler was made for {self.device}")
        image = scan.filled(self.model.norm_range).flip(self._flips).unsqueeze(0)
        answer = self._replay(image) if self.device.type == "cuda" else self._answer(image)
        return answer.view(self.target.shape)

    def __call__(self, scan: Scan) -> Scan:
        """Predicts the target sensor's scan; see `Model.upsample`."""
        return _returns(self.ranges(scan), self._seen, self.source, self.target)

    def _answer(self, image: torch.Tensor) -> torch.Tensor:
        model, wrap = self.model, self.source.wrap
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self._half):
            encoded = model.encode(image, wrap)
            count = self._queries.shape[1]
            answer = image.new_empty(1, count)
            tile = count if model.is_fused(encoded) else _TILE[self.device.type]
            for begin in range(0, count, tile):
                part = slice(begin, begin + tile)
                answer[:, part] = model.decode(encoded, image, self._queries[:, part], wrap)
        return answer

    def _replay(self, image: torch.Tensor) -> torch.Tensor:
        if not self._warm:  # a recording may neither load kernels nor try out algorithms
            self._warm = True
            return self._answer(image)
        if self._graph is None:
            self._image = image.clone()
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph):
                self._recorded = self._answer(self._image)
        self._image.copy_(image)
        self._graph.replay()
        return self._recorded.clone()


def normalised(image: torch.Tensor, norm_range: float) -> torch.Tensor:
    """Scales ranges (B, H, W) [m] to the encoder's input (B, 1, H, W) in [-1, 1]; farther than `norm_range` is 1."""
    return (image.clamp(max=norm_range) * (2 / norm_range) - 1).unsqueeze(1)


def returns(ranges: torch.Tensor, source: Sensor, sensor: Sensor) -> Scan:
    """Tells returns from no return in predicted ranges.

    Args:
        ranges: (H, W) metres, of the rays of `sensor`.
        source: The sensor they were predicted from.
        sensor: The sensor they were predicted for.

    Returns:
        A scan of `sensor`; 0 outside the field of view of `source` and outside the range limits of `sensor`, and
        beyond the maximum range of `source`, where a blend with no return lies.
    """
    return _returns(ranges, source.contains(source.grid_queries(sensor)).to(ranges.device), source, sensor)


def _returns(ranges: torch.Tensor, seen: torch.Tensor, source: Sensor, sensor: Sensor) -> Scan:
    valid = seen & (ranges >= sensor.min_range) & (ranges <= min(sensor.max_range, source.max_range))
    return Scan(ranges.where(valid, 0.0), sensor)
