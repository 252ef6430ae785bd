"""The image files of a pair, with the orientation and scale of their calibration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from epipole.cameras.image_fit import ImagePixels, ImageShape, is_same_view
from epipole.disparity_search.rectification import rectify
from epipole.errors import EpipoleError
from epipole.io.images.photographs import read_header, read_rgb
from epipole.pipelines.stereo.rows import match_features
from epipole.scene import RectifiedRig, StereoRig

LEAST_MATCHES, CLEAR, SLACK_PX = 20, 2.0, 2.0
"""Matches that agree with the rig decide on the orientation: fewest matches, smallest ratio to the other orientation, and tolerance."""


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
    """Notes on how the calibration was adapted to the files."""

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Both images as RGB.

        Raises:
            FileFormatError: an image is damaged.
        """
        left, right = self.orientations
        return read_rgb(self.left, orientation=left), read_rgb(self.right, orientation=right)


def files_of_pair(left: Path, right: Path, rig: RectifiedRig | StereoRig | None) -> PairFiles:
    """The files of a pair, and its calibration at their scale.

    The image sizes decide whether the calibration describes stored or upright pixels. If both fit, the number of matches that agree
    with it decides; if that is inconclusive, files with different orientations are taken as stored. A calibration that fits neither
    is returned unchanged, and measuring rejects it.

    Raises:
        FileFormatError: an image cannot be read.
    """
    if not isinstance(rig, StereoRig):
        return PairFiles(left, right, rig)
    headers = [read_header(path) for path in (left, right)]
    shapes = [ImageShape(h.width, h.height, h.orientation) for h in headers]
    cameras = (rig.left, rig.right)
    orientations = [
        pixels
        for pixels in ImagePixels
        if all(is_same_view((c.width, c.height), s.size(pixels)) for c, s in zip(cameras, shapes))
    ]
    if not orientations:
        return PairFiles(left, right, rig)
    files = [_fitted(left, right, rig, shapes, pixels) for pixels in orientations]
    is_rotated = {shape.orientation for shape in shapes} != {1}
    if len(files) == 1 or not is_rotated:
        return files[-1]
    counts = [_num_agreeing(file) for file in files]
    if max(counts) >= LEAST_MATCHES and max(counts) >= CLEAR * min(counts):
        return files[int(np.argmax(counts))]
    return files[
        orientations.index(
            ImagePixels.STORED if shapes[0].orientation != shapes[1].orientation else ImagePixels.UPRIGHT
        )
    ]


def _fitted(
    left: Path, right: Path, rig: StereoRig, shapes: list[ImageShape], pixels: ImagePixels
) -> PairFiles:
    """The files as stored or upright pixels, with the calibration at their scale."""
    notes = []
    scaled = rig.scaled_to(shapes[0].size(pixels), shapes[1].size(pixels))
    if scaled is not rig:
        notes.append(f"the calibration is for {_sizes(rig)} images: it is scaled to {_sizes(scaled)}")
    is_stored = pixels is ImagePixels.STORED and {s.orientation for s in shapes} != {1}
    if is_stored:
        notes.append(
            "the calibration is assumed to describe the stored pixels: EXIF orientations are not applied"
        )
    return PairFiles(left, right, scaled, (1, 1) if is_stored else (None, None), tuple(notes))


def _num_agreeing(files: PairFiles) -> int:
    """Number of matches in the same row and in front of the cameras after rectification; 0 if that fails."""
    assert isinstance(files.rig, StereoRig)
    try:
        found = rectify(files.rig)
        pair = found.apply(*(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in files.read()))
    except EpipoleError:
        return 0
    matches = match_features(*pair)
    in_front = matches.disparity_px + found.rig.principal_offset_px > -SLACK_PX
    return int((in_front & (np.abs(matches.vertical_px) < SLACK_PX)).sum())


def _sizes(rig: StereoRig) -> str:
    sizes = [f"{camera.width}x{camera.height}" for camera in (rig.left, rig.right)]
    return " and ".join(dict.fromkeys(sizes))
