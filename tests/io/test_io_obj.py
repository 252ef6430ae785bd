"""Textured meshes as OBJ with MTL: parsed back line by line."""

from pathlib import Path

import numpy as np
import pytest
from textured_meshes import BLUE, GREEN, RED, UTM, WHITE, color_at, corner_mesh, large_mesh

from epipole.errors import ConfigError, ShapeError, WorkspaceError
from epipole.io.images.photographs import read_rgb
from epipole.io.meshes.obj import write_obj
from epipole.scene import TexturedMesh


def parsed(path: Path) -> TexturedMesh:
    """The mesh of an OBJ file, with texture coordinates converted to the top left."""
    vertices, coordinates, faces, corners, materials, used = [], [], [], [], {}, []
    textures: list[np.ndarray] = []
    for line in path.read_text("utf-8").splitlines():
        word, *rest = line.split()
        if word == "mtllib":
            materials = material_files(path.parent / rest[0])
        elif word == "v":
            vertices.append([float(x) for x in rest])
        elif word == "vt":
            coordinates.append([float(x) for x in rest])
        elif word == "usemtl":
            textures.append(read_rgb(path.parent / materials[rest[0]]))
        elif word == "f":
            pairs = np.array([corner.split("/") for corner in rest], int) - 1
            faces.append(pairs[:, 0])
            corners.append(pairs[:, 1])
            used.append(len(textures) - 1)
        else:
            raise AssertionError(line)
    uv = np.array(coordinates)[np.array(corners)]
    uv[..., 1] = 1 - uv[..., 1]
    return TexturedMesh(np.array(vertices), np.array(faces), uv, np.array(used), tuple(textures))


def material_files(path: Path) -> dict[str, str]:
    out, name = {}, ""
    for line in path.read_text("utf-8").splitlines():
        word, *rest = line.split()
        if word == "newmtl":
            (name,) = rest
        elif word == "map_Kd":
            (out[name],) = rest
    return out


def test_a_written_mesh_is_read_back(tmp_path: Path) -> None:
    mesh = corner_mesh()
    write_obj(tmp_path / "a.obj", mesh, jpeg_quality=None)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mtl", "a.obj", "a_0.png", "a_1.png"]
    found = parsed(tmp_path / "a.obj")
    assert np.array_equal(found.vertices_in_world, mesh.vertices_in_world)
    assert np.array_equal(found.faces, mesh.faces) and np.allclose(found.uv, mesh.uv, atol=1e-9)
    assert np.array_equal(found.texture_of_face, mesh.texture_of_face)
    assert all(np.array_equal(a, b) for a, b in zip(found.textures, mesh.textures))
    text = (tmp_path / "a.obj").read_text()
    assert text.count("vt ") == 4, "equal texture coordinates are written once"


def test_jpeg_textures_keep_their_orientation(tmp_path: Path) -> None:
    write_obj(tmp_path / "a.obj", corner_mesh())
    found = parsed(tmp_path / "a.obj")
    assert (tmp_path / "a_1.jpg").is_file()
    for vertex, color in enumerate((RED, GREEN, WHITE, BLUE)):
        face, corner = np.argwhere(found.faces[:2] == vertex)[0]
        seen = color_at(found.textures[0], found.uv[face, corner])
        assert np.abs(seen - color).max() < 12


def test_utm_coordinates_are_exact_to_less_than_a_millimeter(tmp_path: Path) -> None:
    mesh = corner_mesh(UTM)
    write_obj(tmp_path / "a.obj", mesh)
    assert np.allclose(
        parsed(tmp_path / "a.obj").vertices_in_world, mesh.vertices_in_world, rtol=0, atol=1e-5
    )


def test_long_meshes_are_written_in_blocks(tmp_path: Path) -> None:
    mesh = large_mesh(300)
    write_obj(tmp_path / "a.obj", mesh)
    found = parsed(tmp_path / "a.obj")
    assert np.array_equal(found.faces, mesh.faces) and np.allclose(found.uv, mesh.uv, atol=1e-8)


def test_unused_textures_are_not_written(tmp_path: Path) -> None:
    mesh = corner_mesh()
    second = TexturedMesh(
        mesh.vertices_in_world, mesh.faces[2:], mesh.uv[2:], mesh.texture_of_face[2:], mesh.textures
    )
    write_obj(tmp_path / "a.obj", second, jpeg_quality=None)
    found = parsed(tmp_path / "a.obj")
    assert not (tmp_path / "a_1.png").exists() and np.array_equal(found.textures[0], mesh.textures[1])


def test_names_beside_the_file_have_no_spaces(tmp_path: Path) -> None:
    write_obj(tmp_path / "my scène #1.obj", corner_mesh())
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "my scène #1.obj",
        "my_scène_1.mtl",
        "my_scène_1_0.jpg",
        "my_scène_1_1.jpg",
    ]
    assert len(parsed(tmp_path / "my scène #1.obj")) == 4


def test_wrong_arguments_write_nothing(tmp_path: Path) -> None:
    mesh = corner_mesh()
    empty = TexturedMesh(
        mesh.vertices_in_world, mesh.faces[:0], mesh.uv[:0], mesh.texture_of_face[:0], mesh.textures
    )
    with pytest.raises(ShapeError, match="no triangles"):
        write_obj(tmp_path / "a.obj", empty)
    with pytest.raises(ConfigError, match=r"must end in \.obj"):
        write_obj(tmp_path / "a.mtl", mesh)
    with pytest.raises(ConfigError, match="jpeg_quality must be from 1 to 100"):
        write_obj(tmp_path / "a.obj", mesh, jpeg_quality=0)
    wide = TexturedMesh(
        mesh.vertices_in_world,
        mesh.faces,
        mesh.uv,
        0 * mesh.texture_of_face,
        (np.zeros((1, 70_000, 3), np.uint8),),
    )
    with pytest.raises(ConfigError, match="70000 x 1"):
        write_obj(tmp_path / "a.obj", wide)
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkspaceError):
        write_obj(tmp_path / "file" / "a.obj", mesh)
