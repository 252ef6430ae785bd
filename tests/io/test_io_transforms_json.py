"""nerfstudio's transforms.json: axes, half pixels, round trips, NeRF-synthetic, broken files."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.errors import FileFormatError
from epipole.io import read_transforms, write_transforms
from epipole.scene import Cameras
from io_models import mappable_model, small_model

DATA = Path(os.environ.get("EPIPOLE_DATA", Path(__file__).parents[2].parent / "shared" / "data"))


def test_round_trip(tmp_path: Path) -> None:
    model = small_model()
    write_transforms(model, tmp_path / "transforms.json")
    read = read_transforms(tmp_path / "transforms.json")
    assert read.images.name == model.images.name[:8]
    expected = model.cams_from_world()[np.arange(8)]
    np.testing.assert_allclose(read.cams_from_world().as_matrix(), expected.as_matrix(), atol=1e-12)
    assert len(read.cameras) == 3
    for image in range(8):
        mine = model.cameras[int(model.camera_of_image[image])]
        theirs = read.cameras[int(read.camera_of_image[image])]
        assert (theirs.width, theirs.height) == (mine.width, mine.height)
        np.testing.assert_allclose(theirs.K, mine.K, atol=1e-12)
        # The models may differ in name, not in what they do.
        in_cam = np.array([[0.1, -0.2, 1.5], [0.3, 0.2, 1.0]])
        np.testing.assert_allclose(theirs.project(in_cam), mine.project(in_cam), atol=1e-9)
    np.testing.assert_allclose(read.points.xyz_in_world, model.points.xyz_in_world, atol=1e-6)
    np.testing.assert_array_equal(read.points.rgb, model.points.rgb)
    assert len(read.tracks) == len(model.points) and len(read.tracks.image) == 0


def test_a_shared_camera_stands_once(tmp_path: Path) -> None:
    model = mappable_model()
    write_transforms(model, tmp_path / "transforms.json", image_folder="photos/")
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert (content["w"], content["h"], content["fl_x"], content["camera_model"]) == (
        640,
        480,
        550.0,
        "OPENCV",
    )
    assert (content["cx"], content["cy"]) == (320.0, 240.0)  # the middle of the image, from its corner
    assert content["ply_file_path"] == "sparse_pc.ply" and (tmp_path / "sparse_pc.ply").is_file()
    assert content["frames"][0]["file_path"] == "photos/000.jpg"
    assert set(content["frames"][0]) == {"file_path", "transform_matrix"}
    assert read_transforms(tmp_path / "transforms.json", "photos").images.name[0] == "000.jpg"


def test_axes_are_those_of_opengl(tmp_path: Path) -> None:
    """A camera at the origin that looks along +z with y down: OpenGL's z is backwards, y is up."""
    content = {
        "w": 100, "h": 80, "fl_x": 90, "fl_y": 90, "cx": 50, "cy": 40,
        "frames": [{"file_path": "a.png", "transform_matrix": np.diag([1.0, -1, -1, 1]).tolist()}],
    }  # fmt: skip
    (tmp_path / "t.json").write_text(json.dumps(content))
    model = read_transforms(tmp_path / "t.json")
    np.testing.assert_allclose(model.cams_from_world().as_matrix()[0], np.eye(4), atol=1e-15)
    assert model.cameras[0].params.tolist() == [90, 90, 49.5, 39.5]
    write_transforms(model, tmp_path / "again.json")
    again = json.loads((tmp_path / "again.json").read_text())
    np.testing.assert_array_equal(again["frames"][0]["transform_matrix"], np.diag([1.0, -1, -1, 1]))
    assert "ply_file_path" not in again


def test_fisheye_round_trip(tmp_path: Path) -> None:
    fisheye = Camera(
        CameraModel.OPENCV_FISHEYE, 640, 480, np.array([300, 301, 310.0, 240.0, 0.1, -0.02, 0.003, -0.0004])
    )
    model = replace(mappable_model(), cameras=Cameras.from_list([fisheye]))
    write_transforms(model, tmp_path / "t.json")
    assert json.loads((tmp_path / "t.json").read_text())["camera_model"] == "OPENCV_FISHEYE"
    camera = read_transforms(tmp_path / "t.json").cameras[0]
    assert camera.model == CameraModel.OPENCV_FISHEYE
    np.testing.assert_allclose(camera.params, fisheye.params, atol=1e-12)


@pytest.mark.skipif(not (DATA / "fields" / "lego").is_dir(), reason="fields/lego is not in the data folder")
def test_nerf_synthetic() -> None:
    path = DATA / "fields" / "lego" / "transforms_train.json"
    model = read_transforms(path)
    content = json.loads(path.read_text())
    assert len(model.images) == len(content["frames"]) and len(model.cameras) == 1
    camera = model.cameras[0]
    assert (camera.width, camera.height) == (400, 400)
    assert abs(camera.focal_px - 200 / np.tan(content["camera_angle_x"] / 2)) < 1e-9
    assert camera.params[2:].tolist() == [199.5, 199.5]
    # The cameras stand on a sphere around the origin and look at it.
    in_cam = model.cams_from_world().apply(np.zeros((len(model.images), 3)))
    np.testing.assert_allclose(in_cam[:, 2], 4.031, atol=0.01)
    assert np.abs(in_cam[:, :2]).max() < 0.05
    assert all((path.parent / name).is_file() for name in model.images.name)


def valid() -> dict:
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    return {"w": 100, "h": 80, "fl_x": 90.0, "cx": 50, "cy": 40, "frames": [frame]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": None}, "the list of frames is missing"),
        ({"frames": [1]}, "the list of frames is missing"),
        ({"frames": [{}]}, "frame 0: the key 'file_path' is missing"),
        ({"frames": [{"file_path": "a.png"}]}, "frame 0: the key 'transform_matrix' is missing"),
        ({"frames": [{"file_path": "a", "transform_matrix": [[1]]}]}, "frame 0: transform_matrix is not 4x4"),
        (
            {"frames": [{"file_path": "a", "transform_matrix": (2 * np.eye(4)).tolist()}]},
            "does not contain a rotation",
        ),
        ({"fl_x": "wide"}, "frame 0: could not convert"),
        ({"fl_x": -3}, "focal length must be positive"),
        ({"fl_x": float("nan")}, "not a finite number"),
        ({"w": 0}, "invalid image size"),
        ({"w": None}, "frame 0"),
        ({"k4": 0.1}, "k4 of"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    (tmp_path / "t.json").write_text(json.dumps({**valid(), **change}))
    with pytest.raises(FileFormatError, match=message):
        read_transforms(tmp_path / "t.json")


def test_what_is_no_transforms_file(tmp_path: Path) -> None:
    for content, message in (
        ("{", "not JSON"),
        ("[" * 100000, "not JSON"),
        ("[]", "no JSON object"),
        ("\xff", "not"),
    ):
        (tmp_path / "t.json").write_bytes(content.encode("latin-1"))
        with pytest.raises(FileFormatError, match=message):
            read_transforms(tmp_path / "t.json")
    without_size = {k: v for k, v in valid().items() if k != "w"}
    (tmp_path / "t.json").write_text(json.dumps(without_size))
    with pytest.raises(FileFormatError, match="w and h are missing"):
        read_transforms(tmp_path / "t.json")
    without_focal = {k: v for k, v in valid().items() if k != "fl_x"}
    (tmp_path / "t.json").write_text(json.dumps(without_focal))
    with pytest.raises(FileFormatError, match="camera_angle_x"):
        read_transforms(tmp_path / "t.json")
