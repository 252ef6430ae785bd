"""Writing textured meshes as OBJ files (Wavefront Technologies) with an MTL file of materials."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.io.atomic import atomic_write
from epipole.io.meshes._texture_files import (
    check_textured,
    distinct_rows,
    require_suffix,
    stem_beside,
    used_textures,
    write_textures_beside,
)
from epipole.scene.textured_mesh import TexturedMesh

_ROWS_PER_BLOCK = 1 << 16
"""Number of lines that are formatted at once, which limits the memory."""


@checked
def write_obj(path: str | Path, mesh: TexturedMesh, *, jpeg_quality: int | None = 92) -> None:
    """Write a textured mesh as OBJ, with its materials and textures as files in the same folder.

    For `mesh.obj`, these are `mesh.mtl` and the textures `mesh_0.jpg`, `mesh_1.jpg` and so on, with `_` instead of
    spaces. Textures without triangles are not written. Coordinates have 12 significant digits: UTM coordinates are
    exact to 0.01 mm. The origin of OBJ's texture coordinates is at the bottom left of the texture.

    Args:
        path: the file, with the suffix `.obj`.
        mesh: the mesh.
        jpeg_quality: quality of the JPEG textures, 1 to 100; None: PNG.

    Raises:
        ConfigError: the suffix or the JPEG quality is not valid, or a texture is too large.
        ShapeError: the mesh has no triangles.
        WorkspaceError: a file cannot be written.
    """
    path = Path(path)
    require_suffix(path, ".obj")
    check_textured(mesh, jpeg_quality)
    textures, texture_of_face = used_textures(mesh)
    names = write_textures_beside(path, textures, jpeg_quality)
    materials = f"{stem_beside(path)}.mtl"
    with atomic_write(path.parent / materials) as part:
        part.write_text("".join(_material(k, name) for k, name in enumerate(names)), "utf-8", newline="\n")
    uv = mesh.uv.reshape(-1, 2)
    first, index = distinct_rows(uv[:, 0], uv[:, 1])
    coordinates = np.stack([uv[first, 0], 1 - uv[first, 1]], axis=1)
    corners = np.stack([mesh.faces, index.reshape(-1, 3)], axis=2).reshape(-1, 6) + 1
    with atomic_write(path) as part, part.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(f"mtllib {materials}\n")
        stream.writelines(_lines("v %.12g %.12g %.12g\n", mesh.vertices_in_world))
        stream.writelines(_lines("vt %.9g %.9g\n", coordinates))
        for k in range(len(textures)):
            stream.write(f"usemtl {_material_name(k)}\n")
            stream.writelines(_lines("f %d/%d %d/%d %d/%d\n", corners[texture_of_face == k]))


def _material_name(texture: int) -> str:
    return f"texture_{texture}"


def _material(texture: int, name: str) -> str:
    """A material without shading: photographs already contain the light."""
    return f"newmtl {_material_name(texture)}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nd 1\nillum 0\nmap_Kd {name}\n"


def _lines(template: str, rows: np.ndarray) -> Iterator[str]:
    """The text of rows, in blocks."""
    for start in range(0, len(rows), _ROWS_PER_BLOCK):
        block = rows[start : start + _ROWS_PER_BLOCK]
        yield (template * len(block)) % tuple(block.ravel().tolist())
