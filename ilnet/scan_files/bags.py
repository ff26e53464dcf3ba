"""Bags of ROS: `.bag` of ROS 1; of ROS 2 a folder, or its `.mcap` or `.db3` file alone. The extra `io` reads them.

Messages pass through as they are. Only clouds are ever unpacked, see `ilnet.scan_files.clouds`.
"""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ilnet.scan_files.clouds import TYPE, Cloud
from ilnet.scan_files.points import XYZ

__all__ = ["Bag", "BagWriter", "Message", "blank", "is_bag", "written"]

# ROS 2 knows a message definition by this; bags of before 2023 lack it, and readers then ignore it.
_NO_HASH = "RIHS01_" + "0" * 64


class Message(NamedTuple):
    """A message as a bag stores it: its connection, when it was recorded [ns], its bytes."""

    connection: Any
    time: int
    data: bytes | memoryview


def is_bag(path: Path) -> bool:
    """Returns whether a path is named as a bag is, or is the folder of one."""
    return path.suffix.lower() in (".bag", ".mcap", ".db3") or (path / "metadata.yaml").is_file()


class Bag:
    """A bag to read; a context manager.

    Args:
        path: Its file or folder.

    Raises:
        OSError: If it is missing or unreadable.
        ValueError: If rosbags is not installed, or the bag is damaged or of another kind than its suffix says.
    """

    def __init__(self, path: Path):
        rosbags = _rosbags()
        if not path.exists():
            raise FileNotFoundError(f"{path}: there is no such file or folder")
        self.path = path
        self.ros2 = path.suffix.lower() != ".bag" or path.is_dir()
        with _one_line(path):
            self._reader = (rosbags.rosbag2.Reader if self.ros2 else rosbags.rosbag1.Reader)(path)
            self._reader.open()
        self._types = _typestore(self.ros2)

    def __enter__(self) -> "Bag":
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    @property
    def mcap(self) -> bool:
        """Whether it is a bag of ROS 2 that is stored as MCAP."""
        files = [self.path, *(self.path.iterdir() if self.path.is_dir() else ())]
        return self.ros2 and any(file.suffix == ".mcap" for file in files)

    @property
    def connections(self) -> list[Any]:
        """What was recorded: topics, each with the type of its messages."""
        return self._reader.connections

    def __len__(self) -> int:
        return self._reader.message_count

    def count(self, topic: str) -> int:
        """Returns the number of messages of a topic."""
        return sum(connection.msgcount for connection in self.connections if connection.topic == topic)

    def cloud_topic(self, topic: str | None = None) -> str:
        """Returns the topic of clouds of that name, or the only one.

        Raises:
            ValueError: If there is none, or several and `topic` is None; it names those that there are.
        """
        types = {connection.topic: connection.msgtype for connection in self.connections}
        clouds = [name for name, kind in types.items() if kind == TYPE]
        found = ", ".join(f"{name} ({kind.replace('/msg/', '/')})" for name, kind in sorted(types.items())) or "none"
        if not clouds:
            raise ValueError(f"{self.path}: it has no topic of sensor_msgs/PointCloud2; its topics are {found}")
        if topic is None and len(clouds) == 1:
            return clouds[0]
        if topic is None or topic not in clouds:
            what = "topic is not named" if topic is None else f"topic is {topic!r}"
            raise ValueError(f"{self.path}: {what}; it should be one of {', '.join(clouds)}. All topics: {found}")
        return topic

    def messages(self) -> Iterator[Message]:
        """Yields all messages in the order of their times.

        Raises:
            ValueError: At the first one that is damaged.
        """
        messages = iter(self._reader.messages())
        while True:
            with _one_line(self.path):
                message = next(messages, None)
            if message is None:
                return
            yield Message(*message)

    def cloud(self, message: Message) -> Cloud:
        """Returns the cloud in a message.

        Raises:
            ValueError: If it is damaged.
        """
        with _one_line(self.path):
            unpack = self._types.deserialize_cdr if self.ros2 else self._types.deserialize_ros1
            return Cloud(unpack(message.data, TYPE))


class BagWriter:
    """A bag to write; `written` opens one."""

    def __init__(self, writer: Any, ros2: bool):
        self._writer, self.ros2 = writer, ros2
        self._types = _typestore(ros2)
        self._copies: dict[Any, Any] = {}

    def add(self, topic: str, kind: str = TYPE) -> Any:
        """Returns a new connection for messages of a type."""
        return self._writer.add_connection(topic, kind, typestore=self._types)

    def copy(self, connection: Any) -> Any:
        """Returns the connection that is, in this bag, what `connection` is in the bag that it comes from."""
        key = tuple(map(str, (connection.topic, connection.msgtype, connection.ext)))  # several may be alike
        if key not in self._copies:
            self._copies[key] = self._copied(connection)
        return self._copies[key]

    def _copied(self, connection: Any) -> Any:
        topic, kind, definition, ext = connection.topic, connection.msgtype, connection.msgdef.data, connection.ext
        if not self.ros2:
            return self._writer.add_connection(
                topic, kind, msgdef=definition, md5sum=connection.digest, callerid=ext.callerid, latching=ext.latching
            )
        options = {
            "serialization_format": ext.serialization_format,
            "offered_qos_profiles": ext.offered_qos_profiles,
        }
        if not definition and kind in self._types.fielddefs:
            return self._writer.add_connection(topic, kind, typestore=self._types, **options)
        return self._writer.add_connection(
            topic, kind, msgdef=definition, rihs01=connection.digest or _NO_HASH, **options
        )

    def write(self, connection: Any, time: int, data: bytes | memoryview) -> None:
        """Writes a message of a connection of this bag, recorded at a time [ns]."""
        self._writer.write(connection, time, data)

    def write_cloud(self, connection: Any, time: int, message: Any) -> None:
        """Writes a cloud."""
        pack = self._types.serialize_cdr if self.ros2 else self._types.serialize_ros1
        self._writer.write(connection, time, pack(message, TYPE))


@contextmanager
def written(path: Path, mcap: bool = True) -> Iterator[BagWriter]:
    """Opens a bag to be written, for as long as the context lasts.

    Until it is complete, it lies in a hidden folder beside `path`; after an error nothing is left.

    Args:
        path: A name that ends in .bag makes a bag of ROS 1, one that ends in .mcap a file of ROS 2; others a folder of
            ROS 2. A file of that name is replaced.
        mcap: Whether the folder holds MCAP; if not, SQLite.

    Raises:
        OSError: If it cannot be made.
        ValueError: If rosbags is not installed, or `path` is a folder.
    """
    rosbags = _rosbags()
    suffix = path.suffix.lower()
    if path.is_dir() or (path.exists() and suffix not in (".bag", ".mcap")):
        raise ValueError(f"{path}: it exists already; it should be a new name")
    partial = path.with_name(f".{path.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)  # of a run that was killed
    partial.mkdir(parents=True)
    try:
        if suffix == ".bag":
            made = partial / path.name
            writer = rosbags.rosbag1.Writer(made)
        else:
            made = partial / (path.stem if suffix == ".mcap" else path.name)
            plugin = rosbags.rosbag2.StoragePlugin
            storage = plugin.MCAP if mcap or suffix == ".mcap" else plugin.SQLITE3
            writer = rosbags.rosbag2.Writer(made, version=8, storage_plugin=storage)  # 9 is not read by older ROS
        with writer:
            yield BagWriter(writer, suffix != ".bag")
        os.replace(made / f"{made.name}.mcap" if suffix == ".mcap" else made, path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def blank(ros2: bool, time: int, frame: str) -> Any:
    """Returns a cloud of no points.

    Args:
        ros2: Whether for ROS 2.
        time: When it was measured [ns].
        frame: The name of the sensor's frame.
    """
    types = _typestore(ros2).types
    stamp = types["builtin_interfaces/msg/Time"](*divmod(time, 10**9))
    header = types["std_msgs/msg/Header"](*(() if ros2 else (0,)), stamp=stamp, frame_id=frame)
    field = types["sensor_msgs/msg/PointField"]
    fields = [field(name=axis, offset=4 * number, datatype=7, count=1) for number, axis in enumerate(XYZ)]
    return types[TYPE](header, 1, 0, fields, False, 12, 0, np.zeros(0, np.uint8), True)


def _rosbags() -> Any:
    try:
        import rosbags
        import rosbags.rosbag1
        import rosbags.rosbag2
    except ImportError:
        raise ValueError("bags need the package rosbags, which is not installed: pip install 'ilnet[io]'") from None
    return rosbags


def _typestore(ros2: bool) -> Any:
    from rosbags.typesys import Stores, get_typestore

    # Clouds and headers are the same in all versions of ROS 2.
    return get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Turns whatever a library raises on a damaged bag into a ValueError that names it."""
    try:
        yield
    except OSError:
        raise
    except Exception as error:  # rosbags, apsw, lz4 and struct raise many kinds
        text = " ".join(str(error).split())[:300]
        raise ValueError(f"{path}: it cannot be read as a bag: {text or type(error).__name__}") from error
