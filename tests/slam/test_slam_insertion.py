"""Insertion of a keyframe in two steps: the same as in one, and its points are tracked to a later frame."""

import cv2
import numpy as np
import pytest
from slam_rides import CAMERA, MONO, RGBD, ride

from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import Frame
from epipole.pipelines.slam.map.insertion import KeyframeInserter
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.tracking.points import Tracks
from epipole.pipelines.slam.tracking.tracker import PointTracker

CONFIG = SlamConfig().odometry


def textured() -> np.ndarray:
    noise = np.random.default_rng(1).uniform(0, 255, (60, 80)).astype(np.float32)
    return (
        cv2.resize(noise, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_CUBIC)
        .clip(0, 255)
        .astype(np.uint8)
    )


def test_two_steps_are_as_good_as_one():
    frames = ride().frames("rgbd")
    slam = Slam(RGBD)
    for frame in frames[:8]:
        slam.track(frame)
    tracks, pose, maps = slam.odometry.tracker.tracks, slam.odometry.cam_from_world, []
    tracks.keep(np.arange(len(tracks)) % 2 == 0)  # the others will be detected again
    tracked = Observations(tracks.pixels, np.full(len(tracks), np.nan), tracks.point)
    stale = np.concatenate([tracks.point[:5], np.setdiff1d(np.arange(slam.map.num_points), tracks.point)])
    for is_complete in (True, False):
        model = slam.map.copied()
        inserter = KeyframeInserter(model, RGBD, slam.focal_baseline, CONFIG)
        seen = inserter.find_points(frames[8], pose, tracked)
        inserter.insert(frames[8], 8, pose, seen if is_complete else tracked, stale)
        if not is_complete:
            added = inserter.complete(seen)
            assert len(added.point) == len(seen.point) - len(tracks)
            assert (seen.point[len(tracks) :] >= 0).sum() > 10 and (seen.point < 0).sum() > 10
        maps.append(model)
    (one, two), names = maps, ("pixels", "disparity_px", "point", "shift_px", "descriptors")
    for name in names:
        np.testing.assert_array_equal(getattr(one.keyframes[-1], name), getattr(two.keyframes[-1], name))
    for name in ("xyz", "anchor", "anchor_px", "num_agreed"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


@pytest.mark.parametrize("depth", [0.2, 10.0])
def test_new_points_of_one_camera_are_tracked_at_the_depth_of_the_others(rng, depth):
    """Whatever the unit: the image moves by 25 pixels, more than optical flow finds without a prediction at the right depth."""
    image, shift_px = textured(), 25.0
    later = cv2.warpAffine(image, np.float64([[1, 0, -shift_px], [0, 1, 0]]), image.shape[::-1])
    pixels = rng.uniform([60, 30], [290, 210], (60, 2))
    rays = CAMERA.unproject(pixels)
    known, model = depth * rays[:20] / rays[:20, 2:], SlamMap()
    rows = model.add_points(np.concatenate([known, np.full((40, 3), np.nan)]), pixels, 0)
    none = np.full(60, np.nan)
    keyframe = Keyframe(0, 0.0, image, Rigid3.identity(), Observations(pixels, none, rows))
    model.keyframes.append(keyframe)
    tracker = PointTracker(model, MONO, None, CONFIG)
    again = pixels[:21] - np.array([shift_px, 0.0])
    tracker.tracks = Tracks(again, rows[:21], pixels[:21])  # one was detected again meanwhile
    moved = Rigid3(np.eye(3), np.array([-shift_px * depth / CAMERA.params[0], 0.0, 0.0]))
    added = Observations(pixels[20:], none[20:], rows[20:])
    tracker.track_added(added, Frame(0.1, later), moved)
    found = tracker.tracks
    assert len(found) >= 55 and len(np.unique(found.point)) == len(found)
    off = np.linalg.norm(found.pixels - (pixels[found.point] - [shift_px, 0.0]), axis=1)
    assert np.mean(off < 0.3) > 0.9
