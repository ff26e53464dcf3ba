"""The command `stream`: scans of a running sensor, or of a recording at its rate, made denser as they come."""

import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
import torch

from ilnet.commands import viewer
from ilnet.commands.recordings import TOPIC, Densifier, Frame, Kind, frames_of, sink
from ilnet.scan import Scan
from ilnet.scan_files import captures
from ilnet.sensor import Sensor

__all__ = ["Summary", "run", "show"]

_UDP = "udp://"
# The largest datagram, and how long to wait for one before looking whether to stop [s].
_DATAGRAM, _WAIT = 65535, 0.2
# How long without a packet until a line says so [s].
_SILENCE = 5.0


class Summary(NamedTuple):
    """What became of a stream.

    Args:
        scans: Number of scans that came.
        dense: Number of those that were made denser.
        dropped: Number of those that were not, as the one before them took too long.
        seconds: From the first scan to the last.
        delay: Median time from a scan's arrival until it was made denser and delivered [s].
        problem: Why the source ended early; what came before is written.
    """

    scans: int
    dense: int
    dropped: int
    seconds: float
    delay: float
    problem: str = ""

    def __str__(self) -> str:
        rate = self.dense / self.seconds if self.seconds > 0 else 0.0
        return (
            f"{self.scans} scan(s) in {self.seconds:.1f} s: {self.dense} made denser ({rate:.1f} a second, "
            f"{1000 * self.delay:.0f} ms after each), {self.dropped} dropped"
        )


class _Waiting:
    """Frames that wait to be made denser: at most one with a scan; a newer one takes its place."""

    def __init__(self) -> None:
        self._frames: deque[tuple[Frame, float]] = deque()
        self._over, self._changed = False, threading.Condition()
        self.scans = self.dropped = 0
        self.problem: BaseException | None = None

    def put(self, frame: Frame) -> None:
        with self._changed:
            if frame.scan is not None:
                self.scans += 1
                older = [entry for entry in self._frames if entry[0].scan is not None]
                for entry in older:
                    self._frames.remove(entry)
                    self.dropped += 1
            self._frames.append((frame, time.monotonic()))
            self._changed.notify()

    def close(self, problem: BaseException | None = None) -> None:
        with self._changed:
            self._over, self.problem = True, problem
            self._changed.notify()

    def __iter__(self) -> Iterator[tuple[Frame, float]]:
        """Yields each frame, and when it arrived, until the source is over."""
        while True:
            with self._changed:
                while not self._frames:
                    if self._over:
                        return
                    self._changed.wait(_WAIT)  # not for ever, so that an interrupt from the keyboard comes through
                entry = self._frames.popleft()
            yield entry


def run(
    source: str,
    deliver: list[Callable[[Frame, Scan | None], None]],
    dense: Densifier,
    out: Path | None = None,
    sensor: Sensor | None = None,
    topic: str | None = None,
    metadata: Path | None = None,
    scans: int | None = None,
) -> Summary:
    """Makes the scans of a source denser, at the rate at which they come, until it is over or the user interrupts.

    While a scan is made denser, the next one is read and decoded. If one more comes, the one that waits is dropped.

    Args:
        source: A bag, a capture, or `udp://[ADDRESS]:PORT`, where a sensor sends its packets.
        deliver: What takes each frame with its denser scan, such as a viewer.
        dense: What makes scans denser.
        out: A bag to write as well, or a folder; see `recordings.sink`.
        sensor: See `recordings.frames_of`.
        topic: See `recordings.frames_of`.
        metadata: See `recordings.frames_of`.
        scans: How many scans to take; None takes all.

    Raises:
        OSError: If the port is taken, or a file is missing.
        ValueError: If the source is of no known kind, or damaged before its first scan.
    """
    waiting, stop = _Waiting(), threading.Event()
    with ExitStack() as stack:
        frames, kind = stack.enter_context(_opened(source, stop, sensor, topic, metadata))
        takers = [*deliver, *([stack.enter_context(sink(out, kind))] if out else [])]
        thread = threading.Thread(target=_feed, args=(frames, waiting, stop, scans), daemon=True)
        if sensor is not None:
            dense(Scan(torch.zeros(sensor.shape), sensor))  # the first one takes seconds: kernels are loaded
        thread.start()
        stack.callback(thread.join)
        stack.callback(stop.set)
        done, delays, first, last = 0, [], 0.0, 0.0
        try:
            for frame, arrived in waiting:
                scan = None if frame.scan is None else dense(frame.scan)
                for take in takers:
                    take(frame, scan)
                if scan is not None:
                    last = time.monotonic()
                    first = first or arrived
                    delays.append(last - arrived)
                    done += 1
        except KeyboardInterrupt:
            click.echo("stopped", err=True)
        if waiting.problem is not None and not done:
            raise waiting.problem
    delay = float(np.median(delays)) if delays else 0.0
    problem = "" if waiting.problem is None else " ".join(str(waiting.problem).split())
    return Summary(waiting.scans, done, waiting.dropped, last - first, delay, problem)


def show(server: viewer.Server, frame: Frame, scan: Scan | None) -> None:
    """Shows a scan beside the denser one that was made of it, and how sure that is."""
    if scan is None or frame.scan is None:
        return
    panels = [viewer.height("as it comes", frame.scan), viewer.height("denser", scan)]
    server.show(panels + ([viewer.trust("denser", scan)] if scan.confidence is not None else []))


@contextmanager
def _opened(
    source: str, stop: threading.Event, sensor: Sensor | None, topic: str | None, metadata: Path | None
) -> Iterator[tuple[Iterator[Frame], Kind]]:
    if not source.startswith(_UDP):
        path = Path(source)
        with frames_of(path, sensor, topic, metadata) as (frames, kind):
            yield _in_time(frames, stop), kind
        return
    address, _, port = source.removeprefix(_UDP).rpartition(":")
    if not (port.isdecimal() and 0 < int(port) < 65536):
        raise ValueError(f"source is {source!r}; it should be such as udp://:2368, the port of the sensor's packets")
    turns = captures.decoder(sensor, metadata)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        receiver.bind((address, int(port)))
        receiver.settimeout(_WAIT)
        yield _received(receiver, turns, stop), Kind(topic or TOPIC)


def _received(receiver: socket.socket, turns: captures.Decoder, stop: threading.Event) -> Iterator[Frame]:
    heard = time.monotonic()
    while not stop.is_set():
        try:
            packet = receiver.recv(_DATAGRAM)
        except TimeoutError:
            if heard and time.monotonic() - heard > _SILENCE:
                click.echo(f"no packet for {_SILENCE:.0f} s", err=True)
                heard = 0.0  # once for each silence
            continue
        heard = time.monotonic()
        sweep = turns.feed(time.time(), packet)
        if sweep is not None:
            yield Frame(*sweep)


def _in_time(frames: Iterator[Frame], stop: threading.Event) -> Iterator[Frame]:
    """Yields each frame when it is due."""
    began, first = time.monotonic(), None
    for frame in frames:
        first = frame.time if first is None else first
        stop.wait(max(0.0, began + (frame.time - first) / 1e9 - time.monotonic()))
        if stop.is_set():
            return
        yield frame


def _feed(frames: Iterator[Frame], waiting: _Waiting, stop: threading.Event, scans: int | None) -> None:
    try:
        for frame in frames:
            if stop.is_set():
                break
            waiting.put(frame)
            if scans is not None and waiting.scans >= scans:
                break
        waiting.close()
    except BaseException as error:
        waiting.close(error)
