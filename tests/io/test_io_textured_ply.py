"""Textured meshes as PLY in MeshLab's convention: header and faces parsed back."""

from pathlib import Path

import numpy as np
import pytest
from textured_meshes import UTM, corner_mesh

from epipole.errors import ConfigError, ShapeError
from epipole.io.images.photographs import read_rgb
from epipole.io.meshes.ply import read_points_ply
from epipole.io.meshes.textured_ply import write_textured_ply
from epipole.scene import TexturedMesh

FACE = np.dtype([("k", "u1"), ("i", "<i4", 3), ("n", "u1"), ("uv", "<f4", (3, 2)), ("texture", "<i4")])


def parsed(path: Path) -> tuple[TexturedMesh, str]:
    """The mesh, with texture coordinates converted to the top left, and the header."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    names = [line.removeprefix("comment TextureFile ") for line in lines if "TextureFile" in line]
    counts = [int(line.split()[2]) for line in lines if line.startswith("element")]
    kind = "<f8" if "property double x" in lines else "<f4"
    size = counts[0] * 3 * np.dtype(kind).itemsize
    vertices = np.frombuffer(body[:size], kind).reshape(-1, 3).astype(np.float64)
    faces = np.frombuffer(body[size:], FACE)
    assert len(faces) == counts[1] and (faces["k"] == 3).all() and (faces["n"] == 6).all()
    uv = faces["uv"].astype(np.float64)
    uv[..., 1] = 1 - uv[..., 1]
    textures = tuple(read_rgb(path.parent / name) for name in names)
    mesh = TexturedMesh(vertices, faces["i"].astype(int), uv, faces["texture"].astype(int), textures)
    return mesh, head.decode()


def test_a_written_mesh_is_read_back(tmp_path: Path) -> None:
    mesh = corner_mesh()
    write_textured_ply(tmp_path / "a b.ply", mesh, jpeg_quality=None)
    found, header = parsed(tmp_path / "a b.ply")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a b.ply", "a_b_0.png", "a_b_1.png"]
    assert np.array_equal(found.vertices_in_world, mesh.vertices_in_world) and "property float x" in header
    assert np.array_equal(found.faces, mesh.faces) and np.allclose(found.uv, mesh.uv, atol=1e-6)
    assert np.array_equal(found.texture_of_face, mesh.texture_of_face)
    assert all(np.array_equal(a, b) for a, b in zip(found.textures, mesh.textures))
    for line in ("property list uchar float texcoord", "property int texnumber"):
        assert line in header.splitlines()


def test_large_coordinates_are_doubles_and_textures_are_jpeg(tmp_path: Path) -> None:
    mesh = corner_mesh(UTM)
    write_textured_ply(tmp_path / "a.ply", mesh)
    found, _ = parsed(tmp_path / "a.ply")
    assert np.array_equal(found.vertices_in_world, mesh.vertices_in_world)
    assert (tmp_path / "a_1.jpg").is_file()
    assert np.array_equal(read_points_ply(tmp_path / "a.ply").xyz, mesh.vertices_in_world)


def test_wrong_arguments_write_nothing(tmp_path: Path) -> None:
    mesh = corner_mesh()
    empty = TexturedMesh(
        mesh.vertices_in_world, mesh.faces[:0], mesh.uv[:0], mesh.texture_of_face[:0], mesh.textures
    )
    with pytest.raises(ShapeError, match="no triangles"):
        write_textured_ply(tmp_path / "a.ply", empty)
    with pytest.raises(ConfigError, match=r"must end in \.ply"):
        write_textured_ply(tmp_path / "a.obj", mesh)
    assert not list(tmp_path.iterdir())
