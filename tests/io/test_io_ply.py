"""PLY: round trips, what other programs write, drawn cameras, broken files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from epipole.errors import FileFormatError, ShapeError, WorkspaceError
from epipole.io import read_points_ply, write_points_ply, write_scene_ply
from io_models import small_model


def test_trimesh_reads_what_we_write(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    xyz, rgb = rng.normal(size=(20, 3)), rng.integers(0, 256, (20, 3)).astype(np.uint8)
    write_points_ply(tmp_path / "x.ply", xyz, rgb)
    cloud = trimesh.load(tmp_path / "x.ply")
    np.testing.assert_allclose(cloud.vertices, xyz, atol=1e-6)
    np.testing.assert_array_equal(cloud.colors[:, :3], rgb)


TEXT = """ply\r
format ascii 1.0\r
comment made by hand\r
element vertex 2\r
property double x\r
property double y\r
property double z\r
property float confidence\r
property uchar diffuse_red\r
property uchar diffuse_green\r
property uchar diffuse_blue\r
element face 1\r
property list uchar int vertex_indices\r
end_header\r
1 2.5 -3e0 0.5 255 0 7\r
4 5 6 0.25 1 2 3\r
3 0 1 0\r
"""


def test_text_with_more_properties_and_faces(tmp_path: Path) -> None:
    (tmp_path / "x.ply").write_bytes(TEXT.encode())
    read = read_points_ply(tmp_path / "x.ply")
    np.testing.assert_array_equal(read.xyz, [[1, 2.5, -3], [4, 5, 6]])
    np.testing.assert_array_equal(read.rgb, [[255, 0, 7], [1, 2, 3]])


@pytest.mark.parametrize(("name", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary_of_both_orders_without_colors(tmp_path: Path, name: str, order: str) -> None:
    header = f"ply\nformat {name} 1.0\nelement vertex 3\nproperty short i\n"
    header += "property float64 z\nproperty float y\nproperty float x\nend_header\n"
    rows = np.zeros(3, [("i", f"{order}i2"), ("z", f"{order}f8"), ("y", f"{order}f4"), ("x", f"{order}f4")])
    rows["x"], rows["y"], rows["z"] = [1, 2, 3], [4, 5, 6], [7, 8, 9]
    (tmp_path / "x.ply").write_bytes(header.encode() + rows.tobytes())
    read = read_points_ply(tmp_path / "x.ply")
    np.testing.assert_array_equal(read.xyz, [[1, 4, 7], [2, 5, 8], [3, 6, 9]])
    assert read.rgb is None


def test_colors_from_zero_to_one(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 1\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "red", "green", "blue"))
    (tmp_path / "x.ply").write_text(header + "end_header\n0 0 0 1 0.5 -1\n")
    assert read_points_ply(tmp_path / "x.ply").rgb.tolist() == [[255, 128, 0]]


def test_a_scene_holds_points_and_cameras(tmp_path: Path) -> None:
    model = small_model()
    write_scene_ply(tmp_path / "scene.ply", model)
    data = (tmp_path / "scene.ply").read_bytes()
    n, cameras = len(model.points), 8
    assert f"element vertex {n + 5 * cameras}\n".encode() in data
    assert f"element edge {8 * cameras}\n".encode() in data
    read = read_points_ply(tmp_path / "scene.ply")
    np.testing.assert_allclose(read.xyz[:n], model.points.xyz_in_world, atol=1e-6)
    np.testing.assert_array_equal(read.rgb[:n], model.points.rgb)
    for image in range(cameras):
        corners = read.xyz[n + 5 * image : n + 5 * image + 5]
        cam_from_world = model.cams_from_world()[image]
        np.testing.assert_allclose(corners[0], cam_from_world.centers(), atol=1e-5)
        camera = model.cameras[int(model.camera_of_image[image])]
        in_cam = cam_from_world.apply(corners[1:])
        pixels = (in_cam / in_cam[:, 2:]) @ camera.K.T
        w, h = camera.width - 0.5, camera.height - 0.5
        np.testing.assert_allclose(pixels[:, :2], [(-0.5, -0.5), (w, -0.5), (w, h), (-0.5, h)], atol=0.02)
        assert (in_cam[:, 2] > 0).all()
    edges = np.frombuffer(data[-64 * 11 :], [("v", "<i4", 2), ("rgb", "u1", 3)])
    assert edges["v"].min() == n and edges["v"].max() == n + 5 * cameras - 1


def test_scenes_with_one_camera_or_none(tmp_path: Path) -> None:
    model = small_model()
    for known in (0, 1):
        rig_from_world = model.frames.rig_from_world
        translation = rig_from_world.translation.copy()
        translation[: 5 if known == 0 else 3] = np.nan
        translation[4] = np.nan
        frames = replace(model.frames, rig_from_world=replace(rig_from_world, translation=translation))
        write_scene_ply(tmp_path / "scene.ply", replace(model, frames=frames))
        read = read_points_ply(tmp_path / "scene.ply")
        assert len(read) == len(model.points) + 5 * known
        assert np.isfinite(read.xyz).all()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a PLY file"),
        (b"solid cube\n", "not a PLY file"),
        (TEXT.encode()[:200], "not a PLY file"),
        (TEXT.encode()[:-30], "before the last of 2 vertices"),
        (TEXT.replace("vertex 2", "vertex 99999999999999999999").encode(), "before the last"),
        (TEXT.replace("vertex 2", "vertex -2").encode(), "line 4: invalid header line"),
        (TEXT.replace("element vertex 2\r\n", "").encode(), "line 11: invalid header line"),
        (TEXT.replace("format ascii 1.0\r\n", "").encode(), "does not describe vertices"),
        (TEXT.replace("vertex 2", "vertex two").encode(), "line 4: invalid header line"),
        (TEXT.replace("ascii", "morse").encode(), "line 2: invalid header line"),
        (TEXT.replace("double x", "double a").encode(), "no x"),
        (TEXT.replace("double x", "list uchar int x").encode(), "invalid header line"),
        (TEXT.replace("-3e0", "three").encode(), "not all numbers"),
        (TEXT.replace("ascii", "binary_little_endian").encode(), "2 vertices do not fit into the"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "x.ply").write_bytes(content)
    with pytest.raises(FileFormatError, match=message):
        read_points_ply(tmp_path / "x.ply")


def test_misuse_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="uint8"):
        write_points_ply(tmp_path / "x.ply", np.zeros((2, 3)), np.zeros((2, 3)))
    with pytest.raises(ShapeError, match="lengths differ"):
        write_points_ply(tmp_path / "x.ply", np.zeros((2, 3)), np.zeros((3, 3), np.uint8))
    with pytest.raises(FileFormatError, match="it does not exist"):
        read_points_ply(tmp_path / "x.ply")
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkspaceError):
        write_points_ply(tmp_path / "file" / "x.ply", np.zeros((2, 3)), np.zeros((2, 3), np.uint8))
