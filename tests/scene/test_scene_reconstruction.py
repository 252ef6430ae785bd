"""A reconstruction: how its rows refer to each other, its errors, its gauge freedom."""

from dataclasses import replace

import numpy as np
import pytest
from scene_models import CAMERAS, empty_model, rig_model

from epipole.geometry import Rigid3, Similarity3
from epipole.scene import Reconstruction


@pytest.fixture
def model(rng: np.random.Generator) -> Reconstruction:
    return rig_model(rng)


def test_images_find_their_cameras_through_their_rigs(model: Reconstruction) -> None:
    np.testing.assert_array_equal(model.camera_of_image, [0, 1, 0, 1, 0, 1, 2, 2])
    np.testing.assert_array_equal(model.is_registered(), [True] * 7 + [False])


def test_cam_from_world_is_the_product_over_the_rig(model: Reconstruction) -> None:
    cams_from_world = model.cams_from_world()
    assert len(cams_from_world) == 8
    for image in range(7):
        cam_from_rig = model.rigs.cam_from_rig[int(model.images.sensor[image])]
        rig_from_world = model.frames.rig_from_world[int(model.images.frame[image])]
        expected = cam_from_rig.as_matrix() @ rig_from_world.as_matrix()
        np.testing.assert_allclose(cams_from_world[image].as_matrix(), expected, atol=1e-14)
    assert np.isnan(cams_from_world.translation[7]).all()


def test_centers_map_to_the_camera_origin(model: Reconstruction) -> None:
    centers = model.camera_centers_in_world()
    np.testing.assert_allclose(model.cams_from_world()[:7].apply(centers[:7]), 0.0, atol=1e-13)
    assert np.isnan(centers[7]).all()


def test_observations_find_their_keypoints(model: Reconstruction) -> None:
    rows, pixels = model.keypoint_rows(), model.observed_pixels()
    point = model.tracks.point_of_observation()
    for k in range(0, len(rows), 5):
        image = int(model.tracks.image[k])
        np.testing.assert_array_equal(pixels[k], model.images.keypoints_of(image)[model.tracks.keypoint[k]])
        assert model.point_of_keypoint()[rows[k]] == point[k]
    of_keypoint = model.point_of_keypoint()
    assert (of_keypoint >= 0).sum() == len(rows) == 7 * 11 + 2
    # The last point's keypoints in images 1 to 5 belong to no track, nor do those of the image without a place.
    assert (of_keypoint[-2:] == -1).all() and (of_keypoint == 11).sum() == 2


def test_an_exact_model_has_no_error(model: Reconstruction) -> None:
    assert model.reprojection_errors_px().max() < 1e-9
    assert model.mean_reprojection_error_px() < 1e-9


def test_errors_are_distances_in_pixels(model: Reconstruction) -> None:
    moved = model.images.keypoints_px.copy()
    row = int(model.keypoint_rows()[4])
    moved[row] += [3.0, -4.0]
    worse = replace(model, images=replace(model.images, keypoints_px=moved))
    errors = worse.reprojection_errors_px()
    assert errors[4] == pytest.approx(5.0) and np.delete(errors, 4).max() < 1e-9
    assert worse.mean_reprojection_error_px() == pytest.approx(5.0 / len(errors))


def test_a_point_behind_its_cameras_has_no_error_in_pixels(model: Reconstruction) -> None:
    xyz = model.points.xyz_in_world.copy()
    xyz[2] = [0.0, 0.0, -50.0]
    changed = replace(model, points=replace(model.points, xyz_in_world=xyz))
    errors = changed.reprojection_errors_px()
    np.testing.assert_array_equal(np.isnan(errors), model.tracks.point_of_observation() == 2)
    assert changed.mean_reprojection_error_px() == errors[np.isfinite(errors)].mean()


def test_a_similarity_changes_no_pixel(model: Reconstruction, rng: np.random.Generator) -> None:
    target_from_world = Similarity3.exp(rng.normal(size=7))
    moved = model.transformed(target_from_world)
    assert moved.mean_reprojection_error_px() < 1e-8
    np.testing.assert_allclose(
        moved.camera_centers_in_world()[:7],
        target_from_world.apply(model.camera_centers_in_world()[:7]),
        atol=1e-11,
    )
    np.testing.assert_array_equal(moved.is_registered(), model.is_registered())
    # The rig grows with the world.
    grown = np.linalg.norm(moved.rigs.cam_from_rig.translation, axis=1)
    before = np.linalg.norm(model.rigs.cam_from_rig.translation, axis=1)
    np.testing.assert_allclose(grown, before * float(target_from_world.scale))
    back = moved.transformed(target_from_world.inverse())
    np.testing.assert_allclose(back.points.xyz_in_world, model.points.xyz_in_world, atol=1e-12)
    np.testing.assert_allclose(
        back.frames.rig_from_world.as_matrix()[:4], model.frames.rig_from_world.as_matrix()[:4], atol=1e-11
    )


def test_a_model_is_not_changed_by_moving_it(model: Reconstruction) -> None:
    points, positions = model.points.xyz_in_world.copy(), model.frames.rig_from_world.translation.copy()
    model.transformed(Similarity3.exp(np.full(7, 0.5)))
    np.testing.assert_array_equal(model.points.xyz_in_world, points)
    np.testing.assert_array_equal(model.frames.rig_from_world.translation, positions)


def test_nothing_is_a_model_too() -> None:
    model = empty_model()
    assert len(model.cams_from_world()) == 0 and model.camera_centers_in_world().shape == (0, 3)
    assert model.is_registered().shape == (0,) and model.point_of_keypoint().shape == (0,)
    assert model.observed_pixels().shape == (0, 2) and model.reprojection_errors_px().shape == (0,)
    assert np.isnan(model.mean_reprojection_error_px())
    assert len(model.transformed(Similarity3.identity()).points) == 0
    assert repr(model) == "Reconstruction(0 of 0 images registered, 0 points, 0 observations, 0 cameras)"


def test_one_point(rng: np.random.Generator) -> None:
    model = rig_model(rng, num_points=1)
    assert len(model.points) == 1 and model.reprojection_errors_px().shape == (2,)
    assert model.mean_reprojection_error_px() < 1e-9


def test_text(model: Reconstruction) -> None:
    start, end = "Reconstruction(7 of 8 images registered, 12 points, 79 observations", ", 3 cameras)"
    known = replace(model.points, error_px=np.r_[[0.5] * 6, [1.5] * 6])
    weights = np.diff(model.tracks.offsets)
    mean = (0.5 * weights[:6].sum() + 1.5 * weights[6:].sum()) / weights.sum()
    assert repr(replace(model, points=known)) == f"{start}, mean error {mean:.2f} px{end}"
    unknown = replace(model.points, error_px=np.full(12, np.nan))
    assert repr(replace(model, points=unknown)) == start + end


def test_single_cameras_are_rigs_of_one(rng: np.random.Generator) -> None:
    """The same images as single cameras give the same places."""
    model = rig_model(rng)
    cams_from_world = model.cams_from_world()
    single = replace(
        model,
        frames=replace(
            model.frames,
            rig=model.camera_of_image,
            rig_from_world=cams_from_world,
            timestamp_s=np.full(8, np.nan),
        ),
        rigs=type(model.rigs).of_single_cameras(len(CAMERAS)),
        images=replace(model.images, frame=np.arange(8, dtype=np.int32), sensor=model.camera_of_image),
    )
    np.testing.assert_allclose(single.cams_from_world().as_matrix(), cams_from_world.as_matrix(), atol=1e-15)
    assert single.mean_reprojection_error_px() < 1e-9
    assert isinstance(single.rigs.cam_from_rig, Rigid3)
