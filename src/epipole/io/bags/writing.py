"""Writing ROS 2 recordings: one MCAP file, which Foxglove, RViz (`ros2 bag play`) and `read_bag` open."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from epipole._checks import checked
from epipole.errors import ConfigError, MissingDependencyError
from epipole.io.atomic import atomic_write, part_beside, remove_abandoned_parts
from epipole.io.ros import header_fields


class BagWriter:
    """An open recording."""

    def __init__(self, writer: Any, types: Any) -> None:
        self._writer, self._types = writer, types
        self._connections: dict[str, Any] = {}
        self._makers: dict[str, Callable[[Mapping[str, Any]], Any]] = {}
        self._kinds: dict[str, str] = {}

    def write(self, topic: str, kind: str, stamp_s: float, fields: Mapping[str, Any]) -> None:
        """Append a message.

        Args:
            topic: its topic; always with the same kind.
            kind: its type, such as `nav_msgs/msg/Odometry`.
            stamp_s: when it is published.
            fields: its content, as from `epipole.io.ros`.

        Raises:
            ConfigError: the time cannot be recorded, the kind is unknown or not that of the topic, or a field is missing.
        """
        if kind not in self._types.types:
            raise ConfigError(f"{kind} is not a kind of message of ROS 2 Humble")
        if self._kinds.setdefault(topic, kind) != kind:
            raise ConfigError(f"{topic} has messages of the kind {self._kinds[topic]}, not {kind}")
        stamp = header_fields(stamp_s, "")["stamp"]
        recorded_ns = 10**9 * stamp["sec"] + stamp["nanosec"]
        if recorded_ns < 0:
            raise ConfigError(f"a recording cannot have the time {stamp_s:g} s, before 1970")
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._types, offered_qos_profiles=_quality(topic)
            )
        if kind not in self._makers:
            self._makers[kind] = _maker(self._types, kind)
        try:
            message = self._makers[kind](fields)
        except KeyError as error:
            raise ConfigError(f"a message of {topic} lacks the field {error.args[0]}") from error
        data = self._types.serialize_cdr(message, kind)
        self._writer.write(self._connections[topic], recorded_ns, data)


@contextmanager
@checked
def written_bag(path: str | Path) -> Iterator[BagWriter]:
    """Yield a recording; the file appears when the block ends, complete.

    Raises:
        ConfigError: the name does not end with .mcap.
        MissingDependencyError: the package rosbags is not installed.
        WorkspaceError: the file cannot be written.
    """
    require_writing(path)
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    remove_abandoned_parts(Path(path).resolve().parent)
    with atomic_write(path) as part:
        # The package writes a folder with the recording and a description.
        folder = part_beside(part.with_suffix(""))
        try:
            with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                yield BagWriter(writer, get_typestore(Stores.ROS2_HUMBLE))
            (folder / f"{folder.name}.mcap").replace(part)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@checked
def require_writing(path: str | Path) -> None:
    """Check that a recording of this name can be written.

    Raises:
        ConfigError: the name does not end with .mcap.
        MissingDependencyError: the package rosbags is not installed.
    """
    if Path(path).suffix.lower() != ".mcap":
        raise ConfigError(f"a recording is an MCAP file: its name must end with .mcap, not {Path(path).name}")
    try:
        import rosbags.rosbag2  # noqa: F401
    except ImportError:
        raise MissingDependencyError(
            "recording needs the package rosbags: pip install 'epipole[ros]'"
        ) from None


def _quality(topic: str) -> list[Any]:
    """Static transforms are kept for those who subscribe later; others have the default quality of service."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    if topic != "/tf_static":
        return []
    always = QosTime(2147483647, 4294967295)
    kept = (QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL)
    return [Qos(*kept, always, always, QosLiveliness.AUTOMATIC, always, False)]


def _maker(types: Any, kind: str) -> Callable[[Mapping[str, Any]], Any]:
    """A function that makes an object of a message type from its fields."""
    message = types.types[kind]
    parts = [(name, _converter(types, described)) for name, described in types.fielddefs[kind][1]]

    def make(fields: Mapping[str, Any]) -> Any:
        return message(
            *[fields[name] if convert is None else convert(fields[name]) for name, convert in parts]
        )

    return make


def _converter(types: Any, described: Any) -> Callable[[Any], Any] | None:
    """Converts a value to what a field's description (a kind of node, and its details) asks; None if it is the same."""
    node, details = described
    if node.name == "NAME":
        return _maker(types, details)
    if node.name not in ("ARRAY", "SEQUENCE"):
        return None
    (inner, name), _ = details
    if inner.name == "NAME":
        make = _maker(types, name)
        return lambda values: [make(each) for each in values]
    return partial(np.asarray, dtype=name[0])
