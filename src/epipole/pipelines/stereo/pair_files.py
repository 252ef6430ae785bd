"""The two image files of a pair, in the pixels and at the scale that their cameras describe."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from epipole.cameras import MAX_PARAMS, Camera, ImagePixels, ImageShape
from epipole.cameras.image_fit import fitted_camera, is_same_view
from epipole.io.photographs import read_header, read_rgb
from epipole.scene import RectifiedRig, StereoRig


@dataclass(frozen=True, slots=True, eq=False)
class PairFiles:
    """Two image files and the cameras of their pixels."""

    left: Path
    right: Path
    rig: RectifiedRig | StereoRig | None
    """At the scale of the files."""
    orientations: tuple[int | None, int | None] = (None, None)
    """EXIF orientations to apply; None: the file's own."""
    notes: tuple[str, ...] = ()
    """How the calibration was fitted to the files, in words."""

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Both images as RGB.

        Raises:
            FileFormatError: one is damaged.
        """
        left, right = self.orientations
        return read_rgb(self.left, orientation=left), read_rgb(self.right, orientation=right)


def files_of_pair(left: Path, right: Path, rig: RectifiedRig | StereoRig | None) -> PairFiles:
    """The files of a pair, and its calibration at their scale.

    The sizes decide whether a calibration is of stored or of upright pixels; where they fit both ways, files that are turned
    differently are taken as stored, for their cameras are mounted rigidly. A calibration that fits neither way is left
    as it is: measuring refuses it.

    Raises:
        FileFormatError: one cannot be read.
    """
    if not isinstance(rig, StereoRig):
        return PairFiles(left, right, rig)
    headers = [read_header(path) for path in (left, right)]
    shapes = [ImageShape(h.width, h.height, h.orientation) for h in headers]
    cameras = (rig.left, rig.right)
    ways = [
        pixels
        for pixels in ImagePixels
        if all(is_same_view((c.width, c.height), s.size(pixels)) for c, s in zip(cameras, shapes))
    ]
    if not ways:
        return PairFiles(left, right, rig)
    is_mixed = shapes[0].orientation != shapes[1].orientation
    pixels = ways[0] if len(ways) == 1 else ImagePixels.STORED if is_mixed else ImagePixels.UPRIGHT
    notes = []
    scaled = scaled_rig(rig, shapes[0].size(pixels), shapes[1].size(pixels))
    if scaled is not rig:
        notes.append(f"the calibration is of {_sizes(rig)} images: it is scaled to {_sizes(scaled)}")
    is_stored = pixels is ImagePixels.STORED and {s.orientation for s in shapes} != {1}
    if is_stored:
        notes.append(
            "the calibration is taken to describe the stored pixels: EXIF orientations are not applied"
        )
    return PairFiles(left, right, scaled, (1, 1) if is_stored else (None, None), tuple(notes))


def scaled_rig(rig: StereoRig, left_size: tuple[int, int], right_size: tuple[int, int]) -> StereoRig:
    """The rig of images of these sizes, with its covariance; the same one where these are its own.

    Raises:
        ConfigError: an image does not show what its camera's images show at one scale.
    """
    left, right = fitted_camera(rig.left, *left_size), fitted_camera(rig.right, *right_size)
    if left is rig.left and right is rig.right:
        return rig
    covariance = rig.covariance
    if covariance is not None:
        factors = np.concatenate([_factors(rig.left, left), _factors(rig.right, right), np.ones(6)])
        covariance = covariance * np.outer(factors, factors)
    return replace(rig, left=left, right=right, covariance=covariance)


def _factors(camera: Camera, scaled: Camera) -> np.ndarray:
    """Of each parameter, padded: what its changes are multiplied by."""
    out = np.ones(MAX_PARAMS)
    for index in camera.model.focal_indices:
        out[index] = scaled.params[index] / camera.params[index]
    cx, cy = camera.model.principal_point_indices
    out[cx], out[cy] = scaled.width / camera.width, scaled.height / camera.height
    return out


def _sizes(rig: StereoRig) -> str:
    sizes = [f"{camera.width}x{camera.height}" for camera in (rig.left, rig.right)]
    return " and ".join(dict.fromkeys(sizes))
