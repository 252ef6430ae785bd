"""Textures of meshes as image files, and corners that several triangles share."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
from jaxtyping import Int64, UInt8
from PIL import Image

from epipole._checks import check_pixels
from epipole.errors import ConfigError, ShapeError
from epipole.io.atomic import atomic_write
from epipole.scene.textured_mesh import TexturedMesh

_MAX_JPEG_SIDE = 65_500
"""Limit of libjpeg, in pixels."""
_NOT_IN_NAMES = re.compile(r"[^\w.-]+")
"""Characters, such as spaces, at which some readers of OBJ and PLY split file names."""


def check_textured(mesh: TexturedMesh, jpeg_quality: int | None) -> None:
    """Check that a mesh can be written.

    Raises:
        ShapeError: the mesh has no triangles.
        ConfigError: the JPEG quality is not from 1 to 100, or a texture is too large.
    """
    if not len(mesh):
        raise ShapeError("the mesh has no triangles")
    if jpeg_quality is not None and not 1 <= jpeg_quality <= 100:
        raise ConfigError(f"jpeg_quality must be from 1 to 100, got {jpeg_quality}")
    for texture in mesh.textures:
        height, width = texture.shape[:2]
        check_pixels(width, height, 1 << 30)
        if jpeg_quality is not None and max(width, height) > _MAX_JPEG_SIDE:
            raise ConfigError(f"a JPEG has at most {_MAX_JPEG_SIDE} pixels per side, got {width} x {height}")


def used_textures(mesh: TexturedMesh) -> tuple[list[UInt8[np.ndarray, "_ _ 3"]], Int64[np.ndarray, " m"]]:
    """The textures that have triangles, and the index of each triangle's texture among them."""
    used, texture_of_face = np.unique(mesh.texture_of_face, return_inverse=True)
    return [mesh.textures[k] for k in used], texture_of_face.astype(np.int64)


def encoded(texture: UInt8[np.ndarray, "h w 3"], jpeg_quality: int | None) -> bytes:
    """The bytes of a JPEG file, or of a PNG file if there is no JPEG quality."""
    data = io.BytesIO()
    image = Image.fromarray(texture)
    if jpeg_quality is None:
        image.save(data, "PNG", compress_level=3)
    else:
        image.save(data, "JPEG", quality=jpeg_quality)
    return data.getvalue()


def require_suffix(path: Path, suffix: str) -> None:
    """Check the suffix of a mesh file, from which the names of the files beside it are derived.

    Raises:
        ConfigError: it is another one.
    """
    if path.suffix.lower() != suffix:
        raise ConfigError(f"path must end in {suffix}, got {path.name[:60]!r}")


def stem_beside(path: Path) -> str:
    """First part of the names of the files beside a mesh, with `_` instead of spaces and special characters."""
    return _NOT_IN_NAMES.sub("_", path.stem)


def write_textures_beside(
    path: Path, textures: list[UInt8[np.ndarray, "_ _ 3"]], jpeg_quality: int | None
) -> list[str]:
    """Write textures beside the mesh file `STEM.SUFFIX` as STEM_0, STEM_1 and so on.

    Returns:
        The names of the files.

    Raises:
        WorkspaceError: a file cannot be written.
    """
    suffix = ".png" if jpeg_quality is None else ".jpg"
    names = [f"{stem_beside(path)}_{k}{suffix}" for k in range(len(textures))]
    for name, texture in zip(names, textures):
        with atomic_write(path.parent / name) as part:
            part.write_bytes(encoded(texture, jpeg_quality))
    return names


def distinct_rows(*columns: np.ndarray) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " k"]]:
    """Find equal rows of a table.

    Args:
        columns: the columns (k,) of the table.

    Returns:
        The index (n,) of one row for each distinct value, sorted by value, and the index (k,) of each row's value
        among them.
    """
    order = np.lexsort(columns[::-1])
    is_new = np.zeros(len(order), bool)
    is_new[:1] = True
    for column in columns:
        is_new[1:] |= column[order[1:]] != column[order[:-1]]
    index = np.empty(len(order), np.int64)
    index[order] = np.cumsum(is_new) - 1
    return order[is_new].astype(np.int64), index
