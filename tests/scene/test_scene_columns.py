"""The columns: cameras, rigs, frames, images, points, tracks, view graph."""

import numpy as np
import pytest
from scene_models import CAMERAS, empty_model, rig_model

from epipole.cameras import MAX_PARAMS, Camera, CameraModel
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.scene import Cameras, Frames, Points, Rigs, Tracks, ViewGraph, unregistered


def test_cameras_there_and_back() -> None:
    cameras = Cameras.from_list(
        CAMERAS, is_focal_trusted=[True, False, True], is_constant=[False, True, False]
    )
    assert len(cameras) == 3 and cameras.params.shape == (3, MAX_PARAMS)
    np.testing.assert_array_equal(cameras.is_focal_trusted, [True, False, True])
    np.testing.assert_array_equal(cameras.is_constant, [False, True, False])
    for row, camera in enumerate(CAMERAS):
        back = cameras[row]
        assert (back.model, back.width, back.height) == (camera.model, camera.width, camera.height)
        np.testing.assert_array_equal(back.params, camera.params)
        assert not cameras.params[row, camera.model.num_params :].any()
    assert repr(cameras) == "Cameras(3: OPENCV, SIMPLE_PINHOLE, SIMPLE_RADIAL)"


def test_a_camera_taken_out_is_a_copy() -> None:
    cameras = Cameras.from_list(CAMERAS)
    cameras[0].params[:] = 1.0
    np.testing.assert_array_equal(cameras[0].params, CAMERAS[0].params)


def test_cameras_from_a_generator_and_from_nothing() -> None:
    cameras = Cameras.from_list(c for c in CAMERAS)
    assert cameras.is_focal_trusted.all() and not cameras.is_constant.any() and len(cameras) == 3
    none = Cameras.from_list([])
    assert len(none) == 0 and none.params.shape == (0, MAX_PARAMS) and none.model.dtype == np.int32


def test_camera_models_keep_their_numbers_in_the_column() -> None:
    column = Cameras.from_list(CAMERAS).model
    assert [CameraModel(int(m)) for m in column] == [c.model for c in CAMERAS]


@pytest.mark.parametrize("count", [0, 1, 3])
def test_rigs_of_single_cameras(count: int) -> None:
    rigs = Rigs.of_single_cameras(count)
    assert len(rigs) == len(rigs.sensor_camera) == len(rigs.cam_from_rig) == count
    np.testing.assert_array_equal(rigs.rig_of_sensor(), np.arange(count))
    np.testing.assert_array_equal(rigs.sensor_camera, np.arange(count))
    np.testing.assert_array_equal(rigs.cam_from_rig.as_matrix(), np.tile(np.eye(4), (count, 1, 1)))


def test_rigs_in_compressed_rows(rng: np.random.Generator) -> None:
    rigs = rig_model(rng).rigs
    assert len(rigs) == 2 and repr(rigs) == "Rigs(2 rigs, 3 sensors)"
    np.testing.assert_array_equal(rigs.rig_of_sensor(), [0, 0, 1])


def test_frames_know_which_of_them_have_a_place() -> None:
    positions = Rigid3.identity(4)
    positions.translation[1] = np.nan
    positions.translation[2, 0] = np.inf
    frames = Frames(np.zeros(4, np.int32), positions, np.full(4, np.nan))
    np.testing.assert_array_equal(frames.is_registered(), [True, False, False, True])
    assert len(frames) == 4 and repr(frames) == "Frames(4, 2 registered)"


@pytest.mark.parametrize("count", [0, 1, 5])
def test_unregistered_rows(count: int) -> None:
    positions = unregistered(count)
    assert len(positions) == count and np.isnan(positions.as_matrix()[..., :3, :]).all()
    frames = Frames(np.zeros(count, np.int32), positions, np.zeros(count))
    assert not frames.is_registered().any()
    assert np.isnan((positions @ Rigid3.identity(count)).inverse().translation).all()


def test_keypoints_of_each_image(rng: np.random.Generator) -> None:
    images = rig_model(rng).images
    assert len(images) == 8 and repr(images) == "Images(8, 86 keypoints)"
    together = np.concatenate([images.keypoints_of(i) for i in range(8)])
    np.testing.assert_array_equal(together, images.keypoints_px)
    np.testing.assert_array_equal(images.keypoints_of(7), [[1.0, 2.0], [3.0, 4.0]])


def test_tracks_in_compressed_rows() -> None:
    tracks = Tracks(np.array([0, 2, 2, 5]), np.arange(5, dtype=np.int32), np.zeros(5, np.int32))
    assert len(tracks) == 3 and repr(tracks) == "Tracks(3, 5 observations)"
    np.testing.assert_array_equal(tracks.point_of_observation(), [0, 0, 2, 2, 2])
    assert empty_model().tracks.point_of_observation().shape == (0,)


def test_points_have_a_length() -> None:
    points = Points(np.zeros((4, 3)), np.zeros((4, 3), np.uint8), np.zeros(4))
    assert len(points) == 4 and repr(points) == "Points(4)"


@pytest.mark.parametrize("pairs", [0, 2])
def test_view_graph_counts_its_inliers(pairs: int) -> None:
    ids, matrices = np.arange(pairs, dtype=np.int32), np.zeros((pairs, 3, 3))
    offsets = np.array([0, 3, 4][: pairs + 1])
    matches = np.zeros(offsets[-1], np.int32)
    graph = ViewGraph(
        ids,
        ids + 1,
        ids,
        ids + 9,
        offsets,
        matches,
        matches,
        unregistered(pairs),
        matrices,
        matrices,
        matrices,
        np.full(pairs, np.nan),
    )
    assert len(graph) == pairs
    np.testing.assert_array_equal(graph.num_inliers(), [3, 1][:pairs])
    assert repr(graph) == f"ViewGraph({pairs} pairs, {offsets[-1]} inlier matches)"


def test_rows_must_fit_each_other_in_the_test_run() -> None:
    """The type checks of this test run see columns of unequal length."""
    with pytest.raises(Exception, match="rgb"):
        Points(np.zeros((4, 3)), np.zeros((3, 3), np.uint8), np.zeros(4))


@pytest.mark.usefixtures("unchecked")
def test_single_cameras_are_no_columns() -> None:
    camera = Camera("PINHOLE", 64, 48, [50, 50, 31.5, 23.5])
    assert repr(Cameras.from_list([camera])[0]) == repr(camera)
    for wrong in ("PINHOLE", [camera], camera):
        with pytest.raises(ConfigError, match=r"use Cameras\.from_list\(\[Camera\(\.\.\.\)\]\)"):
            Cameras(wrong, 64, 48, camera.params, True, False)
    with pytest.raises(ConfigError, match=r"cameras\[0\] must be a Camera, got 'PINHOLE'"):
        Cameras.from_list(["PINHOLE"])


def test_view_graph_in_order_of_its_images(rng: np.random.Generator) -> None:
    pairs, counts = [(0, 1), (0, 2), (1, 2), (1, 3)], [2, 0, 3, 1]

    def graph_of(order: list[int]) -> ViewGraph:
        models = np.arange(4.0)[order][:, None, None] * np.ones((4, 3, 3))
        offsets = np.concatenate([[0], np.cumsum(np.array(counts)[order])]).astype(np.int64)
        keypoints = np.concatenate([10 * e + np.arange(counts[e]) for e in order]).astype(np.int32)
        image1, image2 = np.array(pairs, np.int32)[order].T.copy()
        return ViewGraph(
            *(image1, image2, np.array(order, np.int32), np.array(order, np.int32), offsets),
            *(
                keypoints,
                keypoints + 1,
                Rigid3(np.tile(np.eye(3), (4, 1, 1)), models[:, 0]),
                models,
                models,
                models,
            ),
            np.arange(4.0)[order],
        )

    wanted, found = graph_of([0, 1, 2, 3]), graph_of(rng.permutation(4).tolist()).in_order()
    for name in ViewGraph.__dataclass_fields__:
        one, two = getattr(wanted, name), getattr(found, name)
        if isinstance(one, Rigid3):
            one, two = one.as_matrix(), two.as_matrix()
        np.testing.assert_array_equal(one, two)
    assert wanted.in_order() is wanted
