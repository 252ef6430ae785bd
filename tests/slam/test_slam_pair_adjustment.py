"""A pair's second principal point: found where it is off, and left alone where patches' own errors would tell as much."""

import numpy as np
import pytest
from slam_rides import CAMERA, STEREO

from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.map.local_mapping import LEAST_TOGETHER, LocalMapper
from epipole.pipelines.slam.map.pair_adjustment import LEAST_SHIFT_PX
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap

FOCAL_BASELINE = 31.2


def scene(rng, shift_px: float) -> tuple[LocalMapper, Rigid3]:
    """Keyframes of a pair whose second principal point is further right by so much, with noise, and their true places."""
    points = np.stack([rng.uniform(-2, 2, 200), rng.uniform(-1, 1, 200), rng.uniform(2, 6, 200)], axis=1)
    positions = Rigid3.exp(
        np.array([[0.25 * k, 0.02 * k, 0.3 * k, 0.01 * k, 0.05 * k, 0] for k in range(LEAST_TOGETHER)])
    )
    model = SlamMap()
    rows = model.add_points(points + 0.02 * rng.normal(size=points.shape), np.zeros((200, 2)), 0)
    for k in range(LEAST_TOGETHER):
        in_cam = positions[k].apply(points)
        disparity = FOCAL_BASELINE / in_cam[:, 2] - shift_px + 0.05 * rng.normal(size=200)
        seen = CAMERA.project(in_cam) + 0.05 * rng.normal(size=(200, 2))
        keyframe = Keyframe(
            k, k / 10, np.zeros((240, 320), np.uint8), positions[k], Observations(seen, disparity, rows)
        )
        model.keyframes.append(keyframe)
    return LocalMapper(model, STEREO, FOCAL_BASELINE, SlamConfig()), positions


@pytest.mark.parametrize(("shift_px", "is_given"), [(0.0, False), (0.05, False), (0.25, True), (-0.4, True)])
def test_only_a_shift_that_patches_do_not_make_is_told(rng, shift_px, is_given):
    assert (abs(shift_px) > LEAST_SHIFT_PX) == is_given
    mapper, positions = scene(rng, shift_px)
    mapper.adjust_all()
    mapper.adjust_all()
    if is_given:
        # Pixels count as if they were off by one, so that what is expected of the rectification pulls.
        assert 0.75 < mapper.map.right_shift_px / shift_px < 1.05
    else:
        assert mapper.map.right_shift_px == 0.0
    last = mapper.map.keyframes[-1].cam_from_world
    off = (last @ positions[LEAST_TOGETHER - 1].inverse()).log()
    assert np.linalg.norm(off[:3]) < 0.03  # of 2.8 m; a quarter of a pixel left in it makes it 8 cm


def test_an_adjustment_ends_after_the_step_at_which_it_is_asked_to(rng):
    mapper, _ = scene(rng, 0.0)
    usual, asked = mapper.adjust_all(), []
    assert usual is not None and usual.result.num_iterations > 1
    hurried, _ = scene(np.random.default_rng(3), 0.0)
    hurried.goes_on = lambda: bool(asked.append(1))
    adjusted = hurried.adjust_all()
    assert adjusted is not None and adjusted.result.num_iterations == 1 and asked
    assert adjusted.result.final_cost < adjusted.result.initial_cost
