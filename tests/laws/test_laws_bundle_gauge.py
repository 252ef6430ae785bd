"""Gauge freedom of bundle adjustment: its cost does not see a similarity of the whole reconstruction."""

from dataclasses import replace

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3, Similarity3
from epipole.mapping import bundle_problem_of
from epipole.optim import (
    BundleConfig,
    BundlePriors,
    BundleProblem,
    BundleResult,
    Loss,
    adjust_bundle,
    evaluate_loss,
)
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks

NUM_FRAMES, NUM_POINTS = 5, 40
LOSSES = list(Loss)
CAMERAS = [
    Camera(CameraModel.OPENCV, 640, 480, np.array([500.0, 490.0, 320.0, 240.0, -0.1, 0.02, 1e-3, -1e-3])),
    Camera(
        CameraModel.OPENCV_FISHEYE, 640, 480, np.array([260.0, 255.0, 321.5, 236.3, 0.03, -0.01, 4e-3, 0])
    ),
]


@pytest.fixture
def model(rng: np.random.Generator) -> Reconstruction:
    """A rig of two cameras at five instants; both see every point, with two pixels of noise."""
    cam_from_rig = Rigid3.exp([[0.0] * 6, [-0.4, 0.0, 0.1, 0.02, -0.1, 0.03]])
    spread = [1, 1, 0.5, 0.1, 0.1, 0.1]
    rig_from_world = Rigid3.exp(rng.normal([0, 0, 6, 0, 0, 0], spread, (NUM_FRAMES, 6)))
    points = rng.uniform(-1, 1, (NUM_POINTS, 3))
    frame = np.repeat(np.arange(NUM_FRAMES, dtype=np.int32), 2)
    sensor = np.tile(np.arange(2, dtype=np.int32), NUM_FRAMES)
    cams_from_world = cam_from_rig[sensor] @ rig_from_world[frame]
    num_images = 2 * NUM_FRAMES
    exact = [CAMERAS[sensor[i]].project(cams_from_world[i].apply(points)) for i in range(num_images)]
    pixels = np.concatenate(exact) + 2.0 * rng.normal(size=(num_images * NUM_POINTS, 2))
    return Reconstruction(
        Cameras.from_list(CAMERAS),
        Rigs(np.array([0, 2], np.int32), np.array([0, 1], np.int32), cam_from_rig),
        Frames(np.zeros(NUM_FRAMES, np.int32), rig_from_world, np.full(NUM_FRAMES, np.nan)),
        Images(
            tuple(f"{s}/{f}.jpg" for f, s in zip(frame, sensor)),
            frame,
            sensor,
            np.arange(num_images + 1, dtype=np.int64) * NUM_POINTS,
            pixels,
        ),
        Points(points, np.zeros((NUM_POINTS, 3), np.uint8), np.zeros(NUM_POINTS)),
        Tracks(
            np.arange(NUM_POINTS + 1, dtype=np.int64) * num_images,
            np.tile(np.arange(num_images, dtype=np.int32), NUM_POINTS),
            np.repeat(np.arange(NUM_POINTS, dtype=np.int32), num_images),
        ),
    )


def problem_of(model: Reconstruction) -> BundleProblem:
    """All frames and points free, the intrinsics held."""
    return replace(bundle_problem_of(model), params_free=np.zeros(model.cameras.params.shape))


def cost_of(problem: BundleProblem, loss: Loss = Loss.TRIVIAL) -> float:
    """The cost before any step."""
    config = BundleConfig(loss=loss, loss_scale_px=1.5, max_iterations=0)
    return adjust_bundle(problem, config).initial_cost


def similarities(rng: np.random.Generator) -> list[Similarity3]:
    """Small, large, and each of the three freedoms alone."""
    alone = np.diag([5.0, 0, 0, 2.0, 0, 0, 1.5])[[0, 3, 6]]
    return [Similarity3.exp(xi) for xi in [*(rng.normal(size=(3, 7)) * [[1e-3], [1], [2]]), *alone]]


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.name)
def test_the_cost_is_the_sum_of_the_losses_of_the_reprojection_errors(
    model: Reconstruction, loss: Loss
) -> None:
    expected = 0.5 * evaluate_loss(loss, model.reprojection_errors_px() ** 2, 1.5).sum()
    assert expected > 100 and cost_of(problem_of(model), loss) == pytest.approx(expected, rel=1e-11)


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.name)
def test_a_similarity_of_the_reconstruction_leaves_the_cost(
    model: Reconstruction, loss: Loss, rng: np.random.Generator
) -> None:
    before = cost_of(problem_of(model), loss)
    for target_from_world in similarities(rng):
        moved = model.transformed(target_from_world)
        assert cost_of(problem_of(moved), loss) == pytest.approx(before, rel=1e-9)


def test_what_is_not_a_similarity_of_the_whole_changes_the_cost(model: Reconstruction) -> None:
    """The law above is no accident of a cost that sees nothing: a part that is left behind shows."""
    before, moved = cost_of(problem_of(model)), model.transformed(Similarity3.exp(np.full(7, 1e-2)))
    for part in ("rigs", "frames", "points"):
        left_behind = replace(moved, **{part: getattr(model, part)})
        assert abs(cost_of(problem_of(left_behind)) / before - 1) > 1e-4, part


def adjusted(model: Reconstruction, **changes: object) -> BundleResult:
    problem = replace(problem_of(model), **changes)
    return adjust_bundle(problem, BundleConfig(function_tolerance=1e-13, max_iterations=100))


def test_adjustment_in_other_coordinates_finds_the_same_minimum(
    model: Reconstruction, rng: np.random.Generator
) -> None:
    """With one frame held and a rig of known size nothing is free: the minimum moves with the coordinates."""
    frame_free = np.ones((NUM_FRAMES, 6))
    frame_free[0] = 0.0
    found = adjusted(model, frame_free=frame_free)
    assert found.converged and found.final_cost < 0.9 * found.initial_cost
    for target_from_world in similarities(rng):
        again = adjusted(model.transformed(target_from_world), frame_free=frame_free)
        assert again.final_cost == pytest.approx(found.final_cost, rel=1e-9)
        expected = target_from_world.apply(found.points_in_world)
        size = float(target_from_world.scale)
        np.testing.assert_allclose(again.points_in_world, expected, atol=1e-4 * size)
        positions = target_from_world.move_cam_from_source(found.rig_from_world)
        np.testing.assert_allclose(again.rig_from_world.centers(), positions.centers(), atol=1e-4 * size)


def test_expected_places_end_the_freedom_unless_they_move_along(
    model: Reconstruction, rng: np.random.Generator
) -> None:
    expected = model.frames.rig_from_world.centers() + 0.1 * rng.normal(size=(NUM_FRAMES, 3))
    with_priors = replace(
        problem_of(model), priors=BundlePriors(position_in_world=expected, position_sigma=0.05)
    )
    before = cost_of(with_priors)
    assert before > cost_of(problem_of(model)) + 1.0
    target_from_world = Similarity3.exp(np.array([1.0, -2.0, 0.5, 0.3, 0.2, -0.4, 0.7]))
    moved = problem_of(model.transformed(target_from_world))
    along = replace(
        moved,
        priors=BundlePriors(
            position_in_world=target_from_world.apply(expected),
            position_sigma=0.05 * float(target_from_world.scale),
        ),
    )
    assert cost_of(along) == pytest.approx(before, rel=1e-9)
    left_behind = replace(moved, priors=BundlePriors(position_in_world=expected, position_sigma=0.05))
    assert cost_of(left_behind) > before + 1.0
