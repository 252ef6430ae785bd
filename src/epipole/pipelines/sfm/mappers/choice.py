"""The choice between the global and the incremental mapper, by what their models explain."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Bool

from epipole.pipelines.sfm.mappers.global_mapper import map_globally
from epipole.pipelines.sfm.mappers.incremental import IncrementalMapper, Progress, ignore_progress

LEAST_COVERAGE = 0.8
"""Fraction of the images connected to a global model that it must have; below it, the incremental mapper tries too."""

Method = Literal["global", "incremental", "divided", "grown"]
"""How a model was made; divided: from models of its parts; grown: from the poses of an earlier one."""


def map_with(
    mapper: IncrementalMapper,
    usable: Bool[np.ndarray, " n"],
    progress: Progress = ignore_progress,
    adjusting: Progress = ignore_progress,
) -> Method | None:
    """Map the usable images with the method of the options; returns the method of the model, None if there is none.

    By default the global mapper, which is faster and spreads errors evenly. Its model is kept if it agrees with its own
    matches and has most of the images; otherwise the model that explains more matches.

    Args:
        mapper: has the model, the pairs and the options.
        usable: mask of images.
        progress: called with the number of registered and of usable images.
        adjusting: called with the rounds of adjustment.
    """
    method, model = mapper.config.method, mapper.model
    if method == "incremental":
        return "incremental" if mapper.run(usable, progress, adjusting) else None
    is_mapped = map_globally(mapper, usable, progress, adjusting)
    if method == "global" or (is_mapped and _is_sound(mapper, usable)):
        return "global" if is_mapped else None
    explained = mapper.consistency.num_explained(model) if is_mapped else -1
    first, rejections = model.snapshot(), dict(mapper.rejections)
    if mapper.run(usable, progress, adjusting) and mapper.consistency.num_explained(model) > explained:
        return "incremental"
    model.restore(first)
    mapper.rejections = rejections
    return "global" if is_mapped else None


def _is_sound(mapper: IncrementalMapper, usable: np.ndarray) -> bool:
    """Whether a model agrees with its matches, and has most of the usable images that pairs connect to it."""
    registered, graph = mapper.model.registered, mapper.view_graph
    is_connected = registered.copy()
    is_connected[graph.image2[registered[graph.image1]]] = True
    is_connected[graph.image1[registered[graph.image2]]] = True
    covers = registered.sum() >= LEAST_COVERAGE * (is_connected & usable).sum()
    return bool(covers) and mapper.consistency.overall(mapper.model) >= mapper.config.min_match_agreement
