"""`depths.json` in an output folder of `surface`: the file, camera and pose of the depth of each image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from epipole._checks import checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import EpipoleError, FileFormatError
from epipole.geometry import Rigid3
from epipole.io.files import read_json
from epipole.io.json_files import json_text
from epipole.io.names import path_inside
from epipole.pipelines.surfaces.depth_stage import depth_in
from epipole.pipelines.surfaces.inputs import SurfaceInputs
from epipole.runs import Unit
from epipole.scene.view_depth import ViewDepth

DEPTHS = "depths.json"
_NUMBERS = ("width", "height", "fx", "fy", "cx", "cy")


@dataclass(frozen=True, slots=True, eq=False)
class DepthView:
    """An image with a depth map."""

    name: str
    """Name of the image in the model."""
    path: Path
    camera: Camera
    """Pinhole camera of the undistorted image at the size of the depth; (0, 0) is the center of the first pixel."""
    cam_from_world: Rigid3

    def depth(self) -> ViewDepth:
        """Read depth, standard deviation and reason of each pixel.

        Raises:
            WorkspaceError: the file is missing or damaged.
            FileFormatError: its size is not that of the camera.
        """
        found = depth_in(self.path)
        if found.depth.shape != (self.camera.height, self.camera.width):
            raise FileFormatError(self.path, "its size is not that of the camera")
        return found


def depth_views_text(inputs: SurfaceInputs, depths: Mapping[int, Unit], root: Path) -> str:
    """The content of `depths.json`: views in the order of their names, with paths relative to the output folder `root`."""
    return json_text(
        {"views": [_fields(inputs, k, unit.path.relative_to(root)) for k, unit in depths.items()]}
    )


def _fields(inputs: SurfaceInputs, k: int, path: Path) -> dict[str, Any]:
    view = inputs.views[k]
    K = view.pinhole.K
    numbers = (view.pinhole.width, view.pinhole.height, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    return {
        "name": view.name,
        "file": path.as_posix(),
        **dict(zip(_NUMBERS, numbers)),
        "cam_from_world": view.cam_from_world.as_matrix()[:3].tolist(),
    }


@checked
def read_depth_views(folder: str | Path) -> list[DepthView]:
    """The images with a depth map in an output folder of `epipole surface`.

    Raises:
        FileFormatError: there is no `depths.json`, or it is damaged.
    """
    path = Path(folder) / DEPTHS
    content = read_json(path)
    views = content.get("views") if isinstance(content, dict) else None
    if not isinstance(views, list):
        raise FileFormatError(path, "it has no list of views")
    return [_view(path, fields) for fields in views]


def _view(path: Path, fields: Any) -> DepthView:
    try:
        width, height, fx, fy, cx, cy = (float(fields[name]) for name in _NUMBERS)
        camera = Camera(CameraModel.PINHOLE, int(width), int(height), [fx, fy, cx, cy])
        motion = Rigid3.from_matrix(np.array(fields["cam_from_world"], np.float64))
        return DepthView(str(fields["name"]), path_inside(path.parent, str(fields["file"])), camera, motion)
    except (KeyError, TypeError, ValueError, OverflowError, EpipoleError) as error:
        raise FileFormatError(path, f"a view is damaged: {error}") from error
