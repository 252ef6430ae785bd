"""Rides keep their truth: what one frame sees with its depth is where the next frame sees it, rows and all."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3
from epipole.synthetic import look_at, render, rides
from epipole.synthetic.ride import Ride, Shutter

SIZE = (160, 120)
SILENT = Shutter(noise_sigma=0.0)
MAKERS: dict[str, Callable[..., Ride]] = {
    "loop_room": rides.loop_room,
    "rotate_only": rides.rotate_only,
    "corridor": rides.corridor,
    "tiled_room": rides.tiled_room,
    "walking_box": rides.walking_box,
    "shuttered": rides.shuttered,
}


def silent(name: str) -> Ride:
    return replace(MAKERS[name](size=SIZE), shutter=SILENT)


def agreeing(ride: Ride, first: int, second: int, truth: Ride | None = None) -> tuple[float, float, float]:
    """Of the pixels of one frame that the other has in its image: share, share with the right depth, gray difference."""
    here, there = ride.left(first), ride.left(second)
    positions = (ride if truth is None else truth).world_from_camera
    v, u = np.mgrid[2 : SIZE[1] - 2 : 3, 2 : SIZE[0] - 2 : 3].reshape(2, -1)
    points = ride.camera.unproject(np.stack([u, v], axis=1).astype(float))
    points *= (here.depth[v, u] / points[:, 2])[:, None]
    in_second = (positions[second].inverse() @ positions[first]).apply(points)
    at = ride.camera.project(in_second)
    inside = (in_second[:, 2] > 0) & (at > 1).all(axis=1) & (at < np.array(SIZE) - 2).all(axis=1)
    near = np.rint(at[inside]).astype(int)
    depth = there.depth[near[:, 1], near[:, 0]]
    right = np.abs(depth - in_second[inside, 2]) < 0.03 * depth
    gray = np.abs(here.gray[v, u][inside].astype(float) - there.gray[near[:, 1], near[:, 0]])
    return inside.mean(), right.mean(), float(np.median(gray[right]))


@pytest.mark.parametrize(
    ("name", "first", "second"),
    [
        ("loop_room", 30, 36),
        ("loop_room", 5, 365),
        ("rotate_only", 20, 24),
        ("corridor", 40, 46),
        ("corridor", 3, 600),
        ("tiled_room", 100, 106),
        ("tiled_room", 2, 362),
        ("walking_box", 10, 20),
        ("shuttered", 60, 63),
    ],
)
def test_a_point_is_seen_where_the_truth_says(name: str, first: int, second: int) -> None:
    fraction, right, gray = agreeing(silent(name), first, second)
    assert fraction > 0.4
    assert right > 0.95
    assert gray < 3


def test_another_place_does_not_agree() -> None:
    ride, stopped = silent("loop_room"), 35 / rides.RATE_HZ
    late = replace(ride, world_from_camera_at=lambda t: ride.world_from_camera_at(t + 0.1 * (t > stopped)))
    # The image of frame 36 is now that of 39, and agrees: the truth goes along. The old truth does not.
    assert agreeing(late, 30, 36)[1] > 0.95
    assert agreeing(late, 30, 36, truth=ride)[1] < 0.8


def test_the_right_camera_stands_a_baseline_aside() -> None:
    ride = silent("loop_room")
    left, right = ride.left(12), ride.right(12)
    focal = ride.camera.params[0]
    v, u = np.mgrid[5 : SIZE[1] - 5 : 2, 60 : SIZE[0] - 5 : 2].reshape(2, -1)
    moved = u - focal * ride.baseline / left.depth[v, u]
    near = np.rint(moved).astype(int)
    same = np.abs(right.depth[v, near] - left.depth[v, u]) < 0.02 * left.depth[v, u]
    assert same.mean() > 0.9
    assert np.median(np.abs(left.gray[v, u].astype(float) - right.gray[v, near])[same]) < 4


def test_the_box_walks_with_its_texture_and_the_camera_rests() -> None:
    ride = silent("walking_box")
    positions = ride.world_from_camera.translation
    np.testing.assert_allclose(positions[90], positions[150], atol=1e-12)
    one, two = ride.left(115), ride.left(125)
    moved = np.abs(one.depth - two.depth) > 0.3
    assert 0.05 < moved.mean() < 0.4
    depth = 1.8 + np.zeros(SIZE[::-1])
    on_box = np.abs(one.depth - depth) < 0.05
    assert 0.2 < on_box.mean() < 0.4
    # Ten frames of 3.2 cm, 1.8 m away.
    shift = 10 * 0.96 / rides.RATE_HZ / 1.8 * ride.camera.params[0]
    v, u = np.nonzero(on_box)
    at = np.rint(u - shift).astype(int)
    same = np.abs(two.depth[v, at] - one.depth[v, u]) < 0.05
    assert same.mean() > 0.9
    difference = np.abs(one.gray[v, u].astype(float) - two.gray[v, at])[same]
    assert np.median(difference) < 4 < np.median(np.abs(one.gray[v, u].astype(float) - two.gray[v, u]))


def test_the_corridor_goes_blank_and_its_end_sees_its_begin() -> None:
    ride = silent("corridor")
    blank = [n for n in range(91, 125) if np.ptp(ride.left(n).gray) <= 4]
    assert blank == list(range(blank[0], blank[-1] + 1))
    assert 17 <= len(blank) <= 25
    assert np.ptp(ride.left(200).gray) > 60
    assert np.ptp(ride.left(395).gray) > 60


def test_four_places_look_alike_and_are_not_one() -> None:
    ride = silent("tiled_room")
    positions = ride.world_from_camera
    for first in (0, 33):
        one = ride.left(first).gray.astype(float)
        for quarter in (90, 180, 270):
            other = ride.left(first + quarter).gray.astype(float)
            assert np.corrcoef(one.ravel(), other.ravel())[0, 1] > 0.8
            between = positions[first].inverse() @ positions[first + quarter]
            assert np.linalg.norm(between.translation) > 0.9
        there = ride.left(first + 45).gray.astype(float)
        assert np.corrcoef(one.ravel(), there.ravel())[0, 1] < 0.5


def test_turning_on_the_spot_moves_nothing() -> None:
    positions = rides.rotate_only(size=SIZE).world_from_camera
    assert np.ptp(positions.translation, axis=0).max() == 0
    steps = (positions[:-1].inverse() @ positions[1:]).log()
    np.testing.assert_allclose(np.linalg.norm(steps[:, 3:], axis=1), np.deg2rad(1.8), rtol=0.01)


def test_each_row_is_drawn_from_its_own_place() -> None:
    ride = rides.shuttered(size=SIZE)
    ride = replace(ride, shutter=replace(ride.shutter, noise_sigma=0.0))
    frame, height = 40, SIZE[1]
    seen = ride.left(frame)
    still = replace(ride, shutter=SILENT)
    middle = ride.timestamp_s[frame]
    for row in (0, 17, 60, height - 1):
        # Rows follow each other evenly; the middle of the image is read at the frame's time.
        time = middle + 0.03 * (row + 0.5 - 0.5 * height) / height
        moment = replace(still, timestamp_s=np.array([time]))
        np.testing.assert_array_equal(moment.left(0).gray[row], seen.gray[row])
        np.testing.assert_array_equal(moment.left(0).depth[row], seen.depth[row])
        if row in (0, height - 1):
            assert (moment.left(0).gray[height // 2] != seen.gray[height // 2]).mean() > 0.2


def test_motion_blur_is_the_mean_of_sharp_pictures() -> None:
    ride = silent("rotate_only")
    blurred = replace(ride, shutter=Shutter(exposure_s=0.03, num_exposures=4, noise_sigma=0.0))
    times = ride.timestamp_s[8] + 0.03 * (np.arange(4) - 1.5) / 4
    sharp = replace(ride, timestamp_s=times)
    mean = np.mean([sharp.left(n).gray.astype(float) for n in range(4)], axis=0)
    # Colors are rounded before they become gray, here and there.
    np.testing.assert_allclose(blurred.left(8).gray, mean, atol=2.0)
    contrast = [
        np.abs(np.diff(p.astype(float), axis=1)).mean() for p in (blurred.left(8).gray, ride.left(8).gray)
    ]
    assert contrast[0] < 0.75 * contrast[1]


def test_light_and_noise() -> None:
    ride = silent("loop_room")
    darker = replace(ride, gain=np.full(len(ride), 0.5))
    np.testing.assert_allclose(darker.left(3).gray, 0.5 * ride.left(3).gray, atol=1.5)
    noisy = replace(ride, shutter=Shutter(noise_sigma=3.0))
    difference = noisy.left(3).gray.astype(float) - ride.left(3).gray
    # Rounding adds 1/12 to the variance; 19200 values know their deviation to 0.5 %.
    assert difference.std() == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.03)
    assert (noisy.left(3).gray == noisy.left(3).gray).all()
    assert (noisy.left(3).gray.astype(float) - noisy.right(3).gray).std() > 3.0


def test_looking_is_look_at() -> None:
    center, yaw, pitch = np.array([[1.0, 2.0, 3.0]]), np.array([0.4]), np.array([-0.2])
    forward = np.array([np.cos(0.4) * np.cos(0.2), np.sin(0.4) * np.cos(0.2), -np.sin(0.2)])
    level = rides.facing(center, yaw, pitch, np.zeros(1))
    expected = look_at(center[0], center[0] + forward).inverse()
    np.testing.assert_allclose(level.rotation[0], expected.rotation, atol=1e-12)
    rolled = rides.facing(center, yaw, pitch, np.array([0.3]))
    rotation = level[0].inverse() @ rolled[0]
    np.testing.assert_allclose(rotation.log(), [0, 0, 0, 0, 0, 0.3], atol=1e-12)


def test_a_global_shutter_without_blur_is_render() -> None:
    ride = silent("loop_room")
    position = ride.world_from_camera[7].inverse()
    depth = render(ride.scene_at(0.0), ride.camera, position).depth
    np.testing.assert_array_equal(ride.left(7).depth, depth.astype(np.float32))


def test_misuse_is_refused() -> None:
    ride = rides.loop_room(num_frames=3, size=SIZE)
    assert len(ride.truth()) == len(ride) == 3
    for frame in (-1, 3):
        with pytest.raises(ConfigError, match="frame must be"):
            ride.left(frame)
    with pytest.raises(ConfigError, match="at least 1 frame"):
        rides.corridor(num_frames=0)
    with pytest.raises(ConfigError, match="readout_s"):
        rides.shuttered(readout_s=-0.1)
    with pytest.raises(ConfigError, match="num_exposures"):
        Shutter(num_exposures=0)
    with pytest.raises(ConfigError, match="baseline"):
        replace(ride, baseline=0.0)
    with pytest.raises(ShapeError, match="increase"):
        replace(ride, timestamp_s=np.zeros(3))


def test_no_ride_but_the_turn_runs_along_a_line() -> None:
    for name, make in MAKERS.items():
        centers = make(size=SIZE).world_from_camera.translation
        spread = np.linalg.svd(centers - centers.mean(axis=0), compute_uv=False)
        assert spread[1] > 0.01 * spread[0] > 0 or name == "rotate_only"


def test_world_is_z_up_and_cameras_upright() -> None:
    for make in MAKERS.values():
        positions: Rigid3 = make(num_frames=50, size=SIZE).world_from_camera
        np.testing.assert_allclose(np.linalg.det(positions.rotation), 1.0, atol=1e-12)
        assert (positions.rotation[:, 2, 1] < -0.9).all()
