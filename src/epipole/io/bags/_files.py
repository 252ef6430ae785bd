"""Opening ROS recordings with the package `rosbags`: ROS 1 bags, and ROS 2 bags in SQLite or MCAP.

Standard messages are decoded by their published definitions, unchanged since ROS Noetic and Foxy, rather than by the
definitions in the recording, which could be wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from epipole.errors import FileFormatError, MissingDependencyError
from epipole.io.bags._scanning import ScannedBag, is_scannable, refuse_views
from epipole.io.bags._unpacking import bound_unpacking
from epipole.io.files import read_by_others, require_file

ROS1_SUFFIX = ".bag"
ROS2_SUFFIXES = frozenset({".db3", ".mcap"})
METADATA = "metadata.yaml"
_PROBLEM = "cannot be read as a recording of ROS"


@dataclass(frozen=True, slots=True, eq=False)
class BagMessage:
    """A message as recorded."""

    topic: str
    kind: str
    """Message type, such as `sensor_msgs/msg/Image`."""
    recorded_ns: int
    data: bytes


@dataclass(frozen=True, slots=True, eq=False)
class OpenBag:
    """An open recording."""

    path: Path
    reader: Any
    types: Any
    is_ros1: bool
    counts: dict[str, int]
    """Number of messages by topic."""
    kinds: dict[str, str]
    """Message type by topic."""
    warnings: tuple[str, ...] = ()

    def messages(self, topics: Sequence[str]) -> Iterator[BagMessage]:
        """Messages of some topics, in recorded order.

        Raises:
            FileFormatError: the recording is damaged from here on.
        """
        wanted = [
            c for c in self.reader.connections if c.topic in topics and c.msgtype == self.kinds[c.topic]
        ]
        if not wanted:
            return
        rows = self.reader.messages(connections=wanted)
        while True:
            with read_by_others(self.path, _PROBLEM):
                row = next(rows, None)
                if row is None:
                    return
                if row[0] not in wanted:  # two connections share an id: the reader returns the other one
                    raise FileFormatError(self.path, f"{_PROBLEM}: two connections share an id")
                # A damaged database can contain values of any type.
                message = BagMessage(row[0].topic, row[0].msgtype, int(row[1]), _as_bytes(row[2]))
            yield message

    def content(self, message: BagMessage) -> Any:
        """Decode a message into an object with the fields of its definition.

        Raises:
            FileFormatError: the message is damaged.
        """
        with read_by_others(self.path, f"a message of {message.topic} is damaged"):
            if self.is_ros1:
                return self.types.deserialize_ros1(message.data, message.kind)
            return self.types.deserialize_cdr(message.data, message.kind)


def is_bag(path: str | Path) -> bool:
    """Whether a path is a ROS recording: a .bag, .db3 or .mcap file, or a folder of one of the latter two."""
    path = Path(path)
    if path.is_dir():
        return bool(_storages(path))
    return path.suffix.lower() in {ROS1_SUFFIX, *ROS2_SUFFIXES} and path.is_file()


@contextmanager
def opened_bag(path: Path) -> Iterator[OpenBag]:
    """Open a recording for the duration of the block.

    Raises:
        MissingDependencyError: the package rosbags is not installed.
        FileFormatError: the file is not a readable recording, or contains no messages.
    """
    at, reader_of, types = _reader_and_types(path)
    warnings: tuple[str, ...] = ()
    files = _storages(at) if at.is_dir() else [at]
    for file in files:
        refuse_views(file)
    try:
        with read_by_others(path, _PROBLEM):
            reader = reader_of(at)
            reader.open()
    except FileFormatError as error:
        if len(files) != 1 or not is_scannable(files[0]):
            raise
        reader = ScannedBag(files[0])
        reader.open()
        if not sum(c.msgcount for c in reader.connections):
            raise
        warnings = (f"{error}; only the part before the damage or truncation is used",)
    try:
        with read_by_others(path, _PROBLEM):
            # One message type per topic: messages of other types are ignored.
            kinds = {str(c.topic): str(c.msgtype) for c in reversed(reader.connections)}
            counts = dict.fromkeys(kinds, 0)
            for connection in reader.connections:
                is_of_kind = connection.msgtype == kinds[connection.topic]
                counts[connection.topic] += max(int(connection.msgcount), 0) if is_of_kind else 0
        if not sum(counts.values()):
            raise FileFormatError(path, "the recording contains no messages")
        is_ros1 = at.suffix.lower() == ROS1_SUFFIX
        yield OpenBag(path, reader, types, is_ros1, counts, kinds, warnings)
    finally:
        with read_by_others(path, _PROBLEM):
            reader.close()


def _as_bytes(data: object) -> bytes:
    if not isinstance(data, bytes):
        raise TypeError("a message does not consist of bytes")
    return data


def _reader_and_types(path: Path) -> tuple[Path, Any, Any]:
    """The file or folder to read, the reader class, and the message definitions."""
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingDependencyError(
            f"{path} is a ROS recording; to read it, run pip install 'epipole[ros]' (or rosbags>=0.11,<0.12)"
        ) from error
    bound_unpacking()
    if path.suffix.lower() == ROS1_SUFFIX and not path.is_dir():
        require_file(path)
        return path, Reader1, get_typestore(Stores.ROS1_NOETIC)
    at = path
    if path.is_dir() and not (path / METADATA).is_file():  # written last: the recording was cut off
        storages = _storages(path)
        if len(storages) != 1:
            raise FileFormatError(
                path, f"it has no {METADATA} and {len(storages)} message files: pass one of the files"
            )
        at = storages[0]
    if not at.is_dir():
        require_file(at)
    return at, Reader2, get_typestore(Stores.ROS2_HUMBLE)


def _storages(folder: Path) -> list[Path]:
    return sorted(
        file
        for file in folder.iterdir()
        if ROS2_SUFFIXES & {suffix.lower() for suffix in file.suffixes} and file.is_file()
    )
