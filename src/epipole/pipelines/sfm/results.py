"""The files of a reconstruction: the database, the models, their points and their pictures."""

from __future__ import annotations

import numpy as np

from epipole.errors import NoModelError
from epipole.io.colmap import write_colmap_model
from epipole.io.colmap_database import DatabaseContents, write_database
from epipole.io.photographs import copy_or_rotate
from epipole.io.ply import write_scene_ply
from epipole.pipelines.sfm.mapping_stage import no_model_reason
from epipole.pipelines.sfm.match_stage import load_putative
from epipole.pipelines.sfm.pipeline import DATABASE, Solution
from epipole.runs import Run, load
from epipole.scene import Frames, Images, Rigs, unregistered


def write_results(solution: Solution, run: Run) -> None:
    """Write `database.db`, then `sparse/`, `points.ply` and `images/`.

    Raises:
        NoModelError: there is no model; the database is written all the same.
        WorkspaceError: the disk is full.
    """
    with run.folder.publish("database") as aside:
        write_database(aside / DATABASE, database_contents(solution))
    models = solution.mapped.models
    if not models:
        raise NoModelError(no_model_reason(solution.view_graph, len(solution.images)))
    with run.folder.publish("model") as aside:
        for number, model in enumerate(models):
            write_colmap_model(model, aside / "sparse" / str(number))
        write_scene_ply(aside / "points.ply", models[0])
    _write_pictures(solution, run)


def _write_pictures(solution: Solution, run: Run) -> None:
    """Write the registered pictures, turned upright; those already there stay."""
    images = solution.images
    placed = np.zeros(len(images), bool)
    for model in solution.mapped.models:
        placed |= model.is_registered()
    names = [images.names[i] for i in np.flatnonzero(placed)]
    with run.folder.replacing("images", [f"images/{name}" for name in names]):
        for name in names:
            source, target = images.folder / name, run.root / "images" / name
            if not target.is_file() or target.stat().st_mtime_ns < source.stat().st_mtime_ns:
                copy_or_rotate(source, target)


def database_contents(solution: Solution) -> DatabaseContents:
    """Features, putative matches and two-view geometries, as COLMAP stores them."""
    images, cameras, keypoints = solution.images, solution.cameras, solution.keypoints
    n = len(images)
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])]).astype(np.int64)
    stacked = np.concatenate(keypoints).reshape(-1, 2)
    rows = np.arange(n, dtype=np.int32)
    stored = [load(unit.path, "descriptors")["descriptors"] for unit in solution.features]
    return DatabaseContents(
        cameras,
        Rigs.of_single_cameras(len(cameras)),
        Frames(images.camera_of_image, unregistered(n), images.timestamps_s),
        Images(images.names, rows, images.camera_of_image, offsets, stacked),
        [descriptors if descriptors.shape[1] == 128 else None for descriptors in stored],
        load_putative(solution.matches),
        solution.view_graph,
        images.lat_lon_alt,
    )
