"""First stage: depth of each view, one file each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole._checks.tables import Expected, Table
from epipole.dense.depth import view_depth
from epipole.pipelines.surfaces.inputs import SurfaceInputs
from epipole.pipelines.surfaces.view_files import ViewFile, view_of_file
from epipole.runs import Unit, digest, load
from epipole.scene.view_depth import DepthReason, ViewDepth

FORMAT = 5
"""Increase when the method or the contents of the files change."""
DEPTH: Table = {
    "depth": Expected("float32", "h w", may_be_nan=True),
    "relative_sigma": Expected("float16", "h w", may_be_nan=True),
    "reason": Expected("uint8", "h w", most=max(DepthReason)),
    "num_agreeing": Expected("uint8", "h w"),
}


@dataclass(frozen=True, slots=True, eq=False)
class DepthPayload:
    """Input of the unit of one view."""

    view: ViewFile
    sources: tuple[ViewFile, ...]
    depths: tuple[float, float]


def depth_units(inputs: SurfaceInputs, folder: Path) -> dict[int, Unit]:
    """The unit of each view that has sources."""
    units = {}
    for k in inputs.usable:
        sources = tuple(inputs.views[j] for j in inputs.sources[k])
        key = digest(
            "depth",
            FORMAT,
            inputs.views[k].fingerprint,
            [source.fingerprint for source in sources],
            list(inputs.depths[k]),
        )
        payload = DepthPayload(inputs.views[k], sources, inputs.depths[k])
        units[k] = Unit(folder / f"{key}.npz", key, depth_of_files, payload)
    return units


def depth_of_files(payload: DepthPayload) -> dict[str, np.ndarray]:
    """Depth of a view from its sources."""
    found = view_depth(
        view_of_file(payload.view), [view_of_file(source) for source in payload.sources], payload.depths
    )
    return {
        "depth": found.depth,
        "relative_sigma": (found.sigma / found.depth).astype(np.float16),
        "reason": found.reason,
        "num_agreeing": found.num_agreeing,
    }


def depth_in(path: Path) -> ViewDepth:
    """Depth of a view, as stored by its unit.

    Raises:
        WorkspaceError: the file is missing or damaged.
    """
    found = load(path, DEPTH)
    sigma = found["relative_sigma"].astype(np.float32) * found["depth"]
    return ViewDepth(found["depth"], sigma, found["reason"], found["num_agreeing"])
