"""What is written is read again: every format that has both, for contents that Hypothesis makes up."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of
from PIL import Image

from any_geometry import cameras, numbers, steps_aside, twists
from any_models import maps, pose_graphs, reconstructions, rows
from epipole.cameras import MAX_PARAMS, Camera, CameraModel
from epipole.errors import ConfigError
from epipole.geometry import Rigid2, Rigid3
from epipole.io import (
    DatabaseContents,
    read_bal,
    read_chan,
    read_colmap_model,
    read_database,
    read_g2o,
    read_kapture,
    read_metashape,
    read_opensfm,
    read_points_ply,
    read_realityscan,
    read_transforms,
    write_bal,
    write_chan,
    write_colmap_model,
    write_database,
    write_g2o,
    write_kapture,
    write_metashape,
    write_opensfm,
    write_points_ply,
    write_realityscan,
    write_transforms,
)
from epipole.io.calibration.files import (
    CalibrationFile,
    read_calibration,
    write_calibration,
    write_opencv_yaml,
    write_ros_yaml,
)
from epipole.io.images.depth_maps import read_pfm, read_png16, write_pfm, write_png16
from epipole.io.images.exif import gps_of, new_exif
from epipole.io.models.model_file import Observations, model_of_single_images, no_points
from epipole.optim import BundleProblem, free_params_mask
from epipole.scene import Cameras, Reconstruction
from io_models import mappable_model

pytestmark = pytest.mark.usefixtures("unchecked")  # a thousand files, of types that other tests check

LENSES = (CameraModel.OPENCV, CameraModel.OPENCV_FISHEYE, CameraModel.FULL_OPENCV)
"""Models that OpenCV's coefficient vectors tell apart."""


def assert_same_motions(found: Any, expected: Any, tolerance: float = 1e-12) -> None:
    if isinstance(expected, Rigid2):
        np.testing.assert_allclose(found.rotation(), expected.rotation(), atol=tolerance)
    else:
        np.testing.assert_allclose(found.rotation, expected.rotation, atol=tolerance)
    size = np.maximum(1.0, np.abs(expected.translation))
    assert (np.abs(found.translation - expected.translation) <= tolerance * size).all()


def assert_same_cameras(found: Reconstruction, expected: Reconstruction) -> None:
    np.testing.assert_array_equal(found.cameras.model, expected.cameras.model)
    np.testing.assert_allclose(found.cameras.params, expected.cameras.params, rtol=1e-13, atol=1e-12)


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@given(model=reconstructions())
def test_colmap_models(tmp_path: Path, text: bool, model: Reconstruction) -> None:
    write_colmap_model(model, tmp_path / "model", text=text)
    found = read_colmap_model(tmp_path / "model")
    assert_same_cameras(found, model)
    assert found.images.name == model.images.name
    for column in ("frame", "sensor", "keypoint_offsets"):
        np.testing.assert_array_equal(getattr(found.images, column), getattr(model.images, column))
    np.testing.assert_allclose(found.images.keypoints_px, model.images.keypoints_px, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(found.frames.rig, model.frames.rig)
    assert_same_motions(found.frames.rig_from_world, model.frames.rig_from_world)
    assert_same_motions(found.rigs.cam_from_rig, model.rigs.cam_from_rig)
    np.testing.assert_array_equal(found.points.xyz_in_world, model.points.xyz_in_world)
    np.testing.assert_array_equal(found.points.rgb, model.points.rgb)
    np.testing.assert_array_equal(found.points.error_px, model.points.error_px)
    for column in ("offsets", "image", "keypoint"):
        np.testing.assert_array_equal(getattr(found.tracks, column), getattr(model.tracks, column))


@given(model=reconstructions(), data=st.data())
def test_colmap_databases(tmp_path: Path, model: Reconstruction, data: st.DataObject) -> None:
    counts = np.diff(model.images.keypoint_offsets)
    descriptors = [data.draw(arrays_of.arrays(np.uint8, (int(n), 128))) for n in counts]
    matches = {}
    for second in range(1, len(counts)):
        n, m = int(counts[0]), int(counts[second])
        pairs = data.draw(st.sets(st.tuples(st.integers(0, n - 1), st.integers(0, m - 1)))) if n and m else ()
        matches[0, second] = np.array(sorted(pairs), np.int32).reshape(-1, 2)
    position = st.tuples(numbers(-90, 90), numbers(-180, 180), numbers(-400, 9000))
    gps = np.array([data.draw(position) for _ in counts])
    contents = DatabaseContents(
        model.cameras, model.rigs, model.frames, model.images, descriptors, matches, None, gps
    )
    write_database(tmp_path / "database.db", contents)
    found = read_database(tmp_path / "database.db")
    np.testing.assert_array_equal(found.cameras.model, model.cameras.model)
    np.testing.assert_allclose(found.cameras.params, model.cameras.params, rtol=1e-13, atol=1e-12)
    assert_same_motions(found.rigs.cam_from_rig, model.rigs.cam_from_rig)
    assert found.images.name == model.images.name
    np.testing.assert_array_equal(found.images.frame, model.images.frame)
    np.testing.assert_array_equal(found.images.sensor, model.images.sensor)
    # Keypoints are stored in single precision.
    np.testing.assert_allclose(found.images.keypoints_px, model.images.keypoints_px, rtol=2**-23, atol=1e-6)
    for own, theirs in zip(found.descriptors, descriptors, strict=True):
        np.testing.assert_array_equal(own, theirs)
    assert found.matches.keys() == matches.keys() and found.view_graph is None
    for pair, expected in matches.items():
        np.testing.assert_array_equal(found.matches[pair], expected)
    np.testing.assert_array_equal(found.gps_lat_lon_alt, gps)


@given(model=reconstructions(models=LENSES[:2]))
def test_transforms(tmp_path: Path, model: Reconstruction) -> None:
    write_transforms(model, tmp_path / "transforms.json")
    found = read_transforms(tmp_path / "transforms.json")
    assert_same_motions(found.cams_from_world(), model.cams_from_world(), 1e-10)
    for image in range(len(model.images)):
        own, theirs = (m.cameras[int(m.camera_of_image[image])] for m in (found, model))
        pixels = np.array([[10.0, 20.0], [300.0, 250.0], [600.0, 400.0]])
        np.testing.assert_allclose(own.unproject(pixels), theirs.unproject(pixels), atol=1e-9)
        assert (own.width, own.height) == (theirs.width, theirs.height)
    # Points are stored in single precision, or in double where that is too coarse.
    np.testing.assert_allclose(found.points.xyz_in_world, model.points.xyz_in_world, rtol=2**-24, atol=1e-40)
    np.testing.assert_array_equal(found.points.rgb, model.points.rgb)


def assert_same_views(found: Reconstruction, model: Reconstruction) -> None:
    """The same poses and cameras, image by image; the cameras may be of other models."""
    assert_same_motions(found.cams_from_world(), model.cams_from_world(), 1e-9)
    for image in range(len(model.images)):
        own, theirs = (m.cameras[int(m.camera_of_image[image])] for m in (found, model))
        pixels = np.array([[10.0, 20.0], [300.0, 250.0], [600.0, 400.0]])
        np.testing.assert_allclose(own.unproject(pixels), theirs.unproject(pixels), atol=1e-9)
        assert (own.width, own.height) == (theirs.width, theirs.height)


def numbered(model: Reconstruction) -> Reconstruction:
    """With image names that every format can store."""
    names = tuple(f"{image}/a b.jpg" for image in range(len(model.images)))
    return replace(model, images=replace(model.images, name=names))


@given(model=reconstructions(models=LENSES[:2]))
def test_models_of_opensfm(tmp_path: Path, model: Reconstruction) -> None:
    write_opensfm(model, tmp_path / "reconstruction.json")
    found = read_opensfm(tmp_path / "reconstruction.json")
    assert_same_views(found, model)
    assert found.images.name == model.images.name
    np.testing.assert_array_equal(found.points.xyz_in_world, model.points.xyz_in_world)
    np.testing.assert_array_equal(found.points.rgb, model.points.rgb)
    np.testing.assert_array_equal(found.tracks.offsets, model.tracks.offsets)
    np.testing.assert_array_equal(found.tracks.image, model.tracks.image)
    np.testing.assert_allclose(found.observed_pixels(), model.observed_pixels(), rtol=0, atol=1e-9)


@given(model=reconstructions(models=LENSES[:2]))
def test_cameras_of_metashape(tmp_path: Path, model: Reconstruction) -> None:
    write_metashape(numbered(model), tmp_path / "cameras.xml")
    assert_same_views(read_metashape(tmp_path / "cameras.xml"), model)


def with_images(folder: Path, model: Reconstruction) -> Reconstruction:
    """A model whose images exist, and whose cameras have one focal length, with images below 700 pixels."""
    cameras = []
    for camera in model.cameras:
        params = camera.params.copy()
        params[list(camera.model.focal_indices)] = camera.focal_px
        cameras.append(Camera(camera.model, min(camera.width, 700), min(camera.height, 500), params))
    model = replace(numbered(model), cameras=Cameras.from_list(cameras))
    for row, name in enumerate(model.images.name):
        camera = model.cameras[int(model.camera_of_image[row])]
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (camera.width, camera.height)).save(folder / name, quality=10)
    return model


@pytest.mark.filterwarnings("ignore:epipole")  # a file does not name its distortion model
@given(model=reconstructions(models=LENSES[:1]))
def test_cameras_of_realityscan(tmp_path: Path, model: Reconstruction) -> None:
    model = with_images(tmp_path, model)
    write_realityscan(model, tmp_path / "cameras.csv")
    assert_same_views(read_realityscan(tmp_path / "cameras.csv"), model)


@given(model=reconstructions(models=(CameraModel.SIMPLE_PINHOLE,)))
def test_frames_of_chan(tmp_path: Path, model: Reconstruction) -> None:
    """Of the first camera."""
    own = np.flatnonzero(model.camera_of_image == model.camera_of_image[0])
    width, height = 640, 480
    camera = Camera("SIMPLE_PINHOLE", width, height, [model.cameras[0].focal_px, 319.5, 239.5])
    none = Observations.none()
    names = [f"{n:04d}" for n in range(1, len(own) + 1)]
    motions = model.cams_from_world()[own]
    frames = model_of_single_images(names, [camera], [0] * len(own), motions, no_points(), none)
    write_chan(frames, tmp_path / "shot.chan")
    assert_same_views(read_chan(tmp_path / "shot.chan", (width, height)), frames)


@given(model=reconstructions())
def test_datasets_of_kapture(tmp_path: Path, model: Reconstruction) -> None:
    write_kapture(numbered(model), tmp_path / "kapture")
    found = read_kapture(tmp_path / "kapture")
    assert_same_views(found, model)
    for column in ("keypoint_offsets", "frame"):
        np.testing.assert_array_equal(getattr(found.images, column), getattr(model.images, column))
    np.testing.assert_allclose(found.images.keypoints_px, model.images.keypoints_px, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(found.points.xyz_in_world, model.points.xyz_in_world)
    for column in ("offsets", "image", "keypoint"):
        np.testing.assert_array_equal(getattr(found.tracks, column), getattr(model.tracks, column))


@given(xyz=rows(5, 3), rgb=arrays_of.arrays(np.uint8, (5, 3)), count=st.integers(0, 5))
def test_ply(tmp_path: Path, xyz: np.ndarray, rgb: np.ndarray, count: int) -> None:
    write_points_ply(tmp_path / "points.ply", xyz[:count], rgb[:count])
    found = read_points_ply(tmp_path / "points.ply")
    np.testing.assert_allclose(found.xyz, xyz[:count], rtol=2**-24, atol=1e-40)
    np.testing.assert_array_equal(found.rgb, rgb[:count])


@st.composite
def bundle_problems(draw: st.DrawFn) -> BundleProblem:
    """Every point is seen by one to all of the frames."""
    num_frames, num_points = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    seen = [sorted(draw(st.sets(st.integers(0, num_frames - 1), min_size=1))) for _ in range(num_points)]
    frame = np.array([f for row in seen for f in row], np.int32)
    params = np.zeros((num_frames, MAX_PARAMS))
    for row in params:
        row[[0, 3, 4]] = draw(numbers(100, 3000)), draw(numbers(-0.5, 0.5)), draw(numbers(-0.5, 0.5))
    models = np.full(num_frames, int(CameraModel.RADIAL), np.int32)
    return BundleProblem(
        Rigid3.exp(np.array([draw(twists()) for _ in range(num_frames)])),
        Rigid3.identity(1),
        models,
        params,
        draw(rows(num_points, 3)),
        np.concatenate([[0], np.cumsum([len(row) for row in seen])]).astype(np.int64),
        frame,
        np.zeros(len(frame), np.int32),
        frame.copy(),
        draw(rows(len(frame), 2)),
        np.ones((num_frames, 6)),
        free_params_mask(models),
        np.ones(num_points),
    )


@pytest.mark.parametrize("name", ["problem.txt", "problem.txt.bz2"])
@given(problem=bundle_problems())
def test_bundle_problems(tmp_path: Path, name: str, problem: BundleProblem) -> None:
    write_bal(tmp_path / name, problem)
    found = read_bal(tmp_path / name)
    assert_same_motions(found.rig_from_world, problem.rig_from_world, 1e-9)
    for column in ("frame", "camera", "offsets", "pixels", "points_in_world", "camera_params"):
        np.testing.assert_array_equal(getattr(found, column), getattr(problem, column), err_msg=column)


@given(graph=pose_graphs(), data=st.data())
def test_pose_graphs(tmp_path: Path, graph, data: st.DataObject) -> None:
    ids = sorted(data.draw(st.sets(st.integers(0, 2**62), min_size=len(graph), max_size=len(graph))))
    write_g2o(tmp_path / "graph.g2o", graph, ids)
    found = read_g2o(tmp_path / "graph.g2o")
    assert found.ids.tolist() == ids
    np.testing.assert_array_equal(found.graph.first, graph.first)
    np.testing.assert_array_equal(found.graph.second, graph.second)
    assert_same_motions(found.graph.world_from_body, graph.world_from_body)
    assert_same_motions(found.graph.first_from_second, graph.first_from_second)
    np.testing.assert_array_equal(found.graph.information, graph.information)
    np.testing.assert_array_equal(found.graph.fixed, graph.fixed)


@given(values=maps(-(2.0**100), 2.0**100))
def test_pfm(tmp_path: Path, values: np.ndarray) -> None:
    write_pfm(tmp_path / "map.pfm", values)
    np.testing.assert_array_equal(read_pfm(tmp_path / "map.pfm"), values)


@given(values=maps(0.0, 300.0), scale=st.sampled_from([1.0, 256.0, 1000.0]))
def test_png16(tmp_path: Path, values: np.ndarray, scale: float) -> None:
    """To half a step where the value fits, unknown where it does not."""
    write_png16(tmp_path / "map.png", values, scale)
    found = read_png16(tmp_path / "map.png", scale)
    stored = np.rint(scale * values.astype(np.float64))
    fits = (stored >= 1) & (stored <= 65535)
    assert np.isnan(found[~fits]).all()
    np.testing.assert_allclose(found[fits], values[fits], rtol=1e-6, atol=0.5 / scale)


@pytest.mark.parametrize("model", [pytest.param(m, id=m.name) for m in CameraModel])
@given(data=st.data())
def test_own_calibrations(tmp_path: Path, model: CameraModel, data: st.DataObject) -> None:
    both = tuple(data.draw(cameras(model=model, bend=0.5)) for _ in range(2))
    motion = data.draw(twists())
    wrote = CalibrationFile(both, Rigid3.exp(np.stack([np.zeros(6), motion])))
    write_calibration(tmp_path / "rig.json", wrote)
    found = read_calibration(tmp_path / "rig.json")
    assert_same_motions(found.cam_from_rig, wrote.cam_from_rig)
    for own, theirs in zip(found.cameras, both, strict=True):
        assert (own.model, own.width, own.height) == (theirs.model, theirs.width, theirs.height)
        np.testing.assert_array_equal(own.params, theirs.params)


def assert_same_lens(own: Camera, theirs: Camera) -> None:
    """The models may differ in name (no distortion is none of any kind), not in their rays."""
    pixels = np.array([[100.0, 90.0], [320.0, 240.0], [500.0, 350.0]])
    np.testing.assert_allclose(own.unproject(pixels), theirs.unproject(pixels), atol=1e-10)
    assert (own.width, own.height) == (theirs.width, theirs.height)


@given(cameras(), cameras(), steps_aside())
def test_opencv_calibrations(tmp_path_factory, left: Camera, right: Camera, motion: Rigid3) -> None:
    path = tmp_path_factory.getbasetemp() / "any_opencv.yaml"
    write_opencv_yaml(path, CalibrationFile((left,), Rigid3.identity(1)))
    assert_same_lens(read_calibration(path).cameras[0], left)
    if (left.model is CameraModel.OPENCV_FISHEYE) == (right.model is CameraModel.OPENCV_FISHEYE):
        positions = Rigid3(
            np.stack([np.eye(3), motion.rotation]), np.stack([np.zeros(3), motion.translation])
        )
        write_opencv_yaml(path, CalibrationFile((left, right), positions))
        found = read_calibration(path)
        assert_same_lens(found.cameras[0], left)
        assert_same_lens(found.cameras[1], right)
        assert_same_motions(found.cam_from_rig, positions)


@given(camera=cameras())
def test_ros_calibrations(tmp_path: Path, camera: Camera) -> None:
    write_ros_yaml(tmp_path / "camera.yaml", camera, "left")
    assert_same_lens(read_calibration(tmp_path / "camera.yaml").cameras[0], camera)


@given(numbers(-89.99, 89.99), numbers(-179.99, 179.99), st.none() | numbers(-400, 9000))
def test_gps_in_exif(lat_deg: float, lon_deg: float, alt_m: float | None) -> None:
    """To a microsecond of arc (3 cm / 1000) and a millimeter."""
    exif = Image.Exif()
    exif.load(new_exif("epipole", "any", 35.0, (lat_deg, lon_deg, alt_m)).tobytes())
    found = gps_of(exif)
    if found is None:  # 0, 0 is what cameras write that know no place
        assert max(abs(lat_deg), abs(lon_deg)) < 2e-10
        return
    assert abs(found.lat_deg - lat_deg) < 2e-10 and abs(found.lon_deg - lon_deg) < 2e-10
    assert (found.alt_m is None) == (alt_m is None)
    assert alt_m is None or abs(found.alt_m - alt_m) <= 5.01e-4


@pytest.mark.parametrize("name", ["", "a\nb.jpg", "a\rb.jpg", "a\0b.jpg", "a\udcffb.jpg"])
def test_names_that_no_file_can_hold_are_refused(tmp_path: Path, name: str) -> None:
    """Among them a file's name on the disk that is not UTF-8, which Python reads with lone surrogates."""
    model = named(name)
    for text in (False, True):
        with pytest.raises(ConfigError, match="cannot be written"):
            write_colmap_model(model, tmp_path / "model", text=text)
    with pytest.raises(ConfigError, match="cannot be written"):
        contents = DatabaseContents(model.cameras, model.rigs, model.frames, model.images)
        write_database(tmp_path / "database.db", contents)


def test_outer_spaces_of_a_name_live_in_the_binary_file_alone(tmp_path: Path) -> None:
    write_colmap_model(named(" a.jpg"), tmp_path / "model")
    assert read_colmap_model(tmp_path / "model").images.name[0] == " a.jpg"
    with pytest.raises(ConfigError, match="spaces"):
        write_colmap_model(named(" a.jpg"), tmp_path / "model", text=True)


def named(name: str) -> Reconstruction:
    model = mappable_model(3, 20)
    return replace(model, images=replace(model.images, name=(name, *model.images.name[1:])))
