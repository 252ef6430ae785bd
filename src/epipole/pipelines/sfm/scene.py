"""What the viewer shows of a reconstruction."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.io.convert import read_model
from epipole.io.files import read_json
from epipole.io.names import path_inside
from epipole.io.photographs import read_rgb
from epipole.report.space_model import scene_of_model
from epipole.report.space_scene import METRES, NO_UNIT, SpaceScene

PICTURE_PX = 640


def scene(path: Path) -> SpaceScene:
    """The points of a model, its cameras and its pictures.

    Raises:
        FileFormatError: there is no model.
    """
    unit = METRES if _is_metric(path) else NO_UNIT
    return scene_of_model(
        read_model(path), title=path.resolve().name, unit=unit, load_picture=picture_loader(path / "images")
    )


def _is_metric(path: Path) -> bool:
    """Whether a workspace's summary tells that lengths are metres."""
    try:
        summary = read_json(path / "summary.json")
    except FileFormatError:
        return False
    return isinstance(summary, dict) and summary.get("is_metric") is True


def picture_loader(folder: Path) -> Callable[[str], np.ndarray | None]:
    """Reads a picture by its name; gives None for one that cannot be read."""

    def load_picture(name: str) -> np.ndarray | None:
        try:
            return read_rgb(path_inside(folder, name), PICTURE_PX)
        except FileFormatError:
            return None

    return load_picture
