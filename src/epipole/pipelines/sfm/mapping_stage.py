"""Mapping stage: models from a view graph, largest first, upright, and metric if GPS allows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from epipole.features import Features
from epipole.geometry import Rigid3
from epipole.mapping import ModelBuilder, PositionPriors, connect_matches
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.gps.alignment import (
    GpsAlignment,
    align_to_gps,
    gps_distances,
)
from epipole.pipelines.sfm.known_poses import PoseFit, fit_known_poses
from epipole.pipelines.sfm.mappers.choice import Method, map_with
from epipole.pipelines.sfm.mappers.completion import FINAL_ROUNDS, GROWN_ROUNDS, ROUNDS, complete_model
from epipole.pipelines.sfm.mappers.divided import MapParts, map_divided
from epipole.pipelines.sfm.mappers.growth import grow_from, keep_coordinates
from epipole.pipelines.sfm.mappers.incremental import IncrementalMapper, Rejection
from epipole.pipelines.sfm.orientation import upright_from_world
from epipole.pipelines.sfm.photographs import ImageSet
from epipole.pipelines.sfm.up_direction import LEVEL_SIGMA_RAD, up_directions
from epipole.robust import PairKind
from epipole.runs import Progress, ProgressCallback
from epipole.scale import MetricScale
from epipole.scene import Georeference, Reconstruction, ViewGraph

GPS_OUTLIER_SIGMAS = 5.0
UNKNOWN_ALTITUDE_SIGMA_M = 1e4
VAGUE_UP_RAD = np.deg2rad(8.0)
"""Standard deviation of the up direction above which a warning is given."""
FEW_FEATURES = 30
MOSTLY = 0.9
"""Fraction of a grown model's images that the earlier one had, from which it is adjusted in fewer rounds."""


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """What was detected in each image."""

    keypoints: Sequence[np.ndarray]
    """(k, 2) pixels"""
    colors: Sequence[np.ndarray] | None
    """(k, 3) RGB of the keypoints, 8 bits"""
    features: Sequence[Features] | None
    """The same keypoints with SIFT descriptors; None if there are none, and tracks are not completed."""


@dataclass(frozen=True, slots=True, eq=False)
class Mapped:
    """The models, and why the other images are not registered."""

    models: tuple[Reconstruction, ...]
    """Largest first; each has all images."""
    rejections: dict[int, Rejection]
    gps: tuple[GpsAlignment | None, ...]
    """Alignment of each model with the GPS positions of its images; None if it is not aligned."""
    agreements: tuple[float, ...]
    """Fraction of each model's matches that are points of the model (`MatchConsistency.overall`)."""
    methods: tuple[Method, ...]
    """Mapper that each model comes from."""
    pose_fits: tuple[PoseFit | None, ...] = ()
    """How the known poses fit each model; None if there are none, or if they do not."""
    notes: tuple[str, ...] = ()
    """What was remarkable about parts that were mapped separately."""
    scale: MetricScale | None = None
    """Scale of the largest model if it is metric; None if it is up to scale."""

    def num_registered(self) -> int:
        """Number of images that are registered in any model."""
        return sum(int(model.is_registered().sum()) for model in self.models)


def map_images(
    images: ImageSet,
    view_graph: ViewGraph,
    detections: Detections,
    config: MapperConfig,
    progress: ProgressCallback,
    earlier: Sequence[Reconstruction] = (),
    map_parts: MapParts | None = None,
) -> Mapped:
    """Map each connected component of the images to a model; the first grows from the earlier ones, if there are any and they fit.

    More than `divide_above` images are mapped in parts, by `map_parts`.
    """
    keypoints, features = detections.keypoints, detections.features
    starts = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])]).astype(np.int64)
    components = connect_matches(view_graph, starts)
    remaining = np.ones(len(images), bool)
    found: list[tuple[Reconstruction, _Located, float, Method]] = []
    rejections, notes = dict[int, Rejection](), list[str]()
    while remaining.sum() >= 2 and len(found) < config.max_models:
        builder = ModelBuilder(images.cameras, images.camera_of_image, keypoints, components)
        mapper = IncrementalMapper(builder, view_graph, config, is_last=features is None)
        counting = _counting(progress, remaining)
        is_grown = not found and grow_from(mapper, earlier, images.names, remaining, counting)
        method: Method | None = "grown" if is_grown else None
        if method is None and remaining.sum() > config.divide_above:
            method = "divided" if map_divided(mapper, remaining, map_parts, counting) else None
        if method is None:
            method = map_with(mapper, remaining, counting, _in_stage("adjust", progress))
        if method is None or builder.registered.sum() < 2:  # adjustment may leave nothing of a weak start
            break
        if features is not None:
            rounds = GROWN_ROUNDS if method == "grown" else ROUNDS
            is_adjusted = method == "grown" and _is_mostly(earlier, builder)
            final_rounds = GROWN_ROUNDS if is_adjusted else FINAL_ROUNDS
            complete_model(mapper, features, starts, rounds, final_rounds, _in_stage("complete", progress))
        before = earlier[0] if method == "grown" else None
        located = _locate_by_poses(mapper, images, config, _in_stage("adjust", progress)) or _locate(
            mapper, images, config, before, _in_stage("adjust", progress)
        )
        notes += mapper.notes
        rejections.update({i: r for i, r in mapper.rejections.items() if not found})
        if builder.registered.sum() < 2 or len(np.unique(builder.row_point[builder.row_point >= 0])) < 3:
            break
        agreement = mapper.consistency.overall(builder)
        model = builder.freeze(images.names, detections.colors, images.timestamps_s)
        found.append((replace(model, georeference=located.georeference), located, agreement, method))
        remaining &= ~builder.registered
    progress(Progress("map", int((~remaining).sum()), len(images)))
    found.sort(key=lambda m: (-int(m[0].is_registered().sum()), -len(m[0].points)))
    models, locations, agreements, methods = zip(*found) if found else ((), (), (), ())
    gps, poses = tuple(one.gps for one in locations), tuple(one.fit for one in locations)
    return Mapped(tuple(models), rejections, gps, tuple(agreements), tuple(methods), poses, tuple(notes))


def _is_mostly(earlier: Sequence[Reconstruction], builder: ModelBuilder) -> bool:
    """Whether nearly all registered images come from one earlier model, which was adjusted as a whole."""
    return len(earlier) == 1 and bool(earlier[0].is_registered().sum() >= MOSTLY * builder.registered.sum())


@dataclass(frozen=True, slots=True, eq=False)
class _Located:
    """What determines the coordinates of a model, if anything does."""

    gps: GpsAlignment | None = None
    georeference: Georeference | None = None
    fit: PoseFit | None = None


def _locate_by_poses(
    mapper: IncrementalMapper, images: ImageSet, config: MapperConfig, adjusting: Callable[[int, int], None]
) -> _Located | None:
    """Move the model to the coordinates of the known poses, and adjust it with them; None if they do not fit."""
    if images.known_poses is None:
        return None
    fit = fit_known_poses(_poses_of(mapper.model), images.known_poses, config.seed)
    if fit is None:
        return None
    mapper.model.move(fit.known_from_model)
    mapper.priors = fit.priors(images.known_poses)
    _adjust_again(mapper, adjusting)
    return _Located(fit=fit.after(_poses_of(mapper.model), images.known_poses))


def _poses_of(model: ModelBuilder) -> Rigid3:
    """cam_from_world of all images; NaN for those that are not registered."""
    motion = np.where(model.registered[:, None], model.motion, np.nan)
    return Rigid3(motion[:, :9].reshape(-1, 3, 3), motion[:, 9:])


def _locate(
    mapper: IncrementalMapper,
    images: ImageSet,
    config: MapperConfig,
    before: Reconstruction | None,
    adjusting: Callable[[int, int], None],
) -> _Located:
    """Coordinates by GPS, by the model that this one grew from, or upright ones."""
    model = mapper.model
    origin = _origin_of(images, model.registered, config, before)
    positions = np.full((len(images), 3), np.nan) if origin is None else origin.enu_of(images.lat_lon_alt)
    gps = _publish(mapper, positions, images.up_in_cams, config, adjusting)
    if before is None or (gps is not None and before.georeference is None):
        return _Located(gps, origin if gps is not None else None)
    keep_coordinates(model, before, images.names)
    if gps is not None:
        gps = replace(gps, residuals_m=gps_distances(model.center, positions))
    return _Located(gps, before.georeference)


def _origin_of(
    images: ImageSet, registered: np.ndarray, config: MapperConfig, before: Reconstruction | None
) -> Georeference | None:
    """Origin of a model's coordinates if GPS is used: that of the model that it grew from, or the middle of its images."""
    if not config.use_gps:
        return None
    known = None if before is None else before.georeference
    return known or Georeference.about(np.where(registered[:, None], images.lat_lon_alt, np.nan))


def _counting(progress: ProgressCallback, remaining: np.ndarray) -> Callable[[int, int], None]:
    """Progress over all images: those of earlier models, and those of the current attempt."""
    earlier, best, num_attempts = int((~remaining).sum()), 0, 0

    def report(done: int, _: int) -> None:
        nonlocal best, num_attempts
        note = ""
        if done == 0:
            note = "starts again in another way" if num_attempts else ""
            best, num_attempts = 0, num_attempts + 1
        best = max(best, done)
        progress(Progress("map", earlier + best, len(remaining), note))

    return report


def _in_stage(stage: str, progress: ProgressCallback) -> Callable[[int, int], None]:
    return lambda done, total: progress(Progress(stage, done, total))


def _publish(
    mapper: IncrementalMapper,
    positions_enu: np.ndarray,
    up_in_cams: np.ndarray,
    config: MapperConfig,
    adjusting: Callable[[int, int], None],
) -> GpsAlignment | None:
    """Rotate the model upright; if GPS agrees, transform it to meters east-north-up, and adjust it with GPS."""
    model = mapper.model
    ups = up_directions(model.registered_poses(), up_in_cams[model.registered])
    reach_m = GPS_OUTLIER_SIGMAS * config.gps_sigma_m
    aligned = align_to_gps(model.center, ups, positions_enu, config.gps_sigma_m, reach_m, config.seed)
    if aligned is None:
        model.move(upright_from_world(model.registered_poses(), model.living_points(), ups[0]))
        return None
    model.move(aligned.enu_from_world)
    expected = np.where(model.registered[:, None], positions_enu, np.nan)
    sigma = np.full(expected.shape, config.gps_sigma_m)
    has_no_altitude = np.isfinite(expected[:, 0]) & ~np.isfinite(expected[:, 2])
    expected[has_no_altitude, 2] = model.center[has_no_altitude, 2]
    sigma[has_no_altitude, 2] = UNKNOWN_ALTITUDE_SIGMA_M
    mapper.priors = PositionPriors(expected, sigma, _down_in_one(model), float(LEVEL_SIGMA_RAD))
    _adjust_again(mapper, adjusting)
    return replace(aligned, residuals_m=gps_distances(model.center, positions_enu))


def _down_in_one(model: ModelBuilder) -> np.ndarray:
    """Directions (n, 3) that point down in camera coordinates, NaN but for the middle one of the registered images."""
    registered, out = np.flatnonzero(model.registered), np.full((len(model.registered), 3), np.nan)
    middle = int(registered[len(registered) // 2])
    out[middle] = model.motion[middle, :9].reshape(3, 3) @ (0.0, 0.0, -1.0)
    return out


def _adjust_again(mapper: IncrementalMapper, adjusting: Callable[[int, int], None]) -> None:
    """Adjust the model with its priors."""
    adjusting(0, 3)
    mapper.adjust_globally(2, lambda done: adjusting(done, 3))
    adjusting(2, 3)
    mapper.finish()
    adjusting(3, 3)


def images_left(num_images: int, mapped: Mapped, view_graph: ViewGraph, config: MapperConfig) -> np.ndarray:
    """(n,) mask of images that match each other and are in no model, because there were as many models as the options allow."""
    out = np.zeros(num_images, bool)
    if mapped.models and len(mapped.models) >= config.max_models:
        registered = np.any([model.is_registered() for model in mapped.models], axis=0)
        matches = ~registered[view_graph.image1] & ~registered[view_graph.image2]
        out[view_graph.image1[matches]] = out[view_graph.image2[matches]] = True
    return out


def reasons_in_words(
    images: ImageSet,
    mapped: Mapped,
    view_graph: ViewGraph,
    unused: ViewGraph,
    keypoints: Sequence[np.ndarray],
    config: MapperConfig,
) -> dict[str, str]:
    """Reasons why images are not registered; `unused` are the verified pairs that contradict others."""
    min_inliers, is_left = config.resection_min_inliers, images_left(len(images), mapped, view_graph, config)
    registered = np.zeros(len(images), bool)
    for model in mapped.models:
        registered |= model.is_registered()
    out = dict(images.left_out)
    for image in np.flatnonzero(~registered):
        words = _reason(int(image), mapped, view_graph, unused, len(keypoints[int(image)]), min_inliers)
        if is_left[image]:
            words = f"mapping ended after {config.max_models} models (--mapper.max-models)"
        is_masked = images.mask_fingerprints[image] and len(keypoints[int(image)]) < 2 * min_inliers
        out[images.names[image]] = f"{words}, or its mask covers it" if is_masked else words
    return out


def _reason(
    image: int, mapped: Mapped, view_graph: ViewGraph, unused: ViewGraph, num_features: int, min_inliers: int
) -> str:
    if num_features == 0:
        return "no features: the image is blank, too dark or too blurred"
    if num_features < 2 * min_inliers:
        return f"only {num_features} features: too little texture"
    edges = np.flatnonzero((view_graph.image1 == image) | (view_graph.image2 == image))
    num_unused = int(((unused.image1 == image) | (unused.image2 == image)).sum())
    if len(edges) == 0 and num_unused:
        plural = "s" if num_unused > 1 else ""
        return (
            f"its {num_unused} pair{plural} with other images contradict{'' if plural else 's'} others: different things look alike"
            " (report, table of pairs)"
        )
    if len(edges) == 0:
        return f"{num_features} features, but no other image shares enough of them: no overlap"
    kinds = view_graph.kind[edges]
    if (kinds == PairKind.NO_MOTION).all():
        return "identical to another image: without a translation of the camera there is no depth"
    if np.isin(kinds, (PairKind.ROTATION, PairKind.NO_MOTION)).all():
        return "the camera only rotated relative to its neighbors: without a translation there is no depth"
    rejection = mapped.rejections.get(image)
    if not mapped.models:
        return "no pair of images could start a model: too few matches, or too small a triangulation angle"
    if rejection is None or rejection.num_points_in_sight == 0:
        return "its matches belong to no point of the model"
    if rejection.num_inliers == 0:
        return f"sees only {rejection.num_points_in_sight} points of the model; at least {min_inliers} are needed"
    return f"of {rejection.num_points_in_sight} visible points of the model, only {rejection.num_inliers} agree on a pose"


def no_model_reason(images: ImageSet, keypoints: Sequence[np.ndarray], view_graph: ViewGraph) -> str:
    """Reason why there is no model at all, with advice."""
    if len(images) < 2:
        return "one image cannot give depth; take at least two from different positions"
    covered = [bool(mask) and len(k) < FEW_FEATURES for mask, k in zip(images.mask_fingerprints, keypoints)]
    if sum(covered) > len(images) / 2:
        return (
            f"the masks leave {sum(covered)} of {len(images)} images fewer than {FEW_FEATURES} features: black areas of a mask"
            " are not used (are the masks inverted?)"
        )
    if len(view_graph) == 0:
        return (
            "no two images share enough features; take sharp images of textured surfaces "
            "that overlap by half or more"
        )
    kinds = view_graph.kind
    if (kinds == PairKind.NO_MOTION).all():
        return "the images are the same; take them from different positions"
    if np.isin(kinds, (PairKind.ROTATION, PairKind.NO_MOTION)).all():
        return (
            "the camera only rotated: pure rotation has no parallax, so depth cannot be measured; "
            "move sideways between images"
        )
    return "no pair of images has enough matches at a large enough triangulation angle to start a model"
