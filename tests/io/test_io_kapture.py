"""Kapture 1.1: there and back, in the form that kapture writes, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from epipole.cameras import CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.io import read_kapture, read_model, write_kapture
from epipole.scene import Reconstruction
from io_models import mappable_model, small_model

HEAD = "# kapture format: 1.1\n"
EXAMPLE = {
    "sensors/sensors.txt": f"""{HEAD}# sensor_id, name, sensor_type, [sensor_params]+
cam01, Hero7, camera, OPENCV, 800, 600, 610, 600, 400.5, 300, 0.01, 0., 0., 0.
cam02, , camera, SIMPLE_PINHOLE, 640, 480, 500, 320, 240
phone, gs9, camera, UNKNOWN_CAMERA, 2988, 5312
lidar0, , lidar
gps1, , gnss, EPSG:4326
""",
    "sensors/rigs.txt": f"""{HEAD}# rig_id, sensor_id, qw, qx, qy, qz, tx, ty, tz
rig, cam01, 1, 0, 0, 0, 1, 0, 0
rig, cam02, 0.7071067811865476, 0, 0, 0.7071067811865476, 0, 2, 0
rig, lidar0, 1, 0, 0, 0, -10, 0, 0
""",
    "sensors/trajectories.txt": f"""{HEAD}# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz
0000, rig, 1, 0, 0, 0, 0, 0, 5
0001,rig,0,1,0,0,0,0,6
0002, cam01, 1, 0, 0, 0, 7, 8, 9
0003, cam01, , , , , 7, 8, 9
""",
    "sensors/records_camera.txt": f"""{HEAD}# timestamp, device_id, image_path
0000, cam02, mapping/cam_02/00001.jpg
0000, cam01, mapping/cam_01/00001.jpg
0001, cam01, mapping/cam_01/00003.jpg
0002, cam01, query/1.jpg
0003, cam01, query/2.jpg
0009, phone, query/3.jpg
""",
    "reconstruction/points3d.txt": f"{HEAD}# X, Y, Z, [R, G, B]\n2.5, 4.25, 1.75, 0, 10, 255\n1e0,2,3,1.6e1,2,3\n",
    "reconstruction/observations.txt": f"""{HEAD}# point3d_id, keypoints_type, [image_path, feature_id]*
0, r2d2, mapping/cam_01/00001.jpg, 1, mapping/cam_02/00001.jpg, 0, query/2.jpg, 9
1, r2d2, query/1.jpg, 0
1, d2_tf, query/1.jpg, 7
""",
    "reconstruction/keypoints/r2d2/keypoints.txt": f"{HEAD}# name, dtype, dsize\nr2d2, float32, 3\n",
}
KEYPOINTS = {
    "mapping/cam_01/00001.jpg": [[1.0, 2.0, 0.5], [100.5, 200.5, 0.5]],
    "mapping/cam_02/00001.jpg": [[3.0, 4.0, 1.0]],
    "query/1.jpg": [[0.0, 0.0, 1.0]],
}


def written(folder: Path, file: str = "", old: str = "", new: str = "") -> Path:
    for name, text in EXAMPLE.items():
        assert name != file or old in text
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text.replace(old, new) if name == file and old else text)
    for name, values in KEYPOINTS.items():
        path = folder / "reconstruction" / "keypoints" / "r2d2" / f"{name}.kpt"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(np.array(values, "<f4").tobytes())
    return folder


def test_a_dataset_in_the_form_of_kapture(tmp_path: Path) -> None:
    with pytest.warns(RuntimeWarning) as caught:
        model = read_model(written(tmp_path))
    texts = sorted(str(each.message) for each in caught)
    assert texts[0].endswith("images without a pose are not read: 2")
    assert texts[1].endswith("keypoints of other types than r2d2 are not read")
    names = (
        "mapping/cam_02/00001.jpg",
        "mapping/cam_01/00001.jpg",
        "mapping/cam_01/00003.jpg",
        "query/1.jpg",
    )
    assert model.images.name == names
    one, two = (model.cameras[int(model.camera_of_image[image])] for image in (0, 1))
    assert (one.model, two.model) == (CameraModel.SIMPLE_PINHOLE, CameraModel.OPENCV)
    np.testing.assert_allclose(one.params, [500, 319.5, 239.5])
    np.testing.assert_allclose(two.params, [610, 600, 400.0, 299.5, 0.01, 0, 0, 0])
    found = model.cams_from_world()
    # cam02 is turned by 90 degrees about z in the rig, which is 5 ahead of the world.
    np.testing.assert_allclose(found.rotation[0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(found.translation, [[0, 2, 5], [1, 0, 5], [1, 0, 6], [7, 8, 9]], atol=1e-12)
    np.testing.assert_allclose(found.rotation[2], np.diag([1.0, -1.0, -1.0]), atol=1e-12)
    assert model.images.frame.tolist() == [0, 0, 1, 2]
    assert np.diff(model.rigs.sensor_offsets).tolist() == [2, 1]
    assert model.points.rgb.tolist() == [[0, 10, 255], [16, 2, 3]]
    # (0, 0) is the corner of the image; keypoints without a point stay.
    assert np.diff(model.images.keypoint_offsets).tolist() == [1, 2, 0, 1]
    assert model.tracks.offsets.tolist() == [0, 2, 3] and model.tracks.image.tolist() == [0, 1, 3]
    np.testing.assert_allclose(model.observed_pixels(), [[2.5, 3.5], [100, 200], [-0.5, -0.5]])


@pytest.mark.parametrize("model", [small_model(), mappable_model()])
def test_there_and_back(tmp_path: Path, model: Reconstruction) -> None:
    write_kapture(model, tmp_path / "k")
    found = read_kapture(tmp_path / "k")
    known = np.flatnonzero(model.is_registered())
    assert found.images.name == tuple(model.images.name[k] for k in known)
    matrices = model.cams_from_world().as_matrix()[known]
    np.testing.assert_allclose(found.cams_from_world().as_matrix(), matrices, atol=1e-12)
    np.testing.assert_allclose(
        found.rigs.cam_from_rig.as_matrix(), model.rigs.cam_from_rig.as_matrix(), atol=1e-12
    )
    assert found.images.frame.tolist() == model.images.frame[known].tolist()
    for image, row in enumerate(known):
        one, other = (
            each.cameras[int(each.camera_of_image[k])] for each, k in ((found, image), (model, row))
        )
        assert (one.model, one.width, one.height) == (other.model, other.width, other.height)
        np.testing.assert_allclose(one.params, other.params, atol=1e-12)
        np.testing.assert_allclose(
            found.images.keypoints_of(image), model.images.keypoints_of(row), atol=1e-12
        )
    np.testing.assert_array_equal(found.points.xyz_in_world, model.points.xyz_in_world)
    np.testing.assert_array_equal(found.points.rgb, model.points.rgb)
    for name in ("offsets", "image", "keypoint"):
        np.testing.assert_array_equal(getattr(found.tracks, name), getattr(model.tracks, name))


def test_without_points_there_are_cameras_and_keypoints(tmp_path: Path) -> None:
    written(tmp_path)
    for name in (POINTS, SEEN):
        (tmp_path / name).unlink()
    with pytest.warns(RuntimeWarning):
        model = read_kapture(tmp_path)
    assert len(model.images) == 4 and len(model.points) == len(model.tracks.image) == 0
    assert np.diff(model.images.keypoint_offsets).tolist() == [1, 2, 0, 1]
    (tmp_path / KIND).unlink()
    with pytest.warns(RuntimeWarning):
        assert len(read_kapture(tmp_path).images.keypoints_px) == 0


def test_packed_keypoints_are_named(tmp_path: Path) -> None:
    (written(tmp_path) / "reconstruction" / "keypoints" / "r2d2" / "keypoints.tar").touch()
    with pytest.warns(RuntimeWarning) as caught:
        model = read_kapture(tmp_path)
    assert len(model.points) == 2 and len(model.tracks.image) == 0
    assert any("the keypoints are packed in r2d2/keypoints.tar" in str(each.message) for each in caught)


SENSORS, RIGS, PATHS = "sensors/sensors.txt", "sensors/rigs.txt", "sensors/trajectories.txt"
RECORDS, SEEN = "sensors/records_camera.txt", "reconstruction/observations.txt"
POINTS, KIND = "reconstruction/points3d.txt", "reconstruction/keypoints/r2d2/keypoints.txt"


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        (SENSORS, "1.1", "1.0", "version 1.0 of the format is not supported"),
        (SENSORS, "OPENCV,", "FOV,", "line 3: unknown camera model FOV"),
        (SENSORS, "OPENCV,", "UNKNOWN_CAMERA,", "line 3: unknown camera model UNKNOWN_CAMERA"),
        (SENSORS, "0.01, 0., 0., 0.", "0.01, 0., 0.", "line 3: camera model 4 has 8 parameters, got 7"),
        (SENSORS, "800, 600", "0, 600", "line 3: invalid image size 0x600"),
        (SENSORS, "800, 600", "8e2, 600", "the width is not a whole number, got '8e2'"),
        (SENSORS, "610", "nan", "a number is not finite"),
        (SENSORS, "cam01, Hero7, camera", "cam01, Hero7", "sensor 'cam01' is not a camera"),
        (RIGS, "1, 0, 0\nrig, cam02", "1, 0\nrig, cam02", "line 3: a pose needs 7 values"),
        (RIGS, "rig, cam02", "rig, cam01", "sensor 'cam01' has no pose, or two poses"),
        (RIGS, "rig, cam02", "cam01, cam02", "rig 'cam01' is also a sensor"),
        (PATHS, "0000, rig, 1,", "0000, rig, 9,", "the quaternion does not have length 1"),
        (PATHS, "0000, rig, 1,", "0000, rig, x,", "line 3: not numbers"),
        (PATHS, "0000, rig", "now, rig", "the timestamp is not a whole number, got 'now'"),
        (PATHS, "0001,rig", "0000,rig", "device 'rig' has two poses at 0"),
        (
            RECORDS,
            "0000, cam02, mapping/cam_02/00001.jpg",
            "0000, cam02",
            "expected a timestamp, a device and an",
        ),
        (RECORDS, "query/1.jpg", "mapping/cam_01/00003.jpg", "two images have the name"),
        (POINTS, "2.5, 4.25, 1.75, 0,", "2.5, 4.25, 1.75,", "a point needs x, y, z, or also r, g, b, got 5"),
        (POINTS, "255", "256", "a color is not from 0 to 255"),
        (POINTS, "2.5", "inf", "a number is not finite"),
        (SEEN, "1, r2d2", "2, r2d2", "point 2 does not exist"),
        (
            SEEN,
            "1, r2d2, query/1.jpg, 0",
            "1, r2d2, query/1.jpg",
            "an image without the number of its keypoint",
        ),
        (
            SEEN,
            "1, r2d2, query/1.jpg, 0",
            "1, r2d2, query/1.jpg, 1",
            "keypoint 1 of query/1.jpg does not exist",
        ),
        (SEEN, "query/1.jpg, 0", "mapping/cam_02/00001.jpg, 0", "belongs to two points"),
        (SEEN, "r2d2", "../r2d2", "does not name a file inside"),
        (KIND, "float32", "int8", "of type 'int8' are not supported"),
        (KIND, "3\n", "4\n", "bytes are not keypoints of 4 values"),
        (KIND, "r2d2, float32, 3\n", "", "expected one line, got 0"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, file: str, old: str, new: str, words: str) -> None:
    written(tmp_path, file, old, new)
    with pytest.raises(FileFormatError, match=words) as caught:
        read_kapture(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_a_dataset_without_poses_is_refused(tmp_path: Path) -> None:
    (written(tmp_path) / PATHS).write_text(HEAD)
    with pytest.raises(FileFormatError, match="none of the images has a pose"):
        read_kapture(tmp_path)
    (tmp_path / PATHS).unlink()
    with pytest.raises(FileFormatError, match=r"trajectories\.txt: it does not exist"):
        read_kapture(tmp_path)


def test_names_that_the_format_cannot_store_are_refused(tmp_path: Path) -> None:
    model = mappable_model()
    for name in ("a,b.jpg", " a.jpg", "a\nb.jpg", "../a.jpg"):
        images = replace(model.images, name=(name, *model.images.name[1:]))
        with pytest.raises(ConfigError, match="cannot be written to a table"):
            write_kapture(replace(model, images=images), tmp_path / "k")
    assert not list(tmp_path.iterdir())
