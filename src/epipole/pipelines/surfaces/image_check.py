"""Check that images can be decoded, before other work depends on them: the header of a truncated file is complete."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole._checks.tables import TEXT, Expected, Table
from epipole.errors import FileFormatError
from epipole.io.images.photographs import read_rgb
from epipole.io.images.rgba import read_rgba
from epipole.runs import Run, Unit, digest, load

FORMAT = 1
"""Increase when the method or the contents of the files change."""
FAILURE: Table = {"failure": Expected(TEXT, "")}
SIDE_PX = 64
"""Side up to which images are decoded; a JPEG is decoded at an eighth of its size."""


@dataclass(frozen=True, slots=True, eq=False)
class ImagePayload:
    """Input of the unit of one image."""

    path: Path


def failures_of(digests: Mapping[Path, str], run: Run) -> dict[Path, str]:
    """The images that cannot be decoded, with the reason.

    Args:
        digests: the images, with digests of their contents.
        run: stores the reason of each image, so that an unchanged image is decoded once.

    Raises:
        WorkspaceError: a result cannot be written.
    """
    units = {}
    for path, content in digests.items():
        key = digest("image", FORMAT, path.name, content)
        units[path] = Unit(
            run.root / "units" / "images" / f"{key}.npz", key, failure_of_file, ImagePayload(path)
        )
    run.do(list({unit.key: unit for unit in units.values()}.values()), "images")
    reasons = {path: str(load(unit.path, FAILURE)["failure"]) for path, unit in units.items()}
    return {path: reason for path, reason in reasons.items() if reason}


def failure_of_file(payload: ImagePayload) -> dict[str, np.ndarray]:
    """Why an image cannot be decoded; an empty text if it can."""
    try:
        read_rgb(payload.path, SIDE_PX)
        read_rgba(payload.path)
    except FileFormatError as error:
        return {"failure": np.array(str(error).removeprefix(f"{payload.path}: "))}
    return {"failure": np.array("")}
