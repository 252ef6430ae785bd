"""SLAM on rendered rides with exact truth: where the camera was, what it waits for, and what it does not claim."""

import numpy as np
import pytest
from slam_rides import CAMERA, CAMERAS, MONO, RGBD, STEREO, ride, tracked

from epipole import _parallel
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.mapping import RefinedPose
from epipole.metrics import absolute_error
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import DepthCamera, Frame, SlamCamera, TrackingState
from epipole.pipelines.slam.output.export import reconstruction_of
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.tracking.frame_quality import FrameQuality
from epipole.pipelines.slam.tracking.points import parallax_px
from whole import IS_WHOLE


@pytest.fixture(scope="module")
def rides():
    return {kind: tracked(ride().frames(kind), camera) for kind, camera in CAMERAS.items()}


@pytest.mark.parametrize(("kind", "most_cm"), [("rgbd", 1.0), ("stereo", 1.5)])
def test_the_path_in_meters_where_depth_is_told(rides, kind, most_cm):
    slam, answers = rides[kind]
    assert [a.state for a in answers] == [TrackingState.TRACKING] * 30
    causal = absolute_error(
        slam.trajectory().world_from_body, ride().truth(), "none"
    )  # in the first frame's coordinates: nothing is aligned
    assert causal.position.rmse < 0.01 * most_cm and causal.rotation_deg.max < 0.5
    slam.finish()
    final = absolute_error(slam.trajectory().world_from_body, ride().truth(), "none")
    assert final.position.rmse < 0.01 * most_cm


def test_one_camera_gives_the_path_up_to_scale(rides):
    slam, answers = rides["mono"]
    origin, *others = answers
    assert origin.state is TrackingState.ROTATING and not origin.covariance.any()
    assert np.array_equal(origin.world_from_body.translation, np.zeros(3))
    waiting = [a for a in others if a.state is TrackingState.STARTING]
    start = others[len(waiting)].covariance  # a place that is not the world's origin is never known exactly
    assert (np.diag(start) > 0).all() and np.isfinite(start).all()
    assert len(waiting) <= 5 and all(a.world_from_body is None and a.reason for a in waiting)
    assert all(a.state is TrackingState.TRACKING for a in others[len(waiting) :])
    slam.finish()
    path = slam.trajectory()
    assert len(path) == 30  # the frames before the begin have their places, too
    truth = ride().truth()
    assert absolute_error(path.world_from_body, truth, "similarity").position.rmse < 0.006
    # The path is nearly a line, about which places tell no orientation: turns are compared from the first frame on.
    given, true = (all_.rotation[0].T @ all_.rotation for all_ in (path.world_from_body, truth))
    assert np.degrees(np.linalg.norm(Rotation3(np.swapaxes(given, 1, 2) @ true).log(), axis=1)).max() < 0.3


def test_keyframes_go_out_as_a_model(rides):
    slam, _ = rides["rgbd"]
    model = reconstruction_of(slam.map, CAMERA, [f"{n}.png" for n in range(30)])
    assert len(model.images) == len(slam.map.keyframes) >= 3
    assert model.mean_reprojection_error_px() < 1.0
    assert (np.diff(model.tracks.offsets) >= 2).all()


def test_the_covariance_is_of_the_size_of_the_error():
    """The calibration is exact; one that may be off moves nothing and widens the deviations."""
    paths = []
    for config in (SlamConfig(focal_sigma=0.0, center_sigma_px=0.0, depth_sigma=0.0), SlamConfig()):
        slam = Slam(RGBD, config)
        for frame in ride().frames("rgbd"):
            slam.track(frame)
        slam.finish()
        paths.append(slam.trajectory())
    path, wider = paths
    np.testing.assert_array_equal(wider.world_from_body.translation, path.world_from_body.translation)
    exact, variances = (np.diagonal(p.covariance, axis1=1, axis2=2) for p in paths)
    assert (variances >= exact - 1e-12).all() and (variances[-1, :3] > 4 * exact[-1, :3]).any()
    truth = ride().truth()
    error = np.linalg.norm(path.world_from_body.translation - truth.translation, axis=1)[1:]
    sigma = np.sqrt(path.covariance[1:, :3, :3].trace(axis1=1, axis2=2))
    assert (sigma > 0).all() and (sigma < 0.05).all()
    assert 0.2 < np.median(error / sigma) < 2


def test_a_turning_camera_gets_no_depth_out_of_nothing():
    slam, answers = tracked(ride("turn", 16).frames("mono"), MONO)
    assert all(a.state is TrackingState.ROTATING for a in answers) and not slam.map.num_points
    assert any("only rotates" in a.reason for a in answers)
    path = slam.trajectory()
    assert len(path) == 16 and not path.world_from_body.translation.any()
    assert np.isinf(path.covariance[1:, :3, :3]).all()  # of the place nothing is known, and that is said
    rotated = Rotation3(
        np.swapaxes(path.world_from_body.rotation, -1, -2) @ ride("turn", 16).truth().rotation
    )
    assert np.degrees(rotated.angle_rad()).max() < 0.1
    sigma = np.degrees(np.sqrt(np.diagonal(path.covariance[1:, 3:, 3:], axis1=1, axis2=2)))
    assert (sigma > 0).all() and sigma.max() < 0.1
    slam, answers = tracked(ride("turn", 16).frames("rgbd"), RGBD)
    assert all(a.state is TrackingState.TRACKING for a in answers)
    path = slam.trajectory().world_from_body
    assert np.linalg.norm(path.translation, axis=1).max() < 0.005
    rotated = Rotation3(np.swapaxes(path.rotation, -1, -2) @ ride("turn", 16).truth().rotation)
    assert np.degrees(rotated.angle_rad()).max() < 0.2


def test_a_resting_camera_rests():
    _, answers = tracked(ride("rest", 8).frames("mono"), MONO)
    assert all(a.state is TrackingState.ROTATING for a in answers) and "hardly moves" in answers[-1].reason
    rotated = Rotation3(np.stack([a.world_from_body.rotation for a in answers]))
    assert np.degrees(rotated.angle_rad()).max() < 0.05


def test_a_blank_wall_gives_no_begin():
    blank = np.full((240, 320), 128, np.uint8)
    for camera, extra in (
        (MONO, {}),
        (STEREO, {"right_gray": blank}),
        (RGBD, {"depth": np.ones((240, 320), np.float32)}),
    ):
        _, answers = tracked([Frame(0.1 * n, blank, **extra) for n in range(3)], camera)
        assert all(a.state is TrackingState.STARTING and a.world_from_body is None for a in answers)
        assert "blank" in answers[-1].reason


@pytest.mark.parametrize("kind", ["stereo"] + IS_WHOLE * ["rgbd"])
def test_only_parallax_may_make_keyframes(rides, kind):
    slam, answers = tracked(ride().frames(kind), CAMERAS[kind], SlamConfig(keyframe_rotation=False))
    assert all(a.state is TrackingState.TRACKING for a in answers)
    # The camera looks at one point while it passes: its rotation hides a part of the parallax.
    assert len(slam.map.keyframes) > len(rides[kind][0].map.keyframes)
    error = absolute_error(slam.trajectory().world_from_body, ride().truth(), "none").position
    assert error.rmse < 0.015
    blank = np.full((240, 320), 128, np.uint8)
    extra = {"right_gray": blank} if kind == "stereo" else {"depth": np.ones((240, 320), np.float32)}
    tracked([Frame(0.0, blank, **extra)], CAMERAS[kind], SlamConfig(keyframe_rotation=False))


def test_few_of_many_points_in_a_blurred_image_give_no_pose():
    pose, blurred = RefinedPose.__new__(RefinedPose), FrameQuality("the image is blurred")
    few = 2 * SlamConfig().min_tracked + 4
    assert blurred.confirmed((pose, few), 100, SlamConfig()) == (pose, few)
    assert blurred.confirmed((pose, few), 250, SlamConfig()) is None
    assert FrameQuality().confirmed((pose, few), 250, SlamConfig()) == (pose, few)
    assert blurred.confirmed(None, 250, SlamConfig()) is None


def test_parallax_is_motion_without_rotation():
    rng = np.random.default_rng(1)
    points = rng.uniform([-1, -1, 3], [1, 1, 5], (50, 3))
    first, moved = Rigid3.identity(), Rigid3(np.eye(3), np.array([0.1, 0.0, 0.0]))
    rotated = Rigid3.exp(np.array([0.0, 0.0, 0.0, 0.02, -0.05, 0.1]))
    pixels = CAMERA.project(rotated.apply(points))
    assert parallax_px(points, pixels, first, rotated, CAMERA) < 1e-9
    shift = np.linalg.norm(CAMERA.project(moved.apply(points)) - CAMERA.project(points), axis=1)
    both = parallax_px(points, pixels, first, moved, CAMERA)
    assert both == pytest.approx(float(np.median(shift)))
    assert parallax_px(points, pixels, first, rotated @ moved, CAMERA) == pytest.approx(both, rel=0.2)
    assert parallax_px(np.full((3, 3), np.nan), pixels[:3], first, moved, CAMERA) == 0.0


def test_the_same_answers_on_any_number_of_threads():
    frames = ride().frames("stereo")
    paths = []
    try:
        for threads in (1, 3):
            _parallel.set_num_threads(threads)
            again, _ = tracked(frames[:12], STEREO)
            paths.append(again.trajectory())
    finally:
        _parallel.set_num_threads(None)
    assert np.array_equal(paths[0].world_from_body.translation, paths[1].world_from_body.translation)
    assert np.array_equal(paths[0].covariance, paths[1].covariance)


def test_depth_of_a_sensor_beside_the_camera_is_registered(rides):
    """A sensor 10 cm to the side, with another lens: the path is as good as with registered depth."""
    from slam_rides import courtyard, render

    from epipole.cameras import Camera
    from epipole.geometry import Rigid3

    camera = Camera("PINHOLE", 280, 210, [240.0, 240.0, 139.5, 104.5])
    beside = Rigid3(np.eye(3), np.array([-0.10, 0.0, 0.0]))
    frames = []
    for n, frame in enumerate(ride().frames("rgbd")[:10]):
        seen = render(courtyard(), camera, beside @ ride().cams_from_world[n])
        frames.append(
            Frame(frame.timestamp_s, frame.gray, None, np.nan_to_num(seen.depth, nan=0.0).astype(np.float32))
        )
    truth = ride().truth()[np.arange(10)]
    slam, answers = tracked(frames, SlamCamera(CAMERA, None, DepthCamera(camera, beside)))
    assert all(a.state is TrackingState.TRACKING for a in answers)
    right = absolute_error(slam.trajectory().world_from_body, truth, "none").position.rmse
    assert right < 0.01
    wrong, _ = tracked(frames, SlamCamera(CAMERA, None, DepthCamera(camera, Rigid3.identity())))
    path = wrong.trajectory()
    rows = np.rint(path.timestamp_s * 10).astype(int)
    assert absolute_error(path.world_from_body, truth[rows], "none").position.rmse > 1.5 * right


@pytest.mark.usefixtures("unchecked")
def test_frames_that_do_not_fit_are_refused():
    frames = ride().frames("rgbd")
    slam = Slam(RGBD)
    slam.track(frames[0])
    with pytest.raises(ConfigError, match="timestamps must increase"):
        slam.track(frames[0])
    with pytest.raises(ShapeError, match="the image is 100 x 80"):
        slam.track(Frame(5.0, np.zeros((80, 100), np.uint8), None, frames[0].depth))
    with pytest.raises(ShapeError, match="the depth is 100 x 80, but the depth camera is 320 x 240"):
        slam.track(Frame(5.0, frames[0].gray, None, np.ones((80, 100), np.float32)))
    with pytest.raises(ConfigError, match="needs depth"):
        slam.track(Frame(5.0, frames[0].gray))
    with pytest.raises(ConfigError, match="right image"):
        Slam(STEREO).track(Frame(0.0, frames[0].gray))
    with pytest.raises(ConfigError, match="must be a number"):
        Frame(float("nan"), frames[0].gray)
    with pytest.raises(ConfigError, match="baseline must be positive"):
        SlamCamera(CAMERA, -1.0)
    for wrong in ({"num_features": 3}, {"max_error_px": 0.0}, {"min_angle_deg": 0.0}):
        with pytest.raises(ConfigError):
            SlamConfig(**wrong)
    assert slam.track(frames[1]).state is TrackingState.TRACKING  # what was refused has changed nothing


@pytest.mark.usefixtures("unchecked")
def test_depth_of_another_kind_is_told():
    frame = ride().frames("rgbd")[0]
    with pytest.raises(ShapeError, match=r"float32 in meters, got uint16"):
        Frame(0.0, frame.gray, None, (1000 * frame.depth).astype(np.uint16))
    with pytest.raises(ConfigError, match="the camera has no depth sensor"):
        Slam(MONO).track(frame)
    far = np.where(frame.depth > 0, frame.depth, np.inf).astype(np.float32)
    assert (far == np.inf).any()
    slam, _ = tracked(
        [
            Frame(f.timestamp_s, f.gray, None, np.where(f.depth > 0, f.depth, np.inf))
            for f in ride().frames("rgbd")[:4]
        ],
        RGBD,
    )
    plain, _ = tracked(ride().frames("rgbd")[:4], RGBD)
    np.testing.assert_array_equal(
        slam.trajectory().world_from_body.translation, plain.trajectory().world_from_body.translation
    )
