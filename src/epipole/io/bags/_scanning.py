"""Reading truncated or damaged recordings record by record from the start, without the index at the end.

ROS 1: https://wiki.ros.org/Bags/Format/2.0. MCAP: https://mcap.dev/spec. SQLite: the tables of rosbag2. Data after the
first incomplete record are lost.
"""

from __future__ import annotations

import io
import sqlite3
import struct
from collections.abc import Collection, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from epipole.errors import FileFormatError
from epipole.io.bags._unpacking import unpacked
from epipole.io.files import open_file

_ROS1, _MCAP, _SQLITE = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0"
_MOST_RECORD_BYTES = 1 << 31
_R1_MESSAGE, _R1_CHUNK, _R1_CONNECTION = 2, 5, 7
_M_SCHEMA, _M_CHANNEL, _M_MESSAGE, _M_CHUNK = 3, 4, 5, 6
_DAMAGE = (
    ValueError,
    OverflowError,
    KeyError,
    IndexError,
    TypeError,
    struct.error,
    OSError,
    EOFError,
    RuntimeError,
    MemoryError,
    sqlite3.Error,
)
"""Exceptions raised by damaged bytes, here and in decompression."""


@dataclass(frozen=True, slots=True)
class ScannedConnection:
    """A topic with messages; attributes are named as in rosbags."""

    id: int
    topic: str
    msgtype: str
    msgcount: int = 0


class ScannedBag:
    """The readable part of a damaged recording, with the interface of a rosbags reader."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.connections: list[ScannedConnection] = []

    def open(self) -> None:
        """Find the topics and count their messages."""
        counts: dict[int, int] = {}
        found: dict[int, ScannedConnection] = {}
        for what in self._records():
            if isinstance(what, ScannedConnection):
                found[what.id] = what
            else:
                counts[what[0]] = counts.get(what[0], 0) + 1
        self.connections = [replace(c, msgcount=counts.get(c.id, 0)) for c in found.values()]

    def messages(
        self, connections: Collection[ScannedConnection]
    ) -> Iterator[tuple[ScannedConnection, int, bytes]]:
        """Messages of some topics: the topic, nanoseconds, bytes."""
        wanted = {c.id: c for c in connections}
        for what in self._records():
            if not isinstance(what, ScannedConnection) and what[0] in wanted:
                yield wanted[what[0]], what[1], what[2]

    def close(self) -> None:
        """Do nothing: no file stays open."""

    def _records(self) -> Iterator[ScannedConnection | tuple[int, int, bytes]]:
        """Topics, and messages as (topic id, nanoseconds, bytes), up to the first incomplete record."""
        kind = _kind_of(self.path)
        with suppress(*_DAMAGE):
            if kind == _SQLITE:
                yield from _sqlite_records(self.path)
                return
            with open_file(self.path) as stream:
                stream.seek(len(kind))
                yield from _ros1_records(stream) if kind == _ROS1 else _mcap_records(stream, {})


def is_scannable(path: Path) -> bool:
    """Whether a file starts like a ROS 1 bag, an MCAP file or a SQLite database."""
    return path.is_file() and bool(_kind_of(path))


def refuse_views(path: Path) -> None:
    """Reject a database with computed tables, which may never end; recorders do not write them.

    Raises:
        FileFormatError: the database has a view, a trigger or a virtual table.
    """
    if not path.is_file() or _kind_of(path) != _SQLITE:
        return
    address = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    requested = (
        "SELECT name FROM sqlite_master WHERE type NOT IN ('table', 'index') OR sql LIKE 'CREATE VIRTUAL%'"
    )
    with suppress(sqlite3.Error), closing(sqlite3.connect(address, uri=True)) as database:
        try:
            found = database.execute(requested).fetchone()
        except UnicodeDecodeError as error:
            raise FileFormatError(path, "not a ROS recording: a table name is not text") from error
        if found:
            raise FileFormatError(path, f"not a ROS recording: {str(found[0])[:60]} is not a plain table")


def _kind_of(path: Path) -> bytes:
    with open_file(path) as stream:
        head = stream.read(len(_SQLITE))
    return next((kind for kind in (_ROS1, _MCAP, _SQLITE) if head.startswith(kind)), b"")


def _exactly(stream: io.BufferedIOBase, size: int) -> bytes:
    if size > _MOST_RECORD_BYTES:
        raise EOFError("a record is too long")
    data = stream.read(size)
    if len(data) < size:
        raise EOFError("a record is truncated")
    return data


def _number(stream: io.BufferedIOBase, form: str) -> int:
    return int(struct.unpack("<" + form, _exactly(stream, struct.calcsize("<" + form)))[0])


def _ros1_records(stream: io.BufferedIOBase) -> Iterator[Any]:
    """Records of a file, or of a chunk, which has the same format."""
    while size_bytes := stream.read(4):
        header = _ros1_fields(_exactly(stream, struct.unpack("<I", size_bytes)[0]))
        data = _exactly(stream, _number(stream, "I"))
        kind = header["op"][0]
        if kind == _R1_CHUNK:
            yield from _ros1_records(io.BytesIO(unpacked(header["compression"].decode(), data)))
        elif kind == _R1_CONNECTION:
            fields = _ros1_fields(data)
            package, _slash, name = fields["type"].decode().partition("/")
            number = struct.unpack("<I", header["conn"])[0]
            yield ScannedConnection(number, header["topic"].decode(), f"{package}/msg/{name}")
        elif kind == _R1_MESSAGE:
            seconds, nanoseconds = struct.unpack("<II", header["time"])
            yield struct.unpack("<I", header["conn"])[0], seconds * 10**9 + nanoseconds, data


def _ros1_fields(data: bytes) -> dict[str, bytes]:
    """Fields of a header: the length of `name=value`, then `name=value`."""
    out, at = {}, 0
    while at < len(data):
        (size,) = struct.unpack_from("<I", data, at)
        name, _, value = data[at + 4 : at + 4 + size].partition(b"=")
        out[name.decode()] = value
        at += 4 + size
    return out


def _mcap_records(stream: io.BufferedIOBase, schemas: dict[int, str]) -> Iterator[Any]:
    """Records of a file, or of a chunk, which has the same format."""
    while kind := stream.read(1):
        record = io.BytesIO(_exactly(stream, _number(stream, "Q")))
        if kind[0] == _M_SCHEMA:
            number = _number(record, "H")
            schemas[number] = _text(record)
        elif kind[0] == _M_CHANNEL:
            number, schema = _number(record, "H"), _number(record, "H")
            yield ScannedConnection(number, _text(record), schemas[schema])
        elif kind[0] == _M_MESSAGE:
            number, _, recorded_ns, _ = struct.unpack("<HIQQ", _exactly(record, 22))
            yield number, recorded_ns, record.read()
        elif kind[0] == _M_CHUNK:
            record.seek(28)
            compression = _text(record)
            data = _exactly(record, _number(record, "Q"))
            yield from _mcap_records(io.BytesIO(unpacked(compression, data)), schemas)


def _sqlite_records(path: Path) -> Iterator[Any]:
    address = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    with closing(sqlite3.connect(address, uri=True)) as database:
        # No value can be longer than the file; a wrong length would exhaust the memory.
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(path.stat().st_size, 1 << 16))
        for number, topic, kind in database.execute("SELECT id, name, type FROM topics"):
            yield ScannedConnection(int(number), str(topic), str(kind))
        before = -(1 << 63)
        for row, number, recorded_ns, data in database.execute(
            "SELECT rowid, topic_id, timestamp, data FROM messages"
        ):
            if row <= before:
                raise ValueError("the pages of the table form a cycle")
            before = row
            yield int(number), int(recorded_ns), bytes(memoryview(data))


def _text(stream: io.BufferedIOBase) -> str:
    return _exactly(stream, _number(stream, "I")).decode()
