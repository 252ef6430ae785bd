"""Writing textured meshes as PLY files, in the convention of MeshLab."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.io.atomic import atomic_write
from epipole.io.meshes._texture_files import (
    check_textured,
    require_suffix,
    used_textures,
    write_textures_beside,
)
from epipole.io.meshes.ply import vertex_type
from epipole.scene.textured_mesh import TexturedMesh

_FACE = np.dtype(
    [("count", "u1"), ("vertices", "<i4", 3), ("uv_count", "u1"), ("uv", "<f4", (3, 2)), ("texture", "<i4")]
)
_FACE_HEADER = (
    "property list uchar int vertex_indices",
    "property list uchar float texcoord",
    "property int texnumber",
)


@checked
def write_textured_ply(path: str | Path, mesh: TexturedMesh, *, jpeg_quality: int | None = 92) -> None:
    """Write a textured mesh as binary little-endian PLY, with its textures as image files in the same folder.

    For `mesh.ply`, the textures are `mesh_0.jpg`, `mesh_1.jpg` and so on, with `_` instead of spaces. The header has a
    comment `TextureFile NAME` for each; each face has the index of its texture, `texnumber`, and the texture
    coordinates of its corners, `texcoord`, with the origin at the bottom left of the texture. Textures without
    triangles are not written. Coordinates far from the origin are written as doubles (`vertex_type`).

    Args:
        path: the file, with the suffix `.ply`.
        mesh: the mesh.
        jpeg_quality: quality of the JPEG textures, 1 to 100; None: PNG.

    Raises:
        ConfigError: the suffix or the JPEG quality is not valid, or a texture is too large.
        ShapeError: the mesh has no triangles.
        WorkspaceError: a file cannot be written.
    """
    path = Path(path)
    require_suffix(path, ".ply")
    check_textured(mesh, jpeg_quality)
    textures, texture_of_face = used_textures(mesh)
    kind, properties = vertex_type(mesh.vertices_in_world)
    vertices = np.ascontiguousarray(mesh.vertices_in_world, kind["xyz"].base)
    faces = np.zeros(len(mesh), _FACE)
    faces["count"], faces["vertices"], faces["texture"] = 3, mesh.faces, texture_of_face
    faces["uv_count"], faces["uv"] = 6, np.stack([mesh.uv[..., 0], 1 - mesh.uv[..., 1]], axis=-1)
    names = write_textures_beside(path, textures, jpeg_quality)
    header = ["ply", "format binary_little_endian 1.0", *(f"comment TextureFile {name}" for name in names)]
    header += [f"element vertex {len(vertices)}", *properties[:3]]
    header += [f"element face {len(faces)}", *_FACE_HEADER, "end_header"]
    with atomic_write(path) as part, part.open("wb") as stream:
        stream.write("".join(f"{line}\n" for line in header).encode())
        stream.write(vertices.tobytes())
        stream.write(faces.tobytes())
