"""Completion of a model: longer tracks first, then an adjustment of the points that three images confirm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from epipole.config import MatchConfig
from epipole.features import Features
from epipole.mapping import connect_matches, find_further_matches, median_error_px
from epipole.pipelines.sfm.mappers.incremental import IncrementalMapper, Progress, ignore_progress

ROUNDS, FINAL_ROUNDS = 3, 2
"""Most rounds of adjustment of a completed model, and rounds with the final loss."""
GROWN_ROUNDS = 1
"""Most rounds of adjustment of a model that grew from earlier ones, which are adjusted already. It is also the number of
rounds with the final loss if nearly all images come from one earlier model."""
RADIUS_FACTOR = 4.0
"""Multiple of the median reprojection error within which features are looked for: 99.9 % of the right ones, if both errors
are normal. A larger radius adds other features nearby, which double the error of a rendered scene."""
MIN_RADIUS_PX = 1.0
"""Smallest radius: the localization error of large features."""


def complete_model(
    mapper: IncrementalMapper,
    features: Sequence[Features],
    keypoint_offsets: np.ndarray,
    rounds: int = ROUNDS,
    final_rounds: int = FINAL_ROUNDS,
    progress: Progress = ignore_progress,
) -> None:
    """Complete the tracks of a finished model, triangulate them again with its poses, and adjust it.

    A wrong match along the epipolar line makes a point in two images that no residual reveals, and a third image does.
    Therefore points in two images take no part in this adjustment, unless an image has few others.

    Args:
        mapper: a mapper that has finished a model; unchanged if that has no points.
        features: SIFT features of each image, in the order of its keypoints.
        keypoint_offsets: first keypoint of each image, and the number of all.
        rounds: most rounds of adjustment.
        final_rounds: rounds with the loss that suppresses wrong matches.
        progress: called with the number of steps that are done, and of all: matches, points, and each round.
    """
    model, config = mapper.model, mapper.config
    error_px = median_error_px(model)
    if not np.isfinite(error_px):  # a model without points
        return
    # No ratio test: a repeated structure has no second instance within a few pixels.
    similar = MatchConfig(max_ratio=1.0)
    num_steps = 2 + rounds + final_rounds
    progress(0, num_steps)
    radius_px = min(max(RADIUS_FACTOR * error_px, MIN_RADIUS_PX), config.completion_px)
    further = find_further_matches(model, features, radius_px, similar)
    progress(1, num_steps)
    components = connect_matches(mapper.view_graph, keypoint_offsets, further)
    mapper.replace_components(components)
    model.triangulate(np.arange(len(components)), config.max_error_px, np.deg2rad(config.min_angle_deg))
    progress(2, num_steps)
    mapper.min_track_length, mapper.is_last = config.min_track_length, True
    mapper.adjust_globally(rounds, lambda done: progress(2 + done, num_steps))
    mapper.finish(final_rounds, lambda done: progress(2 + rounds + done, num_steps))
