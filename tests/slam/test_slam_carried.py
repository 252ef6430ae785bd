"""An IMU beside a camera that measures depth: carries the pose while images are dark, finds its clock, gives what is up."""

import json
from copy import deepcopy
from dataclasses import replace

import cv2
import numpy as np
import pytest
from slam_rides import rendered

from epipole.cameras import Camera
from epipole.errors import ConfigError, ShapeError
from epipole.geometry import Rigid3, Rotation3
from epipole.inertial import ImuLog, ImuNoise, MountedImu, align_path_to_imu
from epipole.pipelines.slam import run
from epipole.pipelines.slam.frames import Frame, SlamCamera, TrackingState, rectification_of
from epipole.pipelines.slam.map.imu import InertialConstraints
from epipole.pipelines.slam.map.imu_clock import CameraImu
from epipole.pipelines.slam.map.imu_readings import LARGEST_MISFIT, better_reading
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.pipelines.slam.output.ros_record import open_recording
from epipole.pipelines.slam.slam import Slam
from epipole.scene import CameraRig, StereoRig
from epipole.synthetic.inertial import imu_along
from ros_messages import messages_of
from whole import IS_WHOLE, in_whole_run

pytestmark = pytest.mark.usefixtures("unchecked_module")

COUNT, DARK, LATE_S = 168, range(62, 74), 0.05
MOUNTING = Rigid3(Rotation3.exp(np.array([0.4, -1.1, 0.7])).matrix, np.array([0.03, -0.02, 0.05]))
NOISE = ImuNoise()


@pytest.fixture(scope="module")
def ride():
    return rendered("loop_room", COUNT, 2)


@pytest.fixture(scope="module")
def imu(ride):
    times = 0.1 * np.arange(len(ride.images))
    log = imu_along(times, ride.truth(), MOUNTING, 0, NOISE, tuple(gravity_in_camera(ride)))
    return MountedImu(log, MOUNTING, NOISE)


def gravity_in_camera(ride):
    return ride.ride.world_from_camera[0].rotation.T @ np.array([0.0, 0.0, -9.81])


def frames_of(ride, dark=DARK):
    out = ride.frames("rgbd")
    for n in dark:
        out[n] = replace(out[n], gray=np.full_like(out[n].gray, 2), depth=np.zeros_like(out[n].depth))
    return out


def later(imu, seconds):
    log = imu.log
    return replace(imu, log=ImuLog(log.timestamp_s + seconds, log.gyro_rad_s, log.accel_m_s2))


def tracked(ride, imu, count=None):
    system = Slam(ride.sensor("rgbd"), imu=imu)
    return system, [system.track(frame) for frame in frames_of(ride)[:count]]


@pytest.fixture(scope="module")
def before_dark(ride, imu):
    """A SLAM with the IMU that has seen all frames up to the first dark one, and its answers; copied before it goes on."""
    return tracked(ride, imu, DARK[0])


@pytest.fixture(scope="module")
def with_imu(ride, before_dark):
    system, answers = deepcopy(before_dark)
    return system, [*answers, *(system.track(frame) for frame in frames_of(ride)[DARK[0] :])]


def test_the_imu_carries_the_pose_through_dark_images(ride, with_imu):
    system, answers = with_imu
    truth, states = ride.truth(), [answer.state for answer in answers]
    assert all(states[n] is TrackingState.INERTIAL for n in DARK)
    again = states.index(
        TrackingState.TRACKING, DARK[0]
    )  # a place not seen before must first move as the IMU says
    assert again <= DARK[-1] + 7
    assert all(
        states[n] is TrackingState.TRACKING for n in range(len(states)) if n not in range(DARK[0], again)
    )
    errors, sigmas = np.zeros(len(states)), np.zeros(len(states))
    for n, answer in enumerate(answers):
        errors[n] = np.linalg.norm(answer.world_from_body.translation - truth.translation[n])
        sigmas[n] = np.sqrt(np.trace(answer.covariance[:3, :3]))
    assert (np.diff(sigmas[list(DARK)]) > 0).all()
    assert (errors[list(DARK)] < 3.0 * sigmas[list(DARK)]).all()
    assert errors.max() < 0.03
    assert len(system.maps) == 1
    assert all(answers[n].num_points == 0 for n in DARK)


def test_something_in_front_of_the_camera_does_not_become_part_of_the_map(ride, before_dark, rng):
    """It does not move as the IMU says; without the check the camera would be half a meter off."""
    board = cv2.GaussianBlur(rng.integers(0, 255, (240, 320), np.uint8), (0, 0), 1.5)
    (system, answers), frames = deepcopy(before_dark), frames_of(ride, ())[: DARK[-1] + 30]
    for n in DARK:
        gray = np.roll(board, n, axis=1)
        frames[n] = replace(frames[n], gray=gray, depth=np.full_like(frames[n].depth, 0.5))
    answers, truth = [*answers, *(system.track(frame) for frame in frames[DARK[0] :])], ride.truth()
    assert all(answers[n].state is TrackingState.INERTIAL for n in DARK)
    system.finish()
    path = system.trajectory()
    rows = np.rint(10 * path.timestamp_s).astype(int)
    off = np.linalg.norm(path.world_from_body.translation - truth.translation[rows], axis=1)
    assert len(system.maps) == 1 and len(rows) == len(frames) and off.max() < 0.03


def test_a_look_at_another_map_that_fails_changes_nothing(ride, before_dark, monkeypatch):
    (system, _), frames = deepcopy(before_dark), frames_of(ride)
    before = system.map, system.odometry

    def entered(system, frame):
        system._enter(SlamMap(7))

    monkeypatch.setattr(Slam, "_recognized", entered)
    monkeypatch.setattr(type(system.odometry), "find_carried", lambda *_: None)
    bright = replace(frames[DARK[0]], gray=np.roll(frames[3].gray, 100, axis=0), depth=frames[3].depth)
    monkeypatch.setattr(type(system.odometry), "track", lambda *_: None)
    assert system.track(bright).state is TrackingState.INERTIAL
    assert (system.map, system.odometry) == before


@in_whole_run
def test_without_the_imu_the_camera_is_lost(ride, with_imu):
    _, answers = tracked(ride, None, DARK[-1] + 1)
    assert all(answers[n].world_from_body is None for n in DARK)


def test_it_carries_the_pose_for_some_seconds_only(ride, imu):
    system, frames = Slam(ride.sensor("rgbd"), imu=imu), frames_of(ride, range(50, 84))[:83]
    answers = [system.track(frame) for frame in frames]
    assert [answers[n].state for n in (50, 79, 82)] == ["inertial", "inertial", "lost"]
    assert answers[82].world_from_body is None


def test_measurements_that_arrive_with_the_frames_serve_as_well(ride, imu, with_imu):
    none = ImuLog(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
    system, log, done = Slam(ride.sensor("rgbd"), imu=replace(imu, log=none)), imu.log, 0
    for frame, expected in zip(frames_of(ride)[: DARK[-1] + 1], with_imu[1]):
        until = int(np.searchsorted(log.timestamp_s, frame.timestamp_s)) + 1
        rows, done = slice(done, until), until
        system.add_imu(ImuLog(log.timestamp_s[rows], log.gyro_rad_s[rows], log.accel_m_s2[rows]))
        answer = system.track(frame)
        assert answer.state is expected.state
        off = answer.world_from_body.translation - expected.world_from_body.translation
        assert np.abs(off).max() < 0.01  # the clock is estimated from the measurements so far
    assert len(system.imu.log) == until
    with pytest.raises(ShapeError, match="must increase"):
        system.add_imu(log)
    with pytest.raises(ConfigError, match="mounting"):
        Slam(ride.sensor("rgbd")).add_imu(log)


def test_gravity_is_that_of_the_ride(ride, with_imu):
    system, _ = with_imu
    found = system.gravity_in_world
    cosine = found @ gravity_in_camera(ride) / 9.81 / np.linalg.norm(found)
    assert np.degrees(np.arccos(min(float(cosine), 1.0))) < 0.3


@pytest.mark.parametrize("kind", IS_WHOLE * ["stereo", "rig"])
def test_it_carries_a_pair_and_a_rig_too(imu, kind):
    ride = rendered("loop_room", 2 * (DARK[-1] + 8), 2, with_right=True)
    pair, frames = ride.sensor("stereo"), ride.frames("stereo")
    for n in DARK:
        black = np.full_like(frames[n].gray, 2)
        frames[n] = replace(frames[n], gray=black, right_gray=black)
    sensor = pair
    if kind == "rig":
        poses = Rigid3(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0.0, 0.0], [-pair.baseline, 0.0, 0.0]]))
        rig = CameraRig((pair.camera, pair.camera), poses)
        sensor = SlamCamera.of_cameras(rig)
        frames = [Frame.from_rig(f.timestamp_s, [f.gray, f.right_gray], rig) for f in frames]
    system = Slam(sensor, imu=imu)
    answers = [system.track(frame) for frame in frames]
    assert {answers[n].state for n in DARK} == {TrackingState.INERTIAL}
    assert {answer.state for answer in answers[DARK[-1] + 4 :]} == {TrackingState.TRACKING}
    last = answers[DARK[-1]]
    error = np.linalg.norm(last.world_from_body.translation - ride.truth().translation[DARK[-1]])
    assert error < 3.0 * np.sqrt(np.trace(last.covariance[:3, :3])) < 0.05
    assert len(system.maps) == 1


@in_whole_run
def test_the_map_of_a_recording_is_level_once_gravity_is_known(ride, imu, tmp_path):
    sensor = ride.sensor("rgbd")
    system = Slam(sensor, imu=imu)
    with open_recording(tmp_path / "run.mcap", sensor, Rigid3.identity()) as recording:
        for frame in frames_of(ride)[: DARK[0]]:
            recording.add(system, frame, system.track(frame))
        num_live = len(recording._leveled)
        recording.finish(system)
    static = [tf.transforms[-1] for _, tf in messages_of(tmp_path / "run.mcap")["/tf_static"]]
    assert num_live == 1 and [t.header.frame_id for t in static] == ["map"] * 3
    down = gravity_in_camera(ride) / 9.81
    for transform, largest_deg in zip(static, (180.0, 0.5, 0.3)):
        r = transform.transform.rotation
        axes = Rotation3.from_quat_wxyz(np.array([r.w, r.x, r.y, r.z])).matrix
        assert np.degrees(np.arccos(min(float(-(axes @ down)[2]), 1.0))) < largest_deg
    np.testing.assert_allclose((axes @ [0.0, 0.0, 1.0])[1], 0.0, atol=1e-9)  # the first camera looks along x


def test_a_mounting_on_a_pair_that_is_rectified_refers_to_the_left_camera(imu):
    inward = Rotation3.exp(np.array([0.0, np.radians(10.0), 0.0])).matrix
    camera = Camera("PINHOLE", 320, 240, np.array([260.0, 260.0, 159.5, 119.5]))
    pair = StereoRig(camera, camera, Rigid3(inward, np.array([-0.12, 0.0, 0.0])))
    sensor = SlamCamera.of_rig(pair)
    found = Slam(sensor, imu=imu).imu.camera_from_imu
    left_from_tracked = rectification_of(pair).rectified_from_left.T
    np.testing.assert_allclose(left_from_tracked @ found.rotation, MOUNTING.rotation, atol=1e-12)
    np.testing.assert_allclose(left_from_tracked @ found.translation, MOUNTING.translation, atol=1e-12)
    assert np.degrees(Rotation3(left_from_tracked).angle_rad()) > 4.0


def test_the_unit_of_the_map(ride, imu, before_dark):
    system, _ = before_dark
    assert system.meters_per_unit == (1.0, 0.0)
    mono = Slam(ride.sensor("mono"), imu=imu)
    assert mono.meters_per_unit is None
    mono.map.by_imu = system.map.by_imu._replace(meters_per_unit=1.98)
    assert mono.meters_per_unit == (1.98, 1.98 * NOISE.accel_gain_sigma)


@in_whole_run
def test_a_clock_that_is_late_is_found_and_corrected(ride, imu):
    system, _ = tracked(ride, later(imu, LATE_S), DARK[0])
    (note,) = system._camera_imu.notes()
    assert "ahead of the camera's: corrected" in note
    assert abs(system._camera_imu.offset_s - LATE_S) < 5e-3
    assert system.gravity_in_world is not None
    system.finish()
    assert system.gravity_in_world is not None


@in_whole_run
@pytest.mark.parametrize("sign", [1, -1])
def test_the_pose_is_carried_whichever_clock_is_late(ride, imu, sign):
    """Frames before the offset was known count with it, too."""
    system, frames = Slam(ride.sensor("rgbd"), imu=later(imu, 0.15 * sign)), frames_of(ride, range(45, 50))
    states = [system.track(frame).state for frame in frames[:50]]
    assert {states[n] for n in range(45, 50)} <= {TrackingState.INERTIAL, TrackingState.LOST}


def test_a_wrong_mounting_is_reported(imu, before_dark):
    off = Rotation3.exp(np.array([0.0, 0.1, 0.0])).matrix @ MOUNTING.rotation
    wrong = CameraImu(replace(imu, camera_from_imu=Rigid3(off, MOUNTING.translation)))
    for answer in before_dark[1]:
        wrong.see(answer.timestamp_s, answer.world_from_body.inverse())
    assert wrong.is_clock_known(is_last=False)
    (note,) = wrong.notes()
    assert "mounting differs by 5." in note or "mounting differs by 6." in note


@pytest.mark.parametrize(
    ("gyro_factor", "accel_factor", "words"),
    [(np.degrees(1.0), 1.0, "degrees per second")] + IS_WHOLE * [(1.0, -1.0, "opposite sign")],
)
def test_another_reading_that_fits_better_is_named_and_the_imu_not_used(
    ride, imu, before_dark, gyro_factor, accel_factor, words
):
    """The accelerations of a phone that measures gravity, and angular velocities in degrees."""
    keyframes = before_dark[0].map.keyframes
    log = ImuLog(imu.log.timestamp_s, gyro_factor * imu.log.gyro_rad_s, accel_factor * imu.log.accel_m_s2)
    found = InertialConstraints(CameraImu(replace(imu, log=log)), is_metric=True)
    found.learn(keyframes, is_last=True)
    assert found.aligned is None and words in found.camera_imu.other_reading
    right = InertialConstraints(CameraImu(imu), is_metric=True)
    right.learn(keyframes, is_last=True)
    assert right.aligned is not None and not right.camera_imu.other_reading


def test_a_gentle_ride_does_not_hide_the_sign_of_the_accelerations():
    """Swings of 5 cm at 0.4 m/s, for which the log with the opposite sign fits within the limit."""

    def poses(times):
        swing = 0.05 * np.stack([np.sin(0.8 * times), np.sin(1.1 * times), 0.3 * np.cos(0.9 * times)], axis=1)
        turn = np.stack([0.1 * np.sin(0.7 * times), 0.3 * np.sin(0.4 * times), 0.05 * np.cos(times)], axis=1)
        return Rigid3(Rotation3.exp(turn).matrix, swing + 0.4 * times[:, None] * [1.0, 0.0, 0.0])

    times, mounting = np.arange(0.0, 15.0, 0.25)[2:-2], Rigid3.identity()
    log = imu_along(
        np.arange(0.0, 15.0, 0.05), poses(np.arange(0.0, 15.0, 0.05)), mounting, 0, NOISE, (0, 9.81, 0)
    )
    wrong = MountedImu(ImuLog(log.timestamp_s, log.gyro_rad_s, -log.accel_m_s2), mounting, NOISE)
    misfit = align_path_to_imu(times, poses(times), wrong, is_metric=True).misfit
    assert misfit < LARGEST_MISFIT  # so the limit alone would accept it
    assert "opposite sign" in better_reading(times, poses(times), wrong, misfit, is_metric=True)
    right = MountedImu(log, mounting, NOISE)
    misfit = align_path_to_imu(times, poses(times), right, is_metric=True).misfit
    assert not better_reading(times, poses(times), right, misfit, is_metric=True)


@in_whole_run
def test_the_map_goes_on_in_a_thread_too(ride, imu):
    system, answers = Slam(ride.sensor("rgbd"), imu=imu, mapping="thread"), []
    for frame in frames_of(ride)[: DARK[-1] + 3]:  # faster than a camera
        answers.append(system.track(frame))
        system.wait_for_mapping()
    assert all(answers[n].state is TrackingState.INERTIAL for n in DARK)
    system.finish()
    assert len(system.maps) == 1 and len(system.trajectory()) == len(answers)


def test_the_job_levels_the_world(ride, imu, tmp_path):
    (tmp_path / "rgb").mkdir()
    (tmp_path / "depth").mkdir()
    lists = {"rgb": [], "depth": []}
    for n, frame in enumerate(frames_of(ride, ())[: DARK[0]]):
        cv2.imwrite(str(tmp_path / "rgb" / f"{n:03d}.png"), frame.gray)
        cv2.imwrite(str(tmp_path / "depth" / f"{n:03d}.png"), (5000 * frame.depth).astype(np.uint16))
        for kind in lists:
            lists[kind].append(f"{frame.timestamp_s:.3f} {kind}/{n:03d}.png")
    for kind, lines in lists.items():
        (tmp_path / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    log, there = later(imu, LATE_S).log, imu.camera_from_imu
    np.savetxt(
        tmp_path / "imu.txt", np.column_stack([log.timestamp_s, log.gyro_rad_s, log.accel_m_s2]), "%.9g"
    )
    rows = np.column_stack([there.rotation, there.translation]).tolist()
    (tmp_path / "mounting.yaml").write_text(f"T_cam_imu: {json.dumps([*rows, [0, 0, 0, 1]])}\n")
    params = ride.sensor("rgbd").camera.params
    result = run.slam(
        tmp_path,
        tmp_path / "out",
        camera_params=",".join(str(p + 0.5 * (n >= 2)) for n, p in enumerate(params)),
        imu=tmp_path / "imu.txt",
        imu_mounting=tmp_path / "mounting.yaml",
    )
    assert result.summary["world"].startswith("z up") and result.summary["is_metric"]
    assert any("clock" in words and "corrected" in words for words in result.warnings)
    up_in_camera = -gravity_in_camera(ride) / 9.81
    for path in (result.trajectory, result.causal):
        up = path.world_from_body.rotation[0] @ up_in_camera
        assert np.degrees(np.arccos(min(up[2], 1.0))) < 0.5
        assert abs(path.world_from_body.rotation[0][1, 2]) < 1e-6  # x is ahead
