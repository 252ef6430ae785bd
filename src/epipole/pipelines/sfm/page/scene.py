"""Scene of a reconstruction for the viewer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import FileFormatError, WorkspaceError
from epipole.io.convert import read_model
from epipole.io.files import read_json
from epipole.io.images.photographs import read_rgb
from epipole.io.models.images import ModelImages
from epipole.io.names import path_inside
from epipole.pipelines.sfm.notes import title_of
from epipole.report.space_model import scene_of_model
from epipole.report.space_scene import METERS, NO_UNIT, SpaceScene
from epipole.runs import has_own_model, read_mark
from epipole.scene import Reconstruction

IMAGE_PX = 640


def scene(path: Path) -> SpaceScene:
    """Points, cameras and images of a model.

    Raises:
        FileFormatError: there is no model.
    """
    summary, model = _summary(path), read_model(path)
    num_given = summary.get("num_images")
    is_metric = summary.get("is_metric") is True or model.georeference is not None
    found = scene_of_model(
        model,
        title=_title(path),
        unit=METERS if is_metric else NO_UNIT,
        load_image=image_loader(path / "images", model, is_own=has_own_model(path)),
        num_given=num_given if isinstance(num_given, int) and num_given >= len(model.images) else None,
    )
    others = [other for other in sorted((path / "sparse").glob("[0-9]*")) if other.is_dir()][1:]
    if not others:
        return found
    return replace(
        found, words=f"{found.words}; the first of {len(others) + 1} models (see also {others[0]})"
    )


def _title(path: Path) -> str:
    """Name of the photographs' folder or video, if a run recorded it; else that of the folder, or OUT/sparse/0."""
    whole = path.resolve()
    try:
        mark = read_mark(path)
    except WorkspaceError:
        mark = None
    if mark is not None and mark.source.paths:
        return title_of(Path(mark.source.paths[0]))
    return "/".join(whole.parts[-3:]) if whole.parent.name == "sparse" else whole.name


def _summary(path: Path) -> dict[str, Any]:
    """Summary of a workspace; empty if there is none."""
    try:
        summary = read_json(path / "summary.json")
    except FileFormatError:
        return {}
    return summary if isinstance(summary, dict) else {}


def image_loader(
    folder: Path, model: Reconstruction | None = None, *, is_own: bool = False
) -> Callable[[str], np.ndarray | None]:
    """Function that reads an image by name and returns None if it cannot be read.

    Args:
        folder: folder of the images.
        model: model whose cameras describe them; None: images are read upright.
        is_own: whether epipole made the model.
    """
    if model is not None:
        return ModelImages(model, folder, is_own=is_own).loader(IMAGE_PX)

    def load_image(name: str) -> np.ndarray | None:
        try:
            return read_rgb(path_inside(folder, name), IMAGE_PX)
        except FileFormatError:
            return None

    return load_image
