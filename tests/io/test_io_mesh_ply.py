"""Meshes as PLY: written and read back, polygons of any number of corners, and damage."""

from pathlib import Path

import numpy as np
import pytest
from example_files import TEXT_MESH

from epipole.errors import FileFormatError
from epipole.io.meshes.mesh_ply import FIRST_VIEW, first_view_of_mesh, read_mesh_ply, write_mesh_ply
from epipole.io.meshes.ply import read_points_ply, write_points_ply

HEAD = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face %d\nproperty list %s vertex_indices\nend_header\n"
)
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")


def polygons(
    folder: Path, faces: list[list[int]], kinds: bytes = b"uchar int", count: int | None = None
) -> Path:
    rows = b"".join(np.array([len(f)], "u1").tobytes() + np.array(f, "<i4").tobytes() for f in faces)
    head = HEAD % (len(faces) if count is None else count, kinds)
    (folder / "a.ply").write_bytes(head + CORNERS.tobytes() + rows)
    return folder / "a.ply"


def test_what_is_written_comes_back(tmp_path: Path, rng: np.random.Generator) -> None:
    xyz, rgb = rng.normal(size=(9, 3)).astype(np.float32), rng.integers(0, 255, (9, 3), dtype=np.uint8)
    faces = rng.integers(0, 9, (20, 3))
    write_mesh_ply(tmp_path / "a.ply", xyz, faces, rgb)
    found = read_mesh_ply(tmp_path / "a.ply")
    assert np.array_equal(found.xyz, xyz) and np.array_equal(found.faces, faces)
    assert found.rgb is not None and np.array_equal(found.rgb, rgb) and "20 triangles" in repr(found)
    assert len(read_points_ply(tmp_path / "a.ply")) == 9


@pytest.mark.parametrize(
    ("faces", "triangles"),
    [
        ([[0, 1, 2, 3]], [[0, 1, 2], [0, 2, 3]]),
        ([[0, 1, 2, 3], [0, 1, 2]], [[0, 1, 2], [0, 2, 3], [0, 1, 2]]),
        ([[0, 1], [3, 2, 1]], [[3, 2, 1]]),
        ([], np.zeros((0, 3))),
    ],
)
def test_polygons_become_triangles(faces: list[list[int]], triangles: object, tmp_path: Path) -> None:
    assert np.array_equal(read_mesh_ply(polygons(tmp_path, faces)).faces, triangles)


def test_text_and_points_are_read(tmp_path: Path) -> None:
    (tmp_path / "t.ply").write_bytes(TEXT_MESH)
    assert read_mesh_ply(tmp_path / "t.ply").faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]
    write_points_ply(tmp_path / "p.ply", CORNERS, np.zeros((4, 3), np.uint8))
    assert len(read_mesh_ply(tmp_path / "p.ply").faces) == 0


@pytest.mark.parametrize(
    ("faces", "kinds", "count", "words"),
    [
        ([[0, 1, 2]], b"uchar int", 2, "ends within"),
        ([[0, 1, 2]], b"uchar int", 10**12, "ends within"),
        ([], b"uchar int", 1, "before its faces"),
        ([[0, 1, 4]], b"uchar int", 1, "missing vertex"),
        ([[0, 1, -1]], b"uchar int", 1, "missing vertex"),
        ([[0, 1, 2]], b"uchar float", 1, "not integers"),
        ([[0, 1, 2]], b"uint int", 1, "ends within"),
    ],
)
def test_damage_is_told(faces: list[list[int]], kinds: bytes, count: int, words: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=words):
        read_mesh_ply(polygons(tmp_path, faces, kinds, count))
    (tmp_path / "t.ply").write_bytes(TEXT_MESH[:-8])
    with pytest.raises(FileFormatError):
        read_mesh_ply(tmp_path / "t.ply")


def test_the_first_view_is_kept(tmp_path: Path) -> None:
    view = np.array([[1.0, 2.0, 1 / 3], [0.0, 0.0, 4.0], [0.0, 0.0, 1.0]])
    faces, rgb = np.array([[0, 1, 2]]), np.zeros((4, 3), np.uint8)
    write_mesh_ply(tmp_path / "m.ply", CORNERS, faces, rgb, view)
    assert np.allclose(first_view_of_mesh(tmp_path / "m.ply"), view, rtol=1e-8)
    assert read_mesh_ply(tmp_path / "m.ply").faces.tolist() == faces.tolist()


@pytest.mark.parametrize(
    "numbers", ["", "1 2 3", "1 2 3 4 5 6 7 8 x", "0 0 0 0 0 nan 0 1 0", "0 0 0 0 0 1 0 0 1"]
)
def test_other_files_have_no_first_view(numbers: str, tmp_path: Path) -> None:
    comment = f"{FIRST_VIEW} {numbers}\nelement vertex".encode()
    (tmp_path / "m.ply").write_bytes(TEXT_MESH.replace(b"element vertex", comment, 1))
    assert first_view_of_mesh(tmp_path / "m.ply") is None
    assert len(read_mesh_ply(tmp_path / "m.ply").faces) == 3
