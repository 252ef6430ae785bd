"""Textured meshes: checks of indices, texture coordinates and textures."""

from typing import Any

import numpy as np
import pytest

from epipole.errors import ConfigError, ShapeError
from epipole.scene import TexturedMesh

VALID: dict[str, Any] = {
    "vertices_in_world": np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]),
    "faces": np.array([[0, 1, 2], [0, 2, 3]]),
    "uv": np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], np.float64),
    "texture_of_face": np.array([0, 1]),
    "textures": (np.zeros((4, 6, 3), np.uint8), np.zeros((2, 2, 3), np.uint8)),
}


def test_size_and_text() -> None:
    mesh = TexturedMesh(**VALID)
    assert len(mesh) == 2 and repr(mesh) == "TexturedMesh(4 vertices, 2 triangles, 2 textures)"
    assert mesh.textures[0] is VALID["textures"][0]


@pytest.mark.usefixtures("unchecked")
def test_other_types_are_converted() -> None:
    lists = {name: np.asarray(VALID[name]).tolist() for name in VALID if name != "textures"}
    mesh = TexturedMesh(**lists, textures=list(VALID["textures"]))
    assert isinstance(mesh.textures, tuple) and mesh.uv.dtype == np.float64
    assert mesh.faces.dtype == np.int64 and mesh.texture_of_face.dtype == np.int64


@pytest.mark.usefixtures("unchecked")
def test_a_mesh_can_be_empty() -> None:
    mesh = TexturedMesh(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 2)), np.zeros(0), ())
    assert len(mesh) == 0 and mesh.faces.dtype == np.int64


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"faces": np.array([[0, 1, 4], [0, 2, 3]])}, "faces must be from 0 to 3, got 0 to 4"),
        ({"faces": np.array([[0, 1, -1], [0, 2, 3]])}, "faces must be from 0 to 3"),
        ({"faces": np.array([[0, 1, 2]])}, "m = 1"),
        ({"texture_of_face": np.array([0, 2])}, "texture_of_face must be from 0 to 1, got 0 to 2"),
        ({"texture_of_face": np.array([0])}, "texture_of_face"),
        ({"textures": ()}, "texture_of_face must be"),
        ({"uv": VALID["uv"] * np.nan}, "uv must be finite"),
        ({"uv": VALID["uv"][:, :2]}, "uv must be"),
        ({"vertices_in_world": np.full((4, 3), np.inf)}, "vertices_in_world must be finite"),
        ({"textures": (np.zeros((4, 6), np.uint8),) * 2}, r"textures\[0\] must be"),
        ({"textures": (VALID["textures"][0], np.zeros((0, 6, 3), np.uint8))}, r"textures\[1\] has no pixels"),
        ({"textures": (np.zeros((4, 6, 3)),) * 2}, r"textures\[0\] must be an array of whole numbers"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_wrong_fields_are_rejected(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ShapeError, match=words):
        TexturedMesh(**{**VALID, **changes})


@pytest.mark.usefixtures("unchecked")
def test_textures_must_be_a_sequence() -> None:
    with pytest.raises(ConfigError, match="textures must be a sequence"):
        TexturedMesh(**{**VALID, "textures": 3})
