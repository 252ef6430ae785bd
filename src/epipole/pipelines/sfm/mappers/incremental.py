"""Incremental structure-from-motion, without file access."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from epipole.config import RansacConfig
from epipole.geometry import Rigid3
from epipole.mapping import (
    Freedom,
    MatchComponents,
    MatchConsistency,
    ModelBuilder,
    PosePriors,
    PositionPriors,
    Snapshot,
    adjust_all,
    adjust_around,
    adjust_sample,
    drop_short_tracks,
    largest_rigid_part,
    median_error_px,
    refine_resection,
    resect_image,
)
from epipole.optim import BundleConfig, Loss
from epipole.pipelines.sfm.config import MapperConfig
from epipole.pipelines.sfm.mappers.visible_points import VisiblePoints
from epipole.robust import PairKind
from epipole.scene import ViewGraph

LEAST_START_INLIERS = 30
"""Matches of an initial pair if no pair has half of `start_min_inliers`; COLMAP's limit for registering an image."""
LEAST_FINAL_SCALE_PX = 0.1
"""Smallest scale of the last loss: better features do not exist."""
MAX_PROBES = 8
"""Maximum number of initial pairs whose models are grown."""

Progress = Callable[[int, int], None]
"""Called with the work done and the total work."""


def ignore_progress(done: int, total: int) -> None:
    """Do nothing."""


@dataclass(frozen=True, slots=True)
class Rejection:
    """Reason why an image could not be registered."""

    image: int
    num_points_in_sight: int
    num_inliers: int


class IncrementalMapper:
    """Grows one model from a pair of images until no further image fits (Snavely et al. 2006; Schoenberger 2016).

    Attributes (besides the arguments):
        rejections: why images are not registered.
        num_apart: for each model that it started from, its images that could not be joined to the first one.
        notes: what was remarkable about parts that were mapped separately, in words.
    """

    def __init__(
        self,
        model: ModelBuilder,
        view_graph: ViewGraph,
        config: MapperConfig,
        *,
        min_track_length: int = 2,
        is_last: bool = True,
    ) -> None:
        self.model, self.view_graph, self.config = model, view_graph, config
        self.min_track_length = min_track_length
        self.is_last = is_last
        """Whether the last round of `finish` adjusts all points; False if the model will be completed and adjusted again."""
        self.consistency = MatchConsistency(model, view_graph)
        self.rejections: dict[int, Rejection] = {}
        self.notes: list[str] = []
        self.num_apart: list[int] = []
        self._started: set[int] = set()
        self._visible = VisiblePoints(model)
        self.priors: PositionPriors | PosePriors | None = None
        self._ransac = RansacConfig(
            max_error_px=config.resection_max_error_px,
            min_inliers=config.resection_min_inliers,
            min_inlier_ratio=config.resection_min_ratio,
            min_iterations=30,
            max_iterations=5000,
            seed=config.seed,
        )
        self._angle = np.deg2rad(config.min_angle_deg)

    def replace_components(self, components: MatchComponents) -> None:
        """Replace the connected keypoints; poses stay, points are removed."""
        del self.consistency  # memory of all matches
        self.model.replace_components(components)
        self.consistency = MatchConsistency(self.model, self.view_graph)

    def run(
        self, usable: np.ndarray, progress: Progress = ignore_progress, adjusting: Progress = ignore_progress
    ) -> bool:
        """Map the usable images (mask); False if no pair of them can start a model.

        A finished model that disagrees with its own matches grew from a poor start (unknown focal lengths, nearly
        parallel views). Then other starts are tried, and the model that explains the most matches is kept.

        Args:
            usable: mask of images.
            progress: called with the number of registered and of usable images; 0 at each new start.
            adjusting: called with the rounds of the final adjustment.
        """
        best: tuple[int, Snapshot] | None = None
        num_rounds = self.config.final_rounds + 1
        for _ in range(1 + self.config.restarts):
            progress(0, int(usable.sum()))
            if not self.start(usable):
                break
            self.grow(usable, int(usable.sum()), progress)
            adjusting(0, num_rounds)
            self.adjust_globally(self.config.final_rounds, lambda done: adjusting(done, num_rounds))
            adjusting(num_rounds - 1, num_rounds)
            self.finish()
            adjusting(num_rounds, num_rounds)
            explained = self.consistency.num_explained(self.model)
            if best is None or explained > best[0]:
                best = (explained, self.model.snapshot())
            if self.consistency.overall(self.model) >= self.config.min_final_agreement:
                break
        if best is None:
            return False
        self.model.restore(best[1])
        return True

    def finish(self, rounds: int = 2, done: Callable[[int], None] = lambda _: None) -> None:
        """Adjust with a loss that suppresses wrong matches, and again without the observations that it rejects.

        Only at the end, because a redescending loss cannot close the gap of a drifted loop.

        Args:
            rounds: number of rounds.
            done: called after each round with the number of rounds so far.
        """
        for round_ in range(rounds):
            self._drop_short_tracks()
            bundle = final_bundle(self.config, median_error_px(self.model))
            is_thorough = self.is_last and round_ == rounds - 1  # before it, a sample takes most of the steps
            (adjust_all if is_thorough else adjust_sample)(self.model, bundle, self.freedom(), self.priors)
            self.model.filter(self.config.max_error_px, self._angle)
            done(round_ + 1)
        self._drop_short_tracks()
        self.keep_rigid_part()

    def grow(self, usable: np.ndarray, limit: int, progress: Progress = ignore_progress) -> None:
        """Register images one by one until `limit` are registered or none fits."""
        size_at_global = int(self.model.registered.sum())
        while self.model.registered.sum() < limit and (image := self.register_next(usable)) is not None:
            self.triangulate_around(image)
            count = int(self.model.registered.sum())
            if count >= self.config.global_growth * size_at_global:
                self.adjust_globally(rounds=1)
                size_at_global = count
            else:
                adjust_around(
                    self.model, image, self.config.local_images, self._local_bundle(), self.freedom()
                )
                self.model.filter(self.config.max_error_px, self._angle)
            self.take_out_if_wrong(image)
            progress(int(self.model.registered.sum()), int(usable.sum()))

    def start(self, usable: np.ndarray) -> bool:
        """Start from the pair whose model, grown to a few images, agrees with the matches.

        Pairs are tried in descending order of inliers and angle. The first model that agrees is kept or, if there is
        none, the one that agrees best (two nearly parallel views may start a mirrored model that fits both).
        """
        best_fraction, best_edge, probes = 0.0, -1, 0
        for edge in self._ranked_starts(usable)[: self.config.start_trials]:
            if probes == MAX_PROBES or not self._probe(int(edge), usable):
                if probes == MAX_PROBES:
                    break
                continue
            probes += 1
            self._started |= {int(self.view_graph.image1[edge]), int(self.view_graph.image2[edge])}
            fraction = self.consistency.overall(self.model)
            if fraction >= self.config.min_match_agreement:
                return True
            if fraction > best_fraction:
                best_fraction, best_edge = fraction, int(edge)
        if best_edge >= 0 and self._probe(best_edge, usable):
            return True
        self.model.clear()
        return False

    def _probe(self, edge: int, usable: np.ndarray) -> bool:
        self.rejections.clear()
        if not self._start_from(edge):
            return False
        self.grow(usable, min(self.config.probe_images, int(usable.sum())))
        return True

    def _ranked_starts(self, usable: np.ndarray) -> np.ndarray:
        g = self.view_graph
        measures_depth = np.isin(g.kind, (PairKind.GENERAL, PairKind.UNCALIBRATED, PairKind.PLANAR))
        fits = measures_depth & usable[g.image1] & usable[g.image2] & np.isfinite(g.median_angle_rad)
        wanted = np.deg2rad(self.config.start_angle_deg)
        preference = np.where(g.kind == PairKind.PLANAR, 0.5, 1.0) * np.minimum(
            g.median_angle_rad / wanted, 1.0
        )
        for least in (
            self.config.start_min_inliers,
            self.config.start_min_inliers // 2,
            LEAST_START_INLIERS,
        ):
            candidates = np.flatnonzero(fits & (g.num_inliers() >= least))
            if len(candidates):
                break
        # A restart must use another pair.
        known = np.isin(g.image1, list(self._started)) & np.isin(g.image2, list(self._started))
        candidates = candidates[~known[candidates]]
        return candidates[np.argsort(-(preference * g.num_inliers())[candidates], kind="stable")]

    def take_out_if_wrong(self, image: int) -> None:
        """Remove an image whose matches are different points of the model, which means that its pose is wrong."""
        if not self.model.registered[image] or self.model.registered.sum() <= 3:
            return
        if self.consistency.of_image(self.model, image) < self.config.image_fraction:
            in_sight = self._num_rows_in_sight(image)
            self.model.deregister(image)
            self.rejections[image] = Rejection(image, in_sight, 0)

    def _num_rows_in_sight(self, image: int) -> int:
        components, of_row = np.unique(
            self.model.row_component[self.model.rows_of_image[image]], return_inverse=True
        )
        return int(self.model.has_point(components)[of_row].sum())

    def _start_from(self, edge: int) -> bool:
        g, model = self.view_graph, self.model
        model.clear()
        first, second = int(g.image1[edge]), int(g.image2[edge])
        model.register(first, Rigid3.identity())
        model.register(second, g.cam2_from_cam1[edge])
        components = self._components_of(np.array([first, second]))
        model.triangulate(components, self.config.max_error_px, self._angle)
        if len(np.unique(model.row_point[model.row_point >= 0])) < 20:
            return False
        adjust_all(model, self._global_bundle(), Freedom(focal=False, distortion=False))
        model.filter(self.config.max_error_px, self._angle)
        model.triangulate(components, self.config.max_error_px, self._angle)
        adjust_all(model, self._global_bundle(), Freedom(focal=False, distortion=False))
        model.filter(self.config.max_error_px, self._angle)
        num_points = len(np.unique(model.row_point[model.row_point >= 0]))
        return num_points >= max(20, min(self.config.start_min_inliers, int(0.3 * g.num_inliers()[edge])))

    def register_next(self, usable: np.ndarray) -> int | None:
        """Register the image with the most and best distributed visible points; None if none fits."""
        for image in self._ranked_candidates(usable):
            if self._register(int(image)):
                self.rejections.pop(int(image), None)
                return int(image)
        return None

    def _ranked_candidates(self, usable: np.ndarray) -> np.ndarray:
        visible, least = self._visible, self.config.resection_min_inliers
        visible.update()
        waiting = np.flatnonzero(usable & ~self.model.registered)
        scores = np.zeros(len(waiting))
        for n, image in enumerate(waiting.tolist()):
            count, before = visible.count(image), self.rejections.get(image)
            was_tried = before is not None and before.num_points_in_sight >= least
            # An image is tried again only if more of the model is visible than at its last failure.
            is_pointless = before is not None and was_tried and count <= 1.1 * before.num_points_in_sight
            if count >= least and not is_pointless:
                scores[n] = visible.score(image)
            elif not was_tried:  # the number of visible points grows with the model
                self.rejections[image] = Rejection(image, count, 0)
        order = np.argsort(-scores, kind="stable")
        return waiting[order[scores[order] > 0]]

    def _register(self, image: int) -> bool:
        model, camera_index = self.model, int(self.model.camera_of_image[image])
        guessed = not (
            model.cameras.is_focal_trusted[camera_index] or model.cameras.is_constant[camera_index]
        )
        used = model.camera_of_image[model.registered]
        search_focal = guessed and camera_index not in used
        estimate, camera, rows = resect_image(
            model, image, replace(self._ransac, seed=self._ransac.seed + image), search_focal=search_focal
        )
        if not estimate.success or estimate.num_inliers < self.config.resection_min_ratio * len(
            np.unique(rows)
        ):
            self.rejections[image] = Rejection(image, self._num_rows_in_sight(image), estimate.num_inliers)
            return False
        if search_focal:
            params = model.params.copy()
            params[camera_index] = camera.padded_params()
            model.set_params(params)
        rows, points = model.points_in_sight(image)
        refined = refine_resection(model.points[points], model.row_pixel[rows], estimate, camera, focal=False)
        model.register(image, estimate.model if refined is None else refined[0])
        return True

    def triangulate_around(self, image: int) -> None:
        """Extend points that are visible in an image, and triangulate new ones from its unused matches."""
        components = self._components_of(np.array([image]))
        self.model.extend(components, self.config.max_error_px)
        self.model.triangulate(components, self.config.max_error_px, self._angle)

    def adjust_globally(self, rounds: int, done: Callable[[int], None] = lambda _: None) -> None:
        """Adjust everything, filter and re-triangulate, until little changes, but at most `rounds` times.

        Args:
            rounds: maximum number of rounds.
            done: called after each round with the number of rounds so far.
        """
        model, config = self.model, self.config
        everything = np.arange(len(model.components))
        for round_ in range(max(rounds, 1)):
            self._drop_short_tracks()
            adjust_sample(model, self._global_bundle(), self.freedom(), self.priors)
            dropped = model.filter(config.max_error_px, self._angle)
            self.drop_lost_images()
            done(min(round_ + 1, rounds))
            if round_ == rounds - 1 or rounds == 0:
                break
            added = model.extend(everything, config.max_error_px)
            added += model.triangulate(everything, config.max_error_px, self._angle)
            if dropped + added < config.converged_fraction * (model.row_point >= 0).sum():
                break

    def _drop_short_tracks(self) -> None:
        if self.min_track_length > 2:
            drop_short_tracks(self.model, self.min_track_length, self.config.min_long_tracks)

    def keep_rigid_part(self) -> None:
        """Remove images whose distances have a scale of their own."""
        model = self.model
        rows = np.flatnonzero(model.row_point >= 0)
        image, point = model.row_image[rows].astype(np.int64), model.row_point[rows].astype(np.int64)
        part = largest_rigid_part(len(model.registered), image, point)
        if part.sum() < 2:  # a model of two images with few points
            return
        others = np.flatnonzero(model.registered & ~part)
        for lost in others:
            model.deregister(int(lost))
        for lost in others:
            self.rejections[int(lost)] = Rejection(int(lost), self._num_rows_in_sight(int(lost)), 0)

    def drop_lost_images(self) -> None:
        """Remove images with too few observations."""
        counts = np.bincount(
            self.model.row_image[self.model.row_point >= 0], minlength=len(self.model.registered)
        )
        for image in np.flatnonzero(self.model.registered & (counts < self.config.min_observations)):
            self.rejections[int(image)] = Rejection(int(image), int(counts[image]), int(counts[image]))
            self.model.deregister(int(image))

    def _components_of(self, images: np.ndarray) -> np.ndarray:
        rows = np.concatenate([self.model.rows_of_image[i] for i in images])
        return np.unique(self.model.row_component[rows])

    def freedom(self) -> Freedom:
        """Which intrinsics are refined."""
        return Freedom(focal=self.config.refine_focal, distortion=self.config.refine_distortion)

    def _local_bundle(self) -> BundleConfig:
        return BundleConfig(loss=Loss.SOFT_L1, max_iterations=10, function_tolerance=1e-4)

    def _global_bundle(self) -> BundleConfig:
        return BundleConfig(
            loss=Loss.SOFT_L1,
            loss_scale_px=self.config.loss_scale_px,
            max_iterations=30,
            function_tolerance=1e-5,
        )


def final_bundle(config: MapperConfig, median_error_px: float) -> BundleConfig:
    """Options of the last adjustment, whose loss is scaled to the noise of the model's observations."""
    scale_px = max(config.final_scale * median_error_px, LEAST_FINAL_SCALE_PX) if median_error_px > 0 else 1.0
    return BundleConfig(
        loss=Loss[config.final_loss.upper()],
        loss_scale_px=scale_px,
        max_iterations=50,
        function_tolerance=1e-5,
    )
