"""What goes wrong is said: a wrong lens, blur, darkness, a covered lens, things that move; and masks."""

from itertools import product

import cv2
import numpy as np
import pytest
from slam_rides import CAMERA, MONO, RGBD, STEREO, errors, ride, tracked, write_pairs

from epipole.cameras import Camera
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.io.calibration.camera_params import camera_of_text
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.frames import Frame, SlamCamera, TrackingState
from epipole.pipelines.slam.output.camera_check import camera_warnings, check_camera
from epipole.pipelines.slam.output.warnings import moving_things, rest, warnings
from epipole.pipelines.slam.run import slam as run_slam
from epipole.pipelines.slam.tracking.frame_quality import FrameQualityMonitor
from epipole.pipelines.slam.tracking.moving_objects import find_moving_object
from epipole.scene import Trajectory
from whole import IS_WHOLE

pytestmark = pytest.mark.usefixtures("unchecked_module")

PARAMS = ",".join(str(p + 0.5 * (n >= 2)) for n, p in enumerate(CAMERA.params))


def changed(frame: Frame, gray=None, right=None) -> Frame:
    """The frame with other images."""
    return Frame(
        frame.timestamp_s,
        frame.gray if gray is None else gray,
        frame.right_gray if right is None else right,
        frame.depth,
    )


def moved_blur(gray: np.ndarray, length_px: int, angle: float) -> np.ndarray:
    """The image of a camera that turned meanwhile, so that all moved along a line."""
    kernel = np.zeros((2 * length_px + 1, 2 * length_px + 1), np.float32)
    for t in np.linspace(-0.5, 0.5, 8 * length_px):
        x, y = length_px * (1 + t * np.cos(angle)), length_px * (1 + t * np.sin(angle))
        kernel[round(y), round(x)] += 1
    return cv2.filter2D(gray, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)


def bent(gray: np.ndarray, k1: float) -> np.ndarray:
    """What a lens with this radial term would have taken."""
    camera = Camera("OPENCV", CAMERA.width, CAMERA.height, [*CAMERA.params, k1, 0.0, 0.0, 0.0])
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    at = CAMERA.project(camera.unproject(np.stack([columns, rows], axis=2).reshape(-1, 2).astype(float)))
    table = at.reshape(CAMERA.height, CAMERA.width, 2).astype(np.float32)
    return cv2.remap(gray, table[..., 0], table[..., 1], cv2.INTER_LINEAR)


@pytest.mark.parametrize(
    ("kind", "factor", "k1", "wrong"),
    [
        ("mono", 1.0, 0.0, ""),
        ("mono", 1.0, -0.2, "distortion"),
        ("stereo", 0.9, 0.0, "focal length"),
    ]
    + IS_WHOLE
    * [("mono", 0.6, 0.0, "focal length"), ("mono", 1.1, 0.0, "focal length"), ("stereo", 1.0, 0.0, "")],
)
def test_a_wrong_lens_is_told_and_a_right_one_is_not(kind, factor, k1, wrong):
    params = CAMERA.params.copy()
    params[:2] *= factor
    given = Camera("PINHOLE", CAMERA.width, CAMERA.height, params)
    frames = ride().frames(kind)
    if k1:
        frames = [changed(f, bent(f.gray, k1)) for f in frames]
    slam, _ = tracked(frames, SlamCamera(given, STEREO.baseline if kind == "stereo" else None))
    slam.finish()
    found = check_camera(slam.map, given)
    words = camera_warnings(found, 0.0)
    assert [word for word in ("focal length", "distortion") if any(word in w for w in words)] == (
        [wrong] if wrong else []
    )
    assert abs(found.focal_px - 260.0) < 3.0 * found.focal_sigma_px < 20.0
    assert abs(found.k1 - k1) < 3.0 * found.k1_sigma < 0.15
    assert camera_warnings(None, 0.2) == [] and "2.5 px" in camera_warnings(None, 2.5)[0]


@pytest.mark.parametrize(
    ("kind", "length_px"),
    list(product(["mono", "rgbd"], [12, 20, 30])) if IS_WHOLE else [("mono", 12), ("rgbd", 30)],
)
def test_blurred_frames_are_told_and_no_keyframes(kind, length_px):
    frames, blurred = ride().frames(kind)[:24], {9, 10, 15, 19}
    for n in blurred:
        frames[n] = changed(frames[n], moved_blur(frames[n].gray, length_px, 0.9 * n))
    slam, answers = tracked(frames, MONO if kind == "mono" else RGBD)
    assert {n for n, a in enumerate(answers) if "the image is blurred" in a.reason} == blurred
    assert not blurred & {k.number for k in slam.map.keyframes if len(k.point)}
    assert all(a.state is TrackingState.TRACKING for a in answers[20:])
    if kind == "rgbd":
        assert errors(slam, ride().truth(), "none").position.max < 0.08
        assert length_px < 30 or all(answers[n].world_from_body is None for n in (10, 15, 19))


def test_a_usual_picture_is_no_blurred_one():
    """Five pixels of blur, noise, exposure and a new place are no reason."""
    noise, watch = np.random.default_rng(3), FrameQualityMonitor()
    for n, frame in enumerate(ride().frames("mono")):
        gray = frame.gray.astype(float) * (0.4 if n % 7 == 5 else 1.0) + noise.normal(
            0, n % 4, frame.gray.shape
        )
        assert not watch.assess(changed(frame, np.rint(gray).clip(0, 255).astype(np.uint8))).problem


@pytest.mark.parametrize(
    ("shade", "words"), [(2, "is dark"), (120, "is of one shade"), (255, "is overexposed: 100 %")]
)
def test_pictures_that_show_nothing_have_a_reason(shade, words):
    frames = ride().frames("rgbd")[:10]
    frames[6] = changed(frames[6], np.full_like(frames[6].gray, shade))
    _, answers = tracked(frames, RGBD)
    assert answers[6].world_from_body is None and words in answers[6].reason
    assert not answers[5].reason.startswith("the image") and answers[9].world_from_body is not None
    (warning,) = warnings(answers, Trajectory(np.zeros(0), Rigid3(np.zeros((0, 3, 3)), np.zeros((0, 3)))))
    assert warning.startswith("in 1 of 10 frames the image is")


@pytest.mark.parametrize(("side", "keyframe_motion"), [("left", 0.04), ("right", 0.04), ("left", 0.015)])
def test_with_one_lens_of_a_pair_covered_the_other_is_followed(side, keyframe_motion):
    """With frame 6 as a keyframe, 16 points match the noise of a dark image."""
    frames, noise = ride().frames("stereo")[:24], np.random.default_rng(6)
    for n in range(8, 16):
        dark = noise.normal(4.0, 2.0, frames[n].gray.shape).clip(0, 255).astype(np.uint8)
        frames[n] = changed(frames[n], **{"gray" if side == "left" else "right": dark})
    slam, answers = tracked(frames, STEREO, SlamConfig(keyframe_motion=keyframe_motion))
    assert all(a.state is TrackingState.TRACKING for a in answers)
    assert all(f"the {side} image is dark" in a.reason for a in answers[8:16])
    assert [n for n, a in enumerate(answers) if "tracked in the right image" in a.reason] == (
        list(range(8, 16)) if side == "left" else []
    )
    assert side == "right" or not any(a.is_keyframe for a in answers[8:16])
    waiting = {seen.number for seen in slam.odometry.tracker.waiting}  # their poses are estimated again later
    assert waiting and (side == "right" or not waiting & set(range(8, 16)))
    truth = ride().truth().translation
    for n, answer in enumerate(answers):
        assert np.linalg.norm(answer.world_from_body.translation - truth[n]) < 0.03
    assert np.linalg.eigvalsh(answers[12].covariance).min() > 0
    assert errors(slam, ride().truth(), "none").position.max < 0.03


def test_a_second_motion_is_that_of_points_that_agree(rng):
    points = rng.uniform([-0.5, -0.5, 2.0], [0.5, 0.5, 2.6], (40, 3))
    moved = Rigid3.exp(np.array([0.05, 0.0, 0.0, 0.0, 0.02, 0.0]))
    seen = CAMERA.project(moved.apply(points)) + rng.normal(0, 0.2, (40, 2))
    here = Rigid3.identity()
    config = SlamConfig()
    found = find_moving_object(points, seen, CAMERA, here, config)
    assert found.num_points > 35
    np.testing.assert_allclose(found.motion, (moved.apply(points) - points).mean(axis=0), atol=0.01)
    assert np.all(np.array(found.low_px) < np.median(seen, axis=0)) and np.all(
        found.high_px > np.median(seen, axis=0)
    )
    chance = seen + rng.uniform(-20, 20, (40, 2))
    assert find_moving_object(points, chance, CAMERA, here, config) is None
    assert find_moving_object(points[:10], seen[:10], CAMERA, here, config) is None
    assert moving_things([]) is None


def test_nothing_is_taken_from_under_a_mask():
    frames = []
    for frame in ride().frames("mono")[:24]:
        mask = np.zeros(frame.gray.shape, bool)
        mask[:, 200:] = True
        frames.append(Frame(frame.timestamp_s, frame.gray, ignored_mask=mask))
    slam, answers = tracked(frames, MONO)
    assert slam.map.num_points > 100 and answers[-1].state is TrackingState.TRACKING
    assert max(k.pixels[:, 0].max() for k in slam.map.keyframes) < 200
    slam.finish()  # keyframes are shown all that is in sight
    assert max(k.pixels[:, 0].max() for k in slam.map.keyframes) < 200


def test_a_camera_that_rests_or_only_turns_is_told():
    def path(positions: Rigid3) -> Trajectory:
        sigma = np.broadcast_to(np.diag([1e-6] * 6), (len(positions.translation), 6, 6)).copy()
        return Trajectory(np.arange(len(positions.translation)) * 0.1, positions, sigma)

    still = Rigid3(np.tile(np.eye(3), (6, 1, 1)), np.full((6, 3), 1e-4) * np.arange(6)[:, None])
    assert "is at rest" in rest(path(still))
    rotation = Rigid3.exp(np.array([[0, 0, 0, 0, 0.1 * n, 0] for n in range(6)]))
    assert "only rotates, by up to 28.6 degrees" in rest(path(rotation))
    assert rest(path(Rigid3(still.rotation, 0.1 * np.arange(18.0).reshape(6, 3)))) == ""


@pytest.mark.usefixtures("unchecked")
def test_start_stride_rate_and_masks_of_a_folder(tmp_path):
    folder = write_pairs(tmp_path / "ride", 24) / "image_0"
    masks = tmp_path / "masks"
    masks.mkdir()
    for n in range(24):
        mask = np.full(ride().left[0].shape, 255, np.uint8)
        mask[:, :60] = 0
        cv2.imwrite(str(masks / f"{n:06d}.png"), mask)
    known = {"camera_params": PARAMS}
    result = run_slam(folder, tmp_path / "out", start=3, stride=2, fps=10.0, masks=masks, **known)
    np.testing.assert_allclose(result.trajectory.timestamp_s, 0.1 * np.arange(3, 24, 2))
    assert result.summary["num_frames"] == 11 and not any(
        "per second are assumed" in w for w in result.warnings
    )
    result = run_slam(folder, tmp_path / "out2", max_frames=6, **known)
    assert any("30 per second are assumed" in w for w in result.warnings)
    with pytest.raises(ConfigError, match="no image has a mask"):
        run_slam(folder, tmp_path / "out3", masks=folder.parent / "image_1" / "none", **known)
    with pytest.raises(ConfigError, match="have times"):
        run_slam(folder.parent, tmp_path / "out3", fps=5.0)
    with pytest.raises(ConfigError, match="start must be >= 0"):
        run_slam(folder, tmp_path / "out3", stride=0, **known)


def test_the_message_of_wrong_parameters_has_an_example():
    with pytest.raises(
        ConfigError, match=r"for example, 640,640,320,240; cx and cy are relative to the image corner, half"
    ):
        camera_of_text(CAMERA.model, (640, 480), "525")
