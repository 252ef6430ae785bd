"""Messages of ROS: their fields mean what the definitions say, and recordings are read back by rosbags and by epipole."""

import cv2
import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, EpipoleError, WorkspaceError
from epipole.geometry import Rigid3, Rotation3
from epipole.io import ros
from epipole.io.bags.recording import bag_frames, read_bag
from epipole.io.bags.writing import require_writing, written_bag
from ros_messages import messages_of, pose_of

CAMERA = Camera(CameraModel.OPENCV, 64, 48, np.array([50.0, 51.0, 31.0, 23.0, 0.1, -0.02, 0.001, 0.002]))
POSE = Rigid3.exp(np.array([0.3, -2.0, 1.0, 0.4, -0.2, 0.9]))
KINDS = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/odometry": "nav_msgs/msg/Odometry",
    "/path": "nav_msgs/msg/Path",
    "/points": "sensor_msgs/msg/PointCloud2",
    "/image": "sensor_msgs/msg/CompressedImage",
    "/camera_info": "sensor_msgs/msg/CameraInfo",
}


def test_every_message_is_read_back(tmp_path, rng):
    points, gray = rng.normal(size=(20, 3)), rng.integers(0, 256, (48, 64), np.uint8)
    covariance = np.diag([1.0, 4.0, 9.0, 0.1, 0.2, 0.3])
    stamps = np.array([1.25, 2.5])
    path = Rigid3(np.stack([POSE.rotation, np.eye(3)]), np.stack([POSE.translation, np.zeros(3)]))
    fields = {
        "/tf": {"transforms": [ros.transform_fields(2.5, POSE, "world", "body")]},
        "/tf_static": {"transforms": [ros.transform_fields(2.5, Rigid3.identity(), "map", "world")]},
        "/odometry": ros.odometry_fields(2.5, POSE, covariance, "world", "body"),
        "/path": ros.path_fields(stamps, path, "world", 2.5),
        "/points": ros.points_fields(2.5, points, "world"),
        "/image": ros.jpeg_fields(2.5, gray, "camera"),
        "/camera_info": ros.camera_info_fields(2.5, CAMERA, "camera"),
    }
    file = tmp_path / "run.mcap"
    with written_bag(file) as bag:
        for topic, content in fields.items():
            bag.write(topic, KINDS[topic], 2.5, content)
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]
    found = messages_of(file)
    assert set(found) == set(fields)
    assert all(stamp == 2_500_000_000 for rows in found.values() for stamp, _ in rows)
    transform = found["/tf"][0][1].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("world", "body")
    assert transform.transform.translation.y == POSE.translation[1]
    odometry = found["/odometry"][0][1]
    np.testing.assert_allclose(pose_of(odometry.pose.pose).as_matrix(), POSE.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(np.diag(odometry.twist.covariance.reshape(6, 6)), ros.UNKNOWN_VARIANCE)
    assert [p.header.stamp.nanosec for p in found["/path"][0][1].poses] == [250_000_000, 500_000_000]
    np.testing.assert_allclose(pose_of(found["/path"][0][1].poses[0].pose).as_matrix(), POSE.as_matrix())
    cloud = found["/points"][0][1]
    np.testing.assert_array_equal(cloud.data.view("<f4").reshape(-1, 3), points.astype(np.float32))
    assert (cloud.width, cloud.row_step, [f.name for f in cloud.fields]) == (20, 240, ["x", "y", "z"])
    decoded = cv2.imdecode(found["/image"][0][1].data, cv2.IMREAD_GRAYSCALE)
    assert decoded.shape == (48, 64) and np.abs(decoded.astype(int) - gray).mean() < 20
    info = found["/camera_info"][0][1]
    assert info.distortion_model == "plumb_bob"
    np.testing.assert_allclose(info.d, [0.1, -0.02, 0.001, 0.002, 0])
    np.testing.assert_allclose(info.k.reshape(3, 3), CAMERA.K)
    read = read_bag(file)
    assert read.sensor == "mono" and read.camera is not None
    np.testing.assert_allclose(read.camera.params, CAMERA.params)
    np.testing.assert_array_equal(next(iter(bag_frames(read))).gray(), decoded)


def test_the_covariance_is_that_of_the_pose_in_the_world(rng):
    """Poses with random errors exp(xi): their spread about the fixed axes of the world."""
    half = 1e-3 * rng.normal(size=(6, 6))
    covariance = half @ half.T
    given = ros.odometry_fields(0.0, POSE, covariance, "world", "body")["pose"]["covariance"].reshape(6, 6)
    xi = rng.multivariate_normal(np.zeros(6), covariance, 20_000)
    samples = (Rigid3.exp(xi) @ POSE.inverse()).inverse()
    turns = Rotation3(samples.rotation @ POSE.rotation.T).log()
    errors = np.concatenate([samples.translation - POSE.translation, turns], axis=1)
    scale = np.sqrt(np.diag(given))
    np.testing.assert_allclose(
        np.cov(errors.T) / np.outer(scale, scale), given / np.outer(scale, scale), atol=0.05
    )
    for unknown in (None, np.full((6, 6), np.inf)):
        fields = ros.odometry_fields(0.0, POSE, unknown, "world", "body")
        variances = np.diag(fields["pose"]["covariance"].reshape(6, 6))
        np.testing.assert_allclose(variances, ros.UNKNOWN_VARIANCE)


def test_what_is_known_of_a_pose_is_kept(rng):
    """The rotation of a camera that only rotates: its position is unknown."""
    half = 1e-3 * rng.normal(size=(3, 3))
    covariance = np.zeros((6, 6))
    covariance[:3, :3], covariance[3:, 3:] = np.inf, half @ half.T
    given = ros.odometry_fields(0.0, POSE, covariance, "world", "body")["pose"]["covariance"].reshape(6, 6)
    np.testing.assert_allclose(given[:3, :3], ros.UNKNOWN_VARIANCE * np.eye(3), atol=1e-6)
    np.testing.assert_allclose(given[3:, 3:], POSE.rotation @ (half @ half.T) @ POSE.rotation.T, atol=1e-15)
    assert not given[:3, 3:].any() and np.linalg.eigvalsh(given).min() > 0


def test_a_level_camera_looks_along_x_of_the_map():
    right, down, ahead = np.eye(3)
    np.testing.assert_array_equal(ros.REP103_FROM_OPTICAL @ ahead, [1, 0, 0])
    np.testing.assert_array_equal(ros.REP103_FROM_OPTICAL @ right, [0, -1, 0])
    np.testing.assert_array_equal(ros.REP103_FROM_OPTICAL @ down, [0, 0, -1])
    assert np.linalg.det(ros.REP103_FROM_OPTICAL) == 1


def test_what_a_message_cannot_contain_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="32 bits"):
        ros.header_fields(1e12, "world")
    assert ros.header_fields(-0.25, "world")["stamp"] == {"sec": -1, "nanosec": 750_000_000}
    for shape in ((0, 4), (4, 4, 2), (4, 4, 4, 3)):
        with pytest.raises(EpipoleError):
            ros.jpeg_fields(0.0, np.zeros(shape, np.uint8), "camera")
    with pytest.raises(ConfigError, match="before 1970"), written_bag(tmp_path / "a.mcap") as bag:
        bag.write("/state", "std_msgs/msg/String", -1.0, {"data": "x"})
    with pytest.raises(ConfigError, match=r"\.mcap"):
        require_writing("run.bag")
    assert not list(tmp_path.iterdir())


def test_messages_that_do_not_fit_their_topic_are_refused(tmp_path):
    string = "std_msgs/msg/String"
    with written_bag(tmp_path / "run.mcap") as bag:
        bag.write("/state", string, 1.0, {"data": "x"})
        with pytest.raises(ConfigError, match="of the kind"):
            bag.write("/state", "nav_msgs/msg/Path", 1.0, {})
        with pytest.raises(ConfigError, match="not a kind"):
            bag.write("/other", "no/msg/Kind", 1.0, {})
        with pytest.raises(ConfigError, match="lacks the field data"):
            bag.write("/state", string, 1.0, {})
    assert len(messages_of(tmp_path / "run.mcap")["/state"]) == 1


def test_a_recording_that_fails_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError), written_bag(tmp_path / "run.mcap") as bag:
        bag.write("/state", "std_msgs/msg/String", 1.0, {"data": "x"})
        raise RuntimeError
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkspaceError), written_bag(tmp_path / "file" / "run.mcap"):
        pass
