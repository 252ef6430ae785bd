"""Reading recordings of ROS with rosbags."""

from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from epipole.geometry import Rigid3


def messages_of(path: Path) -> dict[str, list]:
    """All messages of a recording by topic, read by rosbags."""
    out: dict[str, list] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, stamp_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            out.setdefault(connection.topic, []).append((stamp_ns, message))
    return out


def pose_of(pose) -> Rigid3:
    q = pose.orientation
    return Rigid3.from_quat_wxyz(
        np.array([q.w, q.x, q.y, q.z]), np.array([pose.position.x, pose.position.y, pose.position.z])
    )
