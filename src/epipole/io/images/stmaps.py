"""STMaps as TIFF files, which Nuke, Fusion, Flame and Blender read, with OpenCV (its packages are built without OpenEXR)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from epipole._checks import checked
from epipole.errors import ConfigError, WorkspaceError
from epipole.io.atomic import atomic_write

_DEFLATE, _NO_PREDICTOR = 8, 1
"""TIFF's numbers of a lossless compression that all readers know, and of none of the predictors that some do not."""
_SUFFIXES = (".tif", ".tiff")


@checked
def write_stmap(path: str | Path, stmap: Float32[np.ndarray, "h w 2"]) -> None:
    """Write a map as a TIFF file of 32-bit floating point: red is s, green is t, blue is 0.

    Args:
        path: the file, with the suffix `.tif` or `.tiff`.
        stmap: (h, w, 2) s and t, top row first, as of `epipole.image.undistortion_stmap`.

    Raises:
        ConfigError: the path has another suffix.
        WorkspaceError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        raise ConfigError(f"path must end in {' or '.join(_SUFFIXES)}, got {path.name[:60]!r}")
    blue_green_red = np.stack([np.zeros_like(stmap[..., 0]), stmap[..., 1], stmap[..., 0]], axis=-1)
    options = [cv2.IMWRITE_TIFF_COMPRESSION, _DEFLATE, cv2.IMWRITE_TIFF_PREDICTOR, _NO_PREDICTOR]
    is_encoded, data = cv2.imencode(".tif", blue_green_red, options)
    if not is_encoded:
        raise WorkspaceError(f"{path}: OpenCV cannot write TIFF files of floating point here")
    with atomic_write(path) as part:
        part.write_bytes(data.tobytes())
