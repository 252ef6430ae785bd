"""Files of a reconstruction: database, models, points and images."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import overload

import numpy as np

from epipole._parallel import map_chunks
from epipole.errors import FileFormatError, NoModelError
from epipole.io.atomic import atomic_write
from epipole.io.colmap.database import DatabaseContents, write_database
from epipole.io.colmap.model import write_colmap_model
from epipole.io.files import read_json
from epipole.io.images.photographs import copy_or_rotate
from epipole.io.json_files import json_text
from epipole.io.meshes.ply import write_scene_ply
from epipole.io.workspaces import DATABASE
from epipole.pipelines.sfm.inputs import UNITS, descriptors_on_access
from epipole.pipelines.sfm.mapping_stage import no_model_reason
from epipole.pipelines.sfm.matching.match_stage import load_putative
from epipole.pipelines.sfm.pipeline import Solution
from epipole.runs import Run
from epipole.scene import Frames, Images, Rigs, unregistered

SIFT_COLUMNS = 128
COPIED_AT_ONCE = 16
COPIES = f"{UNITS}/copied_pictures.json"
"""Record in the output folder of the image digest that each copy was made from."""


def write_results(solution: Solution, run: Run) -> None:
    """Write `database.db`, then `sparse/`, `points.ply` and `images/`.

    Raises:
        NoModelError: there is no model; the database is written nevertheless.
        WorkspaceError: the disk is full.
    """
    with run.folder.publish("database") as aside:
        write_database(aside / DATABASE, database_contents(solution))
    models = solution.mapped.models
    if not models:
        raise NoModelError(no_model_reason(solution.images, solution.keypoints, solution.view_graph))
    with run.folder.publish("model") as aside:
        for number, model in enumerate(models):
            write_colmap_model(model, aside / "sparse" / str(number))
        write_scene_ply(aside / "points.ply", models[0])
    _write_images(solution, run)


def _write_images(solution: Solution, run: Run) -> None:
    """Write the registered images, rotated upright; copies of unchanged images are kept."""
    images, record = solution.images, run.root / COPIES
    registered = np.zeros(len(images), bool)
    for model in solution.mapped.models:
        registered |= model.is_registered()
    rows = np.flatnonzero(registered)
    copied = {images.names[i]: images.fingerprints[i] for i in rows}
    before = _read_record(record)
    record.unlink(missing_ok=True)  # an interrupted run must not leave an outdated record
    with run.folder.replacing("images", [f"images/{name}" for name in copied]):
        run.report("write", 0, len(copied))
        stale = [
            name
            for name in copied
            if not (run.root / "images" / name).is_file() or before.get(name) != copied[name]
        ]
        done = len(copied) - len(stale)
        for start in range(0, len(stale), COPIED_AT_ONCE):  # rotated ones are encoded again, in parallel
            names = stale[start : start + COPIED_AT_ONCE]
            map_chunks(
                partial(_copy_images, images.folder, run.root / "images", names), len(names), len(names)
            )
            done += len(names)
            run.report("write", done, len(copied))
        run.report("write", len(copied), len(copied))
    with atomic_write(record) as aside:
        aside.write_text(json_text(copied, indent=1), encoding="utf-8")


def _copy_images(
    source: Path, target: Path, names: Sequence[str], start: int, stop: int, _chunk: int
) -> None:
    for name in names[start:stop]:
        copy_or_rotate(source / name, target / name)


def _read_record(path: Path) -> dict[str, str]:
    """Image digest of each copy; empty if there is no record."""
    try:
        content = read_json(path)
    except FileFormatError:
        return {}
    return content if isinstance(content, dict) else {}


def database_contents(solution: Solution) -> DatabaseContents:
    """Features, putative matches and two-view geometries, in COLMAP's format."""
    images, cameras, keypoints = solution.images, solution.cameras, solution.keypoints
    n = len(images)
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])]).astype(np.int64)
    stacked = np.concatenate(keypoints).reshape(-1, 2)
    rows = np.arange(n, dtype=np.int32)
    return DatabaseContents(
        cameras,
        Rigs.of_single_cameras(len(cameras)),
        Frames(images.camera_of_image, unregistered(n), images.timestamps_s),
        Images(images.names, rows, images.camera_of_image, offsets, stacked),
        _SiftDescriptors([unit.path for unit in solution.features]),
        load_putative(solution.matches, [len(k) for k in keypoints]),
        solution.view_graph,
        np.where(_lacks_altitude(images.lat_lon_alt), 0.0, images.lat_lon_alt),
    )


class _SiftDescriptors(Sequence[np.ndarray | None]):
    """Descriptors of COLMAP's size, read one image at a time; None for others."""

    def __init__(self, paths: list[Path]) -> None:
        self._stored = descriptors_on_access(paths)

    def __len__(self) -> int:
        return len(self._stored)

    @overload
    def __getitem__(self, index: int) -> np.ndarray | None: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[np.ndarray | None]: ...
    def __getitem__(self, index: int | slice) -> np.ndarray | Sequence[np.ndarray | None] | None:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        descriptors = self._stored[index]
        return descriptors if descriptors.shape[1] == SIFT_COLUMNS else None


def _lacks_altitude(lat_lon_alt: np.ndarray) -> np.ndarray:
    """(n, 3) mask of unknown altitudes; COLMAP's table requires numbers, and COLMAP writes 0."""
    is_located = np.isfinite(lat_lon_alt[:, :2]).all(axis=1, keepdims=True)
    return is_located & ~np.isfinite(lat_lon_alt)
