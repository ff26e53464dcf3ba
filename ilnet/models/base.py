"""What all models share: one call, and the path from a scan to a denser scan."""

import torch
from torch import nn

from ilnet.scan import Scan
from ilnet.sensor import Sensor

__all__ = ["OFFSET_SCALE", "Model", "normalised", "returns"]

# The authors measure offsets in half pixels; their checkpoints are worth the factor.
OFFSET_SCALE = 2.0

# Queries decoded at a time: the activations of so many fit the cache of a CPU core.
_CHUNK = {"cpu": 4096, "cuda": 65536}


class Model(nn.Module):
    """A function r̂ = f(I, q) of a range image and query directions (paper, Eq. 1).

    A subclass brings `decode`, and `encode` where it extracts features.
    """

    norm_range = 0.0
    """Metres that the network sees as +1, and no return is filled with at least; 0 where it sees metres."""

    def encode(self, image: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Computes once per image what all queries share; the image itself where there is nothing to extract.

        Args:
            image: (B, H, W) metres, no return filled.
            wrap: Whether column W-1 meets column 0.

        Returns:
            Features (B, C, H, W), or the image.
        """
        return image

    def decode(self, features: torch.Tensor, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        """Answers queries (B, Q, 2) with ranges (B, Q) [m], from the features and the image that gave them."""
        raise NotImplementedError

    def forward(self, image: torch.Tensor, queries: torch.Tensor, wrap: bool = True) -> torch.Tensor:
        """Predicts the range along each queried direction.

        Args:
            image: (B, H, W) float32 ranges in metres, no return filled with the sensor's `norm_range` (`Scan.filled`).
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

    @torch.no_grad()
    def ranges(self, scan: Scan, sensor: Sensor) -> torch.Tensor:
        """Predicts what `sensor` would measure at the place of a scan, as the raw output of the network.

        The memory needed beyond the output does not grow with the number of rays.

        Args:
            scan: What was measured.
            sensor: The rays to predict; any tables within the field of view of the scan's sensor.

        Returns:
            (H, W) float32 metres on the scan's device; near `norm_range` means no return. Rays outside the field of
            view get the range of the outermost beam next to them.
        """
        image = scan.filled(self.norm_range).unsqueeze(0)
        queries = scan.sensor.grid_queries(sensor).to(image.device).view(1, -1, 2)
        wrap = scan.sensor.wrap
        features = self.encode(image, wrap)
        chunks = queries.split(_CHUNK[image.device.type], dim=1)
        return torch.cat([self.decode(features, image, chunk, wrap) for chunk in chunks], dim=1).view(sensor.shape)

    def upsample(self, scan: Scan, sensor: Sensor) -> Scan:
        """Predicts the scan that `sensor` would measure at the place of a scan.

        Args:
            scan: What was measured.
            sensor: The sensor whose scan is wanted, in the same frame: any resolution, any tables.

        Returns:
            A scan of `sensor`. Rays outside the field of view of the scan's sensor, those predicted beyond the maximum
            range of either, and those below the minimum range of `sensor`, hold no return.
        """
        return returns(self.ranges(scan, sensor), scan.sensor, sensor)


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
    seen = source.contains(source.grid_queries(sensor)).to(ranges.device)
    valid = seen & (ranges >= sensor.min_range) & (ranges <= min(sensor.max_range, source.max_range))
    return Scan(ranges.where(valid, 0.0), sensor)
