"""Published calibrations of datasets that include none: TUM RGB-D and 7-Scenes."""

from __future__ import annotations

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3, Rotation3

_TUM = {
    "freiburg1": (517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    "freiburg2": (520.908620, 521.007327, 325.141442, 249.701764, 0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    "freiburg3": (535.4, 539.2, 320.1, 247.6, 0.0, 0.0, 0.0, 0.0, 0.0),
}  # fmt: skip
"""fx, fy, cx, cy, k1, k2, p1, p2, k3 as published with the dataset (Sturm et al., IROS 2012)."""
_TUM_SIZE = _SEVEN_SCENES_SIZE = (640, 480)
_SEVEN_SCENES_FOCAL_PX = 525.505
_SEVEN_SCENES_DEPTH_FOCAL_PX = 585.0
"""Focal length of the depth sensor, as published with the dataset; its principal point is (320, 240)."""
_DEPTH_FROM_COLOR = np.array([0.0386, -0.0052, -0.0033, -0.0059, -0.0076, -0.0029])
"""Translation in meters and rotation in radians. The dataset publishes neither the depth sensor's extrinsics nor the
color camera's focal length: these values, and the scale below, come from aligning RedKitchen's depth with points
triangulated by structure from motion."""
SEVEN_SCENES_DEPTH_SCALE = 1000.0 * 1.0051
"""Stored values per meter: millimeters, corrected by the same alignment."""


def tum_camera(folder_name: str) -> tuple[str, Camera] | None:
    """The camera suggested by a folder's name ("freiburg1" to "freiburg3" in it), and that part of the name."""
    name = next((name for name in _TUM if name in folder_name), None)
    if name is None:
        return None
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = _TUM[name]
    if any((k1, k2, p1, p2, k3)):
        model, params = CameraModel.FULL_OPENCV, [fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    else:
        model, params = CameraModel.PINHOLE, [fx, fy, cx, cy]
    return name, Camera(model, *_TUM_SIZE, np.array(params))


def seven_scenes_cameras() -> tuple[Camera, Camera, Rigid3]:
    """The color camera, the depth camera, and depth_from_color."""
    color, depth = (_centered(focal) for focal in (_SEVEN_SCENES_FOCAL_PX, _SEVEN_SCENES_DEPTH_FOCAL_PX))
    translation, rotation = _DEPTH_FROM_COLOR[:3].copy(), Rotation3.exp(_DEPTH_FROM_COLOR[3:]).matrix
    return color, depth, Rigid3(rotation, translation)


def _centered(focal_px: float) -> Camera:
    width, height = _SEVEN_SCENES_SIZE
    params = np.array([focal_px, focal_px, width / 2, height / 2])
    return Camera(CameraModel.PINHOLE, width, height, params)
