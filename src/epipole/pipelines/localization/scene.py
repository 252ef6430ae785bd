"""3D view of a model and the images that were localized in it, which have another color."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.io.convert import read_model
from epipole.io.files import read_json
from epipole.report.space_model import scene_of_model, stage_of
from epipole.report.space_scene import METERS, NO_UNIT, SpaceScene
from epipole.runs import is_output_of
from epipole.scene import Curve, Reconstruction

KIND = "localize"
COLOR = (255, 140, 0)
"""Of localized images: orange."""
FRUSTUM = 0.02
"""Depth of a frustum, relative to the extent of the model."""


def is_mine(path: Path) -> bool:
    """Whether a path is an output folder of `localize`."""
    return is_output_of(path, KIND)


def scene(path: Path) -> SpaceScene:
    """Points and cameras of the model, and the localized images.

    Raises:
        FileFormatError: the folder has no model, or no list of localized images.
    """
    model = read_model(path)
    summary = read_json(path / "summary.json")
    names = summary.get("names_in_model") if isinstance(summary, dict) else None
    if not isinstance(names, list):
        raise FileFormatError(path / "summary.json", "it does not list the localized images")
    unit = METERS if summary.get("is_metric") is True else NO_UNIT
    return scene_of_localized(model, {str(name) for name in names}, title=path.resolve().name, unit=unit)


def scene_of_localized(
    model: Reconstruction,
    localized: Collection[str],
    *,
    title: str,
    unit: str,
) -> SpaceScene:
    """Scene of a model whose images with these names were localized in it."""
    is_new = np.array([name in localized for name in model.images.name], bool)
    frames = model.frames.rig_from_world
    is_hidden = np.isin(np.arange(len(model.frames)), model.images.frame[is_new])
    before = replace(
        model,
        frames=replace(
            model.frames,
            rig_from_world=Rigid3(frames.rotation, np.where(is_hidden[:, None], np.nan, frames.translation)),
        ),
    )
    found = scene_of_model(
        before,
        title=title,
        unit=unit,
        cameras="Images of the model",
        curves=[Curve("Localized images", _frustums(model, np.flatnonzero(is_new)), COLOR)],
    )
    return replace(found, words=f"{found.words}; {int(is_new.sum())} localized images")


def _frustums(model: Reconstruction, images: np.ndarray) -> np.ndarray:
    """(n, 2, 3) segments: the edges of the viewing pyramids of images."""
    depth = FRUSTUM * stage_of(model).radius
    cams, out = model.cams_from_world(), []
    for image in images.tolist():
        camera = model.cameras[int(model.camera_of_image[image])]
        right, bottom = camera.width - 0.5, camera.height - 0.5
        rays = np.column_stack(
            [
                (np.array([-0.5, right, right, -0.5]) - camera.K[0, 2]) / camera.K[0, 0],
                (np.array([-0.5, -0.5, bottom, bottom]) - camera.K[1, 2]) / camera.K[1, 1],
                np.ones(4),
            ]
        )
        corners = cams[image].inverse().apply(depth * rays)
        center = cams[image].centers()
        out += [(center, corner) for corner in corners]
        out += [(corners[k], corners[(k + 1) % 4]) for k in range(4)]
    return np.array(out, np.float64).reshape(-1, 2, 3)
