"""Second stage: points of each view that other views confirm, one file each; then one cloud."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole._checks.tables import Expected, Table
from epipole.dense.fusion import DensePoints, fuse_view
from epipole.pipelines.surfaces.depth_stage import depth_in
from epipole.pipelines.surfaces.inputs import SurfaceInputs
from epipole.pipelines.surfaces.view_files import ViewFile, view_of_file
from epipole.runs import Unit, digest, load
from epipole.scene.view_depth import ViewDepth

FORMAT = 2
"""Increase when the method or the contents of the files change."""
CLOUD: Table = {
    "points_in_world": Expected("float64", "n 3"),
    "normals": Expected("float32", "n 3"),
    "rgb": Expected("uint8", "n 3"),
    "sigma": Expected("float32", "n", least=0.0),
    "confirmed": Expected("uint8", "b"),
}


@dataclass(frozen=True, slots=True, eq=False)
class CloudPayload:
    """Input of the unit of one view: the view and its neighbors, with the files of their depth."""

    view: ViewFile
    depth: Path
    others: tuple[tuple[ViewFile, Path], ...]


def cloud_units(inputs: SurfaceInputs, depths: Mapping[int, Unit], folder: Path) -> dict[int, Unit]:
    """The unit of each view; its neighbors are its sources and the views that it is a source of."""
    neighbors = {k: set(inputs.sources[k]) & depths.keys() for k in depths}
    for k, row in enumerate(inputs.sources):
        for j in row:
            if j in neighbors and k in depths:
                neighbors[j].add(k)
    units = {}
    for k, depth in depths.items():
        others = [(inputs.views[j], depths[j]) for j in sorted(neighbors[k])]
        first = [inputs.views[k].name < view.name for view, _ in others]
        key = digest("cloud", FORMAT, depth.key, [unit.key for _, unit in others], first)
        payload = CloudPayload(inputs.views[k], depth.path, tuple((view, unit.path) for view, unit in others))
        units[k] = Unit(folder / f"{key}.npz", key, cloud_of_files, payload)
    return units


def cloud_of_files(payload: CloudPayload) -> dict[str, np.ndarray]:
    """Points of a view, and the pixels that other views confirm."""
    others = ((view_of_file(view), depth_in(path)) for view, path in payload.others)
    found = fuse_view(view_of_file(payload.view), depth_in(payload.depth), others)
    return {
        "points_in_world": found.points.points_in_world,
        "normals": found.points.normals,
        "rgb": found.points.rgb,
        "sigma": found.points.sigma,
        "confirmed": np.packbits(found.confirmed),
    }


def points_in(units: Sequence[Unit]) -> Iterator[DensePoints]:
    """The points of each view.

    Raises:
        WorkspaceError: a file is missing or damaged.
    """
    names = ("points_in_world", "normals", "rgb", "sigma")
    for unit in units:
        yield DensePoints(**load(unit.path, CLOUD, *names))


def confirmed_depth(depth: Unit, cloud: Unit) -> ViewDepth:
    """Depth of a view where other views confirm it.

    Raises:
        WorkspaceError: a file is missing or damaged.
    """
    found = depth_in(depth.path)
    bits = np.unpackbits(load(cloud.path, CLOUD, "confirmed")["confirmed"], count=found.depth.size)
    kept = bits.reshape(found.depth.shape).astype(bool)
    nan = np.float32(np.nan)
    return ViewDepth(
        np.where(kept, found.depth, nan), np.where(kept, found.sigma, nan), found.reason, found.num_agreeing
    )
