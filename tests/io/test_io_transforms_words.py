"""transforms.json: camera models, angles, poses and keys that other programs write are used, or refused by name."""

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from epipole.cameras import CameraModel
from epipole.errors import FileFormatError
from epipole.io import read_transforms, write_points_ply
from epipole.io.models.transforms import read_transforms_scene

FAULTS = Path(__file__).parents[2].parent / "shared" / "data" / "faults"
EYE = np.eye(4).tolist()


def content_of(change: dict[str, Any], frame: dict[str, Any] | None = None, count: int = 1) -> dict[str, Any]:
    frames = [{"file_path": f"images/{k}.png", "transform_matrix": EYE} for k in range(count)]
    frames[-1] |= frame or {}
    values = {"w": 640, "h": 480, "fl_x": 500.0, "fl_y": 500.0, "cx": 320.0, "cy": 240.0, "frames": frames}
    return {key: value for key, value in (values | change).items() if value is not ...}


def scene_of(tmp_path: Path, change: dict[str, Any], frame: dict[str, Any] | None = None, count: int = 1):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(content_of(change, frame, count)))
    return read_transforms_scene(path)


@pytest.mark.parametrize(
    "name",
    [
        "EQUIRECTANGULAR",
        "THIN_PRISM_FISHEYE",
        "ftheta",
        "FOV",
        "ORTHOPHOTO",
        "FISHEYE624",
        "VR180_L",
        "",
        4,
        None,
    ],
)
@pytest.mark.parametrize("where", ["file", "frame"])
def test_unknown_camera_models_are_refused(tmp_path: Path, name: Any, where: str) -> None:
    own = {"camera_model": name}
    with pytest.raises(FileFormatError, match=f"camera_model.*{name}"):
        scene_of(tmp_path, own if where == "file" else {}, own if where == "frame" else None)


def test_spherical_images_are_refused_as_such(tmp_path: Path) -> None:
    for own in ({"camera_model": "EQUIRECTANGULAR"}, {"equirectangular": True}, {"latlong": True}):
        with pytest.raises(FileFormatError, match=r"spherical \(equirectangular\) images are not supported"):
            scene_of(tmp_path, own)


@pytest.mark.skipif(not FAULTS.is_dir(), reason="the folder faults is not in the data folder")
def test_files_that_were_read_wrongly() -> None:
    with pytest.raises(FileFormatError, match="spherical"):
        read_transforms(FAULTS / "transforms_equirectangular.json")
    camera = read_transforms(FAULTS / "transforms_angle_y.json").cameras[0]
    np.testing.assert_allclose(camera.params[:2], [500.0, 600.0], rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "coefficients", "model", "expected"),
    [
        ("PINHOLE", {"k1": 0.0}, CameraModel.PINHOLE, []),
        ("pinhole", {}, CameraModel.PINHOLE, []),
        ("SIMPLE_RADIAL", {"k1": 0.1}, CameraModel.OPENCV, [0.1, 0, 0, 0]),
        ("OPENCV", {"k1": 0.1, "p2": 0.2, "k3": 0.0, "k4": 0.0}, CameraModel.OPENCV, [0.1, 0, 0, 0.2]),
        ("OPENCV", {"k1": 0.1, "k3": 0.3}, CameraModel.FULL_OPENCV, [0.1, 0, 0, 0, 0.3, 0, 0, 0]),
        ("FULL_OPENCV", {"k2": 0.1, "k4": 0.4, "k6": 0.6}, CameraModel.FULL_OPENCV, [0, 0.1, 0, 0, 0, 0.4, 0, 0.6]),
        ("RADIAL_FISHEYE", {"k1": 0.1, "k2": 0.2}, CameraModel.OPENCV_FISHEYE, [0.1, 0.2, 0, 0]),
        ("OPENCV_FISHEYE", {"k4": 0.4, "p1": 0.0}, CameraModel.OPENCV_FISHEYE, [0, 0, 0, 0.4]),
    ],
)  # fmt: skip
def test_known_camera_models(tmp_path, name, coefficients, model, expected) -> None:
    camera = scene_of(tmp_path, {"camera_model": name, **coefficients}).reconstruction.cameras[0]
    assert camera.model == model and camera.params[4:].tolist() == expected


@pytest.mark.parametrize(
    ("own", "words"),
    [
        ({"k5": 0.1}, "k5 of a perspective camera"),
        ({"k6": 0.1}, "k6 of a perspective camera"),
        ({"k7": 0.1}, "unknown key k7 = 0.1"),
        ({"camera_model": "PINHOLE", "k1": 0.1}, "k1 of a perspective camera .PINHOLE."),
        ({"camera_model": "RADIAL", "p1": 0.1}, "p1 of a perspective camera .RADIAL."),
        ({"is_fisheye": True, "p1": 0.1}, "p1 of a fisheye camera"),
        ({"camera_model": "OPENCV_FISHEYE", "k5": 0.1}, "k5 of a fisheye camera"),
        ({"camera_model": "OPENCV", "is_fisheye": True}, "contradicts is_fisheye"),
        ({"is_fisheye": "no"}, "is_fisheye must be true or false"),
        ({"ftheta_p0": 1.0}, "ftheta_p0"),
        ({"rolling_shutter": [0, 0, 0.5, 0]}, "rolling_shutter"),
        ({"b1": 0.1}, "unknown key b1"),
        ({"s1": 0.1}, "unknown key s1"),
        ({"xi": 1.1}, "unknown key xi"),
        ({"skew": 2.0}, "unknown key skew"),
        ({"distortion_params": [0.1]}, "unknown key distortion_params"),
        ({"orthographic": True}, "unknown key orthographic"),
        ({"from_na": True}, "unknown key from_na"),
        ({"intrinsic_matrix": [[1, 0], [0, 1]]}, "unknown key intrinsic_matrix"),
        ({"transform_matrix_start": EYE}, "unknown key transform_matrix_start"),
        ({"camera_convention": "OpenCV"}, "unknown key camera_convention"),
        ({"crop_x": 10}, "unknown key crop_x"),
        ({"width": 320}, "w = 640 contradicts width = 320"),
    ],
)  # fmt: skip
def test_coefficients_and_keys_that_are_not_understood_are_refused(tmp_path, own, words) -> None:
    for change, frame in ((own, None), ({}, own)):
        with pytest.raises(FileFormatError, match=words):
            scene_of(tmp_path, change, frame)


def test_keys_of_exporters_are_accepted_silently(tmp_path: Path) -> None:
    frame = {"colmap_im_id": 3, "sharpness": 41.5, "rotation": 0.01, "time": 0.5, "timestamp": 1.5, "k7": 0.0}
    change = {
        "aabb_scale": 16, "scale": 1.0, "offset": [0.5, 0.5, 0.5], "orientation_override": "none", "is_fisheye": False,
        "applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 0.5, "auto_scale_poses_override": False,
        "rolling_shutter": [0, 0, 0, 0], "width": 640, "image_height": 480, "n_frames": 1, "coordinate_system": "OpenGL", "k1": 0, "camera_model": "OPENCV", "integer_depth_scale": 0.001,
    }  # fmt: skip
    assert scene_of(tmp_path, change, frame).warnings == ()


def test_keys_without_use_are_named_in_a_warning(tmp_path: Path) -> None:
    scene = scene_of(
        tmp_path, {"weather": "sunny", "n_frames": 9, "ply_file_path": "no.ply"}, {"depth_file_path": "d.png"}
    )
    words = "\n".join(scene.warnings)
    assert "depth_file_path is not used" in words and "unknown keys are ignored: weather" in words
    assert "n_frames is not used (all frames are read)" in words
    assert "the file no.ply given by ply_file_path does not exist" in words
    with pytest.warns(RuntimeWarning, match="weather"):
        read_transforms(tmp_path / "transforms.json")


def test_points_and_poses_stay_in_the_coordinates_of_the_file(tmp_path: Path) -> None:
    """nerfstudio writes both after applied_transform: neither is changed again."""
    write_points_ply(tmp_path / "points.ply", np.array([[1.0, 2, 3]]), np.zeros((1, 3), np.uint8))
    moved = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
    own = {"ply_file_path": "points.ply", "applied_transform": moved, "applied_scale": 2.0}
    model = scene_of(tmp_path, own).reconstruction
    assert model.points.xyz_in_world.tolist() == [[1.0, 2.0, 3.0]]
    np.testing.assert_array_equal(model.cams_from_world().rotation[0], np.diag([1.0, -1, -1]))
    for bad in ({"applied_transform": [[1, 2]]}, {"applied_scale": 0}, {"applied_transform": "x"}):
        with pytest.raises(FileFormatError):
            scene_of(tmp_path, bad)


@pytest.mark.parametrize(
    ("own", "expected"),
    [
        ({"camera_angle_y": 2 * np.arctan(240 / 600)}, [600.0, 600.0]),
        ({"camera_angle_x": 2 * np.arctan(320 / 500), "camera_angle_y": 2 * np.arctan(240 / 600)}, [500.0, 600.0]),
        ({"x_fov": np.degrees(2 * np.arctan(320 / 500))}, [500.0, 500.0]),
        ({"fl_y": 450.0}, [450.0, 450.0]),
        ({"fl_x": 500.0, "camera_angle_x": 2 * np.arctan(320 / 502)}, [500.0, 500.0]),
    ],
)  # fmt: skip
def test_angles_of_view(tmp_path, own, expected) -> None:
    unknown = {"fl_x": ..., "fl_y": ...}
    for change, frame in ((unknown | own, None), (unknown, own)):
        params = scene_of(tmp_path, change, frame).reconstruction.cameras[0].params
        np.testing.assert_allclose(params[:2], expected, rtol=1e-9)


def test_angles_of_a_frame_go_before_the_focal_length_of_the_file(tmp_path) -> None:
    frame = {"camera_angle_x": 2 * np.arctan(320 / 400)}
    params = scene_of(tmp_path, {"fl_y": ...}, frame).reconstruction.cameras[0].params
    np.testing.assert_allclose(params[:2], [400.0, 400.0], rtol=1e-9)


@pytest.mark.parametrize(
    "own",
    [
        {"camera_angle_x": 1.0},
        {"x_fov": 40.0},
        {"fl_y": 600.0, "camera_angle_y": 1.0},
        {"fl_x": ..., "camera_angle_x": 1.0, "x_fov": 90.0},
    ],
)
def test_contradictions_are_refused(tmp_path, own) -> None:
    with pytest.raises(FileFormatError, match="contradicts"):
        scene_of(tmp_path, own)


def test_three_focal_values_outvote_one_angle(tmp_path: Path) -> None:
    """Blender's angle_y is that of the sensor, not of the image."""
    scene = scene_of(tmp_path, {"camera_angle_x": 2 * np.arctan(320 / 500), "camera_angle_y": 1.2})
    assert scene.reconstruction.cameras[0].params[:2].tolist() == [500.0, 500.0]
    assert any("camera_angle_y" in warning for warning in scene.warnings)


def test_a_fisheye_needs_its_focal_length(tmp_path: Path) -> None:
    own = {"is_fisheye": True, "camera_angle_x": 2.5}
    assert scene_of(tmp_path, own).reconstruction.cameras[0].params[0] == 500.0
    with pytest.raises(FileFormatError, match="add fl_x"):
        scene_of(tmp_path, own | {"fl_x": ..., "fl_y": ...})


def test_sizes_are_whole_and_those_of_the_image(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    Image.new("L", (640, 480)).save(tmp_path / "images" / "0.png")
    assert scene_of(tmp_path, {"w": 640.0, "h": ...}).reconstruction.cameras[0].height == 480
    with pytest.raises(FileFormatError, match="w = 320, but the image has 640"):
        scene_of(tmp_path, {"w": 320, "h": ...})
    with pytest.raises(FileFormatError, match=r"w = 640\.5"):
        scene_of(tmp_path, {"w": 640.5})


def test_one_pose_that_is_not_finite_leaves_one_frame_out(tmp_path: Path) -> None:
    broken = np.eye(4)
    broken[0, 3] = np.nan
    scene = scene_of(tmp_path, {"train_filenames": ["images/0.png", "images/2.png"]},
                     {"transform_matrix": broken.tolist()}, count=3)  # fmt: skip
    assert scene.reconstruction.images.name == ("0.png", "1.png")
    assert scene.reconstruction.is_registered().all() and scene.splits == {"train": ("0.png",)}
    assert scene.warnings == ("skipped frame 2 (2.png): its transform_matrix is not finite",)
    with pytest.raises(
        FileFormatError, match=r"none of its 1 frames can be used; skipped frame 0 \(0\.png\)"
    ):
        scene_of(tmp_path, {}, {"transform_matrix": broken.tolist()})
    assert scene_of(tmp_path, {}, {"is_bad": True}, count=2).reconstruction.images.name == ("0.png",)


@pytest.mark.parametrize("scale", [0.981, 0.99, 1.01, 1.02])
def test_rotations_scaled_by_up_to_two_percent_are_corrected(tmp_path, scale) -> None:
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * rotation, [1, 2, 3]
    scene = scene_of(tmp_path, {}, {"transform_matrix": matrix.tolist()}, count=2)
    pose = scene.reconstruction.cams_from_world().inverse()
    np.testing.assert_allclose(pose.rotation[1], rotation @ np.diag([1.0, -1, -1]), atol=1e-12)
    np.testing.assert_allclose(pose.translation[1], [1, 2, 3], atol=1e-12)
    assert len(scene.warnings) == 1 and scene.warnings[0].startswith("1 of 2 rotations")


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.diag([1.03, 1.03, 1.03, 1]), "does not contain a rotation"),
        (np.diag([1.0, 1, -1, 1]), "does not contain a rotation"),
        (np.diag([1e300, 1, 1, 1]), "does not contain a rotation"),
        (np.eye(4) + np.array(3 * [[0, 0, 0, 0]] + [[1, 2, 3, 0]]), "transposed"),
        (np.diag([1.0, 1, 1, 2]), "last row"),
    ],
)
def test_matrices_that_are_no_poses(tmp_path, matrix, words) -> None:
    with pytest.raises(FileFormatError, match=f"frame 1: .*{words}.*images/1.png"):
        scene_of(tmp_path, {}, {"transform_matrix": matrix.tolist()}, count=2)


def test_masks_and_splits_are_read(tmp_path: Path) -> None:
    own = {"train_filenames": ["./images/0.png"], "test_filenames": ["images\\1.png"]}
    scene = scene_of(tmp_path, own, {"mask_path": "./masks/1.png"}, count=2)
    assert scene.masks == {"1.png": "masks/1.png"}
    assert scene.splits == {"train": ("0.png",), "test": ("1.png",)} and scene.warnings == ()
    assert scene_of(tmp_path, {"mask_path": "m.png"}, count=2).masks == {"0.png": "m.png", "1.png": "m.png"}
    for bad in (["images/9.png"], "images/0.png", [3]):
        with pytest.raises(FileFormatError, match="val_filenames"):
            scene_of(tmp_path, {"val_filenames": bad})


def test_a_linked_folder_of_images_is_refused_as_a_link(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    Image.new("L", (64, 48)).save(tmp_path / "elsewhere" / "0.png")
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "images").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FileFormatError, match="symbolic link"):
        scene_of(tmp_path / "scene", {"w": ..., "h": ...})


def test_a_key_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    text = json.dumps(content_of({}))
    (tmp_path / "t.json").write_text(text.replace('"fl_x"', '"fl_x": 400.0, "fl_x"', 1))
    with pytest.raises(FileFormatError, match="duplicate key 'fl_x'"):
        read_transforms(tmp_path / "t.json")


def test_a_sound_file_warns_of_nothing(tmp_path: Path) -> None:
    (tmp_path / "t.json").write_text(json.dumps(content_of({"camera_model": "OPENCV"})))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read_transforms(tmp_path / "t.json").images) == 1
