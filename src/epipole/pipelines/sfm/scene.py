"""What the viewer shows of a reconstruction."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.io.convert import read_model
from epipole.io.names import path_inside
from epipole.io.photographs import read_rgb
from epipole.viewer import ViewerHandle, view


def show(path: Path, *, port: int | None, host: str, block: bool) -> ViewerHandle:
    """The points of a model, its cameras and its pictures.

    Raises:
        FileFormatError: there is no model.
    """
    model = read_model(path)
    return view(model, picture_loader(path / "images"), port=port, host=host, block=block)


def picture_loader(folder: Path) -> Callable[[str], np.ndarray | None]:
    """Reads a picture by its name; gives None for one that cannot be read."""

    def load_picture(name: str) -> np.ndarray | None:
        try:
            return read_rgb(path_inside(folder, name), 640)
        except FileFormatError:
            return None

    return load_picture
