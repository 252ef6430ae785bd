"""Small recordings of ROS, written by rosbags: the same messages as ROS 1 bag, SQLite and MCAP."""

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

KINDS = ("ros1", "sqlite", "mcap")
STORES = {"ros1": Stores.ROS1_NOETIC, "sqlite": Stores.ROS2_HUMBLE, "mcap": Stores.ROS2_HUMBLE}
CHANNELS = {"mono8": 1, "bgr8": 3, "rgb8": 3, "bgra8": 4, "16UC1": 1, "32FC1": 1}


@dataclass
class Recorded:
    """Messages to be written: (topic, kind, nanoseconds, message), in any order."""

    kind: str
    rows: list = field(default_factory=list)

    def __post_init__(self):
        self.store = get_typestore(STORES[self.kind])

    def header(self, ns: int, frame_id: str = "cam"):
        types = self.store.types
        stamp = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        extra = {"seq": 0} if self.kind == "ros1" else {}
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id, **extra)

    def image(self, topic, ns, pixels, encoding, stamp_ns=None, frame_id="cam"):
        pixels = np.ascontiguousarray(pixels)
        message = self.store.types["sensor_msgs/msg/Image"](
            header=self.header(ns if stamp_ns is None else stamp_ns, frame_id),
            height=pixels.shape[0],
            width=pixels.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=pixels.strides[0],
            data=pixels.reshape(-1).view(np.uint8),
        )
        self.rows.append((topic, "sensor_msgs/msg/Image", ns, message))

    def compressed(self, topic, ns, data: bytes, format: str):
        message = self.store.types["sensor_msgs/msg/CompressedImage"](
            header=self.header(ns), format=format, data=np.frombuffer(data, np.uint8)
        )
        self.rows.append((topic, "sensor_msgs/msg/CompressedImage", ns, message))

    def camera_info(self, topic, ns, size, K, D=(), R=None, P=None, frame_id="cam", model="plumb_bob"):
        P = np.column_stack([K, np.zeros(3)]) if P is None else P
        names = {"d": D, "k": K, "r": np.eye(3) if R is None else R, "p": P}
        arrays = {name: np.asarray(value, np.float64).ravel() for name, value in names.items()}
        if self.kind == "ros1":
            arrays = {name.upper(): value for name, value in arrays.items()}
        types = self.store.types
        message = types["sensor_msgs/msg/CameraInfo"](
            header=self.header(ns, frame_id),
            height=size[1],
            width=size[0],
            distortion_model=model,
            binning_x=0,
            binning_y=0,
            roi=types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
            **arrays,
        )
        self.rows.append((topic, "sensor_msgs/msg/CameraInfo", ns, message))

    def imu(self, topic, ns, rotation, gradient, stamp_ns=None):
        types = self.store.types
        vector, none = types["geometry_msgs/msg/Vector3"], np.zeros(9)
        message = types["sensor_msgs/msg/Imu"](
            header=self.header(ns if stamp_ns is None else stamp_ns),
            orientation=types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
            orientation_covariance=none,
            angular_velocity=vector(*map(float, rotation)),
            angular_velocity_covariance=none,
            linear_acceleration=vector(*map(float, gradient)),
            linear_acceleration_covariance=none,
        )
        self.rows.append((topic, "sensor_msgs/msg/Imu", ns, message))

    def write(self, folder: Path, name: str = "ride", compression: str = "") -> Path:
        """The path that a user gives; the compression is bz2 or lz4 of ROS 1, message, file or storage of ROS 2."""
        path = folder / (f"{name}.bag" if self.kind == "ros1" else name)
        if self.kind == "ros1":
            writer = Writer1(path)
        else:
            plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
            writer = Writer2(path, version=9, storage_plugin=plugin)
        if compression and self.kind == "ros1":
            writer.set_compression(Writer1.CompressionFormat[compression.upper()])
        elif compression:
            writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
        serialize = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
        with writer:
            connections = {}
            for topic, kind, ns, message in sorted(self.rows, key=lambda row: row[2]):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(connections[topic], ns, serialize(message, kind))
        return path


def png(pixels) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def jpeg(pixels) -> bytes:
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
