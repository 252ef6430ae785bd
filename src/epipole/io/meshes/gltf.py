"""Reading and writing textured meshes as binary glTF 2.0 files (Khronos Group 2021), which most viewers show."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8

from epipole._checks import checked
from epipole.errors import ShapeError
from epipole.geometry import Rotation3
from epipole.io._named_numbers import numbers_of
from epipole.io.atomic import atomic_write
from epipole.io.files import file_bytes
from epipole.io.images.formats import format_of
from epipole.io.images.pixels import decode_bytes, open_with_pillow, refuse_huge, stored_pixels
from epipole.io.json_files import json_text
from epipole.io.meshes._glb_document import (
    BINARY_CHUNK,
    CHUNK_HEADER,
    FILE_HEADER,
    FLOAT,
    JSON_CHUNK,
    MAGIC,
    VERSION,
    GlbDocument,
    parse_glb,
)
from epipole.io.meshes._texture_files import check_textured, distinct_rows, encoded, used_textures
from epipole.scene.local_origin import ORIGIN, local_origin
from epipole.scene.textured_mesh import TexturedMesh

UP = "up_in_world"
"""Name of the up direction in a file's `asset.extras`."""
_UNLIT = "KHR_materials_unlit"
_Y = np.array([0.0, 1.0, 0.0])
"""The up direction of glTF."""
_MAX_BYTES = 2**32 - 1
_MAX_UINT16_VERTICES = 65_535
"""The index 65535 is reserved."""
_UINT16, _UINT32 = 5123, 5125
_VERTICES, _INDICES = 34962, 34963
"""Targets of buffer views: ARRAY_BUFFER and ELEMENT_ARRAY_BUFFER."""
_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP_TO_EDGE, _REPEAT = 9729, 9987, 33071, 10497
_TRIANGLES = 4
_FEW_CORNERS, _CORNERS_OF_PRIMITIVE = 1 << 16, 64
"""Limits of meshes that appear more than once: corners in any file, and corners counted for each primitive."""
_FEW_PIXELS, _PIXELS_PER_BYTE = 1 << 28, 64
"""Limit of all textures together: pixels in any file, and pixels per byte of larger files."""


@checked
def write_glb(
    path: str | Path,
    mesh: TexturedMesh,
    *,
    jpeg_quality: int = 92,
    origin_in_world: Float64[np.ndarray, " 3"] | None = None,
    up: Float64[np.ndarray, " 3"] | None = None,
) -> None:
    """Write a textured mesh as one binary glTF file with JPEG textures; viewers show it without shading.

    Positions are in single precision, relative to an origin. If it is not zero, the file's `asset.extras` has it as
    `origin_in_world`: add it to the positions, before the node's rotation, to obtain world coordinates. The scene
    itself stays near zero, since most viewers render in single precision. Textures and vertices without triangles are
    not written.

    Args:
        path: the file.
        mesh: the mesh.
        jpeg_quality: quality of the textures, 1 to 100.
        origin_in_world: the origin; None: `local_origin` of the vertices, which is zero unless they are far from zero.
        up: the up direction in the world, which the node's rotation maps to +Y, glTF's up direction; also in
            `asset.extras`, as `up_in_world`. None: no rotation.

    Raises:
        ConfigError: the JPEG quality is not valid, or a texture is too large.
        ShapeError: the mesh has no triangles, its coordinates exceed single precision, the up direction is zero or not
            finite, or the file would be larger than 4 GiB.
        WorkspaceError: the file cannot be written.
    """
    check_textured(mesh, jpeg_quality)
    origin = local_origin(mesh.vertices_in_world) if origin_in_world is None else origin_in_world
    with np.errstate(over="ignore", invalid="ignore"):
        positions = (mesh.vertices_in_world - origin).astype(np.float32)
        uv = mesh.uv.astype(np.float32)
    if not (np.isfinite(positions).all() and np.isfinite(uv).all()):
        raise ShapeError("the coordinates relative to the origin are too large for single precision")
    textures, texture_of_face = used_textures(mesh)
    out = _Parts()
    for k in range(len(textures)):
        is_here = texture_of_face == k
        out.add_primitive(positions, mesh.faces[is_here], uv[is_here], k)
    for texture in textures:
        out.add_texture(encoded(texture, jpeg_quality))
    extras: dict[str, Any] = {ORIGIN: origin.tolist()} if origin.any() else {}
    node: dict[str, Any] = {"mesh": 0}
    if up is not None:
        rotation, extras[UP] = y_from_up(up)
        node["rotation"] = np.roll(rotation.as_quat_wxyz(), -1).tolist()
    asset = {"version": "2.0", "generator": "epipole", **({"extras": extras} if extras else {})}
    is_tiled = bool((uv < 0).any() or (uv > 1).any())
    _write(Path(path), _content(asset, node, out, _REPEAT if is_tiled else _CLAMP_TO_EDGE), out)


def _content(asset: dict[str, Any], node: dict[str, Any], out: _Parts, wrap: int) -> dict[str, Any]:
    """The JSON of a file with one node, and one material for each texture."""
    count = len(out.images)
    return {
        "asset": asset,
        "extensionsUsed": [_UNLIT],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": out.primitives}],
        "materials": [_material(k) for k in range(count)],
        "textures": [{"sampler": 0, "source": k} for k in range(count)],
        "samplers": [_sampler(wrap)],
        "images": out.images,
        "accessors": out.accessors,
        "bufferViews": out.views,
        "buffers": [{"byteLength": out.size}],
    }


def _material(texture: int) -> dict[str, Any]:
    """A material without shading; viewers that ignore `KHR_materials_unlit` see a rough, nonmetallic one."""
    color = {"baseColorTexture": {"index": texture}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    return {"pbrMetallicRoughness": color, "extensions": {_UNLIT: {}}, "doubleSided": True}


def _sampler(wrap: int) -> dict[str, int]:
    return {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP_LINEAR, "wrapS": wrap, "wrapT": wrap}


def y_from_up(up: np.ndarray) -> tuple[Rotation3, list[float]]:
    """The smallest rotation that maps the up direction to +Y, and the direction with unit length.

    Raises:
        ShapeError: the direction is zero or not finite.
    """
    largest = np.abs(up).max()
    if not 0 < largest < np.inf:
        raise ShapeError(f"up must be a finite, nonzero direction, got {up}")
    unit = up / largest / np.linalg.norm(up / largest)
    return Rotation3.from_two_vectors(unit, _Y), unit.tolist()


@dataclass(slots=True, eq=False)
class _Parts:
    """The parts of a file that is being composed."""

    pieces: list[bytes] = field(default_factory=list)
    size: int = 0
    """Bytes of the pieces."""
    views: list[dict[str, int]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    primitives: list[dict[str, Any]] = field(default_factory=list)
    images: list[dict[str, Any]] = field(default_factory=list)

    def add_primitive(self, positions: np.ndarray, faces: np.ndarray, uv: np.ndarray, material: int) -> None:
        """Add triangles (m, 3); corners with the same vertex and texture coordinates (m, 3, 2) are shared."""
        vertex, uv = faces.ravel(), uv.reshape(-1, 2)
        first, index = distinct_rows(vertex, uv[:, 0], uv[:, 1])
        corners = positions[vertex[first]]
        kind = ("<u2", _UINT16) if len(first) <= _MAX_UINT16_VERTICES else ("<u4", _UINT32)
        bounds = {"min": corners.min(axis=0).tolist(), "max": corners.max(axis=0).tolist()}
        attributes = {
            "POSITION": self._add_accessor(corners.astype("<f4"), FLOAT, "VEC3", _VERTICES, **bounds),
            "TEXCOORD_0": self._add_accessor(uv[first].astype("<f4"), FLOAT, "VEC2", _VERTICES),
        }
        indices = self._add_accessor(index.astype(kind[0]), kind[1], "SCALAR", _INDICES)
        self.primitives.append({"attributes": attributes, "indices": indices, "material": material})

    def add_texture(self, jpeg: bytes) -> None:
        """Add an encoded image."""
        self.images.append({"bufferView": self._add_view(jpeg), "mimeType": "image/jpeg"})

    def _add_accessor(self, array: np.ndarray, component: int, kind: str, target: int, **more: Any) -> int:
        view = self._add_view(array.tobytes(), target=target)
        accessor = {"bufferView": view, "componentType": component, "count": len(array), "type": kind}
        self.accessors.append({**accessor, **more})
        return len(self.accessors) - 1

    def _add_view(self, data: bytes, **more: int) -> int:
        """Add bytes at a multiple of four."""
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": len(data), **more})
        self.pieces += [data, bytes(-len(data) % 4)]
        self.size += len(data) + len(self.pieces[-1])
        return len(self.views) - 1


def _write(path: Path, content: dict[str, Any], out: _Parts) -> None:
    text = json_text(content, 0).encode()
    text += b" " * (-len(text) % 4)
    size = FILE_HEADER.size + 2 * CHUNK_HEADER.size + len(text) + out.size
    if size > _MAX_BYTES:
        raise ShapeError(f"the mesh needs {size} bytes, and a GLB file has less than 4 GiB: write OBJ or PLY")
    with atomic_write(path) as part, part.open("wb") as stream:
        stream.write(FILE_HEADER.pack(MAGIC, VERSION, size))
        stream.write(CHUNK_HEADER.pack(len(text), JSON_CHUNK) + text)
        stream.write(CHUNK_HEADER.pack(out.size, BINARY_CHUNK))
        stream.writelines(out.pieces)


@checked
def read_glb(path: str | Path) -> TexturedMesh:
    """Read the textured meshes of a binary glTF file as one mesh, in the coordinates of the scene.

    If `asset.extras` has the `origin_in_world` or `up_in_world` of `write_glb`, the result is in world coordinates.
    Vertices with equal positions become one. Textures are returned as stored, without transparency; colors of vertices
    and factors of materials are ignored. Points, lines, strips, animated meshes, compressed data, data in other files,
    meshes without `baseColorTexture` and required extensions other than `KHR_materials_*` are not supported.

    Args:
        path: the file.

    Raises:
        FileFormatError: not a binary glTF 2.0 file, damaged, without triangles, or with unsupported content.
    """
    path = Path(path)
    data = file_bytes(path)
    document = parse_glb(path, data)
    reading = _Reading(document, len(data))
    for mesh, scene_from_mesh in document.meshes():
        for primitive in document.rows(mesh, "primitives"):
            reading.add_primitive(document.mapping(primitive, "a primitive"), scene_from_mesh)
    if not reading.positions:
        raise document.fail("the scene has no triangles")
    textures = tuple(reading.texture(image) for image in reading.texture_of_image)
    positions, corners = np.concatenate(reading.positions), np.concatenate(reading.corners)
    first, index = distinct_rows(*positions.T)
    vertices, uv = _in_world(document, positions[first]), np.concatenate(reading.uv)
    if not (np.isfinite(vertices).all() and np.isfinite(uv).all()):
        raise document.fail("coordinates of vertices or textures are not finite")
    texture_of_face = np.repeat(reading.textures, [len(each) for each in reading.corners])
    return TexturedMesh(vertices, index[corners], uv, texture_of_face.astype(np.int64), textures)


def up_of_glb(path: str | Path) -> Float64[np.ndarray, " 3"]:
    """The upward direction of the coordinates of `read_glb`: as in `write_glb`, else +Y, as in every glTF file.

    Raises:
        FileFormatError: not a binary glTF 2.0 file, or damaged.
    """
    path = Path(path)
    extras = parse_glb(path, file_bytes(path)).content["asset"].get("extras")
    if not isinstance(extras, dict) or UP not in extras:
        return _Y.copy()
    return np.asarray(numbers_of(path, extras, UP, 3), np.float64)


def _in_world(document: GlbDocument, vertices: np.ndarray) -> np.ndarray:
    """Vertices in the world of `write_glb`, from the coordinates of the scene."""
    extras = document.mapping(document.content["asset"], "asset").get("extras")
    if not isinstance(extras, dict):
        return vertices
    with np.errstate(over="ignore", invalid="ignore"):
        if UP in extras:
            up = numbers_of(document.path, extras, UP, 3)
            if not 0.9 < np.linalg.norm(up) < 1.1:
                raise document.fail(f"{UP} is not a direction of unit length")
            vertices = vertices @ Rotation3.from_two_vectors(up, _Y).matrix
        return vertices + numbers_of(document.path, extras, ORIGIN, 3) if ORIGIN in extras else vertices


@dataclass(slots=True, eq=False)
class _Reading:
    """Primitives read from a document."""

    document: GlbDocument
    num_bytes: int
    """Size of the file."""
    positions: list[np.ndarray] = field(default_factory=list)
    corners: list[np.ndarray] = field(default_factory=list)
    """Rows of all positions."""
    uv: list[np.ndarray] = field(default_factory=list)
    textures: list[int] = field(default_factory=list)
    """Index of the texture of each primitive."""
    texture_of_image: dict[int, int] = field(default_factory=dict)
    num_positions: int = 0
    num_corners: int = 0
    num_pixels: int = 0

    def add_primitive(self, primitive: Mapping[str, Any], scene_from_mesh: np.ndarray) -> None:
        """Read the triangles of a primitive."""
        document = self.document
        if document.whole(primitive, "mode", _TRIANGLES) != _TRIANGLES or "targets" in primitive:
            raise document.fail("points, lines, triangle strips and morph targets are not supported")
        attributes = document.mapping(primitive.get("attributes"), "attributes")
        texture, uv_name = self._texture_of(primitive)
        if missing := {"POSITION", uv_name} - attributes.keys():
            raise document.fail(f"a primitive with a texture has no {' and no '.join(sorted(missing))}")
        points = document.accessor(attributes["POSITION"], "VEC3", "POSITION")
        uv = document.accessor(attributes[uv_name], "VEC2", uv_name)
        if points.dtype.kind != "f" or uv.dtype.kind == "i":
            raise document.fail("POSITION or TEXCOORD has an unsupported component type")
        if len(points) != len(uv):
            raise document.fail(f"POSITION has {len(points)} elements, and {uv_name} has {len(uv)}")
        # Views of the file's bytes until here; many nodes and primitives may refer to the same ones.
        self._count(len(points) if "indices" not in primitive else self._indices(primitive).size)
        index = (
            self._indices(primitive).astype(np.int64) if "indices" in primitive else np.arange(len(points))
        )
        if index.max() >= len(points) or len(index) % 3:
            raise document.fail("the indices refer to a missing vertex, or are not a multiple of three")
        used, corners = np.unique(index, return_inverse=True)
        corners = corners.reshape(-1, 3)
        with np.errstate(over="ignore", invalid="ignore"):
            in_scene = points[used].astype(np.float64) @ scene_from_mesh[:3, :3].T + scene_from_mesh[:3, 3]
            if np.linalg.det(scene_from_mesh[:3, :3]) < 0:  # a mirror image: the corners become clockwise
                corners = corners[:, ::-1]
        scale = 1.0 if uv.dtype.kind == "f" else float(np.iinfo(uv.dtype).max)
        self.uv.append(uv[used].astype(np.float64)[corners] / scale)
        self.positions.append(in_scene)
        self.corners.append(corners + self.num_positions)
        self.textures.append(texture)
        self.num_positions += len(used)

    def _indices(self, primitive: Mapping[str, Any]) -> np.ndarray:
        indices = self.document.accessor(primitive["indices"], "SCALAR", "indices")
        if indices.dtype.kind != "u":
            raise self.document.fail("indices are not unsigned whole numbers")
        return indices[:, 0]

    def _count(self, num_corners: int) -> None:
        """Count corners, to limit the memory of files in which many nodes show the same mesh."""
        self.num_corners += max(num_corners, _CORNERS_OF_PRIMITIVE)
        if self.num_corners > max(_FEW_CORNERS, self.num_bytes):
            problem = f"more than {self.num_corners} corners in a file of {self.num_bytes} bytes"
            raise self.document.fail(
                f"{problem}: many nodes show the same mesh, export them as separate meshes"
            )

    def _texture_of(self, primitive: Mapping[str, Any]) -> tuple[int, str]:
        """Index of a primitive's texture, and name of its texture coordinates."""
        document = self.document
        if "material" not in primitive:
            raise document.fail("a primitive has no material, and therefore no texture")
        material = document.entry("materials", primitive["material"])
        color = document.mapping(material.get("pbrMetallicRoughness", {}), "pbrMetallicRoughness")
        if "baseColorTexture" not in color:
            raise document.fail(f"materials[{primitive['material']}] has no baseColorTexture")
        used = document.mapping(color["baseColorTexture"], "baseColorTexture")
        if "KHR_texture_transform" in document.mapping(used.get("extensions", {}), "extensions"):
            raise document.fail("the extension KHR_texture_transform is not supported")
        image = document.whole(document.entry("textures", used.get("index")), "source")
        texture = self.texture_of_image.setdefault(image, len(self.texture_of_image))
        return texture, f"TEXCOORD_{document.whole(used, 'texCoord', 0)}"

    def texture(self, image: int) -> UInt8[np.ndarray, "h w 3"]:
        """Decode an image, JPEG or PNG, of which transparency is ignored."""
        document, path = self.document, self.document.path
        entry = document.entry("images", image)
        if "bufferView" not in entry:
            raise document.fail(f"images[{image}] is not in the binary data: export a single GLB file")
        data = bytes(document.view(entry["bufferView"]))
        kind = format_of(path, data[:64])
        if kind not in ("JPEG", "PNG"):
            raise document.fail(f"images[{image}] is {kind}, and only JPEG and PNG are supported")
        opened = open_with_pillow(path, io.BytesIO(data), kind)
        refuse_huge(path, opened, data)
        self.num_pixels += opened.width * opened.height
        if self.num_pixels > max(_FEW_PIXELS, _PIXELS_PER_BYTE * self.num_bytes):
            raise document.fail(
                f"the textures have more than {self.num_pixels} pixels, more than fit into the file"
            )
        if kind == "PNG":
            pixels, _ = stored_pixels(path, opened, data)
            if pixels.ndim == 3:
                return np.ascontiguousarray(pixels[..., :3])
        return decode_bytes(path, data, gray=False, max_size_px=None, orientation=1)
