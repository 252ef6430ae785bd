"""Calibration files: words for camera models are understood or refused; the forms of Kalibr, OpenVINS, camodocal and mrcal."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from epipole.cameras import CameraModel
from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.io.calibration.files import read_calibration, read_stereo_rig
from epipole.io.sequences.imu_logs import read_camera_from_imu

FAULTS = Path(__file__).parents[2].parent / "shared" / "data" / "faults"
POINTS = np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 1.2], [0.1, 0.6, 0.9]])
K = np.array([[404.0, 0.0, 320.5], [0.0, 404.7, 240.25], [0.0, 0.0, 1.0]])
COEFFICIENTS = [0.17, -0.03, 0.004, -0.0007]
MOTION = Rigid3.exp(np.array([-0.12, 0.002, 0.004, 0.01, -0.03, 0.005]))
CAM0_FROM_IMU = Rigid3.exp(np.array([0.05, -0.04, 0.01, 1.2, -1.1, 1.0]))


def matrix(values: Any) -> dict[str, Any]:
    array = np.asarray(values, np.float64)
    return {"rows": array.shape[0], "cols": array.shape[1], "data": array.ravel().tolist()}


def ros(d: list[float] = COEFFICIENTS, **own: Any) -> dict[str, Any]:
    return {
        "image_width": 640,
        "image_height": 480,
        "camera_name": "left",
        "camera_matrix": matrix(K),
        "distortion_coefficients": matrix([d]),
        "rectification_matrix": matrix(np.eye(3)),
        "projection_matrix": matrix(np.column_stack([K, np.zeros(3)])),
    } | own


def written(tmp_path: Path, content: dict[str, Any] | str, name: str = "c.yaml") -> Path:
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def opencv_fisheye(d: list[float] = COEFFICIENTS) -> np.ndarray:
    return cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), K, np.array(d))[0].reshape(
        -1, 2
    )


def opencv_plane(d: list[float] = COEFFICIENTS) -> np.ndarray:
    return cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), K, np.array(d))[0].reshape(-1, 2)


FISHEYE_WORDS = (
    {"camera_model": "fisheye"},
    {"distortion_model": "fisheye"},
    {"distortion_model": "equidistant"},
    {"distortion_model": "Kannala-Brandt"},
    {"camera_model": "pinhole", "distortion_model": "equidistant"},
    {"camera_model": "pinhole-equi"},
    {"camera_model": "fisheye", "distortion_model": "equidistant"},
    {"fisheye_model": 1},
    {"camera_type": "fisheye"},
    {"model": "Fisheye"},
    {"distortion": "equidistant", "model": "D435"},
)
PLANE_WORDS = (
    {},
    {"distortion_model": "plumb_bob"},
    {"distortion_model": "rational_polynomial"},
    {"camera_model": "pinhole"},
    {"camera_model": "pinhole", "distortion_model": "radtan", "fisheye_model": 0},
    {"camera_model": "pinhole-radtan"},
    {"camera_type": "color", "model": "C920", "lens": "wide", "camera_model_name": "C920", "type": "usb"},
)


@pytest.mark.parametrize("words", FISHEYE_WORDS, ids=str)
def test_fisheye_words_mean_the_fisheye(tmp_path, words) -> None:
    pair = {
        "M1": matrix(K),
        "D1": COEFFICIENTS,
        "M2": matrix(K),
        "D2": COEFFICIENTS,
        "R": matrix(MOTION.rotation),
    }
    pair |= {"T": MOTION.translation.tolist(), "image_width": 640, "image_height": 480}
    for content in (ros(**words), pair | words):
        camera = read_calibration(written(tmp_path, content)).cameras[-1]
        assert camera.model is CameraModel.OPENCV_FISHEYE
        np.testing.assert_allclose(camera.project(POINTS), opencv_fisheye(), atol=1e-9)


@pytest.mark.parametrize("words", PLANE_WORDS, ids=str)
def test_other_words_mean_browns_coefficients(tmp_path, words) -> None:
    camera = read_calibration(written(tmp_path, ros(**words))).cameras[0]
    np.testing.assert_allclose(camera.project(POINTS), opencv_plane(), atol=1e-9)


def test_eight_coefficients_are_the_rational_polynomial(tmp_path) -> None:
    d = [0.3, 0.1, 1e-3, -2e-3, 0.02, 0.5, 0.1, 0.01]
    camera = read_calibration(written(tmp_path, ros(d, distortion_model="rational_polynomial"))).cameras[0]
    np.testing.assert_allclose(camera.project(POINTS), opencv_plane(d), atol=1e-9)


@pytest.mark.skipif(not FAULTS.is_dir(), reason="the folder faults is not in the data folder")
def test_a_ros_file_that_was_read_wrongly() -> None:
    camera = read_calibration(FAULTS / "ros_ost_camera_model_fisheye.yaml").cameras[0]
    assert camera.model is CameraModel.OPENCV_FISHEYE
    assert camera.params[4:].tolist() == [0.1757, -0.0318, 0.0004, -0.0007]


@pytest.mark.parametrize("words", [{"distortion_model": "none"}, {"camera_model": "pinhole-none"}], ids=str)
def test_no_distortion(tmp_path, words) -> None:
    without = ros(**words)
    del without["distortion_coefficients"]
    for content in (ros([0.0] * 5, **words), ros([], **words), without):
        camera = read_calibration(written(tmp_path, content)).cameras[0]
        np.testing.assert_allclose(camera.project(POINTS), opencv_plane([0.0] * 4), atol=1e-9)
    with pytest.raises(FileFormatError, match="none, but distortion coefficients are not zero"):
        read_calibration(written(tmp_path, ros(**words)))


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"distortion_model": "foo"}, "unknown distortion_model foo"),
        ({"camera_model": "omni"}, "unknown camera_model omni"),
        ({"camera_model": "pinhole-fov"}, "unknown camera_model pinhole-fov"),
        ({"distortion_model": "thin_prism"}, "unknown distortion_model thin_prism"),
        ({"distortion_model": "inverse_brown_conrady"}, "unknown distortion_model"),
        ({"distortion_model": 3}, "unknown distortion_model 3"),
        ({"lens_type": "anamorphic"}, "unknown lens_type anamorphic"),
        ({"camera_model": "equirectangular"}, r"spherical \(equirectangular\)"),
        ({"camera_model": "fisheye", "distortion_model": "plumb_bob"}, "contradicts distortion_model plumb_bob"),
        ({"fisheye_model": 1, "distortion_model": "plumb_bob"}, "contradicts"),
        ({"fisheye_model": 0, "distortion_model": "fisheye"}, "contradicts"),
        ({"model": "omni"}, "unknown model omni"),
        ({"camera_type": "ds"}, "unknown camera_type ds"),
        ({"distortion_model_left": "fov"}, "unknown distortion_model_left fov"),
        ({"projection": "equirectangular"}, "spherical"),
        ({"xi": 1.2}, "xi belongs to an omnidirectional camera"),
        ({"binning_x": 2}, "binning_x = 2 is not supported"),
        ({"roi": {"x_offset": 0, "y_offset": 4, "height": 10, "width": 10}}, "y_offset = 4"),
        ({"distortion_coefficients": matrix([[0.1] * 12])}, "thin prism"),
        ({"distortion_coefficients": matrix([[0.1] * 3])}, "3 distortion coefficients"),
        ({"distortion_coefficients": matrix([[0.1] * 5]), "distortion_model": "fisheye"}, "5 distortion coefficients"),
    ],
)  # fmt: skip
def test_words_that_are_not_known_are_refused_by_name(tmp_path, own, message) -> None:
    with pytest.raises(FileFormatError, match=message):
        read_calibration(written(tmp_path, ros(**own)))
    pair = {
        "K1": matrix(K),
        "D1": COEFFICIENTS,
        "K2": matrix(K),
        "D2": COEFFICIENTS,
        "R": matrix(np.eye(3)),
        "T": [1, 0, 0],
    }
    if next(iter(own)) not in ("distortion_coefficients", "binning_x", "roi"):
        with pytest.raises(FileFormatError, match=message):
            read_calibration(written(tmp_path, pair | own), size=(640, 480))


@pytest.mark.parametrize("entry", [(0, 1), (1, 0), (2, 0), (2, 2)])
def test_camera_matrices_with_other_numbers_are_refused(tmp_path, entry) -> None:
    bent = K.copy()
    bent[entry] += 3.0
    with pytest.raises(FileFormatError, match="camera matrix"):
        read_calibration(written(tmp_path, ros(camera_matrix=matrix(bent))))
    one = (
        " ".join(map(str, bent.ravel()[:3])),
        " ".join(map(str, bent.ravel()[3:6])),
        " ".join(map(str, bent.ravel()[6:])),
    )
    text = (
        "\n".join(f"cam{k}=[{'; '.join(one)}]" for k in range(2)) + "\nbaseline=0.1\nwidth=640\nheight=480\n"
    )
    with pytest.raises(FileFormatError, match="camera matrix"):
        read_calibration(written(tmp_path, text, "calib.txt"))


def test_a_ros_pair_of_fisheyes(tmp_path) -> None:
    P = np.column_stack([K, [-404.0 * 0.1, 0, 0]])
    left, right = (
        written(tmp_path, ros(camera_model="fisheye", projection_matrix=matrix(p)), name)
        for name, p in (("l.yaml", np.column_stack([K, np.zeros(3)])), ("r.yaml", P))
    )
    rig = read_stereo_rig(left, right)
    assert {rig.left.model, rig.right.model} == {CameraModel.OPENCV_FISHEYE}


def test_opencvs_xml_with_words(tmp_path) -> None:
    text = (
        '<?xml version="1.0"?><opencv_storage><image_width>640</image_width><image_height>480</image_height>'
        "<camera_matrix><rows>3</rows><cols>3</cols><dt>d</dt><data>404 0 320 0 404 240 0 0 1</data></camera_matrix>"
        "<distortion_coefficients><rows>1</rows><cols>4</cols><dt>d</dt><data>.1 0 0 .2</data></distortion_coefficients>"
        "<distortion_model>{}</distortion_model></opencv_storage>"
    )
    camera = read_calibration(written(tmp_path, text.format("fisheye"), "c.xml")).cameras[0]
    assert camera.model is CameraModel.OPENCV_FISHEYE
    with pytest.raises(FileFormatError, match="unknown distortion_model fov"):
        read_calibration(written(tmp_path, text.format("fov"), "c.xml"))


def test_a_key_that_is_there_twice_is_refused(tmp_path) -> None:
    text = yaml.safe_dump(ros()) + "distortion_model: plumb_bob\ndistortion_model: fisheye\n"
    with pytest.raises(FileFormatError, match="duplicate key distortion_model"):
        read_calibration(written(tmp_path, text))
    text = "<?xml version='1.0'?><opencv_storage><a>1</a><a>2</a></opencv_storage>"
    with pytest.raises(FileFormatError, match="duplicate key a"):
        read_calibration(written(tmp_path, text, "c.xml"))
    merged = "base: &base {k: 1}\nboth:\n  <<: *base\n  m: 2\n" + yaml.safe_dump(ros())
    assert read_calibration(written(tmp_path, merged)).cameras[0].width == 640


# Chains of cameras.

LINK = {
    "cam_overlaps": [1],
    "camera_model": "pinhole",
    "distortion_coeffs": COEFFICIENTS,
    "distortion_model": "radtan",
    "intrinsics": [404.0, 404.7, 320.5, 240.25],
    "resolution": [640, 480],
    "rostopic": "/cam0/image_raw",
    "rnoise": 1.0,
    "timeshift_cam_imu": 0.0044,
}
HEADERS = (
    "",
    "%YAML:1.0\n---\n",
    "%YAML:1.0 # need to specify the file type at the top!\n\n",
    "\n# by hand\n%YAML:1.0\n",
)


def chain(**of_second: Any) -> dict[str, Any]:
    return {"cam0": LINK | {"T_cam_imu": CAM0_FROM_IMU.as_matrix().tolist()}, "cam1": LINK | of_second}


def rows(motion: Rigid3) -> list[list[float]]:
    return motion.as_matrix().tolist()


@pytest.mark.parametrize("header", HEADERS)
@pytest.mark.parametrize(
    "of_second",
    [
        {"T_cn_cnm1": rows(MOTION)},
        {"T_cam_imu": rows(MOTION @ CAM0_FROM_IMU)},
        {"T_imu_cam": rows((MOTION @ CAM0_FROM_IMU).inverse())},
        {"T_imu_cam": matrix((MOTION @ CAM0_FROM_IMU).inverse().as_matrix()) | {"dt": "d"}},
        {"T_cn_cnm1": rows(MOTION), "T_cam_imu": rows(MOTION @ CAM0_FROM_IMU)},
        {"T_cn_cnm1": np.round(MOTION.as_matrix(), 4).tolist()},
    ],
    ids=["chained", "T_cam_imu", "T_imu_cam", "matrix", "both", "four digits"],
)
def test_chains_of_kalibr_and_openvins(tmp_path, header, of_second) -> None:
    path = written(tmp_path, header + yaml.safe_dump(chain(**of_second)))
    rig = read_stereo_rig(path)
    np.testing.assert_allclose(rig.right_from_left.as_matrix(), MOTION.as_matrix(), atol=2e-4)
    np.testing.assert_allclose(rig.left.project(POINTS), opencv_plane(), atol=1e-9)
    np.testing.assert_allclose(read_camera_from_imu(path).as_matrix(), CAM0_FROM_IMU.as_matrix(), atol=1e-12)


@pytest.mark.parametrize(
    ("words", "project"),
    [
        ({"distortion_model": "equidistant"}, opencv_fisheye),
        ({"distortion_model": "equi"}, opencv_fisheye),
        ({"camera_model": "pinhole-equi", "distortion_model": ...}, opencv_fisheye),
        ({"camera_model": "pinhole-radtan", "distortion_model": ...}, opencv_plane),
        ({"distortion_model": "radial-tangential"}, opencv_plane),
        ({"distortion_model": "none", "distortion_coeffs": []}, lambda: opencv_plane([0.0] * 4)),
        ({"distortion_model": "none", "distortion_coeffs": ...}, lambda: opencv_plane([0.0] * 4)),
        ({"distortion_model": ..., "distortion_coeffs": ...}, lambda: opencv_plane([0.0] * 4)),
    ],
)  # fmt: skip
@pytest.mark.parametrize("is_alone", [True, False])
def test_camera_models_of_chains(tmp_path, words, project, is_alone) -> None:
    own = {key: value for key, value in (LINK | words).items() if value is not ...}
    camera = read_calibration(written(tmp_path, own if is_alone else {"cam0": own})).cameras[0]
    np.testing.assert_allclose(camera.project(POINTS), project(), atol=1e-9)


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"camera_model": "omni", "intrinsics": [0.8, 833.0, 830.3, 373.8, 253.7]}, "unknown camera_model omni"),
        ({"camera_model": "ds", "intrinsics": [0.1] * 6, "distortion_model": "none", "distortion_coeffs": []}, "camera_model ds"),
        ({"camera_model": "eucm", "intrinsics": [0.1] * 6}, "camera_model eucm"),
        ({"camera_model": "omni-radtan"}, "camera_model omni-radtan"),
        ({"distortion_model": "fov", "distortion_coeffs": [0.96]}, "unknown distortion_model fov"),
        ({"distortion_model": None}, "distortion_coeffs are given, but the key distortion_model is missing"),
        ({"distortion_model": "none"}, "none, but distortion coefficients are not zero"),
        ({"intrinsics": [404.0, 320.0, 240.0]}, "intrinsics is not 4 numbers"),
        ({"resolution": None}, "resolution"),
    ],
)  # fmt: skip
def test_cameras_of_chains_that_are_refused(tmp_path, own, message) -> None:
    for content in ({"cam0": LINK | own}, chain(T_cn_cnm1=rows(MOTION), **own)):
        with pytest.raises(FileFormatError, match=message):
            read_calibration(written(tmp_path, content))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (chain(), "cam1: the key T_cn_cnm1 is missing"),
        ({"cam1": LINK}, "the key cam0 is missing"),
        (chain(T_cn_cnm1=rows(MOTION), T_cam_imu=rows(CAM0_FROM_IMU @ MOTION)), "contradicts"),
        (chain(T_cam_imu=rows(MOTION), T_imu_cam=rows(MOTION)), "not the inverse"),
        (chain(T_cn_cnm1=(2 * np.eye(4)).tolist()), "T_cn_cnm1 is not a motion"),
        (chain(T_cn_cnm1=MOTION.as_matrix().T.tolist()), "T_cn_cnm1 is not a motion"),
    ],
)
def test_poses_of_chains_that_are_refused(tmp_path, content, message) -> None:
    with pytest.raises(FileFormatError, match=message):
        read_calibration(written(tmp_path, content))


def test_three_cameras_of_a_chain(tmp_path) -> None:
    third = {"cam2": LINK | {"T_cn_cnm1": rows(MOTION)}}
    found = read_calibration(written(tmp_path, chain(T_cn_cnm1=rows(MOTION)) | third))
    np.testing.assert_allclose(found.cam_from_rig[2].as_matrix(), (MOTION @ MOTION).as_matrix(), atol=1e-12)


def test_the_size_may_be_given(tmp_path) -> None:
    own = {key: value for key, value in LINK.items() if key != "resolution"}
    assert read_calibration(written(tmp_path, {"cam0": own}), size=(64, 48)).cameras[0].width == 64
    with pytest.raises(FileFormatError, match="resolution is missing"):
        read_calibration(written(tmp_path, {"cam0": own}))


def test_eurocs_coefficients_need_their_model(tmp_path) -> None:
    own = {"T_BS": matrix(np.eye(4)), "resolution": [640, 480], "intrinsics": LINK["intrinsics"]}
    own |= {"distortion_coefficients": COEFFICIENTS, "camera_model": "pinhole"}
    with pytest.raises(FileFormatError, match="the key distortion_model is missing"):
        read_calibration(written(tmp_path, own))
    camera = read_calibration(written(tmp_path, own | {"distortion_model": "equidistant"})).cameras[0]
    np.testing.assert_allclose(camera.project(POINTS), opencv_fisheye(), atol=1e-9)
    moved = np.eye(4)
    moved[3, 0] = 0.1
    with pytest.raises(FileFormatError, match="last row"):
        read_calibration(written(tmp_path, own | {"distortion_model": "radtan", "T_BS": matrix(moved)}))
    with pytest.raises(FileFormatError, match="camera_model omni"):
        read_calibration(written(tmp_path, own | {"camera_model": "omni", "intrinsics": [1, 2, 3, 4, 5]}))


# camodocal, as VINS-Fusion has it.

CAMODOCAL = {
    "model_type": "PINHOLE",
    "camera_name": "cam0",
    "image_width": 640,
    "image_height": 480,
    "distortion_parameters": dict(zip(("k1", "k2", "p1", "p2"), COEFFICIENTS)),
    "projection_parameters": {"fx": 404.0, "fy": 404.7, "cx": 320.5, "cy": 240.25},
}


def test_camera_files_of_vins(tmp_path) -> None:
    camera = read_calibration(written(tmp_path, "%YAML:1.0\n---\n" + yaml.safe_dump(CAMODOCAL))).cameras[0]
    np.testing.assert_allclose(camera.project(POINTS), opencv_plane(), atol=1e-9)
    numbers = dict(
        zip(("k2", "k3", "k4", "k5", "mu", "mv", "u0", "v0"), (*COEFFICIENTS, *LINK["intrinsics"]))
    )
    own = CAMODOCAL | {"model_type": "KANNALA_BRANDT", "projection_parameters": numbers}
    camera = read_calibration(written(tmp_path, own)).cameras[0]
    np.testing.assert_allclose(camera.project(POINTS), opencv_fisheye(), atol=1e-9)
    for bad, message in (
        (
            {"model_type": "MEI", "mirror_parameters": {"xi": 1.5}},
            "unknown model_type MEI|omnidirectional",
        ),
        ({"model_type": "SCARAMUZZA"}, "unknown model_type SCARAMUZZA"),
        ({"distortion_parameters": {"k1": 0.1}}, "k2, p1, p2 are missing"),
        ({"distortion_parameters": None}, "distortion_parameters is missing"),
    ):
        with pytest.raises(FileFormatError, match=message):
            read_calibration(written(tmp_path, CAMODOCAL | bad))


# mrcal

MRCAL = """# generated on a Tuesday with   mrcal-calibrate-cameras --lensmodel LENSMODEL_OPENCV8
{{
    'lensmodel':  '{model}',

    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 404.0, 404.7, 320.5, 240.25,{numbers}],

    'valid_intrinsics_region': [
    [ 0, 0 ],
    [ 0, 10 ],
],

    # extrinsics are rt_fromref
    'extrinsics': [ {extrinsics}],

    'imagersize': [ 640, 480,],

    'icam_intrinsics': 0,

    # The optimization inputs contain all the data used to compute this model.
    'optimization_inputs': b'P)h>@6aWA{{K2mH0n\\'bw~]#,F0a',
}}
"""


def mrcal(model: str, d: list[float], extrinsics: str = "0, 0, 0, 0, 0, 0,") -> str:
    return MRCAL.format(model=model, numbers="".join(f" {value!r}," for value in d), extrinsics=extrinsics)


@pytest.mark.parametrize(
    ("model", "d"),
    [
        ("LENSMODEL_PINHOLE", []),
        ("DISTORTION_NONE", []),
        ("LENSMODEL_OPENCV4", COEFFICIENTS),
        ("LENSMODEL_OPENCV5", [*COEFFICIENTS, 0.01]),
        ("LENSMODEL_OPENCV8", [0.3, 0.1, 1e-3, -2e-3, 0.02, 0.5, 0.1, 0.01]),
        ("LENSMODEL_OPENCV12", [0.3, 0.1, 1e-3, -2e-3, 0.02, 0.5, 0.1, 0.01, 0.0, 0.0, 0.0, 0.0]),
    ],
)
def test_mrcals_camera_models(tmp_path, model, d) -> None:
    camera = read_calibration(written(tmp_path, mrcal(model, d), "camera-0.cameramodel")).cameras[0]
    assert (camera.width, camera.height) == (640, 480)
    np.testing.assert_allclose(camera.project(POINTS), opencv_plane(d or [0.0] * 4), atol=1e-9)


def test_a_pair_of_mrcals(tmp_path) -> None:
    rotation = cv2.Rodrigues(MOTION.rotation)[0].ravel().tolist()
    numbers = "".join(f" {value!r}," for value in (*rotation, *MOTION.translation.tolist()))
    left = written(tmp_path, mrcal("LENSMODEL_PINHOLE", []), "0.cameramodel")
    right = written(tmp_path, mrcal("LENSMODEL_PINHOLE", [], numbers), "1.cameramodel")
    motion = read_stereo_rig(left, right).right_from_left
    np.testing.assert_allclose(motion.as_matrix(), MOTION.as_matrix(), atol=1e-9)
    back = read_stereo_rig(right, left).right_from_left
    np.testing.assert_allclose(back.as_matrix(), MOTION.inverse().as_matrix(), atol=1e-9)
    with pytest.raises(FileFormatError, match=r"not a \.cameramodel"):
        read_stereo_rig(left, written(tmp_path, ros()))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (mrcal("LENSMODEL_CAHVOR", [0.1] * 5), "LENSMODEL_CAHVOR is not supported; supported are LENSMODEL_PINHOLE"),
        (mrcal("LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=30_Ny=18_fov_x_deg=150", [0.1] * 9), "SPLINED_STEREOGRAPHIC"),
        (mrcal("LENSMODEL_LATLON", []), "LENSMODEL_LATLON is not supported"),
        (mrcal("LENSMODEL_OPENCV12", [0.1] * 12), "thin prism"),
        (mrcal("LENSMODEL_OPENCV8", [0.1] * 5), "has 12 intrinsics, got 9"),
        (mrcal("LENSMODEL_PINHOLE", []).replace("imagersize", "size"), "imagersize is missing"),
        (mrcal("LENSMODEL_PINHOLE", []).replace("'imagersize': [ 640", "'imagersize': [ __import__('os')"), "not a dictionary of literals|neither"),
        (mrcal("LENSMODEL_PINHOLE", []).replace("[ 640", "[" * 5000), "neither JSON nor YAML"),
        (mrcal("LENSMODEL_PINHOLE", [], "1e9, 0, 0, 0, 0, 0"), "rotation vector"),
    ],
    ids=["cahvor", "splined", "latlon", "thin prism", "count", "no size", "call", "deep", "turn"],
)  # fmt: skip
def test_mrcals_models_that_are_refused(tmp_path, text, message) -> None:
    with pytest.raises(FileFormatError, match=message):
        read_calibration(written(tmp_path, text, "c.cameramodel"))
