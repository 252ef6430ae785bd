"""Triangle meshes with textures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from epipole._checks import Declared, check_fields, check_indices
from epipole.errors import ShapeError


@dataclass(frozen=True, slots=True, eq=False)
class TexturedMesh(Declared):
    """Triangles with corners in counterclockwise order, seen from outside, each mapped onto one of several textures."""

    vertices_in_world: Float64[np.ndarray, "n 3"]
    faces: Int64[np.ndarray, "m 3"]
    uv: Float64[np.ndarray, "m 3 2"]
    """Texture coordinates of the corners of each triangle, from (0, 0) at the top left of the texture to (1, 1) at the
    bottom right, as in glTF: the center of a pixel is at ((column + 0.5) / width, (row + 0.5) / height)."""
    texture_of_face: Int64[np.ndarray, " m"]
    """Index into `textures`."""
    textures: tuple[UInt8[np.ndarray, "_ _ 3"], ...]
    """RGB images, which can differ in size."""

    def __post_init__(self) -> None:
        """Check the corners and textures.

        Raises:
            ShapeError: an array has the wrong type or shape, a coordinate is not finite, a texture has no pixels, or a
                corner or a triangle refers to a missing vertex or texture.
            ConfigError: the textures are not a sequence.
        """
        check_fields(self)
        check_indices(self.faces, "faces", len(self.vertices_in_world))
        check_indices(self.texture_of_face, "texture_of_face", len(self.textures))
        for name in ("vertices_in_world", "uv"):
            if not np.isfinite(getattr(self, name)).all():
                raise ShapeError(f"{name} must be finite")
        for k, texture in enumerate(self.textures):
            if not texture.size:
                raise ShapeError(f"textures[{k}] has no pixels, its shape is {texture.shape}")

    def __len__(self) -> int:
        return len(self.faces)

    def __repr__(self) -> str:
        counts = f"{len(self.vertices_in_world):,} vertices, {len(self.faces):,} triangles"
        return f"TexturedMesh({counts}, {len(self.textures)} textures)"
