"""Packet captures, `.pcap` or `.pcapng`, and the packets of a running sensor: to scans, turn by turn. The extra `io`.

Velodyne's packets are decoded by velodyne-decoder, which knows the sensor from them. Ouster's need the sensor's
metadata file, see `ilnet.scan_files.ouster`.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from ilnet.scan import Scan
from ilnet.scan_files import ouster
from ilnet.scan_files.points import scan_of
from ilnet.sensor import PRESETS, Sensor, preset

__all__ = ["Decoder", "Sweep", "decoder", "is_capture", "packets", "sweeps"]

# The last byte of a Velodyne packet, the model as velodyne-decoder calls it, and the preset that has its angles.
_VELODYNES = {
    0x21: ("HDL32E", "hdl-32e"),
    0x22: ("VLP16", "vlp-16"),
    0x28: ("VLP32C", "vlp-32c"),
    0xA1: ("VLS128", "vls-128"),
}
_VELODYNE_SIZE = 1206
_ETHERNET, _LINUX, _RAW, _LOOPBACK = 1, 113, (12, 14, 101), 0
_UDP = 17
# Datagrams that wait for their fragments, at most.
_WAITING = 64


class Sweep(NamedTuple):
    """A turn of the sensor: when it began [ns since 1970, by the clock of the receiver], and its scan."""

    time: int
    scan: Scan


class Decoder(Protocol):
    """Makes sweeps of packets."""

    def feed(self, time: float, packet: bytes) -> Sweep | None:
        """Takes a packet and when it arrived [s]; returns the sweep that it completes. Others' packets are left out.

        Raises:
            ValueError: If it is of a sensor that is not known.
        """

    def finish(self) -> Sweep | None:
        """Returns what was begun."""


def is_capture(path: Path) -> bool:
    """Returns whether a path is named as a capture is."""
    return path.suffix.lower() in (".pcap", ".pcapng")


def sweeps(path: Path, sensor: Sensor | None = None, metadata: Path | None = None) -> Iterator[Sweep]:
    """Yields the sweeps in a capture. The first and the last one are what there is of their turns.

    Args:
        path: The capture.
        sensor: The sensor, if its own angles shall replace those of the preset; None if the packets say it.
        metadata: The metadata file of an Ouster sensor; None for Velodyne.

    Raises:
        OSError: If a file is missing or unreadable.
        ValueError: If the extra is not installed, there is no packet of a known sensor, or the capture was cut short:
            then after all whole sweeps.
    """
    turns, found = decoder(sensor, metadata), 0
    problem = None
    try:
        for time, packet in packets(path):
            sweep = turns.feed(time, packet)
            if sweep is not None:
                found += 1
                yield sweep
    except ValueError as error:
        problem = error
    last = turns.finish()
    if last is not None:
        found += 1
        yield last
    if problem is not None:
        raise problem if str(problem).startswith(str(path)) else ValueError(f"{path}: {problem}")
    if not found:
        kind = "Velodyne: for an Ouster sensor, give its metadata file" if metadata is None else "this Ouster sensor"
        raise ValueError(f"{path}: it holds no packets of {kind}")


def decoder(sensor: Sensor | None = None, metadata: Path | None = None) -> Decoder:
    """Returns a decoder: of Ouster where there is a metadata file, else of Velodyne; see `sweeps`."""
    return _Velodyne(sensor) if metadata is None else _Ouster(metadata)


class _Velodyne:
    def __init__(self, sensor: Sensor | None):
        self._library = _velodyne_decoder()
        self._sensor = sensor
        self._model = 0
        self._stream: Any = None

    def feed(self, time: float, packet: bytes) -> Sweep | None:
        if len(packet) != _VELODYNE_SIZE:
            return None
        if self._stream is None:
            model, name = _VELODYNES.get(packet[-1], (None, ""))
            if model is None or name not in PRESETS:
                known = ", ".join(name for _, name in _VELODYNES.values() if name in PRESETS)
                raise ValueError(f"its packets are of model {packet[-1]:#x}; it should be one of {known}")
            self._model, self._sensor = packet[-1], self._sensor or preset(name)
            library = self._library
            self._stream = library.StreamDecoder(
                library.Config(model=library.Model.__members__[model], timestamp_first_packet=True)
            )
        return self._sweep(self._stream.decode(time, packet, True)) if packet[-1] == self._model else None

    def finish(self) -> Sweep | None:
        return None if self._stream is None else self._sweep(self._stream.finish(True))

    def _sweep(self, decoded: Any) -> Sweep | None:
        if decoded is None or not len(decoded[1]):
            return None
        stamp, points = decoded
        assert self._sensor is not None
        columns = {name: points[name] for name in ("x", "y", "z", "ring", "time")}
        columns["intensity"] = np.clip(points["intensity"] / 255, 0, 1)
        return Sweep(round(stamp.host * 1e9), scan_of(columns, self._sensor, "packets"))


class _Ouster:
    def __init__(self, metadata: Path):
        self._metadata = ouster.Metadata(metadata)
        self._frame: int | None = None
        self._time = 0.0
        self._columns: list[ouster.Columns] = []

    def feed(self, time: float, packet: bytes) -> Sweep | None:
        if len(packet) != self._metadata.packet_size:
            return None
        columns = ouster.columns_of(packet, self._metadata)
        if not len(columns.frames):
            return None
        frame, whole = int(columns.frames[0]), None
        if frame != self._frame:
            whole, self._frame, self._time = self.finish(), frame, time
        self._columns.append(columns)
        return whole

    def finish(self) -> Sweep | None:
        columns, self._columns = self._columns, []
        return Sweep(round(self._time * 1e9), ouster.scan_of(columns, self._metadata)) if columns else None


def packets(path: Path) -> Iterator[tuple[float, bytes]]:
    """Yields when each UDP packet of a capture arrived [s since 1970], and what it holds. Fragments are put together.

    Raises:
        OSError: If the file is missing or unreadable.
        ValueError: If it is no capture; if it was cut short, after all whole packets.
    """
    dpkt = _dpkt()
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    with path.open("rb") as file:
        try:
            reader = dpkt.pcap.UniversalReader(file)
            link, records = reader.datalink(), iter(reader)
        except (dpkt.Error, ValueError, struct.error) as error:
            raise ValueError(f"{path}: it is not a packet capture: {error}") from error
        fragments: dict[tuple, dict[int, Any]] = {}
        whole, cut = 0, False
        while True:
            try:
                time, frame = next(records, (0.0, None))
            except (dpkt.Error, ValueError, struct.error):
                break
            if frame is None:
                if cut:
                    break
                return
            ip = _ip(dpkt, link, frame)
            if ip is None:
                continue
            datagram = _joined(ip, fragments)
            if datagram is None:
                continue
            length = int.from_bytes(datagram[4:6], "big")
            cut = len(datagram) < max(length, 8)
            if cut:
                continue
            whole += 1
            yield float(time), datagram[8:length]
        raise ValueError(f"{path}: it was cut short after {whole} packets")


def _ip(dpkt: Any, link: int, frame: bytes) -> Any:
    """Returns the IPv4 packet of UDP in a captured frame, None if there is none."""
    try:
        if link == _ETHERNET:
            packet = dpkt.ethernet.Ethernet(frame).data
        elif link == _LINUX:
            packet = dpkt.sll.SLL(frame).data
        else:
            packet = dpkt.ip.IP(frame[4:] if link == _LOOPBACK else frame)
    except (dpkt.Error, struct.error, IndexError):
        return None
    return packet if isinstance(packet, dpkt.ip.IP) and packet.p == _UDP else None


def _joined(ip: Any, fragments: dict[tuple, dict[int, Any]]) -> bytes | None:
    """Returns the datagram that a packet completes. Those that wait for more stay in `fragments`."""
    if not (ip.mf or ip.offset):
        return bytes(ip.data)
    key = (ip.src, ip.dst, ip.id)
    parts = fragments.setdefault(key, {})
    parts[ip.offset * 8] = ip
    if len(fragments) > _WAITING:  # the oldest lost a fragment
        del fragments[next(iter(fragments))]
    end, pieces = 0, []
    while end in parts:
        part = parts[end]
        pieces.append(bytes(part.data))
        end += len(pieces[-1])
        if not part.mf:
            fragments.pop(key, None)
            return b"".join(pieces)
        if not pieces[-1]:
            break
    return None


def _velodyne_decoder() -> Any:
    try:
        import velodyne_decoder
    except ImportError:
        raise ValueError(
            "Velodyne's packets need the package velodyne-decoder, which is not installed: pip install 'ilnet[io]'"
        ) from None
    return velodyne_decoder


def _dpkt() -> Any:
    try:
        import dpkt
        import dpkt.sll
    except ImportError:
        raise ValueError("captures need the package dpkt, which is not installed: pip install 'ilnet[io]'") from None
    return dpkt
