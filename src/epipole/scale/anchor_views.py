"""Images of a model as input for scale estimation: names, times, poses with covariance, pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
from jaxtyping import Float64, UInt8

from epipole._checks import Declared, checked
from epipole.cameras import Camera
from epipole.errors import ShapeError
from epipole.geometry import Rigid3
from epipole.mapping.pose_refinement import refine_pose
from epipole.scene import Reconstruction

LEAST_POINTS = 6
RAYLEIGH_MEDIAN = 1.1774
"""Median norm of a 2D vector with standard normal coordinates."""


@dataclass(frozen=True, slots=True, eq=False)
class AnchorViews(Declared):
    """Posed images of one model, one row each."""

    names: tuple[str, ...]
    timestamp_s: Float64[np.ndarray, " n"]
    """NaN where unknown."""
    cams_from_world: Rigid3
    """Batch shape (n,)."""
    cameras: tuple[Camera, ...]
    covariance_of: Callable[[int], np.ndarray]
    """(6, 6) covariance for a row, of xi = (translation, rotation) in exp(xi) @ cam_from_world."""
    image_of: Callable[[int], UInt8[np.ndarray, "h w"] | None]
    """Gray image of a row, at the camera's resolution; None if unavailable."""

    def __post_init__(self) -> None:
        """Check the rows.

        Raises:
            ShapeError: the columns differ in length.
        """
        Declared.__post_init__(self)
        n = len(self.names)
        if {len(self.timestamp_s), len(self.cameras), len(self.cams_from_world.translation)} != {n}:
            raise ShapeError(f"timestamp_s, cameras and cams_from_world must have {n} rows, one per name")

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"AnchorViews({len(self)} images)"

    def row_of(self, name: str) -> int | None:
        """Row of the image with this name, or with this file name if that is unique; None if there is none."""
        if name in self.names:
            return self.names.index(name)
        last = [n for n, own in enumerate(self.names) if PurePath(own).name == PurePath(name).name]
        return last[0] if len(last) == 1 else None


@checked
def views_of_model(
    model: Reconstruction, image_of: Callable[[int], UInt8[np.ndarray, "h w"] | None]
) -> AnchorViews:
    """The registered images of a model; pose covariances treat the points as exact.

    Args:
        model: poses, cameras, points and tracks.
        image_of: the gray image of a row of the model's images; None if unavailable.
    """
    rows = np.flatnonzero(model.is_registered())
    camera = model.camera_of_image
    positions = model.cams_from_world()[rows]
    names = tuple(str(model.images.name[int(i)]) for i in rows)
    times = np.asarray(model.frames.timestamp_s)[model.images.frame[rows]].astype(np.float64)
    return AnchorViews(
        names,
        times,
        positions,
        tuple(model.cameras[int(camera[i])] for i in rows),
        lambda n: position_covariance(model, int(rows[n])),
        lambda n: image_of(int(rows[n])),
    )


@checked
def position_covariance(model: Reconstruction, image: int) -> Float64[np.ndarray, "6 6"]:
    """Covariance of an image's pose with its points fixed, scaled to its own residuals; infinite with too few points.

    It is the covariance of xi = (translation, rotation) in exp(xi) @ cam_from_world, without the points' uncertainty.
    """
    own = np.flatnonzero(model.tracks.image == image)
    if len(own) < LEAST_POINTS:
        return np.full((6, 6), np.inf)
    points = model.points.xyz_in_world[model.tracks.point_of_observation()[own]]
    pixels, camera = model.observed_pixels()[own], model.cameras[int(model.camera_of_image[image])]
    found = refine_pose(points, pixels, camera, model.cams_from_world()[image])
    off = camera.project(found.cam_from_world.apply(points)) - pixels
    noise = float(np.nanmedian(np.linalg.norm(off, axis=1))) / RAYLEIGH_MEDIAN
    return noise**2 * found.covariance()


@checked
def positions_at(
    known_s: Float64[np.ndarray, " n"],
    positions: Float64[np.ndarray, "n 3"],
    wanted_s: Float64[np.ndarray, " m"],
    longest_gap: float = 3.0,
) -> Float64[np.ndarray, "m 3"]:
    """Positions interpolated at given times; NaN outside, and in gaps longer than `longest_gap` median gaps."""
    if not len(known_s):
        return np.full((len(wanted_s), 3), np.nan)
    out = np.stack([np.interp(wanted_s, known_s, positions[:, axis]) for axis in range(3)], axis=1)
    after = np.searchsorted(known_s, wanted_s)
    inside = (after > 0) & (after < len(known_s))
    inside |= np.isin(wanted_s, known_s)
    gap = np.diff(known_s)
    longest = longest_gap * float(np.median(gap)) if len(gap) else 0.0
    width = known_s[np.minimum(after, len(known_s) - 1)] - known_s[np.maximum(after - 1, 0)]
    return np.where((inside & (width <= longest))[:, None], out, np.nan)


def joined_words(words: Sequence[str], most: int = 3) -> str:
    """A comma-separated list, truncated after `most` entries."""
    more = len(words) - most
    return ", ".join(words[:most]) + (f" and {more} more" if more > 0 else "")
