"""Completion of a model: longer tracks first, then an adjustment of the points that three images confirm."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from epipole.config import MatchConfig
from epipole.features import Features
from epipole.mapping import FurtherMatches, connect_matches, find_further_matches, median_error_px
from epipole.pipelines.sfm.mappers.incremental import IncrementalMapper, Progress, ignore_progress

ROUNDS, FINAL_ROUNDS = 3, 2
"""Most rounds of adjustment of a completed model, and rounds with the final loss."""
GROWN_ROUNDS = 1
"""Most rounds of adjustment of a model that grew from earlier ones, which are adjusted already. It is also the number of
rounds with the final loss if nearly all images come from one earlier model."""
SEARCHES = 2
"""Searches for further matches, with an adjustment after each. Where few pairs connect distant images, the first model is bent, and
predicts many of their points too far from the right features; after the first search and an adjustment, it bends less."""
RADIUS_FACTOR = 4.0
"""Multiple of the median reprojection error within which features are looked for: 99.9 % of the right ones, if both errors
are normal. A larger radius adds other features nearby, which double the error of a rendered scene."""
MIN_RADIUS_PX = 1.0
"""Smallest radius: the localization error of large features."""
SIMILAR = MatchConfig(max_ratio=1.0)
"""No ratio test: a repeated structure has no second instance within a few pixels."""


def complete_model(
    mapper: IncrementalMapper,
    features: Sequence[Features],
    keypoint_offsets: np.ndarray,
    rounds: int = ROUNDS,
    final_rounds: int = FINAL_ROUNDS,
    progress: Progress = ignore_progress,
) -> None:
    """Complete the tracks of a finished model, triangulate them again with its poses, and adjust it; twice if `rounds` allow it.

    A wrong match along the epipolar line makes a point in two images that no residual reveals, and a third image does.
    Therefore points in two images take no part in this adjustment, unless an image has few others.

    Args:
        mapper: a mapper that has finished a model; unchanged if that has no points.
        features: SIFT features of each image, in the order of its keypoints.
        keypoint_offsets: first keypoint of each image, and the number of all.
        rounds: most rounds of adjustment.
        final_rounds: rounds with the loss that suppresses wrong matches.
        progress: called with the number of steps that are done, and of all: the matches and points of each search, and each round.
    """
    model, config = mapper.model, mapper.config
    num_searches = max(1, min(SEARCHES, rounds))
    num_steps, step = 2 * num_searches + rounds + final_rounds, 0
    further: FurtherMatches | None = None

    def after(before: int) -> Callable[[int], None]:
        return lambda done: progress(before + done, num_steps)

    for search in range(num_searches):
        error_px = median_error_px(model)
        if not np.isfinite(error_px):  # a model without points
            return
        radius_px = min(max(RADIUS_FACTOR * error_px, MIN_RADIUS_PX), config.completion_px)
        progress(step, num_steps)
        found = find_further_matches(model, features, radius_px, SIMILAR)
        progress(step + 1, num_steps)
        further = found if further is None else further.joined(found)
        components = connect_matches(mapper.view_graph, keypoint_offsets, further)
        mapper.replace_components(components)
        model.triangulate(np.arange(len(components)), config.max_error_px, np.deg2rad(config.min_angle_deg))
        step += 2
        progress(step, num_steps)
        mapper.min_track_length, mapper.is_last = config.min_track_length, True
        own_rounds = 1 if search + 1 < num_searches else rounds - search
        mapper.adjust_globally(own_rounds, after(step))
        step += own_rounds
    mapper.finish(final_rounds, after(step))
