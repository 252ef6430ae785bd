"""Clusters of images from evidence for and against pairs: the number of clusters follows from the evidence (correlation clustering)."""

from __future__ import annotations

import heapq

import numpy as np
from jaxtyping import Float64, Int32

from epipole._checks import checked
from epipole.errors import ConfigError


@checked
def cluster_images(
    num_images: int,
    image1: Int32[np.ndarray, " n"],
    image2: Int32[np.ndarray, " n"],
    weight: Float64[np.ndarray, " n"],
) -> Int32[np.ndarray, " i"]:
    """Join the two clusters with the largest sum of weights between them, until no sum is positive.

    Greedy additive edge contraction (Keuper, Levinkov, Bonneel, Lavoue, Brox, Andres, ICCV 2015).

    Args:
        num_images: number of images.
        image1: one image of each pair.
        image2: the other image.
        weight: positive if the pair belongs to one cluster, negative if it does not; finite.

    Returns:
        Cluster of each image, numbered by first image.

    Raises:
        ConfigError: an image or a weight is invalid.
    """
    rows = np.concatenate([image1, image2])
    if num_images < 0 or ((rows < 0) | (rows >= num_images)).any() or not np.isfinite(weight).all():
        raise ConfigError("a pair has an image that does not exist, or a weight that is not finite")
    between: list[dict[int, float]] = [{} for _ in range(num_images)]
    for i, j, w in zip(image1.tolist(), image2.tolist(), weight.tolist()):
        if i != j:
            between[i][j] = between[j][i] = between[i].get(j, 0.0) + w
    joined = np.arange(num_images)
    best = [(-w, i, j) for i in range(num_images) for j, w in between[i].items() if i < j and w > 0.0]
    heapq.heapify(best)
    while best:
        w, i, j = heapq.heappop(best)
        if between[i].get(j) != -w:  # one of them was joined to another cluster
            continue
        joined[joined == j] = i
        del between[i][j]
        for k, added in between[j].items():
            if k != i:
                del between[k][j]
                between[i][k] = between[k][i] = total = between[i].get(k, 0.0) + added
                if total > 0.0:
                    heapq.heappush(best, (-total, min(i, k), max(i, k)))
        between[j] = {}
    return np.unique(joined, return_inverse=True)[1].astype(np.int32)
