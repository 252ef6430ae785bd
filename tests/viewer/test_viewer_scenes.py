"""What the viewer makes of a path: which way is up, what is a point, what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from viewer_scenes import three_cameras

from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.io import write_colmap_model, write_scene_ply, write_trajectory
from epipole.io.images.depth_maps import write_pfm, write_png16
from epipole.pipelines.viewing.run import scene_of
from epipole.report.space import space_data
from epipole.report.space_scene import SpaceScene
from epipole.scene import Trajectory


def up_of(scene: SpaceScene) -> np.ndarray:
    return np.array(space_data(scene).numbers["up"])


def test_a_model_written_as_ply_has_cameras_and_stands_as_the_model_does(tmp_path: Path) -> None:
    model = three_cameras(20)
    write_scene_ply(tmp_path / "scene.ply", model)
    write_colmap_model(model, tmp_path / "model")
    scene, whole = scene_of(tmp_path / "scene.ply"), scene_of(tmp_path / "model")
    assert scene.words == "20 points and 2 cameras"
    np.testing.assert_allclose(scene.points[0].xyz_in_world, model.points.xyz_in_world, atol=1e-6)
    lines = scene.curves[0].segments_in_world
    assert lines.shape == (16, 2, 3)
    for center in model.camera_centers_in_world()[:2]:
        assert (np.abs(lines.reshape(-1, 3) - center).max(axis=1) < 1e-6).sum() == 4
    np.testing.assert_array_equal(up_of(scene), up_of(whole))
    np.testing.assert_array_equal(up_of(whole), [0, 0, 1])


def path_of(world_from_body: Rigid3) -> Trajectory:
    return Trajectory(0.1 * np.arange(len(world_from_body)), world_from_body)


def test_a_path_keeps_the_places_of_its_file(tmp_path: Path) -> None:
    centers = np.cumsum(np.ones((20, 3)), axis=0) - 1.0
    level = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # a camera (y down) in a world with z up
    for name, rotation, up in (("begun.txt", np.eye(3), [0, -1, 0]), ("surveyed.txt", level, [0, 0, 1])):
        poses = Rigid3(np.broadcast_to(rotation, (20, 3, 3)).copy(), centers)
        write_trajectory(path_of(poses), tmp_path / name)
        scene = scene_of(tmp_path / name)
        np.testing.assert_allclose(scene.points[0].xyz_in_world, centers, atol=1e-6)
        np.testing.assert_allclose(up_of(scene), up, atol=1e-6)
        assert scene.words.startswith("20 poses over 1.9 s")


def test_numbers_of_lines_are_no_times(tmp_path: Path) -> None:
    poses = Rigid3(np.broadcast_to(np.eye(3), (400, 3, 3)).copy(), np.linspace(0, [1, 2, 3], 400))
    write_trajectory(path_of(poses), tmp_path / "poses.txt", "kitti")
    scene = scene_of(tmp_path / "poses.txt")
    assert scene.words.startswith("400 poses, trajectory length ") and not scene.curves[0].is_shown
    assert (scene.points[0].measures[0].name, scene.points[0].measures[0].unit) == ("number", "")


def test_disparities_are_no_depths_and_scaled_numbers_are_told(tmp_path: Path) -> None:
    values = np.full((20, 30), 3.0, np.float32)
    write_pfm(tmp_path / "disparity.pfm", values)
    write_png16(tmp_path / "left_disparity.png", values)
    for name in ("disparity.pfm", "left_disparity.png"):
        with pytest.raises(FileFormatError, match=f"{name}: its name says disparity"):
            scene_of(tmp_path / name)
    write_png16(tmp_path / "depth.png", values)
    assert "divided by 256, as in KITTI, interpreted as depths" in scene_of(tmp_path / "depth.png").words


def test_points_too_far_to_be_drawn_are_left_out(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\nend_header\n"
    (tmp_path / "far.ply").write_text(head + "0 0 0\n1e300 0 0\n")
    assert np.isfinite(space_data(scene_of(tmp_path / "far.ply")).numbers["radius"])
    (tmp_path / "farther.ply").write_text(head + "1e300 0 0\n0 1e300 0\n")
    with pytest.raises(
        FileFormatError, match=r"farther\.ply: it has no finite points with coordinates below 1e30"
    ):
        scene_of(tmp_path / "farther.ply")


def test_pictures_without_a_place_and_other_models_are_told(tmp_path: Path) -> None:
    model = three_cameras()
    for number in range(2):
        write_colmap_model(model, tmp_path / "out" / "sparse" / str(number))
    one = scene_of(tmp_path / "out" / "sparse" / "1")
    assert (one.title, one.words.split(",")[0]) == ("out/sparse/1", "2 images")
    (tmp_path / "out" / "summary.json").write_text(json.dumps({"num_images": 7}))
    scene = scene_of(tmp_path / "out")
    assert scene.words.startswith("2 of 7 images registered, 5 points; the first of 2 models (see also ")
    assert scene.words.endswith("sparse/1)")
