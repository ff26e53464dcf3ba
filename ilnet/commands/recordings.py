"""Recordings, which are bags and packet captures: their scans in order, made denser; `upsample` of a recording."""

import logging
import queue
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from tqdm import tqdm  # type: ignore[import-untyped]

from ilnet import models, scan_files
from ilnet.scan import Scan
from ilnet.scan_files import bags, captures, clouds
from ilnet.sensor import Sensor
from ilnet.world import simulate

__all__ = ["TOPIC", "Densifier", "Frame", "Kind", "ahead", "frames_of", "is_recording", "run", "sink"]

# Topic and frame of the clouds that a capture becomes: it names none.
TOPIC, _FRAME_ID = "/points", "lidar"
_Item = TypeVar("_Item")


class Frame(NamedTuple):
    """What a source gives at a time.

    Args:
        time: When it was recorded [ns].
        scan: The scan; None for a message of another topic, and for a cloud that holds no point in view.
        cloud: The cloud of the scan, if it came as one.
        message: The message of a bag.
        problem: Why a cloud gave no scan.
    """

    time: int
    scan: Scan | None = None
    cloud: clouds.Cloud | None = None
    message: bags.Message | None = None
    problem: str = ""


class Kind(NamedTuple):
    """How the scans of a source are to be written: its topic of clouds, the bag it is, and how many frames it has."""

    topic: str
    bag: bags.Bag | None = None
    frames: int | None = None


def is_recording(path: Path) -> bool:
    """Returns whether a path names a bag or a capture."""
    return bags.is_bag(path) or captures.is_capture(path)


@contextmanager
def frames_of(
    source: Path, sensor: Sensor | None = None, topic: str | None = None, metadata: Path | None = None
) -> Iterator[tuple[Iterator[Frame], Kind]]:
    """Opens a recording.

    Args:
        source: A bag or a capture.
        sensor: The sensor that measured it; not needed for a capture.
        topic: The topic of clouds in a bag; not needed where there is one.
        metadata: The metadata file of an Ouster sensor, for its capture.

    Raises:
        OSError: If a file is missing or unreadable.
        ValueError: If the recording is damaged, lacks the topic, or an option is missing.
    """
    if not bags.is_bag(source):
        found = (Frame(time, scan) for time, scan in captures.sweeps(source, sensor, metadata))
        yield found, Kind(topic or TOPIC)
        return
    with bags.Bag(source) as bag, _noted_once():
        name = bag.cloud_topic(topic)
        if sensor is None:
            raise ValueError(f"{source}: a cloud does not hold the angles of its rays; name its sensor: --from NAME")
        yield _clouds(bag, name, sensor), Kind(name, bag, len(bag))


def _clouds(bag: bags.Bag, topic: str, sensor: Sensor) -> Iterator[Frame]:
    for message in bag.messages():
        if message.connection.topic != topic or message.connection.msgtype != clouds.TYPE:
            yield Frame(message.time, message=message)
            continue
        cloud = bag.cloud(message)
        try:
            yield Frame(message.time, cloud.scan(sensor, f"{bag.path}, {topic}"), cloud, message)
        except ValueError as error:
            yield Frame(message.time, message=message, problem=str(error))


class Densifier:
    """Makes the scans of frames denser; prepares anew where the sensor changes.

    Args:
        model: The model that predicts.
        target: The sensor whose scans are wanted, or rows and columns over the field of view of what measured.
        precision: See `models.Upsampler`.
        min_confidence: Returns of less confidence become no return; None keeps all.

    Raises:
        ValueError: If `min_confidence` is no probability, or the model tells no confidence.
    """

    def __init__(
        self,
        model: models.Model,
        target: Sensor | tuple[int, int],
        precision: str = "float32",
        min_confidence: float | None = None,
    ):
        if min_confidence is not None and not 0 <= min_confidence <= 1:
            raise ValueError(f"--min-confidence is {min_confidence}; it should be from 0 to 1")
        if min_confidence is not None and not model.tells_confidence:
            raise ValueError("--min-confidence needs a model that tells its confidence, such as --model iln-surfaces")
        self._device = simulate.best_device()
        self._model, self._target = model.to(self._device), target
        self._precision, self._least = precision, min_confidence
        self._frames: models.Upsampler | None = None

    def __call__(self, scan: Scan) -> Scan:
        """Returns the denser scan, on the CPU."""
        if self._frames is None or self._frames.source != scan.sensor:
            target = self._target if isinstance(self._target, Sensor) else scan.sensor.resize(*self._target)
            self._frames = models.Upsampler(self._model, scan.sensor, target, self._precision, self._device)
        dense = self._frames(scan.to(self._device)).to("cpu")
        return dense if self._least is None else dense.confident(self._least)


@contextmanager
def sink(out: Path, kind: Kind, suffix: str = ".npz") -> Iterator[Callable[[Frame, Scan | None], None]]:
    """Opens what frames are written to: the function takes a frame, and the denser scan where it has one.

    Args:
        out: A bag of the kind of the source's or, from captures, a `.bag`, an `.mcap` or a folder of files.
        kind: What the source is.
        suffix: Suffix of the files in a folder.

    Raises:
        OSError: If it cannot be made.
        ValueError: If it is of another kind.
    """
    ending = out.suffix.lower()
    if kind.bag is not None and (ending == ".bag") == kind.bag.ros2:
        version, should = (2, "be a folder or end in .mcap") if kind.bag.ros2 else (1, "end in .bag")
        raise ValueError(f"out is {out}; it should {should}, since {kind.bag.path} is a bag of ROS {version}")
    if kind.bag is None and ending not in (".bag", ".mcap"):
        if out.suffix:
            raise ValueError(f"out is {out}; it should be a folder, or end in .bag or .mcap")
        out.mkdir(parents=True, exist_ok=True)
        count = 0

        def write_file(frame: Frame, dense: Scan | None) -> None:
            nonlocal count
            if dense is not None:
                scan_files.write(out / f"{count:06d}{suffix}", dense)
                count += 1

        yield write_file
        return
    with bags.written(out, kind.bag.mcap if kind.bag else True) as bag:
        connection = None if kind.bag else bag.add(kind.topic)
        for known in kind.bag.connections if kind.bag else ():
            bag.copy(known)

        def write_message(frame: Frame, dense: Scan | None) -> None:
            to = connection if frame.message is None else bag.copy(frame.message.connection)
            if dense is None:
                assert frame.message is not None
                bag.write(to, frame.time, frame.message.data)
                return
            assert frame.scan is not None
            cloud = frame.cloud or _cloud(frame, bag.ros2)
            bag.write_cloud(to, frame.time, cloud.denser(dense, frame.scan.sensor))

        yield write_message


def _cloud(frame: Frame, ros2: bool) -> clouds.Cloud:
    """Returns the cloud of a frame of a capture."""
    scan = frame.scan
    assert scan is not None
    images = {"ring": np.broadcast_to(np.argsort(np.argsort(scan.sensor.elevations))[:, None], scan.sensor.shape)}
    types = {name: np.dtype("<f4") for name in "xyz"} | {"ring": np.dtype("<u2")}
    for name in ("intensity", "time"):
        image = getattr(scan, name)
        if image is not None:
            images[name], types[name] = image.numpy(), np.dtype("<f4")
    return clouds.Cloud(clouds.pack(bags.blank(ros2, frame.time, _FRAME_ID), scan, images, types))


def ahead(items: Iterable[_Item], count: int = 2) -> Iterator[_Item]:
    """Yields what `items` gives, which a thread of its own fetches `count` ahead; its errors come out here."""
    fetched: queue.Queue[tuple[str, Any]] = queue.Queue(count)
    over = threading.Event()

    def put(kind: str, value: Any) -> bool:
        while not over.is_set():
            try:
                fetched.put((kind, value), timeout=0.1)
                return True
            except queue.Full:
                continue
        return False

    def fetch() -> None:
        try:
            for item in items:
                if not put("item", item):
                    return
            put("end", None)
        except BaseException as error:
            put("error", error)

    thread = threading.Thread(target=fetch, daemon=True)
    thread.start()
    try:
        while True:
            kind, value = fetched.get()
            if kind == "end":
                return
            if kind == "error":
                raise value
            yield value
    finally:
        over.set()
        thread.join()


class _Once(logging.Filter):
    """Lets each line through once: what is noted of one scan is true of all."""

    def __init__(self) -> None:
        super().__init__()
        self._said: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        line = record.getMessage()
        new = line not in self._said
        self._said.add(line)
        return new


@contextmanager
def _noted_once() -> Iterator[None]:
    once, logger = _Once(), logging.getLogger("ilnet")
    logger.addFilter(once)
    try:
        yield
    finally:
        logger.removeFilter(once)


def run(
    source: Path,
    out: Path,
    dense: Densifier,
    sensor: Sensor | None = None,
    topic: str | None = None,
    metadata: Path | None = None,
    suffix: str = ".npz",
) -> tuple[int, int]:
    """Upsamples a recording, with a progress bar on stderr, in memory that does not grow with its length.

    Reading, predicting and writing overlap. A cloud without a point in view passes as it is. Where the recording turns
    out to be damaged, what came before is written. A bag is written whole or not at all.

    Args:
        source: A bag or a capture.
        out: See `sink`.
        dense: What makes scans denser.
        sensor: See `frames_of`.
        topic: See `frames_of`.
        metadata: See `frames_of`.
        suffix: See `sink`.

    Returns:
        The numbers of scans that were written, and of those that could not be predicted.

    Raises:
        OSError: If a file is missing, or `out` cannot be made.
        ValueError: If no scan could be predicted, or as `frames_of` and `sink` do.
    """
    problems: list[str] = []

    def whole(frames: Iterator[Frame]) -> Iterator[Frame]:
        try:
            yield from frames
        except (ValueError, OSError) as error:
            problems.append(str(error))

    done, passed = 0, 0
    with frames_of(source, sensor, topic, metadata) as (frames, kind):
        if out.exists() and out.samefile(source):
            raise ValueError(f"out is {out}, the recording to be read; it should be another")
        with sink(out, kind, suffix) as write:
            read = ahead(whole(frames))
            found = ahead((frame, None if frame.scan is None else dense(frame.scan)) for frame in read)
            total = kind.bag.count(kind.topic) if kind.bag else None
            with tqdm(total=total, unit="scan", desc="upsample") as bar:
                for frame, scan in found:
                    write(frame, scan)
                    done += scan is not None
                    passed += bool(frame.problem)
                    if frame.problem and passed == 1:
                        problems.insert(0, f"{source}: {frame.problem}")
                    bar.update(scan is not None or bool(frame.problem))
            if not done:
                raise ValueError(problems[0] if problems else f"{source}: {kind.topic} holds no message")
    for problem in problems:
        tqdm.write(f"error: {' '.join(problem.split())}", file=sys.stderr)
    if passed:
        tqdm.write(f"warning: {passed} cloud(s) were written as they were", file=sys.stderr)
    return done, passed + (len(problems) > bool(passed))
