"""The command `upsample`: files of scans in, files of denser scans out."""

import sys
from collections.abc import Iterator
from pathlib import Path

from tqdm import tqdm  # type: ignore[import-untyped]

from ilnet import memory, models, scan_files
from ilnet.commands import options
from ilnet.scan import Scan
from ilnet.sensor import Sensor
from ilnet.world import simulate

__all__ = ["run"]


def run(
    source: Path,
    out: Path,
    model: models.Model,
    target: Sensor | tuple[int, int],
    sensor: Sensor | None = None,
    suffix: str = ".npz",
    min_confidence: float | None = None,
    columns: int | None = None,
) -> tuple[int, int]:
    """Upsamples a file, or all files of a folder, with a progress bar on stderr.

    A file that cannot be upsampled becomes one line on stderr, and the others are upsampled all the same. Each file is
    written whole or not at all; what an earlier run left unfinished, because it was killed, is removed.

    Args:
        source: A file that `ilnet.scan_files.read` reads, or a folder of such files. Folders and hidden files in it are
            left out.
        out: The file to write, in a format of `ilnet.scan_files.write`. If `source` is a folder, the folder to write
            to; made if it is missing.
        model: The model that predicts; it is moved to the device of the scans.
        target: The sensor whose scan is wanted, or rows and columns over the field of view of each file's sensor.
        sensor: The sensor of the files, if they do not hold its angles; see `ilnet.scan_files.read`.
        suffix: Suffix of the files written to a folder.
        min_confidence: Returns of less confidence become no return; None keeps all.
        columns: How many columns the points of a `.bin` have; None tells it by the values.

    Returns:
        The numbers of files that were written and that could not be.

    Raises:
        OSError: If `source` is missing or `out` cannot be made.
        ValueError: If there is nothing to upsample, it would be overwritten, `min_confidence` is no probability, or the
            model tells no confidence to compare with it.
    """
    if min_confidence is not None and not 0 <= min_confidence <= 1:
        raise ValueError(f"--min-confidence is {min_confidence}; it should be from 0 to 1")
    if min_confidence is not None and not model.tells_confidence:
        raise ValueError("--min-confidence needs a model that tells its confidence, such as --model iln-surfaces")
    device = simulate.best_device()
    model = model.to(device)
    frames: models.Upsampler | None = None
    tasks = list(_tasks(source, out, suffix))
    folder = tasks[0][1].parent
    if folder.is_dir():
        scan_files.remove_unfinished(folder)
    written: set[Path] = set()
    failed = 0
    for path, result in tqdm(tasks, unit="scan", desc="upsample"):
        try:
            if result in written:
                raise ValueError(f"{path}: another file of this name became {result} already; rename one of them")
            scan = scan_files.read(path, sensor, columns).to(device)
            if frames is None or frames.source != scan.sensor:
                wanted = target if isinstance(target, Sensor) else scan.sensor.resize(*target)
                frames = models.Upsampler(model, scan.sensor, wanted, device=device)
            dense = frames(scan)
            if min_confidence is not None:
                dense = _confident(dense, min_confidence)
            scan_files.write(result, dense)
            written.add(result)
        except (ValueError, OSError, MemoryError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and not memory.ran_out(error):
                raise
            failed += 1
            line = options.error_line(error)
            if isinstance(error.__cause__, scan_files.UnknownSensor):
                line += ": --from NAME"
            tqdm.write(f"error: {line if line.startswith(str(path)) else f'{path}: {line}'}", file=sys.stderr)
    return len(written), failed


def _confident(scan: Scan, least: float) -> Scan:
    """Returns `scan.confident(least)`, or raises a ValueError if that is empty: no command would read it."""
    found = scan.confident(least)
    if scan.confidence is not None and not found.ranges.any():
        largest = scan.confidence.max()
        raise ValueError(f"none of its returns has a confidence of {least}; the largest is {largest:.2f}")
    return found


def _tasks(source: Path, out: Path, suffix: str) -> Iterator[tuple[Path, Path]]:
    """Yields each file to read, and the file to write."""
    if not source.is_dir():
        if out.exists() and out.samefile(source):
            raise ValueError(f"out is {out}, the file to be read; it should be another file")
        yield source, out
        return
    out.mkdir(parents=True, exist_ok=True)
    if out.samefile(source):
        raise ValueError(f"out is {out}, the folder to be read; it should be another folder")
    for path in scan_files.listed(source):
        yield path, out / f"{path.stem}{suffix}"
