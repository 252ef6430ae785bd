"""What was measured: control points with the pixels at which images show them, and GPS positions of images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Bool, Float64, Int64

from epipole._checks import Declared
from epipole.io.survey.control_points import ControlPoints
from epipole.scene import Reconstruction

NAMES_SHOWN = 5


@dataclass(frozen=True, slots=True, eq=False)
class SurveyedPoints(Declared):
    """Surveyed points in the world of the georeferenced model, and their observations in its images."""

    name: tuple[str, ...]
    position_m: Float64[np.ndarray, "n 3"]
    """East, north, up; NaN if not measured."""
    exchanged_m: Float64[np.ndarray, "n 3"]
    """The same about their own center, if the file had its first two columns in the other order; to recognize that mistake."""
    sigma_m: Float64[np.ndarray, "n 3"]
    is_control: Bool[np.ndarray, " n"]
    """Points that determine the result; the others check it."""
    point: Int64[np.ndarray, " k"]
    """Point of each observation."""
    image: Int64[np.ndarray, " k"]
    """Image row in the model of each observation."""
    pixels: Float64[np.ndarray, "k 2"]

    def __len__(self) -> int:
        return len(self.name)

    def without_control(self, row: int) -> SurveyedPoints:
        """The same points, one of which only checks the result."""
        is_control = self.is_control.copy()
        is_control[row] = False
        return replace(self, is_control=is_control)


@dataclass(frozen=True, slots=True, eq=False)
class GpsFixes(Declared):
    """GPS positions of a model's images, in the world of the georeferenced model."""

    position_m: Float64[np.ndarray, "n 3"]
    """East, north, up; NaN rows for none, NaN up without altitude."""
    sigma_m: Float64[np.ndarray, "n 3"]

    def shifted(self, offset_m: Float64[np.ndarray, " 3"]) -> GpsFixes:
        """The same positions, displaced."""
        return GpsFixes(self.position_m + offset_m, self.sigma_m)


def observations_in_model(
    points: ControlPoints, model: Reconstruction
) -> tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " m"], Float64[np.ndarray, "m 2"], list[str]]:
    """Rows of the observations in registered images, their images and pixels, and notes on the others.

    An image is recognized by its name in the model or, if that is unique, by its file name without folders, in any case.
    """
    find = _finder(model)
    registered = model.is_registered()
    kept, images, pixels = [], [], []
    unknown: list[str] = []
    unregistered: list[str] = []
    outside: list[str] = []
    for k, name in enumerate(points.image):
        row = find(name)
        if row is None:
            unknown.append(name)
            continue
        if not registered[row]:
            unregistered.append(name)
            continue
        camera = model.cameras[int(model.camera_of_image[row])]
        pixel = points.pixels[k]
        if (
            points.is_normalized
        ):  # of OpenSfM: relative to the center of the image, in units of its longer side
            size = np.array([camera.width, camera.height])
            pixel = pixel * size.max() + (size - 1.0) / 2.0
        if not ((pixel >= -0.5).all() and pixel[0] <= camera.width - 0.5 and pixel[1] <= camera.height - 0.5):
            outside.append(f"{points.name[int(points.point[k])]} in {name}")
            continue
        kept.append(k)
        images.append(row)
        pixels.append(pixel)
    notes = [
        *_note(
            "observations of control points refer to images that the model does not have, or has under several folders",
            unknown,
        ),
        *_note("observations of control points are in images that are not registered", unregistered),
        *_note("observations of control points are outside their image", outside),
    ]
    return (
        np.array(kept, np.int64),
        np.array(images, np.int64),
        np.array(pixels, np.float64).reshape(-1, 2),
        notes,
    )


def _finder(model: Reconstruction) -> Callable[[str], int | None]:
    """Finds an image by its name or else, if that is unique, by its file name without folders and in any case."""
    rows = {name: row for row, name in enumerate(model.images.name)}
    short: dict[str, list[int]] = {}
    for name, row in rows.items():
        short.setdefault(_file_name(name), []).append(row)

    def find(name: str) -> int | None:
        if name in rows:
            return rows[name]
        own = short.get(_file_name(name), [])
        return own[0] if len(own) == 1 else None

    return find


def _file_name(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).name.lower()


def _note(words: str, names: Sequence[str]) -> list[str]:
    if not names:
        return []
    unique = list(dict.fromkeys(names))
    more = f" and {len(unique) - NAMES_SHOWN} more" if len(unique) > NAMES_SHOWN else ""
    return [f"{len(names)} {words}: {', '.join(unique[:NAMES_SHOWN])}{more}"]
