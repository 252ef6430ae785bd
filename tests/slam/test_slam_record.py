"""The recording of a run: its poses are those of the trajectories, and a failure of the disk does not stop tracking."""

import shutil
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from slam_rides import BASELINE, CAMERA, ride

from epipole.errors import ConfigError, WorkspaceError
from epipole.geometry import Rigid3
from epipole.io import read_trajectory
from epipole.io.ros import UNKNOWN_VARIANCE
from epipole.pipelines.slam.frames import SlamCamera, TrackedFrame, TrackingState
from epipole.pipelines.slam.output.ros_record import open_recording
from epipole.pipelines.slam.run import slam as run_slam
from epipole.pipelines.slam.slam import Slam
from ros_messages import messages_of, pose_of

pytestmark = pytest.mark.usefixtures("unchecked")
SENSOR = SlamCamera(CAMERA, BASELINE)
TURNED = Rigid3.exp(np.array([0.0, 0.0, 0.0, 0.1, 0.2, 0.3]))
"""body_from_camera"""


def test_the_recording_holds_the_poses_of_the_run(tmp_path):
    frames, system, answers = ride().frames("stereo")[:12], Slam(SENSOR), []
    with open_recording(tmp_path / "run.mcap", SENSOR, TURNED) as recording:
        for frame in frames:
            answers.append(system.track(frame))
            recording.add(system, frame, answers[-1])
        system.finish()
        recording.finish(system)
    assert not recording.warnings
    found = messages_of(tmp_path / "run.mcap")
    for n, (answer, (stamp_ns, odometry), (_, tf)) in enumerate(
        zip(answers, found["/odometry"], found["/tf"])
    ):
        assert stamp_ns == round(1e9 * frames[n].timestamp_s)
        expected = answer.world_from_body @ TURNED.inverse()
        np.testing.assert_allclose(pose_of(odometry.pose.pose).as_matrix(), expected.as_matrix(), atol=1e-12)
        assert tf.transforms[0].transform.translation.x == odometry.pose.pose.position.x
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("world", "body")
        covariance = odometry.pose.covariance.reshape(6, 6)
        # A turned body at the same point has the same uncertainty in the world.
        same = answer.world_from_body.rotation @ answer.covariance[:3, :3] @ answer.world_from_body.rotation.T
        np.testing.assert_allclose(covariance[:3, :3], same, atol=1e-15)
    final = system.trajectory()
    path = found["/path"][-1][1].poses
    for n, pose in enumerate(path):
        np.testing.assert_allclose(
            pose_of(pose.pose).as_matrix(),
            (final.world_from_body[n] @ TURNED.inverse()).as_matrix(),
            atol=1e-12,
        )
    assert len(path) == 12 and len(found["/path"]) < 12
    cloud = found["/points"][-1][1]
    np.testing.assert_allclose(
        cloud.data.view("<f4").reshape(-1, 3), system.snapshot().points_in_world.astype(np.float32)
    )
    static = {t.header.frame_id: t for t in found["/tf_static"][0][1].transforms}
    assert (static["map"].child_frame_id, static["body"].child_frame_id) == ("world", "camera")
    assert len(found["/camera/image/compressed"]) == len(found["/camera/camera_info"]) == 12
    image = cv2.imdecode(found["/camera/image/compressed"][5][1].data, cv2.IMREAD_GRAYSCALE)
    assert np.abs(image.astype(int) - frames[5].gray).mean() < 3
    assert found["/state"][1][1].data.startswith("tracking")


def test_frames_without_a_pose_and_separate_maps_are_recorded_as_such(tmp_path):
    frames, system = ride().frames("stereo")[:3], Slam(SENSOR)
    pose, none = Rigid3.identity(), np.full((6, 6), np.inf)
    answers = [
        TrackedFrame(0.0, TrackingState.TRACKING, "", pose, none, 50, False),
        TrackedFrame(0.1, TrackingState.LOST, "dark", None, None, 0, False),
        TrackedFrame(0.2, TrackingState.SUBMAP, "", None, None, 50, False, pose, map_number=2),
    ]
    with open_recording(tmp_path / "run.mcap", SENSOR, pose) as recording:
        for frame, answer in zip(frames, answers):
            recording.add(system, frame, answer)
    found = messages_of(tmp_path / "run.mcap")
    assert [m.data for _, m in found["/state"]] == ["tracking", "lost: dark", "submap"]
    assert [m.transforms[0].header.frame_id for _, m in found["/tf"]] == ["world", "world_2"]
    assert [len(m.transforms) for _, m in found["/tf_static"]] == [2, 1]  # nothing connects the separate map
    assert [m.pose.covariance[0] for _, m in found["/odometry"]] == [UNKNOWN_VARIANCE] * 2


def test_a_file_that_cannot_be_written_is_a_warning(tmp_path):
    (tmp_path / "file").write_text("")
    frame, system = ride().frames("stereo")[0], Slam(SENSOR)
    answer = TrackedFrame(0.0, TrackingState.LOST, "", None, None, 0, False)
    with open_recording(tmp_path / "file" / "run.mcap", SENSOR, TURNED) as recording:
        for _ in range(200):  # more than may wait
            recording.add(system, frame, answer)
        recording.finish(system)
    assert "was not recorded" in recording.warnings[0]
    with pytest.raises(ConfigError, match=r"\.mcap"), open_recording(tmp_path / "run.bag", SENSOR, TURNED):
        pass


def test_a_file_that_cannot_be_completed_is_a_warning(tmp_path):
    """The folder vanishes during the run: the error comes after the last message."""
    frame, system = ride().frames("stereo")[0], Slam(SENSOR)
    folder = tmp_path / "folder"
    with open_recording(folder / "run.mcap", SENSOR, TURNED) as recording:
        recording.add(system, frame, TrackedFrame(0.0, TrackingState.LOST, "", None, None, 0, False))
        while not folder.exists() or not list(folder.rglob("*.mcap")):
            time.sleep(0.01)
        shutil.rmtree(folder)
        recording.finish(system)
    assert "was not recorded" in recording.warnings[0] and not folder.exists()


def test_a_run_without_frames_leaves_an_earlier_recording(tmp_path):
    (tmp_path / "run.mcap").write_bytes(b"earlier")
    with pytest.raises(RuntimeError), open_recording(tmp_path / "run.mcap", SENSOR, TURNED):
        raise RuntimeError
    with open_recording(tmp_path / "run.mcap", SENSOR, TURNED) as recording:
        recording.finish(Slam(SENSOR))
    assert (tmp_path / "run.mcap").read_bytes() == b"earlier"


def test_the_job_records_and_writes_causal_covariances(tmp_path):
    folder = tmp_path / "ride"
    for name, images in (("image_0", ride().left), ("image_1", ride().right)):
        (folder / name).mkdir(parents=True)
        for n, image in enumerate(images[:4]):
            cv2.imwrite(str(folder / name / f"{n:06d}.png"), image)
    f, _, cx, cy = CAMERA.params
    rows = [[f, 0, cx, x, 0, f, cy, 0, 0, 0, 1, 0] for x in (0.0, -f * BASELINE)]
    (folder / "calib.txt").write_text("".join(f"P{k}: {' '.join(map(str, r))}\n" for k, r in enumerate(rows)))
    with pytest.raises(ConfigError, match=r"\.mcap"):
        run_slam(folder, tmp_path / "out", record=tmp_path / "run.bag")
    result = run_slam(folder, tmp_path / "out", record=tmp_path / "run.mcap")
    with pytest.raises(WorkspaceError, match="already exists"):
        run_slam(folder, tmp_path / "out", record=tmp_path / "run.mcap")
    with pytest.raises(WorkspaceError, match="is an input"):
        run_slam(tmp_path / "run.mcap", tmp_path / "out2", record=tmp_path / "run.mcap")
    found = messages_of(tmp_path / "run.mcap")
    causal = read_trajectory(tmp_path / "out" / "trajectory_causal_covariance.txt")
    assert (
        not result.warnings and len(found["/odometry"]) == len(causal) == 4 and causal.covariance is not None
    )
    for n, (_, odometry) in enumerate(found["/odometry"]):
        np.testing.assert_allclose(
            pose_of(odometry.pose.pose).as_matrix(), causal.world_from_body[n].as_matrix(), atol=1e-9
        )


def test_the_largest_world_is_connected_to_the_map(tmp_path):
    """If a separate map has the most frames in the end, the final path is in its world."""
    frames, system = ride().frames("stereo")[:6], Slam(SENSOR)
    with open_recording(tmp_path / "run.mcap", SENSOR, Rigid3.identity()) as recording:
        for n, frame in enumerate(frames):
            answer = system.track(frame)
            if n > 2:  # as if in a separate map
                world = answer.world_from_body
                answer = replace(answer, world_from_body=None, submap_from_body=world, map_number=1)
            recording.add(system, frame, answer)
        system.map.number = 1
        recording.finish(system)
    found = messages_of(tmp_path / "run.mcap")
    frames_of = [
        (t.header.frame_id, t.child_frame_id) for _, tf in found["/tf_static"] for t in tf.transforms
    ]
    assert frames_of[0] != ("map", "world_1") and ("map", "world_1") in frames_of
    assert found["/path"][-1][1].header.frame_id == "world_1"
