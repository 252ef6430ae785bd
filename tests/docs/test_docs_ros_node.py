"""The node of docs/slam_ros.md runs with stand-ins for the packages of ROS."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from docs_pages import blocks_of

sys.path.insert(0, str(Path(__file__).parents[1] / "slam"))
from slam_rides import BASELINE, CAMERA, ride

PAGE = Path(__file__).parents[2] / "docs" / "slam_ros.md"
NODE_NAMES = {
    "message_filters": ("Subscriber", "TimeSynchronizer"),
    "rclpy": (),
    "rclpy.node": ("Node",),
    "rclpy.qos": ("QoSProfile", "ReliabilityPolicy"),
    "cv_bridge": ("CvBridge",),
    "geometry_msgs.msg": ("TransformStamped",),
    "nav_msgs.msg": ("Odometry",),
    "sensor_msgs.msg": ("CameraInfo", "Image"),
    "rosidl_runtime_py": ("set_message_fields",),
    "tf2_ros": ("TransformBroadcaster",),
}


class StandIn:
    """Takes any call, and notes what is published, sent and said."""

    BEST_EFFORT = 2
    published: ClassVar[list] = []
    said: ClassVar[list] = []

    def __init__(self, *_: object, **__: object) -> None: ...

    def create_publisher(self, *_: object) -> "StandIn":
        return self

    def get_logger(self) -> "StandIn":
        return self

    def registerCallback(self, _: object) -> None: ...

    def publish(self, message: object) -> None:
        self.published.append(message)

    sendTransform = publish

    def warning(self, words: str, **_: object) -> None:
        self.said.append(words)

    def imgmsg_to_cv2(self, image: SimpleNamespace, encoding: str) -> np.ndarray:
        assert encoding == "mono8"
        return image.pixels


def set_message_fields(message: StandIn, fields: dict) -> None:
    message.fields = fields


@pytest.mark.usefixtures("unchecked")
def test_the_node_tracks_and_publishes(monkeypatch):
    for name, members in NODE_NAMES.items():
        module = ModuleType(name)
        for member in members:
            setattr(module, member, type(member, (StandIn,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    sys.modules["rosidl_runtime_py"].set_message_fields = set_message_fields
    monkeypatch.setattr(StandIn, "published", [])
    monkeypatch.setattr(StandIn, "said", [])
    (code,) = blocks_of(PAGE, "python3")
    names = {"__name__": "node"}
    exec(compile(code, "the node", "exec"), names)
    assert len([line for line in code.splitlines() if line.strip()]) <= 60
    node = names["StereoSlam"]()
    f, _, cx, cy = CAMERA.params
    info = SimpleNamespace(
        width=CAMERA.width, height=CAMERA.height, p=[f, 0, cx, -f * BASELINE, 0, f, cy, 0, 0, 0, 1, 0]
    )
    for n in range(3):
        stamp = SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=5, nanosec=n * 10**8)))
        left, right = (
            SimpleNamespace(**vars(stamp), pixels=side[n].copy()) for side in (ride().left, ride().right)
        )
        node.track(left, right, info)
    node.track(left, right, info)  # the same time again
    assert [len(StandIn.published), len(StandIn.said)] == [6, 1] and "must increase" in StandIn.said[0]
    odometry, transform = StandIn.published[-2:]
    assert odometry.fields["header"] == {"stamp": {"sec": 5, "nanosec": 200_000_000}, "frame_id": "world"}
    assert transform.fields["transform"]["translation"] == odometry.fields["pose"]["pose"]["position"]
    truth = ride().truth()[2].translation
    np.testing.assert_allclose(list(transform.fields["transform"]["translation"].values()), truth, atol=0.01)
