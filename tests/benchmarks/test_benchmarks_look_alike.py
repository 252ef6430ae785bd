"""Scores of the look-alike scenes: overlap by exact depth, and the verdict on models."""

from pathlib import Path

import numpy as np
from benchmarks.look_alike_score import ModelScore, verdict
from benchmarks.tasks.look_alike import RenderedTask, common_fraction, project_into
from benchmarks.tasks.sfm import SfmTask

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3

SIZE = (48, 36)


def wall_from(*x_m: float, is_opposite: bool = False) -> RenderedTask:
    """Cameras beside each other, 2 m in front of a wall that fills their images; half the width is 1 m there."""
    camera = Camera(CameraModel.PINHOLE, *SIZE, np.array([48.0, 48.0, 23.5, 17.5]))
    rotation = np.stack([np.eye(3)] * len(x_m))
    if is_opposite:
        rotation[-1] = np.diag([-1.0, 1.0, -1.0])
    centers = np.array([[x, 0.0, 0.0] for x in x_m])
    cams_from_world = Rigid3(rotation, -(rotation @ centers[..., None])[..., 0])
    task = SfmTask("wall", Path(), tuple(f"{k}.png" for k in range(len(x_m))), "")
    return RenderedTask(task, camera, cams_from_world, np.full((len(x_m), SIZE[1], SIZE[0]), 2.0))


def model(max_percent: float, num_wrong: int = 0) -> ModelScore:
    return ModelScore(10, 0.0, 0.0, 0.0, max_percent, 0.0, num_wrong)


def test_overlap_is_the_fraction_of_pixels_with_a_common_surface() -> None:
    scene = wall_from(0.0, 1.0, 2.5)
    assert common_fraction(scene, 0, 0) == 1.0
    assert abs(common_fraction(scene, 0, 1) - 0.5) < 0.1
    assert common_fraction(scene, 0, 2) == 0.0
    assert common_fraction(wall_from(0.0, 0.1, is_opposite=True), 0, 1) == 0.0
    assert scene.size_m == 2.5


def test_a_pixel_is_projected_with_its_depth() -> None:
    at, depth = project_into(wall_from(0.0, 0.5), 0, 1, np.array([[23.5, 17.5]]))
    np.testing.assert_allclose(at, [[23.5 - 0.5 / 2.0 * 48.0, 17.5]])
    np.testing.assert_allclose(depth, [2.0])


def test_verdicts() -> None:
    assert verdict([]) == "no model"
    assert verdict([model(0.5)]) == "right"
    assert verdict([model(0.5), model(0.2)]) == "split"
    assert verdict([model(3.0)]) == "inaccurate"
    assert verdict([model(0.5), model(8.0, num_wrong=1)]) == "wrong model"
