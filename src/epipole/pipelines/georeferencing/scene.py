"""3D view of a georeferenced model with its control and check points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import FileFormatError
from epipole.io.convert import read_model
from epipole.io.files import read_json
from epipole.report.space_model import scene_of_model, stage_of
from epipole.report.space_scene import METERS, SpaceScene
from epipole.runs import is_output_of
from epipole.scene import Curve, Reconstruction

KIND = "georeference"
COLORS = {"control": (40, 120, 255), "check": (0, 170, 90), "rejected": (230, 40, 40)}
WORDS = {"control": "Control points", "check": "Check points", "rejected": "Rejected control points"}
ARM = 0.04
"""Length of the arms of a cross, relative to the extent of the model."""


def is_mine(path: Path) -> bool:
    """Whether a path is an output folder of `georeference`."""
    return is_output_of(path, KIND)


def scene(path: Path) -> SpaceScene:
    """Points and cameras of the model, and the surveyed points.

    Raises:
        FileFormatError: the folder has no model, or no list of surveyed points.
    """
    entries = read_json(path / "control_points.json")
    if not isinstance(entries, dict) or not all(isinstance(entry, dict) for entry in entries.values()):
        raise FileFormatError(path / "control_points.json", "it does not list the surveyed points")
    return scene_of_survey(read_model(path), entries, title=path.resolve().name)


def scene_of_survey(
    model: Reconstruction, entries: Mapping[str, Mapping[str, Any]], *, title: str
) -> SpaceScene:
    """Scene of a model with crosses at the surveyed points.

    Args:
        model: the model.
        entries: what `control_points.json` says about each point.
        title: of the scene.
    """
    arm = ARM * stage_of(model).radius
    curves = []
    for role, color in COLORS.items():
        own = [
            entry["adjusted_m"]
            for entry in entries.values()
            if entry.get("role") == role and "adjusted_m" in entry
        ]
        if own:
            at = np.array([[float(v) for v in point.values()] for point in own]).reshape(-1, 1, 1, 3)
            arms = np.stack([-arm * np.eye(3), arm * np.eye(3)], axis=1)[None]
            curves.append(Curve(WORDS[role], (at + arms).reshape(-1, 2, 3), color))
    found = scene_of_model(model, title=title, unit=METERS, cameras="Images", curves=curves)
    return replace(found, words=f"{found.words}; {len(entries)} surveyed points")
