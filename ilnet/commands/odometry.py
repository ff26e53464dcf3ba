"""Does it help a robot? Odometry from simulated drives, with few beams, with many, and with few made many.

KISS-ICP estimates the way of the car from the points of each scan. Every input is given to its default configuration,
without deskewing, since a simulated scan is taken at once:

    I. Vizzo et al., "KISS-ICP: In defense of point-to-point ICP – simple, accurate, and robust registration if done the
    right way", RA-L 2023.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm  # type: ignore[import-untyped]

from ilnet import models
from ilnet.commands.study import COLOURS, Study, loaded
from ilnet.scan import Scan
from ilnet.sensor import PAPER_INPUT, Sensor
from ilnet.world import drives, places, simulate, towns

__all__ = ["SCANS", "TARGET", "Track", "check_installed", "errors", "odometry"]

SCANS = 400
"""Scans of each drive."""
TARGET = PAPER_INPUT.resize(128, 1024)
"""The sensor with many beams, and what is predicted from `PAPER_INPUT`."""

_COLOURS = COLOURS | {"16 beams": "#000000", "planes": "#cc79a7"}


class Track(NamedTuple):
    """What odometry made of a drive."""

    poses: np.ndarray
    """(N, 4, 4) estimated poses, the first of which is about the identity."""
    points: float
    """Mean number of points in a scan."""
    upsampling: float
    """Processor time of the upsampling of a scan [s]."""
    odometry: float
    """Processor time of the odometry of a scan [s]."""


def check_installed() -> None:
    """Raises a ValueError that says what to install, if KISS-ICP is missing."""
    try:
        import kiss_icp.kiss_icp  # noqa: F401
    except ImportError as error:
        raise ValueError(
            f"kiss-icp cannot be imported ({error}); odometry needs it: pip install 'ilnet[odometry]'"
        ) from error


def odometry(study: Study) -> None:
    """Ours: how well KISS-ICP follows a drive of 400 scans through each test town, by what it is given.

    Inputs are scans of 16x1024 and of 128x1024, and 128x1024 predicted from 16x1024. Parked cars and people stand
    still; other vehicles drive. Errors of translation and rotation are KITTI's: means over all stretches of 100, 200, …
    metres. The absolute trajectory error (ATE) is the root mean square distance from the truth once both ways are
    aligned. Milliseconds are processor time, and so are frames a second.
    """
    check_installed()
    compared = loaded({"planes": "planes"} | {name: study.networks()[name] for name in ("iln-surfaces", "iln")})
    folder = study.out / f"odometry-{study.preset or 'shipped'}"
    rows, off = [], {}
    for town in towns.TEST:
        drive = drives.drive(places.town(town, device=simulate.best_device()), SCANS)
        truth = (drive.poses[0].inverse() @ drive.poses).numpy()
        sources = {f"{sensor.shape[0]} beams": _measured(drive, sensor) for sensor in (PAPER_INPUT, TARGET)}
        sources |= {name: _predicted(drive, model) for name, model in compared.items()}
        for name, source in sources.items():
            track = _track(drive, source, folder / town / f"{name.replace(' ', '-')}-{SCANS}.npz")
            rows.append(_row(town, name, truth, track))
            off[town, name] = np.linalg.norm(track.poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    study.write("odometry", rows)
    _draw(study, off)


def errors(truth: np.ndarray, poses: np.ndarray) -> dict[str, float]:
    """Compares a way with the truth.

    Args:
        truth: (N, 4, 4) true poses.
        poses: (N, 4, 4) estimated ones.

    Returns:
        KITTI's errors of translation, `translation_percent`, and of rotation, `rotation_deg_per_m`, NaN where the way
        is shorter than 100 m; and `ate_m`, the root mean square distance [m] of the two ways once they are aligned.
    """
    from kiss_icp import metrics

    translation, rotation = metrics.sequence_error(truth, poses)
    _, ate = metrics.absolute_trajectory_error(truth, poses)
    return {"translation_percent": translation, "rotation_deg_per_m": rotation, "ate_m": ate}


def _row(town: str, name: str, truth: np.ndarray, track: Track) -> dict[str, Any]:
    metres = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    return {
        "town": town,
        "input": name,
        "scans": len(truth),
        "metres": round(metres),
        "points": round(track.points),
        **errors(truth, track.poses),
        "upsampling_ms": round(1000 * track.upsampling),
        "odometry_ms": round(1000 * track.odometry),
        "fps": round(1 / (track.upsampling + track.odometry), 1),
    }


# Gives scan `number` of a drive, and the processor time of its upsampling [s].
_Source = Callable[[int], tuple[Scan, float]]


def _track(drive: drives.Drive, source: _Source, file: Path) -> Track:
    """Returns the track of a drive; once it is made, it is kept in a file."""
    if not file.exists():
        bar = tqdm(range(len(drive.poses)), unit="scan", desc=f"{file.parent.name}, {file.stem}")
        track = _follow(map(source, bar))
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part")
        with open(part, "wb") as unfinished:
            np.savez(unfinished, **track._asdict())
        part.replace(file)
    with np.load(file) as kept:
        return Track(kept["poses"], *(float(kept[field]) for field in Track._fields[1:]))


def _measured(drive: drives.Drive, sensor: Sensor) -> _Source:
    return lambda number: (simulate.scan(drive.world(number), sensor, drive.poses[number]), 0.0)


def _predicted(drive: drives.Drive, model: models.Model) -> _Source:
    frames = models.Upsampler(model, PAPER_INPUT, TARGET, device=simulate.best_device())
    sparse = _measured(drive, PAPER_INPUT)

    def predict(number: int) -> tuple[Scan, float]:
        scan, _ = sparse(number)
        start = time.process_time()
        answer = frames(scan).to("cpu")
        return answer, time.process_time() - start

    return predict


def _follow(frames: Iterable[tuple[Scan, float]]) -> Track:
    """Returns the track of some scans."""
    from kiss_icp.config import load_config
    from kiss_icp.kiss_icp import KissICP

    pipeline = KissICP(load_config(None))
    found = []
    for scan, upsampling in frames:
        cloud = scan.points().cpu().double().numpy()
        start = time.process_time()
        pipeline.register_frame(cloud, np.empty(0))  # without times it does not deskew
        found.append(Track(pipeline.last_pose, len(cloud), upsampling, time.process_time() - start))
    poses, *means = zip(*found, strict=True)
    return Track(np.stack(poses), *(float(np.mean(column)) for column in means))


def _draw(study: Study, off: Mapping[tuple[str, str], np.ndarray]) -> None:
    """Draws how far each input is off along the way, from the start that both ways share."""
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    kinds = list(dict.fromkeys(town for town, _ in off))
    for axis, town in zip(np.atleast_1d(figure.subplots(1, len(kinds))), kinds, strict=True):
        for (where, name), distance in off.items():
            if where == town:
                axis.plot(distance, label=name, color=_COLOURS.get(name, "#e69f00"))
        axis.set_title(town)
        axis.set_xlabel("scan")
    figure.axes[0].set_ylabel("distance from the truth [m]")
    figure.axes[-1].legend(fontsize=8)
    figure.savefig(study.out / "odometry.png", dpi=120)
