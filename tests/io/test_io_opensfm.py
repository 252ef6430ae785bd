"""OpenSfM's reconstruction.json and tracks.csv: there and back, in the form that OpenSfM writes, and what is refused."""

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.io import read_model, read_opensfm, write_opensfm
from epipole.scene import Cameras, Georeference, Reconstruction
from io_models import mappable_model, small_model

EXAMPLE = """
[
    {
        "cameras": {
            "v2 unknown unknown 3264 2448 perspective 0": {
                "projection_type": "perspective",
                "width": 3264,
                "height": 2448,
                "focal": 0.96,
                "k1": 0.013,
                "k2": 0.0006
            }
        },
        "shots": {
            "02.jpg": {
                "rotation": [0.0, 0.0, 1.5707963267948966],
                "translation": [1.0, 2.0, 3.0],
                "camera": "v2 unknown unknown 3264 2448 perspective 0",
                "orientation": 1,
                "capture_time": 0.0,
                "gps_dop": 5.0,
                "gps_position": [0.817, -4.225, 2.0],
                "vertices": [], "faces": [], "scale": 1.0, "covariance": [], "merge_cc": 0
            },
            "01.jpg": {
                "rotation": [0.0, 0.0, 0.0],
                "translation": [0.0, 0.0, 0.0],
                "camera": "v2 unknown unknown 3264 2448 perspective 0",
                "orientation": 1,
                "capture_time": 1384362365.0,
                "gps_dop": 5.0,
                "gps_position": [-5.594, -5.152, 2.0],
                "compass": {"angle": 270.0}
            }
        },
        "points": {
            "344": {"color": [69.0, 51.0, 37.0], "coordinates": [1.0, 2.0, 8.0]},
            "345": {"color": [66.0, 57.0, 52.0], "coordinates": [0.5, -1.0, 6.0]}
        },
        "biases": {},
        "reference_lla": {"latitude": 52.51926834404209, "longitude": 13.40070277785411, "altitude": 12.5}
    }
]
"""
TRACKS = (
    "OPENSFM_TRACKS_VERSION_v2\n"
    "02.jpg\t344\t2594\t0.0379803\t-0.0481853\t0.00155505\t155\t145\t143\t-1\t-1\n"
    "02.jpg\t1478\t765\t-0.150952\t0.0597917\t0.00100773\t70\t61\t54\t-1\t-1\n"
    "01.jpg\t344\t4691\t-0.5\t0.375\t0.0103128\t24\t20\t19\t-1\t-1\n"
    "other.jpg\t345\t3\t0.1\t0.2\t0.01\t24\t20\t19\t-1\t-1\n"
)


def write_example(folder: Path) -> Path:
    (folder / "reconstruction.json").write_text(EXAMPLE)
    (folder / "tracks.csv").write_text(TRACKS)
    return folder / "reconstruction.json"


def edited(folder: Path, edit: Callable[[list[Any]], Any]) -> Path:
    content = json.loads(EXAMPLE)
    edit(content)
    path = folder / "reconstruction.json"
    path.write_text(json.dumps(content))
    return path


def observations_of(model: Reconstruction) -> list[tuple]:
    """Point, image and pixel of every observation, without the numbers of the keypoints."""
    point, pixels = model.tracks.point_of_observation().tolist(), model.observed_pixels().round(6).tolist()
    names = [model.images.name[image] for image in model.tracks.image]
    return sorted(zip(point, names, map(tuple, pixels)))


def assert_same(found: Reconstruction, expected: Reconstruction) -> None:
    """Equal up to rounding, for the images that have a pose."""
    known = expected.is_registered()
    assert found.images.name == tuple(name for name, is_known in zip(expected.images.name, known) if is_known)
    matrices = expected.cams_from_world().as_matrix()[known]
    np.testing.assert_allclose(found.cams_from_world().as_matrix(), matrices, atol=1e-12)
    np.testing.assert_allclose(found.points.xyz_in_world, expected.points.xyz_in_world, atol=1e-12)
    np.testing.assert_array_equal(found.points.rgb, expected.points.rgb)
    assert observations_of(found) == observations_of(expected)
    for image, row in enumerate(np.flatnonzero(known)):
        one, other = (
            model.cameras[int(model.camera_of_image[k])] for model, k in ((found, image), (expected, row))
        )
        assert (one.width, one.height) == (other.width, other.height)
        points = expected.points.xyz_in_world + np.array([0.0, 0.0, 5.0])
        np.testing.assert_allclose(one.project(points), other.project(points), atol=1e-9)


@pytest.mark.parametrize("model", [small_model(), mappable_model()])
def test_there_and_back(tmp_path: Path, model: Reconstruction) -> None:
    write_opensfm(model, tmp_path / "reconstruction.json")
    found = read_model(tmp_path)
    assert_same(found, model)
    assert found.georeference is None
    errors = model.reprojection_errors_px()
    assert found.mean_reprojection_error_px() == pytest.approx(float(errors.mean()), abs=1e-9)


def test_rigs_times_and_the_position_on_earth_stay(tmp_path: Path) -> None:
    model = small_model()
    times = np.array([10.5, 11.5, np.nan, 13.0, 14.0, 15.0])
    model = replace(
        model, frames=replace(model.frames, timestamp_s=times), georeference=Georeference(48.1, 11.5, 520.0)
    )
    write_opensfm(model, tmp_path / "reconstruction.json")
    found = read_opensfm(tmp_path / "reconstruction.json")
    assert found.georeference == model.georeference
    np.testing.assert_array_equal(found.frames.timestamp_s, times[:5])
    assert np.diff(found.rigs.sensor_offsets).tolist() == [2, 1]
    np.testing.assert_allclose(
        found.rigs.cam_from_rig.as_matrix(), model.rigs.cam_from_rig.as_matrix(), atol=1e-12
    )
    assert found.images.frame.tolist() == model.images.frame[:8].tolist()


@pytest.mark.parametrize(
    ("model", "params", "expected"),
    [
        (CameraModel.SIMPLE_PINHOLE, [500.0, 319.5, 239.5], "perspective"),
        (CameraModel.RADIAL, [500.0, 319.5, 239.5, 0.1, -0.02], "perspective"),
        (CameraModel.RADIAL, [500.0, 320.5, 239.5, 0.1, -0.02], "brown"),
        (CameraModel.OPENCV, [500.0, 510.0, 319.5, 239.5, 0.1, -0.02, 1e-3, 2e-3], "brown"),
        (CameraModel.FULL_OPENCV, [500.0, 510.0, 319.5, 239.5, 0.1, 0.0, 1e-3, 0.0, 0.01, 0, 0, 0], "brown"),
        (CameraModel.OPENCV_FISHEYE, [300.0, 300.0, 319.5, 239.5, 0.1, 0.02, 0.0, 0.0], "fisheye"),
        (CameraModel.OPENCV_FISHEYE, [300.0, 301.0, 319.5, 239.5, 0.1, 0.02, 0.01, 0.1], "fisheye_opencv"),
    ],
)
def test_cameras(tmp_path: Path, model: CameraModel, params: list[float], expected: str) -> None:
    camera = Camera(model, 640, 480, np.array(params))
    before = replace(mappable_model(), cameras=Cameras.from_list([camera]))
    write_opensfm(before, tmp_path / "r.json")
    (entry,) = json.loads((tmp_path / "r.json").read_text())[0]["cameras"].values()
    assert entry["projection_type"] == expected
    assert_same(read_opensfm(tmp_path / "r.json"), before)


def test_a_file_in_the_form_of_opensfm(tmp_path: Path) -> None:
    """Rotation vectors from world to camera; positions from the image center, in units of the longer side."""
    model = read_opensfm(write_example(tmp_path))
    assert model.images.name == ("02.jpg", "01.jpg")
    np.testing.assert_allclose(model.cameras[0].params, [0.96 * 3264, 1631.5, 1223.5, 0.013, 0.0006])
    turned = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(model.cams_from_world().as_matrix()[0], turned, atol=1e-15)
    assert np.isnan(model.frames.timestamp_s[0]) and model.frames.timestamp_s[1] == 1384362365.0
    assert model.georeference == Georeference(52.51926834404209, 13.40070277785411, 12.5)
    # The keypoint of a track without a point stays; those of images that are not in the file do not.
    assert np.diff(model.images.keypoint_offsets).tolist() == [2, 1]
    assert model.tracks.image.tolist() == [0, 1] and np.diff(model.tracks.offsets).tolist() == [2, 0]
    # The corner of the image, half a pixel before the center of its first pixel and below that of its last.
    np.testing.assert_allclose(model.images.keypoints_of(1), [[-0.5, 2447.5]])
    pixel = np.array([0.0379803 * 3264 + 1631.5, -0.0481853 * 3264 + 1223.5])
    np.testing.assert_allclose(model.images.keypoints_of(0)[model.tracks.keypoint[0]], pixel)


@pytest.mark.parametrize("header", ["", "OPENSFM_TRACKS_VERSION_v1\n"])
def test_earlier_tracks(tmp_path: Path, header: str) -> None:
    write_example(tmp_path)
    size = "0.001\t" if header else ""
    (tmp_path / "tracks.csv").write_text(f"{header}01.jpg\t345\t7\t0.25\t-0.125\t{size}1\t2\t3\n")
    model = read_opensfm(tmp_path / "reconstruction.json")
    np.testing.assert_allclose(model.observed_pixels(), [[0.25 * 3264 + 1631.5, -0.125 * 3264 + 1223.5]])


def test_without_tracks_there_are_points(tmp_path: Path) -> None:
    write_example(tmp_path)
    (tmp_path / "tracks.csv").unlink()
    model = read_opensfm(tmp_path / "reconstruction.json")
    assert len(model.points) == 2 and len(model.tracks.image) == 0


def test_the_largest_of_several_is_read(tmp_path: Path) -> None:
    def add(content: list[Any]) -> None:
        small = {"cameras": content[0]["cameras"], "shots": {}, "points": {}}
        small["shots"]["a.jpg"] = {**content[0]["shots"]["01.jpg"], "new": 1}
        content.insert(0, small)

    path = edited(tmp_path, add)
    with pytest.warns(RuntimeWarning, match=r"2 disconnected reconstructions; only the one with the most"):
        assert read_opensfm(path).images.name == ("02.jpg", "01.jpg")


def test_what_is_left_out_is_named(tmp_path: Path) -> None:
    def edit(content: list[Any]) -> None:
        content[0]["shots"]["01.jpg"]["mood"] = "fine"
        content[0]["pano_shots"] = {"p.jpg": {}}

    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        read_model(edited(tmp_path, edit))
    texts = " ".join(str(each.message) for each in found)
    assert "panoramas are not read (1 in pano_shots)" in texts and "shots: mood" in texts


CAMERA, IMAGE = "v2 unknown unknown 3264 2448 perspective 0", "01.jpg"


def camera(**values: Any) -> Callable[[list[Any]], None]:
    return lambda content: content[0]["cameras"][CAMERA].update(values)


def image(**values: Any) -> Callable[[list[Any]], None]:
    return lambda content: content[0]["shots"][IMAGE].update(values)


def point(**values: Any) -> Callable[[list[Any]], None]:
    return lambda content: content[0]["points"]["344"].update(values)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (camera(projection_type="dual"), "unknown projection_type 'dual'; supported are perspective, "),
        (camera(projection_type="equirectangular"), "spherical"),
        (camera(k3=0.01), "k3 = 0.01 of a perspective camera is not supported"),
        (
            camera(projection_type="fisheye62", focal_x=1.0, focal_y=1.0, p1=0.1),
            "focal = 0.96 of a fisheye62",
        ),
        (camera(width=0), "invalid image size width = 0"),
        (camera(focal="long"), "focal is not a number, got 'long'"),
        (camera(focal=-1.0), r"camera 'v2 unknown"),
        (image(camera="b"), "image '01.jpg' has the camera 'b', which does not exist"),
        (image(rotation=[1.0, 2.0]), "the rotation of image '01.jpg' is not three numbers"),
        (image(rotation=[1e9, 0.0, 0.0]), "too long"),
        (image(translation=None), "the translation of image '01.jpg' is not three numbers"),
        (point(coordinates=[1.0, 2.0]), "three coordinates and a color"),
        (point(color=[300.0, 0.0, 0.0]), "a color outside 0 to 255"),
        (lambda content: content[0].update(points=[]), "points is not an object"),
        (lambda content: content[0].update(reference_lla={"latitude": 1.0}), "the key longitude is missing"),
        (
            lambda content: content[0].update(
                reference_lla={"latitude": 100.0, "longitude": 0.0, "altitude": 0.0}
            ),
            "not a latitude",
        ),
        (lambda content: content[0].pop("shots"), "reconstruction 0 has no cameras and shots"),
        (lambda content: content.clear(), "no reconstruction with images"),
        (lambda content: content.append(3), "not a list of reconstructions"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, edit: Callable[[list[Any]], Any], words: str) -> None:
    with pytest.raises(FileFormatError, match=words) as caught:
        read_opensfm(edited(tmp_path, edit))
    assert "reconstruction.json" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("OPENSFM_TRACKS_VERSION_v3\n", "line 1: unknown version of tracks"),
        (TRACKS.replace("\t-1\t-1\n", "\n"), "line 2: expected 11 values separated by tabs, got 9"),
        (TRACKS.replace("2594", "x"), "line 2: the feature 'x' is not a number"),
        (TRACKS.replace("-0.0481853", "x"), "a position is not a number"),
        (TRACKS.replace("-0.0481853", "nan"), "a position is not finite"),
    ],
)
def test_wrong_tracks_are_refused(tmp_path: Path, text: str, words: str) -> None:
    path = write_example(tmp_path)
    (tmp_path / "tracks.csv").write_text(text)
    with pytest.raises(FileFormatError, match=words):
        read_opensfm(path)


def test_a_rig_that_contradicts_its_images_is_refused(tmp_path: Path) -> None:
    write_opensfm(small_model(), tmp_path / "reconstruction.json")
    content = json.loads((tmp_path / "reconstruction.json").read_text())
    content[0]["shots"]["b1.jpg"]["translation"][0] += 0.1
    (tmp_path / "reconstruction.json").write_text(json.dumps(content))
    with pytest.raises(
        FileFormatError, match=r"the pose of the image 'b1\.jpg' contradicts the pose of its rig"
    ):
        read_opensfm(tmp_path / "reconstruction.json")


def test_what_the_format_cannot_store_is_refused(tmp_path: Path) -> None:
    rational = np.array([500.0, 500.0, 320.0, 240.0, 0, 0, 0, 0, 0, 0.1, 0, 0])
    cameras = Cameras.from_list([Camera(CameraModel.FULL_OPENCV, 640, 480, rational)])
    with pytest.raises(ConfigError, match="no rational camera model"):
        write_opensfm(replace(mappable_model(), cameras=cameras), tmp_path / "reconstruction.json")
    names = ("a\tb.jpg", *mappable_model().images.name[1:])
    model = mappable_model()
    with pytest.raises(ConfigError, match="cannot be written to a file of tracks"):
        write_opensfm(replace(model, images=replace(model.images, name=names)), tmp_path / "r.json")
    assert not list(tmp_path.iterdir())
