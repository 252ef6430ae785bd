"""Growth of earlier models: their images keep their poses as a start, and only further images are registered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole.cameras import Camera
from epipole.errors import ConfigError, DegenerateGeometryError, FileFormatError
from epipole.geometry import Rigid3
from epipole.io.colmap.model import find_model, read_colmap_model
from epipole.io.workspaces import DATABASE
from epipole.mapping import ModelBuilder
from epipole.metrics import align_cameras
from epipole.pipelines.sfm.mappers.incremental import IncrementalMapper, Progress, ignore_progress
from epipole.pipelines.sfm.mappers.joining import join_models
from epipole.pipelines.sfm.matching.pairing import EarlierDatabase, has_same_keypoints
from epipole.scene import Reconstruction

LEAST_IMAGES = 3
"""Images of the first earlier model that must be among the images."""
LOOSE = 4.0
"""Multiple of the usual reprojection error with which points of joined models are triangulated first."""
ROUNDS = 2
"""Rounds of adjustment after the further images are registered."""


def earlier_model_in(out: Path) -> Reconstruction:
    """The largest model in the output folder.

    Raises:
        ConfigError: there is none.
    """
    try:
        return read_colmap_model(find_model(out / "sparse" / "0"))
    except FileFormatError as error:
        raise ConfigError(f"grow needs an earlier model in {out}: {error}") from error


@dataclass(frozen=True, slots=True, eq=False)
class Earlier:
    """Finished models that a new one starts from, and the databases of their runs."""

    models: tuple[Reconstruction, ...]
    """The new model has the coordinates of the first."""
    databases: tuple[EarlierDatabase, ...]

    @staticmethod
    def of_output(out: Path) -> Earlier:
        """The largest model of an output folder.

        Raises:
            ConfigError: there is none.
        """
        return Earlier((earlier_model_in(out),), (EarlierDatabase(out / DATABASE),))


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """What mapping starts from: poses in the coordinates of one model, and its intrinsics."""

    cams_from_world: Mapping[int, Rigid3]
    """By row of the image."""
    cameras: Mapping[int, Camera]
    """Refined intrinsics by row of the camera."""


def grow_from(
    mapper: IncrementalMapper,
    earlier: Sequence[Reconstruction],
    names: tuple[str, ...],
    usable: np.ndarray,
    progress: Progress = ignore_progress,
) -> bool:
    """Grow earlier models by the other usable images; False if there are none, or if they do not fit.

    Args:
        mapper: as of `grow_model`.
        earlier: finished models; the images that they have registered keep their poses if their keypoints are the same.
        names: names of the images.
        usable: mask of images.
        progress: called with the number of registered and of usable images.
    """
    model, starts = mapper.model, []
    for one in earlier:
        poses, rows = one.cams_from_world(), _rows_of(one, names, model.keypoints, usable)
        cameras = {
            int(model.camera_of_image[row]): one.cameras[int(one.camera_of_image[before])]
            for row, before in rows.items()
        }
        starts.append(Start({row: poses[before] for row, before in rows.items()}, cameras))
    return bool(starts) and grow_model(mapper, starts, usable, progress)


def grow_model(
    mapper: IncrementalMapper,
    starts: Sequence[Start],
    usable: np.ndarray,
    progress: Progress = ignore_progress,
) -> bool:
    """Start from known poses, triangulate anew, and register the other images; False if that is impossible.

    It is impossible if the first start has fewer than three images, or if the models disagree with the matches.

    Args:
        mapper: an incremental mapper, which has the model.
        starts: models that are joined by their common points; one that has too few starts no images.
        usable: mask of images.
        progress: called with the number of registered and of usable images.
    """
    model, config = mapper.model, mapper.config
    model.clear()
    if len(starts[0].cams_from_world) < LEAST_IMAGES:
        return False
    for start in reversed(starts):  # the first model decides on cameras in common
        _take_cameras(model, start.cameras)
    joined = join_models(model, [start.cams_from_world for start in starts], config)
    for row, pose in joined.items():
        model.register(row, pose)
    mapper.num_apart = [len({*start.cams_from_world} - {*joined}) for start in starts]
    everything, angle_rad = np.arange(len(model.components)), np.deg2rad(config.min_angle_deg)
    if len(starts) > 1:
        model.triangulate(everything, LOOSE * config.max_error_px, angle_rad)
        mapper.adjust_globally(1)
        model.replace_points(np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros((0, 3)))
    model.triangulate(everything, config.max_error_px, angle_rad)
    if mapper.consistency.overall(model) < config.min_match_agreement:
        model.clear()
        return False
    mapper.grow(usable, int(usable.sum()), progress)
    # A model of one earlier model is adjusted again when it is completed; gaps between joined ones must be closed before.
    is_thorough = mapper.is_last or len(starts) > 1
    mapper.adjust_globally(ROUNDS if is_thorough else 1)
    if is_thorough:
        mapper.finish()
    for image in np.flatnonzero(
        model.registered & (mapper.consistency.of_images(model) < config.image_fraction)
    ):
        mapper.take_out_if_wrong(int(image))
    return int(model.registered.sum()) >= LEAST_IMAGES


def keep_coordinates(model: ModelBuilder, earlier: Reconstruction, names: tuple[str, ...]) -> None:
    """Move a model to the coordinates of the earlier one, by the cameras of common images."""
    known = _rows_of(earlier, names, model.keypoints, model.registered)
    if len(known) < 2:
        return
    before = earlier.cams_from_world()[np.array(list(known.values()))]
    after = Rigid3(
        np.stack([model.cam_from_world(row).rotation for row in known]),
        np.stack([model.cam_from_world(row).translation for row in known]),
    )
    with suppress(DegenerateGeometryError):  # too few common images are left
        model.move(align_cameras(after, before).truth_from_estimated)


def _rows_of(
    earlier: Reconstruction, names: tuple[str, ...], keypoints: Sequence[np.ndarray], usable: np.ndarray
) -> dict[int, int]:
    """Row of each usable image that the earlier model has registered with the same keypoints, and its row there."""
    before = {name: k for k, name in enumerate(earlier.images.name)}
    registered = earlier.is_registered()
    return {
        row: before[name]
        for row, name in enumerate(names)
        if usable[row]
        and name in before
        and registered[before[name]]
        and has_same_keypoints(keypoints[row], earlier.images.keypoints_of(before[name]))
    }


def _take_cameras(model: ModelBuilder, cameras: Mapping[int, Camera]) -> None:
    """Start from the earlier intrinsics of each camera that is not constant, if it has the same model and size."""
    params = model.params.copy()
    for row, there in cameras.items():
        camera = model.camera(row)
        is_same = (camera.model, camera.width, camera.height) == (there.model, there.width, there.height)
        if is_same and not model.cameras.is_constant[row]:
            params[row] = there.padded_params()
    model.set_params(params)
