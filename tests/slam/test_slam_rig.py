"""SLAM with a rig of three fisheye cameras, two of which look ahead and one back: meters, a covered camera, maps and files."""

import cv2
import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader

from bag_writing import Recorded
from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.errors import ConfigError, FileFormatError, NoModelError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.geometry.alignment import align_points
from epipole.io import read_colmap_model, read_trajectory
from epipole.metrics import absolute_error
from epipole.pipelines.slam import run
from epipole.pipelines.slam.frames import Frame, SlamCamera
from epipole.pipelines.slam.map import mounting_check
from epipole.pipelines.slam.map.mounting_check import check_mounting
from epipole.pipelines.slam.output.export import reconstruction_of
from epipole.pipelines.slam.output.map_file import read_slam_map, write_slam_map
from epipole.pipelines.slam.output.scene import image_loader
from epipole.pipelines.slam.slam import Slam
from epipole.pipelines.slam.tracking.points import predict_pixels
from epipole.pipelines.slam.tracking.pose_search import search_pose
from epipole.scene import CameraRig, Trajectory
from epipole.synthetic import render, rides
from whole import IS_WHOLE, in_whole_run

pytestmark = pytest.mark.usefixtures("unchecked_module")

COUNT, STEP = 26, 4
SIZE = (240, 180)
PARAMS = [95.0, 95.0, 119.5, 89.5, 0.02, 0.0, 0.0, 0.0]
CAMERA = Camera("OPENCV_FISHEYE", *SIZE, PARAMS)


def rig_of(*mounted):
    """Cameras that look to these sides (degrees), at these positions (x right, z ahead)."""
    rotations = [Rotation3.exp(np.array([0.0, np.radians(yaw), 0.0])).matrix.T for yaw, _ in mounted]
    shifts = [-r @ np.array([x, 0.0, z]) for r, (_, (x, z)) in zip(rotations, mounted)]
    return CameraRig((CAMERA,) * len(mounted), Rigid3(np.stack(rotations), np.stack(shifts)))


RIG = rig_of((0, (0.0, 0.0)), (25, (0.18, 0.0)), (180, (0.1, -0.15)))


@pytest.fixture(scope="module")
def ride():
    return rides.loop_room(COUNT * STEP, SIZE)


@pytest.fixture(scope="module")
def images(ride):
    """Images of each instant, and rig_from_world."""
    positions = ride.world_from_camera.inverse()
    out = []
    for n in range(COUNT):
        scene = ride.scene_at(float(ride.timestamp_s[STEP * n]))
        poses = [RIG.cam_from_rig[k] @ positions[STEP * n] for k in range(3)]
        seen = [render(scene, CAMERA, pose, noise_sigma=2.0, seed=n).rgb for pose in poses]
        out.append([cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in seen])
    return out


@pytest.fixture(scope="module")
def truth(ride):
    positions = ride.world_from_camera.inverse()[np.arange(0, COUNT * STEP, STEP)]
    return (positions @ positions[0].inverse()).inverse()


def frames_of(images, covered=None):
    for n, row in enumerate(images):
        row = [np.zeros_like(i) if k == covered and n >= COUNT // 2 else i for k, i in enumerate(row)]
        yield Frame.from_rig(0.1 * n, row, RIG)


@pytest.fixture(scope="module")
def tracked(images):
    system = Slam(SlamCamera.of_cameras(RIG))
    return system, [system.track(frame) for frame in frames_of(images)]


def test_the_trajectory_is_in_meters_and_the_covariance_covers_its_error(tracked, truth):
    _, answers = tracked
    assert all(answer.world_from_body is not None for answer in answers)
    positions = np.stack([answer.world_from_body.translation for answer in answers])
    off = np.linalg.norm(positions - truth.translation, axis=1)
    length = np.linalg.norm(np.diff(truth.translation, axis=0), axis=1).sum()
    assert off.max() < 0.02 and length > 1.5
    scale = 1.0 / float(align_points(positions, truth.translation, with_scale=True).scale)
    assert abs(scale - 1.0) < 0.004
    sigma = np.sqrt([np.trace(answer.covariance[:3, :3]) for answer in answers])
    assert np.median(off[5:] / sigma[5:]) < 2.0 and np.median(sigma[5:]) < 0.02


def test_points_are_seen_by_several_cameras_and_fit_all_of_them(tracked):
    system, _ = tracked
    newest = system.map.keyframes[-1]
    which = RIG.camera_of(newest.pixels)
    assert set(which) == {0, 1, 2}
    both = np.intersect1d(newest.point[which == 0], newest.point[which == 1])
    assert len(both) > 30
    pairs = np.stack([newest.point, which])
    assert len(np.unique(pairs, axis=1)[0]) == len(newest.point)  # once in each image
    names = [f"cam0/{k.number:03d}.png" for k in system.map.keyframes]
    model = reconstruction_of(system.map, RIG, names)
    assert len(model.images) == 3 * len(names) and model.images.name[2] == "cam2/000.png"
    errors = model.reprojection_errors_px()
    assert np.nanmedian(errors) < 0.5 and np.isfinite(errors).mean() > 0.99


@pytest.mark.parametrize("covered", [0] + IS_WHOLE * [2])
def test_a_covered_camera_does_not_stop_the_others(images, truth, covered):
    system = Slam(SlamCamera.of_cameras(RIG))
    answers = [system.track(frame) for frame in frames_of(images, covered)]
    assert all(answer.world_from_body is not None for answer in answers)
    found = Rigid3(
        np.stack([a.world_from_body.rotation for a in answers]),
        np.stack([a.world_from_body.translation for a in answers]),
    )
    assert absolute_error(found, truth, "none").position.max < 0.05


def test_the_map_is_read_back_and_localizes_the_rig(tracked, images, truth, tmp_path):
    system, _ = tracked
    camera, path = SlamCamera.of_cameras(RIG), tmp_path / "map.npz"
    write_slam_map(path, system.map, [f"{k.number}" for k in system.map.keyframes], camera)
    known = read_slam_map(path, camera)
    assert known.is_metric and len(known.model.keyframes) == len(system.map.keyframes)
    again = Slam(camera, known=known.model, is_map_fixed=True)
    frames = list(frames_of(images))[10:14]
    found = [again.track(frame).world_from_body for frame in frames]
    for pose, true in zip(found, truth.translation[10:14]):
        assert pose is not None and np.linalg.norm(pose.translation - true) < 0.02
    for other in (
        SlamCamera(CAMERA),
        SlamCamera.of_cameras(rig_of((0, (0.0, 0.0)), (25, (0.28, 0.0)), (180, (0.1, -0.15)))),
    ):
        with pytest.raises(ConfigError, match="another camera or rig"):
            read_slam_map(path, other)


def test_cameras_without_a_common_view_start_when_their_motion_shows_the_scale(images, truth):
    apart = CameraRig(
        (CAMERA, CAMERA), Rigid3(RIG.cam_from_rig.rotation[[0, 2]], RIG.cam_from_rig.translation[[0, 2]])
    )
    assert not apart.measures_depth
    system = Slam(SlamCamera.of_cameras(apart))
    answers = [system.track(Frame.from_rig(0.1 * n, [row[0], row[2]], apart)) for n, row in enumerate(images)]
    started = next(n for n, answer in enumerate(answers) if answer.has_pose)
    assert 10 < started < COUNT - 3 and "scale is unknown" in answers[started - 1].reason
    assert all(answer.has_pose for answer in answers[started:])
    system.finish()
    path = system.trajectory()
    assert len(path) > COUNT - 5  # with the frames before the start
    rows = np.rint(path.timestamp_s / 0.1).astype(int)
    found = path.world_from_body
    assert absolute_error(found, truth[rows], "rigid").position.max < 0.03
    scale = 1.0 / float(align_points(found.translation, truth.translation[rows], with_scale=True).scale)
    # A quarter of a circle nearly around the rig's center hides the scale, and the covariance says so.
    off = np.linalg.norm(found.translation - truth.translation[rows], axis=1)
    sigma = np.sqrt(np.trace(path.covariance[:, :3, :3], axis1=1, axis2=2))
    assert abs(scale - 1.0) < 0.05 and np.median(off[5:] / sigma[5:]) < 2.0


@in_whole_run
def test_the_other_cameras_start_if_one_of_those_with_a_common_view_is_covered(images):
    """Cameras 0 and 1 have a common view; with camera 1 covered from the beginning, motion shows the scale."""
    system, dark = Slam(SlamCamera.of_cameras(RIG)), np.zeros_like(images[0][1])
    answers = [
        system.track(Frame.from_rig(0.1 * n, [row[0], dark, row[2]], RIG)) for n, row in enumerate(images)
    ]
    assert not answers[0].has_pose and "too few points together" in answers[0].reason
    assert answers[-1].has_pose and sum(answer.has_pose for answer in answers) > 3


def test_images_of_one_instant_keep_their_names(tracked):
    system, _ = tracked
    names = [f"cam0/{k.number:03d}.png" for k in system.map.keyframes]
    given = {names[0]: (names[0], "cam1/late.png", "cam2/later.png")}
    model = reconstruction_of(system.map, RIG, names, given)
    assert model.images.name[:3] == (names[0], "cam1/late.png", "cam2/later.png")
    assert model.images.name[3:6] == tuple(names[1].replace("cam0", f"cam{k}") for k in range(3))


@in_whole_run
def test_a_thread_maps_beside_tracking(images, truth):
    system = Slam(SlamCamera.of_cameras(RIG), mapping="thread")
    answers = [system.track(frame) for frame in frames_of(images)]
    system.finish()
    assert all(answer.world_from_body is not None for answer in answers)
    assert absolute_error(system.trajectory().world_from_body, truth, "none").position.rmse < 0.02


def kalibr_file(path):
    """The calibration of the rig, as Kalibr writes it."""
    chain = {}
    for k in range(3):
        chain[f"cam{k}"] = {
            "camera_model": "pinhole", "distortion_model": "equidistant", "distortion_coeffs": PARAMS[4:],
            "intrinsics": PARAMS[:4], "resolution": list(SIZE),
        }  # fmt: skip
        if k:
            moved = RIG.cam_from_rig[k] @ RIG.cam_from_rig[k - 1].inverse()
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = moved.rotation, moved.translation
            chain[f"cam{k}"]["T_cn_cnm1"] = matrix.tolist()
    path.write_text(yaml.safe_dump(chain))
    return path


def test_a_bag_with_a_topic_for_each_camera_is_a_rig(images, truth, tmp_path):
    """Topics in another order than by name; the images of one instant are 2 ms apart."""
    recorded = Recorded("mcap")
    topics = ("/ahead/image_raw", "/side/image_raw", "/back/image_raw")
    for n, row in enumerate(images[:12]):
        for topic, image, late_ms in zip(topics, row, (0, 2, 1)):
            recorded.image(topic, 10**8 * (10 + n) + 10**6 * late_ms, image, "mono8")
    source = recorded.write(tmp_path)
    options = {"sensor": "rig", "calibration": kalibr_file(tmp_path / "camchain.yaml")}
    found = run.slam(source, tmp_path / "out", topics=",".join(topics), **options)
    assert found.summary["is_metric"] and "rig's 3 cameras" in found.summary["scale"]
    path = read_trajectory(tmp_path / "out" / "trajectory.txt")
    assert len(path) == 12
    true = truth[0].inverse() @ truth[np.arange(12)]
    assert absolute_error(path.world_from_body, true, "none").position.max < 0.02
    model = read_colmap_model(tmp_path / "out" / "sparse" / "0")
    assert len(model.rigs) == 1 and "cam2/frame_000000.jpg" in model.images.name
    with pytest.raises(NoModelError):  # by name, the second camera would be the one that looks back
        run.slam(source, tmp_path / "swapped", max_frames=1, **options)
    with pytest.raises(ConfigError, match="the calibration has 3 cameras"):
        run.slam(source, tmp_path / "two", topics=",".join(topics[:2]), **options)
    with pytest.raises(ConfigError, match="masks is for folders"):
        run.slam(source, tmp_path / "masked", masks=tmp_path, **options)


def test_a_folder_of_cameras_and_kalibrs_calibration_are_enough(images, truth, tmp_path):
    source = tmp_path / "ride"
    for k in range(3):
        (source / f"cam{k}").mkdir(parents=True)
        for n, row in enumerate(images[:12]):
            cv2.imwrite(str(source / f"cam{k}" / f"{n:03d}.png"), row[k])
    (source / "cam1" / "000.png").write_bytes(b"damaged")
    calibration = kalibr_file(tmp_path / "camchain.yaml")
    record = tmp_path / "ride.mcap"
    found = run.slam(source, tmp_path / "out", sensor="rig", calibration=calibration, fps=10, record=record)
    assert found.summary["is_metric"] and "rig's 3 cameras" in found.summary["scale"]
    path = read_trajectory(tmp_path / "out" / "trajectory.txt")
    assert isinstance(path, Trajectory) and len(path) == 11  # without the damaged one
    true = truth[1].inverse() @ truth[np.arange(1, 12)]
    assert absolute_error(path.world_from_body, true, "none").position.max < 0.02
    model = read_colmap_model(tmp_path / "out" / "sparse" / "0")
    assert len(model.cameras) == 3 and len(model.rigs) == 1 and "cam2/001.png" in model.images.name
    load = image_loader(tmp_path / "out")
    assert load("cam1/001.png").shape[:2] == (SIZE[1], SIZE[0]) and load("cam1/none.png") is None
    assert load("../ride/cam1/001.png") is None
    with AnyReader([record]) as bag:
        counts = {c.topic: c.msgcount for c in bag.connections}
    assert [counts[f"/camera{k}/image/compressed"] for k in range(3)] == [11, 11, 11]
    with pytest.raises(ConfigError, match="pass --calibration"):
        run.slam(source, tmp_path / "out2", sensor="rig", fps=10)


@pytest.mark.parametrize(("camera", "off_deg"), [(1, 1.0)] + IS_WHOLE * [(1, 0.0), (2, 0.5)])
def test_a_camera_that_is_mounted_otherwise_is_reported(images, camera, off_deg, monkeypatch):
    rotation = RIG.cam_from_rig.rotation.copy()
    rotation[camera] = Rotation3.exp(np.radians([0.0, off_deg, 0.0])).matrix @ rotation[camera]
    off = CameraRig(RIG.cameras, Rigid3(rotation, RIG.cam_from_rig.translation))
    system = Slam(SlamCamera.of_cameras(off))
    for n, row in enumerate(images):
        system.track(Frame.from_rig(0.1 * n, row, off))
    system.finish()
    found = check_mounting(system.local_mapper(system.maps[0]))
    expected = np.zeros(3)
    expected[camera] = off_deg
    np.testing.assert_allclose(found.rotation_deg, expected, atol=found.tolerance_deg[camera])
    words = found.warnings()
    assert len(words) == bool(off_deg) and all(f"camera {camera}" in one for one in words)
    monkeypatch.setattr(mounting_check, "LEAST_OBSERVATIONS", 10**6)
    assert check_mounting(system.local_mapper(system.maps[0])) is None  # nothing to compare with


def test_the_calibration_is_the_only_source_of_intrinsics(tmp_path):
    for folder in ("cam0", "cam1"):
        (tmp_path / folder).mkdir()
    options = {"sensor": "rig", "calibration": tmp_path / "chain.yaml", "fps": 10.0}
    with pytest.raises(ConfigError, match="omit camera_params"):
        run.slam(tmp_path, tmp_path / "out", camera_params="1,1,1,1", **options)
    with pytest.raises(FileFormatError, match="it does not exist"):
        run.slam(tmp_path / "nowhere", tmp_path / "out", **options)


def test_frames_and_cameras_that_do_not_fit_are_refused(images):
    camera = SlamCamera.of_cameras(RIG)
    with pytest.raises(ShapeError, match="needs as many images"):
        Frame.from_rig(0.0, images[0][:2], RIG)
    with pytest.raises(ShapeError, match="the camera is 240 x 540"):
        Slam(camera).track(Frame(0.0, images[0][0]))
    with pytest.raises(ConfigError, match="a rig cannot be combined"):
        SlamCamera(CAMERA, baseline=0.1, rig=RIG)
    with pytest.raises(ConfigError, match="a rig cannot be combined"):
        SlamCamera(CAMERA, readout_s=0.02, rig=RIG)


def test_masks_that_do_not_fit_are_refused(images):
    with pytest.raises(ShapeError, match="as many masks, got 1"):
        Frame.from_rig(0.0, images[0], RIG, [None])
    with pytest.raises(ShapeError, match="mask of camera 1"):
        Frame.from_rig(0.0, images[0], RIG, [None, np.zeros((4, 5), bool), None])
    with pytest.raises(ConfigError, match="not the rig's first"):
        SlamCamera(Camera("PINHOLE", *SIZE, [95.0, 95.0, 119.5, 89.5]), rig=RIG)


def test_a_pose_is_found_from_few_points_in_each_camera(rng):
    """Eight in each of three cameras, no camera with the 20 that are needed."""
    which = np.repeat(np.arange(3), 8)
    pixels = rng.uniform(20, 160, (24, 2)) + np.column_stack([np.zeros(24), 180.0 * which])
    in_cam = RIG.unproject(pixels, which) * rng.uniform(2, 5, (24, 1))
    points = np.stack([RIG.cam_from_rig[k].inverse().apply(x) for k, x in zip(which, in_cam)])
    pose = Rigid3.exp(0.3 * rng.normal(size=6))
    found = search_pose(
        pose.inverse().apply(points), pixels, RIG, RansacConfig(max_error_px=2.0, min_inliers=20)
    )
    assert np.abs((found @ pose.inverse()).log()).max() < 1e-6
    assert search_pose(points, pixels, RIG, RansacConfig(max_error_px=2.0, min_inliers=25)) is None


def test_points_behind_a_fisheye_camera_are_not_mirrored():
    wide = Camera("OPENCV_FISHEYE", 400, 400, [100.0, 100.0, 199.5, 199.5, 0.0, 0.0, 0.0, 0.0])
    pixels, none = np.array([[370.0, 200.0], [220.0, 210.0]]), np.full((2, 3), np.nan)
    at = predict_pixels(pixels, none, Rigid3.identity(), Rigid3.identity(), wide)
    np.testing.assert_allclose(at, pixels, atol=1e-9)


def test_only_the_observation_that_was_removed_stops_being_tracked(tracked):
    system, _ = tracked
    tracker, newest = system.odometry.tracker, system.map.keyframes[-1]
    before, kept = (
        tracker.tracks,
        (newest.pixels, newest.point, newest.disparity_px, newest.descriptors, newest.shift_px),
    )
    tracker.start_from_keyframe(newest)
    which = RIG.camera_of(newest.pixels)
    point = np.intersect1d(newest.point[which == 0], newest.point[which == 1])[0]
    newest.keep(~((newest.point == point) & (which == 1)))
    tracker.remove_outliers()
    own = tracker.tracks.point == point
    assert RIG.camera_of(tracker.tracks.pixels[own]).tolist() == [0]
    newest.pixels, newest.point, newest.disparity_px, newest.descriptors, newest.shift_px = kept
    tracker.start_from(before, system.odometry.cam_from_world)


def test_masks_of_the_cameras_are_stacked(images):
    masked = np.zeros(images[0][1].shape, bool)
    masked[:50] = True
    frame = Frame.from_rig(0.0, images[0], RIG, [None, masked, None])
    assert frame.ignored_mask.sum() == masked.sum() and frame.ignored_mask[180:230].all()
