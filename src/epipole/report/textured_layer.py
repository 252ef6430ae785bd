"""Textured meshes as layers of a 3D view: for a server at full resolution, for a page that is a file with fewer bytes."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Int64, UInt8
from PIL import Image

from epipole.image import downscaled
from epipole.image.encoding import encoded_image
from epipole.report.packed_mesh import PackedMesh, depth_first, packed_mesh
from epipole.report.space_scene import TexturedMeshLayer
from epipole.report.texture_gaps import without_gaps
from epipole.scene.mesh_simplification import Corners, simplified
from epipole.scene.textured_mesh import TexturedMesh

MOST_PX, SERVED_QUALITY = 8192, 92
"""Longest side and JPEG quality of a served texture."""
SHARED_PX, SHARED_QUALITY, LEAST_PX = 4096, 80, 128
"""Longest side and JPEG quality of a texture in a file, and the side below which it is not reduced further."""
TRIANGLE_BYTES = 5.4
"""Packed size of a triangle, measured on surfaces of photographs; the first guess of the number that fits."""
MESH_FRACTION = 0.45
"""Fraction of the bytes for triangles if triangles and textures both have to be reduced."""
_TRIALS = 3
Put = Callable[[str, np.ndarray], str]


def textured_layer(name: str, mesh: TexturedMesh) -> TexturedMeshLayer:
    """A layer of a mesh: textures as JPEG, at most 8192 pixels per side, with their black gaps filled."""
    jpegs = []
    for k, texture in enumerate(mesh.textures):
        small = downscaled(texture, MOST_PX)
        jpegs.append(_jpeg(without_gaps(small, mesh.uv[mesh.texture_of_face == k]), SERVED_QUALITY))
    parts = (mesh.vertices_in_world, mesh.faces, mesh.uv, mesh.texture_of_face)
    return TexturedMeshLayer(name, *parts, tuple(jpegs))


def reduced(layer: TexturedMeshLayer, max_bytes: int) -> TexturedMeshLayer:
    """The layer for a page that is a file, with triangles and textures reduced to about `max_bytes`.

    Meshes of many tiny charts may stay larger, since the corners of charts are not removed.
    """
    corners, texture = corners_of(layer)
    jpegs = _smaller(layer.jpegs, int((1.0 - MESH_FRACTION) * max_bytes))
    small, num_bytes = _fitting(corners, texture, max_bytes - sum(map(len, jpegs)))
    if num_bytes < MESH_FRACTION * max_bytes:
        jpegs = _smaller(layer.jpegs, max_bytes - num_bytes)
    return replace(
        layer,
        vertices_in_world=small.positions,
        faces=small.vertex[small.triangles],
        uv=small.uv[small.triangles],
        texture_of_face=texture[small.triangles[:, 0]],
        jpegs=jpegs,
        is_packed=True,
    )


def _fitting(corners: Corners, texture: np.ndarray, max_bytes: int) -> tuple[Corners, int]:
    """A mesh simplified until it fits, if it can be, and its packed size."""
    most, num_bytes = int(max_bytes / TRIANGLE_BYTES), 0
    for _ in range(_TRIALS):
        corners = simplified(corners, max(most, 1))
        num_bytes = len(_packed(corners, texture[corners.triangles[:, 0]]).data)
        if num_bytes <= max_bytes:
            break
        most = int(0.97 * len(corners.triangles) * max_bytes / num_bytes)
    return corners, num_bytes


def corners_of(layer: TexturedMeshLayer) -> tuple[Corners, Int64[np.ndarray, " c"]]:
    """Corners that triangles with the same vertex, texture and coordinates share, and the texture of each."""
    vertex, uv = layer.faces.ravel(), layer.uv.reshape(-1, 2)
    texture = np.repeat(layer.texture_of_face, 3)
    columns = (vertex, texture, uv[:, 0], uv[:, 1])
    order = np.lexsort(columns[::-1])
    is_new = np.ones(len(order), bool)
    is_new[1:] = np.any([column[order[1:]] != column[order[:-1]] for column in columns], axis=0)
    row = np.empty(len(order), np.int64)
    row[order] = np.cumsum(is_new) - 1
    first = order[is_new]
    corners = Corners(
        np.asarray(layer.vertices_in_world, np.float64), vertex[first], uv[first], row.reshape(-1, 3)
    )
    return corners, texture[first]


def textured_data(put: Put, layer: TexturedMeshLayer, origin: np.ndarray) -> dict[str, Any]:
    """A layer for the script: packed, or as arrays; triangles are sorted by texture."""
    corners, texture = corners_of(layer)
    of_face = texture[corners.triangles[:, 0]]
    counts = np.bincount(of_face, minlength=len(layer.jpegs))
    starts = np.cumsum(counts) - counts
    textures = []
    for k in np.flatnonzero(counts).tolist():
        width, height = Image.open(io.BytesIO(layer.jpegs[k])).size
        block = put(f"mesh-texture-{k}", np.frombuffer(layer.jpegs[k], np.uint8))
        own = {"first": int(starts[k]), "count": int(counts[k])}
        textures.append({"block": block, "width": width, "height": height, **own})
    given: dict[str, Any] = {
        "name": layer.name,
        "count": len(corners.triangles),
        "vertices": "mesh-vertices",
        "faces": "mesh-faces",
        "uv": "mesh-uv",
        "rgba": None,
        "packed": None,
        "textures": textures,
        "repeats": bool(corners.uv.min(initial=0.0) < 0.0 or corners.uv.max(initial=1.0) > 1.0),
    }
    near = corners._replace(positions=corners.positions - origin)
    if layer.is_packed:
        packed = _packed(near, of_face)
        put("mesh-packed", np.frombuffer(packed.data, np.uint8))
        columns = {"low": packed.low, "step": packed.step}
        return given | {"packed": {"block": "mesh-packed", "corners": packed.num_corners, **columns}}
    put("mesh-vertices", near.positions[near.vertex].astype("<f4"))
    put("mesh-uv", near.uv.astype("<f4"))
    put("mesh-faces", near.triangles[np.argsort(of_face, kind="stable")].astype("<u4"))
    return given


def _packed(corners: Corners, of_face: np.ndarray) -> PackedMesh:
    order = depth_first(corners.triangles, len(corners.vertex))
    order = order[np.argsort(of_face[order], kind="stable")]
    columns = np.concatenate([corners.positions[corners.vertex], corners.uv], axis=1)
    return packed_mesh(columns, corners.triangles[order])


def _smaller(jpegs: tuple[bytes, ...], max_bytes: int) -> tuple[bytes, ...]:
    """Textures scaled by one factor and compressed again until they fit, or are tiny."""
    textures = [np.asarray(Image.open(io.BytesIO(jpeg)).convert("RGB")) for jpeg in jpegs]
    longest = max(max(texture.shape[:2]) for texture in textures)
    side = min(longest, SHARED_PX)
    while True:
        out = tuple(
            _jpeg(downscaled(texture, max(1, round(max(texture.shape[:2]) * side / longest))), SHARED_QUALITY)
            for texture in textures
        )
        size = sum(map(len, out))
        if size <= max_bytes or side <= LEAST_PX:
            return out
        side = max(LEAST_PX, int(side * min(0.95, 0.99 * (max(max_bytes, 1) / size) ** 0.5)))


def _jpeg(texture: UInt8[np.ndarray, "h w 3"], quality: int) -> bytes:
    return encoded_image(".jpg", cv2.cvtColor(texture, cv2.COLOR_RGB2BGR), quality)
