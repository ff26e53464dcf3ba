"""What networks learn from: batches of rays, and the archives on disk that hold scans."""

from ilnet.data.archive import Archive, open_archive
from ilnet.data.batches import Batch, ContinuousRays, StoredImages
from ilnet.data.rimg import RangeImageTree

__all__ = ["Archive", "Batch", "ContinuousRays", "RangeImageTree", "StoredImages", "open_archive"]
