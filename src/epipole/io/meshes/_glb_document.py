"""The structure of binary glTF 2.0 files (Khronos Group 2021): chunks, JSON entries, accessors, nodes."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import FileFormatError
from epipole.geometry import Rotation3
from epipole.io._named_numbers import numbers_of
from epipole.io.json_files import json_values

MAGIC, VERSION = b"glTF", 2
JSON_CHUNK, BINARY_CHUNK = b"JSON", b"BIN\0"
FILE_HEADER, CHUNK_HEADER = struct.Struct("<4sII"), struct.Struct("<I4s")
FLOAT = 5126
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}
"""Types of numbers by `componentType`."""
_LENGTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}
_READABLE_EXTENSIONS = "KHR_materials_"
"""Extensions with this prefix change shading only."""


@dataclass(frozen=True, slots=True, eq=False)
class GlbDocument:
    """A file's JSON and binary data; every index, count and size is checked when it is used."""

    path: Path
    content: Mapping[str, Any]
    binary: memoryview

    def fail(self, problem: str) -> FileFormatError:
        """The error to raise for a problem of this file."""
        return FileFormatError(self.path, problem)

    def entry(self, kind: str, index: Any) -> Mapping[str, Any]:
        """An entry of one of the lists, such as `nodes`."""
        entries = self.content.get(kind)
        if not isinstance(entries, list) or type(index) is not int or not 0 <= index < len(entries):
            raise self.fail(f"{kind} has no entry {str(index)[:40]}")
        return self.mapping(entries[index], f"{kind}[{index}]")

    def mapping(self, value: Any, what: str) -> Mapping[str, Any]:
        """A value that must be an object."""
        if not isinstance(value, dict):
            raise self.fail(f"{what} is not a JSON object")
        return value

    def rows(self, entry: Mapping[str, Any], key: str) -> list[Any]:
        """A list of an entry; empty if there is none."""
        value = entry.get(key, [])
        if not isinstance(value, list):
            raise self.fail(f"{key} is not a list")
        return value

    def whole(self, entry: Mapping[str, Any], key: str, default: int | None = None) -> int:
        """A count, index or size of an entry."""
        value = entry.get(key, default)
        if type(value) is not int or value < 0:
            raise self.fail(f"{key} must be a nonnegative whole number, got {json.dumps(value)[:40]}")
        return value

    def view(self, index: Any) -> memoryview:
        """The bytes of a buffer view."""
        view = self.entry("bufferViews", index)
        buffer = self.entry("buffers", self.whole(view, "buffer"))
        if self.whole(view, "buffer") != 0 or "uri" in buffer:
            raise self.fail("data in other files are not supported: export a single GLB file")
        start, size = self.whole(view, "byteOffset", 0), self.whole(view, "byteLength")
        if start + size > min(self.whole(buffer, "byteLength"), len(self.binary)):
            raise self.fail(f"bufferViews[{index}] ends after the binary data")
        return self.binary[start : start + size]

    def accessor(self, index: Any, kind: str, what: str) -> np.ndarray:
        """The numbers (n, k) of an accessor, as a read-only view of the file's bytes."""
        accessor = self.entry("accessors", index)
        if "sparse" in accessor or "bufferView" not in accessor:
            raise self.fail(
                f"{what} is sparse or compressed, which is not supported: export without compression"
            )
        component = COMPONENTS.get(self.whole(accessor, "componentType"))
        if component is None or accessor.get("type") != kind:
            raise self.fail(f"{what} does not have the type {kind}")
        dtype, count = np.dtype(component), self.whole(accessor, "count")
        if dtype.kind != "f" and kind != "SCALAR" and accessor.get("normalized") is not True:
            raise self.fail(f"{what} has whole numbers that are not normalized")
        item = dtype.itemsize * _LENGTHS[kind]
        data, start = self.view(accessor["bufferView"]), self.whole(accessor, "byteOffset", 0)
        stride = self.whole(self.entry("bufferViews", accessor["bufferView"]), "byteStride", item)
        if stride < item or count < 1 or start + (count - 1) * stride + item > len(data):
            raise self.fail(f"{what} has {count} elements, which do not fit into its buffer view")
        return np.ndarray((count, _LENGTHS[kind]), dtype, data, start, (stride, dtype.itemsize))

    def meshes(self) -> Iterator[tuple[Mapping[str, Any], np.ndarray]]:
        """The meshes of the scene's nodes, each with its 4x4 matrix scene_from_mesh."""
        scene = self.entry("scenes", self.whole(self.content, "scene", 0))
        waiting = [(index, np.eye(4)) for index in reversed(self.rows(scene, "nodes"))]
        visited = set()
        while waiting:
            index, scene_from_parent = waiting.pop()
            node = self.entry("nodes", index)
            if index in visited:
                raise self.fail(f"nodes[{index}] has two parents")
            visited.add(index)
            with np.errstate(over="ignore", invalid="ignore"):
                scene_from_node = scene_from_parent @ self._parent_from_node(node)
            if "mesh" in node:
                if "skin" in node:
                    raise self.fail(f"nodes[{index}] is animated by a skin, which is not supported")
                yield self.entry("meshes", node["mesh"]), scene_from_node
            waiting += [(child, scene_from_node) for child in reversed(self.rows(node, "children"))]

    def _parent_from_node(self, node: Mapping[str, Any]) -> np.ndarray:
        if "matrix" in node:
            return numbers_of(self.path, node, "matrix", 4, 4).T
        out = np.eye(4)
        if "rotation" in node:
            x, y, z, w = numbers_of(self.path, node, "rotation", 4)
            if not 0.9 < np.linalg.norm([x, y, z, w]) < 1.1:
                raise self.fail("a node's rotation is not a unit quaternion")
            out[:3, :3] = Rotation3.from_quat_wxyz([w, x, y, z]).matrix
        if "scale" in node:
            with np.errstate(over="ignore"):
                out[:3, :3] *= numbers_of(self.path, node, "scale", 3)
        if "translation" in node:
            out[:3, 3] = numbers_of(self.path, node, "translation", 3)
        return out


def parse_glb(path: Path, data: bytes) -> GlbDocument:
    """Parse the header, the chunks and the JSON of a file.

    Raises:
        FileFormatError: not a binary glTF 2.0 file, truncated, invalid JSON, or an unsupported extension is required.
    """
    if len(data) < FILE_HEADER.size or not data.startswith(MAGIC):
        raise FileFormatError(
            path, "not a binary glTF file (it does not start with 'glTF'); export it as GLB"
        )
    _, version, size = FILE_HEADER.unpack_from(data)
    if version != VERSION:
        raise FileFormatError(path, f"glTF version {version} is not supported, only version {VERSION}")
    if size != len(data):
        raise FileFormatError(path, f"truncated or damaged: it has {len(data)} bytes, its header says {size}")
    chunks, start = dict[bytes, memoryview](), FILE_HEADER.size
    while start < len(data):
        if start + CHUNK_HEADER.size > len(data):
            raise FileFormatError(path, "the file ends inside the header of a chunk")
        length, kind = CHUNK_HEADER.unpack_from(data, start)
        start += CHUNK_HEADER.size
        if length > len(data) - start:
            raise FileFormatError(path, f"the file ends inside a chunk of {length} bytes")
        if not chunks and kind != JSON_CHUNK:
            raise FileFormatError(path, "the first chunk is not JSON")
        chunks.setdefault(kind, memoryview(data)[start : start + length])
        start += length
    try:
        text = bytes(chunks.get(JSON_CHUNK, b"")).decode()
    except UnicodeDecodeError as error:
        raise FileFormatError(path, "the JSON chunk is not UTF-8 text") from error
    document = GlbDocument(path, {}, chunks.get(BINARY_CHUNK, memoryview(b"")))
    content = document.mapping(json_values(path, text), "the JSON chunk")
    document = GlbDocument(path, content, document.binary)
    version = document.mapping(content.get("asset"), "asset").get("version")
    if not isinstance(version, str) or not version.startswith("2."):
        raise FileFormatError(path, f"glTF version {str(version)[:20]} is not supported, only 2.0")
    for name in document.rows(content, "extensionsRequired"):
        if not isinstance(name, str) or not name.startswith(_READABLE_EXTENSIONS):
            raise FileFormatError(path, f"it requires the extension {str(name)[:60]}, which is not supported")
    return document
