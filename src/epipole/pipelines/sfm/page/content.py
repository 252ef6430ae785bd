"""Contents of the report of a reconstruction, gathered from a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from epipole._jit import compile_seconds
from epipole.pipelines.sfm.anchored import UP_TO_SCALE
from epipole.pipelines.sfm.matching.unit_tables import FEATURES
from epipole.pipelines.sfm.notes import (
    focal_source,
    focal_verdict,
    images_of_camera,
    rig_in_words,
    scale_in_words,
    title_of,
)
from epipole.pipelines.sfm.pipeline import Solution
from epipole.runs import Run, load
from epipole.scene import Reconstruction, ViewGraph

MAX_INLIERS_SHOWN = 400
MAX_IMAGES_SHOWN = 400
"""Images with a thumbnail, of 20 to 70 kB each: the page stays below 30 MB."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageRow:
    """One image's line in the report."""

    name: str
    is_registered: bool
    component: int
    """0: the model shown; 1, 2, ...: another model; -1: none."""
    num_keypoints: int
    num_observations: int
    mean_error_px: float
    """Mean reprojection error of its observations; NaN where there are none."""
    reason: str = ""
    """Why the image is not registered; empty if it is."""


@dataclass(frozen=True, slots=True, eq=False)
class ContradictingPair:
    """A pair of images that is not used, because it contradicts the others."""

    names: tuple[str, str]
    positions: tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k 2"]]
    """Matched features in both images, as fractions of width and height."""
    num_matches: int
    reason: str
    """What contradicts what."""


@dataclass(frozen=True, slots=True, eq=False)
class ReportContent:
    """Everything that the report shows."""

    title: str
    reconstruction: Reconstruction
    """The largest model."""
    view_graph: ViewGraph
    """Verified pairs; its image numbers are rows of `reconstruction.images`."""
    image_rows: tuple[ImageRow, ...]
    contradicting: tuple[ContradictingPair, ...] = ()
    """Most matches first."""
    other_components: tuple[int, ...] = ()
    """Registered images of each further model."""
    camera_lines: tuple[str, ...] = ()
    timings: Mapping[str, float] = field(default_factory=dict)
    """Seconds of each stage, in order."""
    compile_seconds: float = 0.0
    """Part of the timings spent on compiling kernels; 0 if they came from the cache."""
    warnings: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    thumbnails: Mapping[str, bytes] = field(default_factory=dict)
    """Image name to a small JPEG."""
    inliers: Mapping[str, Float[np.ndarray, "k 2"]] = field(default_factory=dict)
    """Image name to positions of features with a 3D point, as fractions of width and height."""
    scale_note: str = UP_TO_SCALE
    is_metric: bool = False
    """Whether world coordinates are meters."""
    truth_errors: Mapping[str, str] = field(default_factory=dict)
    """Comparisons with ground truth: name, and result with its unit."""

    @property
    def unit(self) -> str:
        """The unit of world coordinates."""
        return "m" if self.is_metric else "model units, up to scale"


def page_content(
    solution: Solution,
    reasons: Mapping[str, str],
    run: Run,
    settings: dict[str, Any],
    rigs: Mapping[str, Mapping[str, Any]],
) -> ReportContent:
    """Gather what the report shows.

    Args:
        solution: the models.
        reasons: why images are not registered.
        run: output folder and timings.
        settings: the options.
        rigs: geometry of each camera of a rig, by prefix (`RigModel.geometry`).
    """
    models, images = solution.mapped.models, solution.images
    rows, thumbnails, inliers = _of_images(solution, reasons)
    gps, scale_note = solution.mapped.gps[0], scale_in_words(solution)
    if gps is not None:
        scale_note += f"; median distance of the cameras from their GPS positions {gps.median_m:.2f} m"
    if (fit := solution.mapped.pose_fits[0]) is not None:
        found, unit = fit.summary(images.names), "" if solution.mapped.scale is None else " m"
        scale_note += (
            f"; median deviations from {found['num_used']} known poses {found['median_position']:.3g}{unit}"
            f" and {found['median_rotation_deg']:.2g} degrees"
        )
    return ReportContent(
        title=title_of(run.job.inputs[0]),
        reconstruction=models[0],
        view_graph=solution.view_graph,
        image_rows=tuple(rows),
        contradicting=tuple(_contradicting(solution)),
        other_components=tuple(int(m.is_registered().sum()) for m in models[1:]),
        camera_lines=(
            *(_camera_line(solution, c) for c in range(len(images.focal_sources))),
            *(f"{prefix}: {rig_in_words(entry)}" for prefix, entry in rigs.items()),
        ),
        timings=dict(run.timings_s),
        compile_seconds=compile_seconds(),
        warnings=tuple(run.warnings),
        settings=settings,
        thumbnails=thumbnails,
        inliers=inliers,
        scale_note=scale_note,
        is_metric=solution.mapped.scale is not None,
    )


def _of_images(
    solution: Solution, reasons: Mapping[str, str]
) -> tuple[list[ImageRow], dict[str, bytes], dict[str, np.ndarray]]:
    """Row, thumbnail, and used features of each image."""
    models, images = solution.mapped.models, solution.images
    model = models[0]
    component = np.full(len(images), -1)
    for number in reversed(range(len(models))):
        component[models[number].is_registered()] = number
    rows = list[ImageRow]()
    thumbnails, inliers = dict[str, bytes](), dict[str, np.ndarray]()
    per_model = [(_observations_per_image(m)) for m in models]
    keypoints_of = [_used_keypoints(m) for m in models]
    pictured = _pictured(images.names, component >= 0)
    for i, name in enumerate(images.names):
        shown = max(int(component[i]), 0)
        counts, errors = per_model[shown]
        registered = bool(component[i] >= 0)
        rows.append(
            ImageRow(
                name,
                registered,
                int(component[i]),
                len(solution.keypoints[i]),
                int(counts[i]) if registered else 0,
                float(errors[i]) if registered else float("nan"),
                "" if registered else reasons.get(name, ""),
            )
        )
        if name not in pictured:
            continue
        thumbnails[name] = load(solution.features[i].path, FEATURES, "thumbnail")["thumbnail"].tobytes()
        camera = model.cameras[int(model.camera_of_image[i])]
        own = keypoints_of[shown][i]
        pixels = model.images.keypoints_of(i)[np.sort(own)[:: max(1, len(own) // MAX_INLIERS_SHOWN)]]
        inliers[name] = (pixels + 0.5) / [camera.width, camera.height]
    rows += [ImageRow(n, False, -1, 0, 0, float("nan"), why) for n, why in images.left_out.items()]
    return rows, thumbnails, inliers


def _used_keypoints(model: Reconstruction) -> list[np.ndarray]:
    """Keypoints of each image that see a point."""
    order = np.argsort(model.tracks.image, kind="stable")
    bounds = np.searchsorted(model.tracks.image[order], np.arange(1, len(model.images)))
    return np.split(model.tracks.keypoint[order], bounds)


def _pictured(names: Sequence[str], is_registered: np.ndarray) -> set[str]:
    """Images with a thumbnail: all of them, or of many those that are not registered first, and some of the others."""
    order = np.concatenate([np.flatnonzero(~is_registered), np.flatnonzero(is_registered)])
    others = order[MAX_IMAGES_SHOWN // 2 :]
    if len(order) > MAX_IMAGES_SHOWN:
        step = -(-len(others) // (MAX_IMAGES_SHOWN - MAX_IMAGES_SHOWN // 2))
        order = np.concatenate([order[: MAX_IMAGES_SHOWN // 2], others[::step]])
    return {names[i] for i in order}


def _contradicting(solution: Solution) -> list[ContradictingPair]:
    graph, images = solution.contradicting.view_graph, solution.images
    found = []
    for e in np.argsort(-graph.num_inliers(), kind="stable"):
        at = slice(graph.match_offsets[e], graph.match_offsets[e + 1])
        first, second = int(graph.image1[e]), int(graph.image2[e])
        positions1 = _positions(solution, first, graph.keypoint1[at])
        positions2 = _positions(solution, second, graph.keypoint2[at])
        found.append(
            ContradictingPair(
                (images.names[first], images.names[second]),
                (positions1, positions2),
                int(at.stop - at.start),
                solution.contradicting.reason(int(e)),
            )
        )
    return found


def _positions(solution: Solution, image: int, keypoints: np.ndarray) -> np.ndarray:
    """(k, 2) at most `MAX_INLIERS_SHOWN` keypoints, as fractions of width and height."""
    camera = solution.cameras[int(solution.images.camera_of_image[image])]
    shown = keypoints[:: max(1, len(keypoints) // MAX_INLIERS_SHOWN)]
    return np.asarray((solution.keypoints[image][shown] + 0.5) / [camera.width, camera.height])


def _camera_line(solution: Solution, camera: int) -> str:
    """Images of a camera, its final parameters, and the source of its focal length."""
    first_px, accuracy = solution.images.cameras[camera].focal_px, solution.focals.get(camera)
    verdict = "" if accuracy is None else f"; {focal_verdict(accuracy)}"
    return (
        f"{images_of_camera(solution, camera)}: {solution.mapped.models[0].cameras[camera]!r}; "
        f"focal length first {first_px:.0f} px, {focal_source(solution, camera)}{verdict}"
    )


def _observations_per_image(model: Reconstruction) -> tuple[np.ndarray, np.ndarray]:
    n = len(model.images)
    counts = np.bincount(model.tracks.image, minlength=n)
    errors = model.reprojection_errors_px()
    is_seen = np.isfinite(errors)
    image = model.tracks.image[is_seen]
    sums, num_seen = np.bincount(image, errors[is_seen], n), np.bincount(image, minlength=n)
    return counts, np.where(num_seen > 0, sums / np.maximum(num_seen, 1), np.nan)
