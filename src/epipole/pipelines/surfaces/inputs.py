"""Which views a surface is made of: their files, sources and ranges of depth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from epipole.dense.source_selection import SharedPoints, depth_range, select_sources
from epipole.errors import ConfigError, EpipoleError, FileFormatError, NoModelError
from epipole.io.files import read_json
from epipole.io.images.photographs import common_range, mask_of, read_mask_file
from epipole.io.models.images import ModelImage, ModelImages
from epipole.io.models.losses import losses_in, losses_of
from epipole.pipelines.sfm.run import reconstruct
from epipole.pipelines.surfaces.config import SurfaceConfig
from epipole.pipelines.surfaces.image_check import failures_of
from epipole.pipelines.surfaces.view_files import ViewFile, pinhole_of, shown_fraction
from epipole.runs import Run, content_digests, digest, is_output_of
from epipole.runs.model_source import ModelSource, is_model, model_source_of, up_in_world
from epipole.scene import Reconstruction

MODEL = "sfm"
"""Subfolder of the model of photographs that are reconstructed first."""
DIGESTS = "files.npz"
LEAST_SHOWN = 0.7
"""Part of an image below which the part that undistortion leaves out is reported."""
MOST_POINTS = 10_000
"""Points without observations that are used, at most: an evenly spaced subset."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceInputs:
    """Views in the order of their names, with the sources and the range of depth of each."""

    model: Reconstruction
    up: np.ndarray
    """(3,) upward direction."""
    views: tuple[ViewFile, ...]
    sources: tuple[tuple[int, ...], ...]
    depths: tuple[tuple[float, float], ...]
    warnings: tuple[str, ...]
    accuracy: dict[str, Any]
    """`summary.json` of the run that made the model, with the residuals of its survey; empty without one."""

    @property
    def image_scale(self) -> float:
        """Side of a pixel of the images relative to one of the depth, which may be made of smaller images; the median."""
        return float(np.median([view.pinhole.focal_px / view.image.camera.focal_px for view in self.views]))

    @property
    def usable(self) -> list[int]:
        """Views with at least one source."""
        return [k for k, row in enumerate(self.sources) if row]


def surface_inputs(source: Path, run: Run, config: SurfaceConfig) -> SurfaceInputs:
    """Find the views of a source; photographs are reconstructed first, into a subfolder.

    Raises:
        NoModelError: fewer than two views share points.
        FileFormatError: there is no model, or it is damaged.
        ConfigError: there are masks, but none for any image.
    """
    found, lost = _model_of(source, run, config)
    warnings = [*lost, *found.warnings]
    views = _view_files(found, run, config, warnings)
    warnings += cropped_notes(views)
    if len(views) < 2:
        reasons = "".join(f"; {warning}" for warning in warnings[:3])
        raise NoModelError(f"{len(views)} images can be used, but a surface needs at least two{reasons}")
    model = found.model
    row_of_name = {name: row for row, name in enumerate(model.images.name)}
    rows = [row_of_name[view.name] for view in views]
    points = _shared_points(model, rows) if len(model.tracks.image) else _points_in_images(model, views)
    if not len(points.point_of_observation):
        raise NoModelError(
            f"{source} has no points that its images see, so the range of depth is unknown: pass the output of `epipole reconstruct` on the"
            " images, or add points to the model (ply_file_path in a transforms.json; COLMAP's point_triangulator)"
        )
    if not len(model.tracks.image):
        warnings.append(
            "the model does not say which images see its points, so each is assumed to see all points that project into it"
        )
    centers = np.array([view.cam_from_world.inverse().translation for view in views]).reshape(-1, 3)
    focals = np.array([view.pinhole.focal_px for view in views], np.float64)
    sources = select_sources(points, centers, focals, config.sources)
    depths = _depth_ranges(views, points)
    usable = [tuple(row.tolist()) if depths[k] is not None else () for k, row in enumerate(sources)]
    alone = [view.name for view, row in zip(views, usable) if not row]
    if len(views) - len(alone) < 2:
        raise NoModelError(
            f"no two of the {len(views)} images see enough common points from different positions: a surface needs overlapping images"
        )
    if alone:
        warnings.append(
            f"{len(alone)} images have no depth, because no other image sees the same points from a suitable position ({alone[0]})"
        )
    return SurfaceInputs(
        model,
        up_in_world(found.model, found.has_z_up),
        tuple(views),
        tuple(usable),
        tuple(row or (1.0, 2.0) for row in depths),
        tuple(warnings),
        _summary_of(source if is_model(source) else run.root / MODEL),
    )


def _summary_of(folder: Path) -> dict[str, Any]:
    """`summary.json` of an output folder; empty where there is none, or a damaged one, which only the report would show."""
    path = folder / "summary.json"
    if not path.is_file():
        return {}
    try:
        found = read_json(path)
    except FileFormatError:
        return {}
    return found if isinstance(found, dict) else {}


def _model_of(source: Path, run: Run, config: SurfaceConfig) -> tuple[ModelSource, list[str]]:
    if is_output_of(source, "surface"):
        raise ConfigError(
            f"{source} is the output of `epipole surface`: pass the images or the model that it was made from"
        )
    if is_model(source):
        return model_source_of(source, config.max_size_px, config.images), losses_in(source)
    if config.images is not None:
        raise ConfigError(
            f"{source} has no cameras, so its images are used: pass images (--images) only with a model"
        )
    out = run.root / MODEL
    done = reconstruct(source, out, progress=run.job.progress, executor=run.job.executor, masks=config.masks)
    photographs = source if source.is_dir() else out / "images"
    return model_source_of(out, config.max_size_px, photographs), losses_of(done.summary, out)


def _view_files(found: ModelSource, run: Run, config: SurfaceConfig, warnings: list[str]) -> list[ViewFile]:
    """Views of the registered images; images that are missing, or do not fit camera or mask, are left out with a warning."""
    model, cams_from_world = found.model, found.model.cams_from_world()
    files = ModelImages(model, found.folder, is_own=found.is_own)
    rows = sorted(np.flatnonzero(model.is_registered()).tolist(), key=lambda k: model.images.name[k])
    images, paths = dict[int, tuple[ModelImage, Path | None]](), list[Path]()
    for row in rows:
        name = model.images.name[row]
        try:
            image, mask = files.find(name), _mask_of(found, config, name)
            if mask is not None:
                read_mask_file(mask, name, size=(image.camera.width, image.camera.height))
        except EpipoleError as error:
            warnings.append(f"{name} is left out: {error}")
            continue
        images[row] = image, mask
        paths += [image.path] if mask is None else [image.path, mask]
    if config.masks is not None:
        warnings += _masks_missing(
            config.masks, {model.images.name[k]: m for k, (_, m) in images.items()}, warnings
        )
    digests = content_digests(paths, run.root / "units" / DIGESTS, run.job.progress)
    failures = failures_of({image.path: digests[image.path] for image, _ in images.values()}, run)
    for row in [row for row, (image, _) in images.items() if image.path in failures]:
        warnings.append(f"{model.images.name[row]} is left out: {failures[images.pop(row)[0].path]}")
    limits = common_range([image.path for image, _ in images.values()])
    views = []
    for row, (image, mask) in images.items():
        name = model.images.name[row]
        try:
            pinhole = pinhole_of(image.camera, config.max_size_px)
        except EpipoleError as error:
            warnings.append(f"{name} is left out: {error}")
            continue
        motion = cams_from_world[row]
        key = digest(
            digests[image.path],
            "" if mask is None else digests[mask],
            [image.orientation, str(limits), int(image.camera.model), pinhole.width, pinhole.height],
            image.camera.params,
            motion.as_matrix(),
        )
        views.append(ViewFile(name, image, pinhole, motion, mask, limits, key))
    return views


def cropped_notes(views: list[ViewFile]) -> list[str]:
    """A warning if undistorted images show much less than the images."""
    first = {view.image.camera.params.tobytes(): view for view in reversed(views)}
    shown = {key: shown_fraction(view.image.camera) for key, view in first.items()}
    less = [view for view in views if shown[view.image.camera.params.tobytes()] < LEAST_SHOWN]
    if not less:
        return []
    part = min(shown[view.image.camera.params.tobytes()] for view in less)
    return [
        f"{len(less)} of {len(views)} images have a very wide field of view, and only the middle {100 * part:.0f} % of their pixels are used: depth is"
        f" computed in undistorted images, which show at most 71 degrees to each side ({less[0].name})"
    ]


def _masks_missing(folder: Path, mask_of_image: dict[str, Path | None], warnings: list[str]) -> list[str]:
    """A warning if some images have no mask.

    Raises:
        ConfigError: none has one that can be used.
    """
    without = [name for name, mask in mask_of_image.items() if mask is None]
    if len(without) == len(mask_of_image):
        why = f"; {warnings[-1]}" if warnings else ""
        raise ConfigError(f"masks {folder} has no mask for any image that is used (expected NAME.png){why}")
    if not without:
        return []
    count = len(mask_of_image) - len(without)
    return [
        f"masks for {count} of {len(mask_of_image)} images: the others are used without one ({without[0]} ...)"
    ]


def _mask_of(found: ModelSource, config: SurfaceConfig, name: str) -> Path | None:
    return found.masks.get(name) if config.masks is None else mask_of(config.masks, name)


def _shared_points(model: Reconstruction, rows: list[int]) -> SharedPoints:
    """Points of the model, and their observations in these images."""
    view_of_image = np.full(len(model.images), -1, np.int64)
    view_of_image[rows] = np.arange(len(rows))
    view = view_of_image[model.tracks.image]
    point = model.tracks.point_of_observation().astype(np.int64)
    used = (view >= 0) & np.isfinite(model.points.xyz_in_world[point]).all(axis=1)
    return SharedPoints(model.points.xyz_in_world, view[used], point[used])


def _points_in_images(model: Reconstruction, views: list[ViewFile]) -> SharedPoints:
    """Points of a model without observations; each view is assumed to see those that project into it, occluded or not."""
    points = model.points.xyz_in_world
    points = points[np.isfinite(points).all(axis=1)]
    points = points[:: max(1, -(-len(points) // MOST_POINTS))]
    seen = [_in_image(view, points) for view in views]
    view = np.repeat(np.arange(len(views)), [len(row) for row in seen])
    return SharedPoints(points, view, np.concatenate([np.empty(0, np.int64), *seen]))


def _in_image(view: ViewFile, points: np.ndarray) -> np.ndarray:
    """Rows of the points that project into a view."""
    in_cam = view.cam_from_world.apply(points)
    in_front = np.flatnonzero(in_cam[:, 2] > 0)
    pixels = view.pinhole.project(in_cam[in_front])
    size = view.pinhole.width - 0.5, view.pinhole.height - 0.5
    return np.asarray(in_front[(pixels > -0.5).all(axis=1) & (pixels < size).all(axis=1)])


def _depth_ranges(views: list[ViewFile], points: SharedPoints) -> list[tuple[float, float] | None]:
    """Range of the depth of each view; None for a view that sees no point."""
    order = np.argsort(points.view_of_observation, kind="stable")
    starts = np.searchsorted(points.view_of_observation[order], np.arange(len(views) + 1))
    return [
        depth_range(
            view.cam_from_world.apply(points.points_in_world[points.point_of_observation[order[a:b]]])[:, 2]
        )
        for view, a, b in zip(views, starts[:-1], starts[1:])
    ]
