"""Localization of an image in a fixed model: retrieval, matching, PnP, a search for further points, and refinement.

The steps are those of hierarchical localization (Sarlin et al., CVPR 2019) with classical features: VLAD instead of NetVLAD, SIFT instead
of SuperPoint. The pose that they give predicts where further points of the model are; the fraction of these that is found
confirms it, since the prediction does not depend on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from epipole import _parallel
from epipole._checks import checked
from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.errors import ConfigError
from epipole.features import Features, detect_features, match_descriptors, match_near_pixels
from epipole.geometry import Rigid3
from epipole.image.gray import gray_image
from epipole.io.images.photographs import read_rgb
from epipole.mapping import camera_with_focal, refine_pose, resect_with_focal
from epipole.pipelines.localization.config import LocalizerConfig
from epipole.pipelines.localization.focal_step import focal_step
from epipole.pipelines.localization.localized_image import LocalizationReason, LocalizedImage
from epipole.pipelines.localization.reference import ReferenceModel
from epipole.robust import estimate_absolute_pose
from epipole.scene import unregistered

REFINEMENTS = 3
"""Rounds of refining the pose and choosing its inliers again."""
INLIER_SIGMAS = 4.0
"""Points with a larger error are outliers of the refined pose, in standard deviations."""
LEAST_SIGMA_PX = 0.3
"""Smaller standard deviations of a pixel are not believed: they come from few inliers."""
DISPLACEMENTS = 4.0
"""Displacement of the predictions with which chance is measured, in search radii."""
CHANCE_SIGMAS = 3.0
"""Standard deviations by which the number of found points must exceed chance."""
CLEAR_INLIERS = 40
"""Inliers of a first pose that needs no confirmation, as nothing may be left to find; images of other scenes gave at most 11."""
CLEAR_RATIO = 0.3
"""Fraction of the matches that these must be, too."""
FEW_NEIGHBORS, FEW_FEATURES = 4, 1500
"""Most similar images, and largest features, that are matched first; the others follow unless the pose is clear."""
MANY_INLIERS = 150
"""Inliers of a clear first pose."""
MOST_MATCHES = 0.5
"""Fraction of the matches that are inliers of a clear first pose."""
FOCAL_SIGMAS = 4.0
"""A focal length is contradicted if the points change it by more standard deviations, and by more than `FOCAL_CHANGE`."""
FOCAL_CHANGE = 0.015
"""Change of the logarithm of a focal length that is accepted: distortion and noise of the model shift it by up to 1.3 percent."""
MAX_FOCAL_STEP = 0.1
"""Largest step of the logarithm of a focal length: a linear step is not valid beyond it."""
MORE_INLIERS = 20
"""A focal length is contradicted, too, if a free one gives this number of inliers more: a linear step fails far from the solution."""
MORE_INLIERS_RATIO = 1.1
"""Smallest ratio of these numbers of inliers."""
FocalKnowledge = Literal["known", "approximate", "unknown"]


class Matches2D3D(NamedTuple):
    """Features of an image and points of the model."""

    feature: np.ndarray
    point: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class _FirstPose:
    """A pose from matches with some images of the model."""

    failure: LocalizedImage
    """The result so far, if the pose is not confirmed."""
    camera: Camera
    cam_from_world: Rigid3
    inliers: Matches2D3D | None
    """None if there is no pose."""

    @property
    def is_clear(self) -> bool:
        """Whether further matches would not change the pose: the search finds the other points."""
        count = self.failure.num_inliers
        return self.inliers is not None and count >= max(
            MANY_INLIERS, MOST_MATCHES * self.failure.num_matches
        )


class Localizer:
    """Localizes images in a fixed model, one at a time.

    Args:
        reference: the model with its descriptors.
        config: options; None for the defaults.
    """

    def __init__(self, reference: ReferenceModel, config: LocalizerConfig | None = None) -> None:
        self.reference = reference
        self.config = LocalizerConfig() if config is None else config
        self._ransac = RansacConfig(
            max_error_px=self.config.max_error_px,
            min_inliers=self.config.min_inliers,
            min_inlier_ratio=self.config.min_ratio,
            seed=self.config.seed,
        )

    @staticmethod
    def open(workspace: str | Path, config: LocalizerConfig | None = None) -> Localizer:
        """Localizer in the model of an output folder of `reconstruct`, or of a COLMAP model beside its database.db.

        Args:
            workspace: the folder.
            config: options; None for the defaults.

        Raises:
            FileFormatError: there is no model or no database, or they do not belong to each other.
        """
        return Localizer(ReferenceModel.open(workspace), config)

    @checked
    def localize(self, image: Any, camera: Camera | None = None) -> LocalizedImage:
        """Pose of an image.

        Args:
            image: file, or upright array: (h, w), RGB (h, w, 3) or RGBA (h, w, 4), 8 or 16 bits or floating point.
            camera: intrinsics; None: those of the model if its images of this size share one camera and the points agree with it,
                otherwise the focal length is estimated.

        Raises:
            ConfigError: the camera is for images of another size.
            ShapeError: the array is not an image.
            FileFormatError: the file is not an image, or is damaged.
        """
        gray = gray_image(read_rgb(image) if isinstance(image, str | Path) else image)
        height, width = gray.shape
        known = self.reference.camera_of_size(width, height) if camera is None else camera
        if known is not None and (known.width, known.height) != (width, height):
            raise ConfigError(
                f"the camera is for images of {known.width}x{known.height}, but the image is {width}x{height}"
            )
        guess = Camera(
            "SIMPLE_RADIAL", width, height, [1.2 * max(width, height), (width - 1) / 2, (height - 1) / 2, 0.0]
        )
        features = detect_features(gray, self.config.features)
        found = self.localize_features(features, known or guess, "unknown" if known is None else "known")
        if camera is None and known is not None and found.is_focal_contradicted:  # another camera or zoom
            again = self.localize_features(features, known, "unknown")
            return again if again.success or not found.success else found
        return found

    @checked
    def localize_features(
        self, features: Features, camera: Camera, focal: FocalKnowledge = "known"
    ) -> LocalizedImage:
        """Pose of an image from its SIFT features.

        Args:
            features: features of the upright image.
            camera: intrinsics.
            focal: known: exact; approximate: kept, but its error is part of the covariance; unknown: estimated, from that of
                `camera` as a guess.
        """
        if len(features) < self.config.min_inliers:
            return _failure(LocalizationReason.FEW_FEATURES, camera)
        neighbors = self.reference.most_similar(features, self.config.neighbors)
        found = self._first_pose(features.largest(FEW_FEATURES), camera, focal, neighbors[:FEW_NEIGHBORS])
        if not found.is_clear and (len(neighbors) > FEW_NEIGHBORS or len(features) > FEW_FEATURES):
            found = self._first_pose(features, camera, focal, neighbors)
        if found.inliers is None:
            return found.failure
        return self._refined(
            features, found.camera, found.cam_from_world, found.inliers, focal, found.failure
        )

    def _first_pose(
        self, features: Features, camera: Camera, focal: FocalKnowledge, neighbors: Int64[np.ndarray, " m"]
    ) -> _FirstPose:
        """Pose from the matches with some images of the model, and what is known if there is none."""
        matches = self.match(features, neighbors)
        failure = replace(
            _failure(LocalizationReason.FEW_MATCHES, camera),
            num_matches=len(matches.point),
            neighbors=tuple(neighbors.tolist()),
        )
        if len(matches.point) < self.config.min_inliers:
            return _FirstPose(failure, camera, failure.cam_from_world, None)
        points, pixels = self.reference.views.points_in_world[matches.point], _pixels(features, matches)
        other_focal_px = float("nan")
        if focal == "unknown":
            first, camera = resect_with_focal(points, pixels, camera, self._ransac)
        else:
            first = estimate_absolute_pose(points, pixels, camera, self._ransac)
            least = max(first.num_inliers + MORE_INLIERS, MORE_INLIERS_RATIO * first.num_inliers)
            if least < len(points):  # else a free focal length cannot have more inliers than that
                free, freed = resect_with_focal(points, pixels, camera, self._ransac)
                if free.success and free.num_inliers > least:
                    other_focal_px = freed.focal_px
        failure = replace(
            failure,
            num_inliers=first.num_inliers,
            is_focal_contradicted=bool(np.isfinite(other_focal_px)),
            focal_correction=other_focal_px / camera.focal_px - 1.0,
            reason=LocalizationReason.FEW_INLIERS,
        )
        if not first.success or first.num_inliers < self.config.min_ratio * len(matches.point):
            return _FirstPose(failure, camera, failure.cam_from_world, None)
        inliers = Matches2D3D(matches.feature[first.inlier_mask], matches.point[first.inlier_mask])
        return _FirstPose(failure, camera, first.model, inliers)

    def match(self, features: Features, neighbors: Int64[np.ndarray, " m"]) -> Matches2D3D:
        """For each feature the point that most neighbors match it with, and for each point one feature."""
        views = self.reference.views

        def match_with(n: int) -> np.ndarray:
            rows = views.rows_of(int(neighbors[n]))
            descriptors = self.reference.descriptors[rows]
            pairs = match_descriptors(features.descriptors, descriptors, self.config.matching)
            return np.stack([pairs[:, 0], views.point[rows[pairs[:, 1]]]], axis=1)

        votes = np.concatenate(_parallel.map_items(match_with, len(neighbors)))
        found, count = np.unique(votes, axis=0, return_counts=True)
        return _one_to_one(found[np.argsort(-count, kind="stable")])

    def _refined(
        self,
        features: Features,
        camera: Camera,
        start: Rigid3,
        inliers: Matches2D3D,
        focal: FocalKnowledge,
        failure: LocalizedImage,
    ) -> LocalizedImage:
        """Refine the pose with all points of the model that are found near their projections."""
        views = self.reference.views
        start = refine_pose(
            views.points_in_world[inliers.point], _pixels(features, inliers), camera, start, loss_scale=2.0
        ).cam_from_world
        found, is_new, by_chance = self._search(features, camera, start, inliers)
        num_new = int(is_new.sum())
        failure = replace(
            failure,
            num_confirmed=num_new,
            num_by_chance=by_chance,
            reason=LocalizationReason.NOT_CONFIRMED,
        )
        num_first = len(inliers.point)
        is_clear = num_first >= max(CLEAR_INLIERS, CLEAR_RATIO * failure.num_matches)
        is_above_chance = num_new > by_chance + CHANCE_SIGMAS * np.sqrt(num_new + by_chance)
        if not (is_clear or is_above_chance):
            return failure
        matches = _one_to_one(
            np.stack(
                [np.append(inliers.feature, found.feature), np.append(inliers.point, found.point)], axis=1
            )
        )
        points, pixels = views.points_in_world[matches.point], _pixels(features, matches)
        pose, sigma, kept = start, 1.0, np.ones(len(points), bool)
        for _ in range(REFINEMENTS):
            refined = refine_pose(
                points[kept], pixels[kept], camera, pose, np.full(int(kept.sum()), sigma), loss_scale=2.0
            )
            pose = refined.cam_from_world
            error_px = _errors_px(camera, pose, points, pixels)
            # The median of a Rayleigh distribution is 1.177 sigma.
            sigma = max(LEAST_SIGMA_PX, float(np.median(error_px[kept])) / 1.177)
            kept = error_px < INLIER_SIGMAS * sigma
            if kept.sum() < self.config.min_inliers:
                return replace(failure, reason=LocalizationReason.FEW_INLIERS)
        matches = Matches2D3D(matches.feature[kept], matches.point[kept])
        return self._result(features, camera, pose, matches, sigma, focal, failure)

    def _result(
        self,
        features: Features,
        camera: Camera,
        start: Rigid3,
        matches: Matches2D3D,
        sigma_px: float,
        focal: FocalKnowledge,
        failure: LocalizedImage,
    ) -> LocalizedImage:
        """The last refinement, its covariance, and a check of the focal length."""
        points, pixels = self.reference.views.points_in_world[matches.point], _pixels(features, matches)
        refined = refine_pose(points, pixels, camera, start, np.full(len(points), sigma_px), loss_scale=2.0)
        pose = refined.cam_from_world
        step = focal_step(points, pixels, camera, pose, sigma_px)
        if focal == "unknown" and abs(step.log_focal) < MAX_FOCAL_STEP:
            # The first pose had fewer points, and an error of its focal length.
            camera = camera_with_focal(camera, float(np.exp(step.log_focal)))
            refined = refine_pose(
                points, pixels, camera, pose, np.full(len(points), sigma_px), loss_scale=2.0
            )
            pose = refined.cam_from_world
            step = focal_step(points, pixels, camera, pose, sigma_px)
        covariance = refined.covariance_by_errors() if focal == "known" else step.covariance
        if not np.isfinite(covariance).all():
            return replace(failure, reason=LocalizationReason.UNDETERMINED)
        change = abs(step.log_focal)
        return replace(
            failure,
            reason=LocalizationReason.OK,
            cam_from_world=pose,
            covariance=covariance,
            camera=camera,
            pixels=pixels,
            point=matches.point,
            focal_correction=failure.focal_correction
            if failure.is_focal_contradicted
            else float(np.expm1(step.log_focal)),
            is_focal_contradicted=failure.is_focal_contradicted
            or change > max(FOCAL_CHANGE, FOCAL_SIGMAS * step.sigma),
            error_px=float(np.median(_errors_px(camera, pose, points, pixels))),
        )

    def _search(
        self, features: Features, camera: Camera, cam_from_world: Rigid3, inliers: Matches2D3D
    ) -> tuple[Matches2D3D, np.ndarray, int]:
        """Points found near their projections, which of them are not inliers, and the number of others found by chance."""
        views = self.reference.views
        is_inlier = np.zeros(len(views.points_in_world), bool)
        is_inlier[inliers.point] = True
        shared = np.bincount(views.image[is_inlier[views.point]], minlength=len(views.starts) - 1)
        count = min(self.config.further_neighbors, int((shared > 0).sum()))
        neighbors = np.sort(np.argsort(-shared, kind="stable")[:count])
        rows = views.seen_from(cam_from_world.centers(), neighbors)
        pixels = camera.project(cam_from_world.apply(views.points_in_world[views.point[rows]]))
        size = np.array([camera.width, camera.height])
        with np.errstate(invalid="ignore"):
            is_inside = ((pixels > -0.5) & (pixels < size - 0.5)).all(axis=1)
        rows, pixels = rows[is_inside], pixels[is_inside]
        descriptors, point = self.reference.descriptors[rows], views.point[rows].astype(np.int64)

        def found_near(predicted: np.ndarray) -> Matches2D3D:
            pairs, _ = match_near_pixels(
                predicted, descriptors, features, self.config.search_px, self.config.matching
            )
            return Matches2D3D(pairs[:, 1].astype(np.int64), point[pairs[:, 0]])

        found = found_near(pixels)
        displaced = found_near(pixels + np.array([DISPLACEMENTS * self.config.search_px, 0.0]))
        is_used = np.zeros(len(features), bool)
        is_used[inliers.feature] = True
        is_new, is_new_by_chance = (
            ~(is_inlier[pairs.point] | is_used[pairs.feature]) for pairs in (found, displaced)
        )
        return found, is_new, int(is_new_by_chance.sum())


def _one_to_one(pairs: np.ndarray) -> Matches2D3D:
    """(feature, point) rows without those whose feature or point is in an earlier one."""
    for column in (0, 1):
        _, first = np.unique(pairs[:, column], return_index=True)
        pairs = pairs[np.sort(first)]
    return Matches2D3D(pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64))


def _pixels(features: Features, matches: Matches2D3D) -> np.ndarray:
    return features.pixels[matches.feature].astype(np.float64)


def _errors_px(
    camera: Camera, cam_from_world: Rigid3, points: np.ndarray, pixels: np.ndarray
) -> Float64[np.ndarray, " n"]:
    """Reprojection errors; infinite for points that the camera cannot see."""
    error_px = np.linalg.norm(camera.project(cam_from_world.apply(points)) - pixels, axis=1)
    return np.where(np.isfinite(error_px), error_px, np.inf)


def _failure(reason: LocalizationReason, camera: Camera) -> LocalizedImage:
    return LocalizedImage(
        reason,
        unregistered(1)[0],
        np.full((6, 6), np.inf),
        camera,
        np.zeros((0, 2)),
        np.zeros(0, np.int64),
        num_matches=0,
        num_inliers=0,
        num_confirmed=0,
        num_by_chance=0,
        focal_correction=float("nan"),
        is_focal_contradicted=False,
        error_px=float("nan"),
        neighbors=(),
    )
