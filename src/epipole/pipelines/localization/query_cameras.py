"""The intrinsics of the images to localize: given, those of the same camera in the model, or unknown."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole.cameras import Camera
from epipole.errors import EpipoleError
from epipole.io.images.photographs import read_header
from epipole.io.names import path_inside
from epipole.pipelines.localization.reference import shared_camera
from epipole.pipelines.sfm.cameras import camera_key
from epipole.pipelines.sfm.photographs import ImageSet
from epipole.scene import Reconstruction


@dataclass(frozen=True, slots=True, eq=False)
class QueryCamera:
    """Intrinsics of images to localize."""

    camera: Camera
    is_known: bool
    """Whether the focal length is known; otherwise that of `camera` is a guess."""
    is_given: bool
    """Whether the user gave the intrinsics."""
    source: str
    """Where the focal length comes from, in words."""


def query_cameras(
    images: ImageSet, model: Reconstruction, folder_of_model: Path, *, is_given: bool
) -> tuple[QueryCamera, ...]:
    """For each camera of the images, its intrinsics.

    A camera of the model is used if its images have the same size, make, model and focal length in their EXIF. Without EXIF, only the
    size distinguishes cameras; the points then show whether the focal length is wrong.

    Args:
        images: the images to localize.
        model: the model.
        folder_of_model: folder of the model's images, which may be missing.
        is_given: whether the intrinsics of `images` are given by the user.
    """
    if is_given:
        return tuple(
            QueryCamera(images.cameras[c], True, True, images.focal_sources[c])
            for c in range(len(images.cameras))
        )
    of_model = _cameras_of_model(model, folder_of_model)
    out = []
    for c in range(len(images.cameras)):
        first = int(np.flatnonzero(images.camera_of_image == c)[0])
        key = camera_key(read_header(images.folder / images.names[first]))
        found = shared_camera([camera for known, camera in of_model if known == key])
        if found is not None:
            out.append(QueryCamera(found, True, False, "the model's camera"))
        else:
            out.append(QueryCamera(images.cameras[c], False, False, images.focal_sources[c]))
    return tuple(out)


def _cameras_of_model(model: Reconstruction, folder: Path) -> list[tuple[tuple, Camera]]:
    """The cameras of registered images, each with the key of its first image."""
    out = []
    registered = np.flatnonzero(model.is_registered())
    rows, firsts = np.unique(model.camera_of_image[registered], return_index=True)
    for row, first in zip(rows.tolist(), registered[firsts].tolist()):
        camera = model.cameras[row]
        key = ("", "", camera.width, camera.height, 0.0)
        with suppress(EpipoleError):  # the image is missing: only its size is known
            key = camera_key(read_header(path_inside(folder, model.images.name[first])))
        if key[2:4] == (camera.width, camera.height):  # not an image at another scale
            out.append((key, camera))
    return out
