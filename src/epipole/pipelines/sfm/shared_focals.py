"""Check whether images grouped into one camera for lack of EXIF fit one focal length; if not, split the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int32

from epipole.pipelines.sfm.focal import FACTORS, Ballot, ballots_of, climbed
from epipole.pipelines.sfm.photographs import ImageSet
from epipole.robust import PairKind
from epipole.scene import Cameras, Reconstruction, ViewGraph

WIDTH = 0.05
"""Disagreement at which a pair's vote for a focal length has half its weight."""
MAX_RATIO = 0.75
"""Images contradict a shared focal length if its votes, divided by those for separate ones, are below this ratio. It
was 0.91 or more with one camera (photographs, video frames, noise of 1 px), and 0.7 or less with focal lengths that
differ by 10 %."""
LEAST_PAIRS, LEAST_IMAGES, MAX_IMAGES = 3, 3, 20
"""Minimum pairs and images of a camera for the check; of more images, those with the most matches are used."""
OTHER_FOCAL = 0.03
"""Difference of the logarithms of focal lengths above which images of two models have different cameras."""
STARTS = (0.5, 0.7, 1.0, 1.4, 2.0)
"""Factors of the best shared focal length at which the search for separate ones starts."""


def contradicted_cameras(
    cameras: Cameras, camera_of_image: Int32[np.ndarray, " n"], view_graph: ViewGraph
) -> list[int]:
    """Cameras of unknown focal length whose images cannot share one.

    Every pair of images votes for the focal lengths that give its two cameras an essential matrix (see
    `estimate_focals`), once for a shared focal length and once for separate ones. Images of one camera lose almost
    nothing by sharing it.
    """
    unknown = np.flatnonzero(~cameras.is_focal_trusted & ~cameras.is_constant)
    return [int(c) for c in unknown if _is_contradicted(int(c), cameras, camera_of_image, view_graph)]


def _is_contradicted(c: int, cameras: Cameras, camera_of_image: np.ndarray, view_graph: ViewGraph) -> bool:
    rows = _most_matched(np.flatnonzero(camera_of_image == c), view_graph)
    if len(rows) < LEAST_IMAGES:
        return False
    inside = np.isin(view_graph.image1, rows) & np.isin(view_graph.image2, rows)
    own = replace(
        view_graph, kind=np.where(inside, view_graph.kind, int(PairKind.NO_MOTION)).astype(np.int32)
    )
    alone, each = with_own_cameras(cameras, camera_of_image, [c])
    others = np.ones(len(alone), bool)
    ballots = ballots_of(alone, each, own, others)
    if len(ballots) < LEAST_PAIRS:
        return False
    shared = np.zeros(len(FACTORS))
    for ballot in ballots:
        shared += ballot.weight / (1.0 + (np.diagonal(ballot.disagreement) / WIDTH) ** 2)
    best = int(np.argmax(shared))
    apart = max(_votes(ballots, climbed(ballots, others, best, factor)) for factor in STARTS)
    return bool(shared[best] < MAX_RATIO * apart)


def _most_matched(rows: np.ndarray, view_graph: ViewGraph) -> np.ndarray:
    """The images with the most matches among each other."""
    inside = np.isin(view_graph.image1, rows) & np.isin(view_graph.image2, rows)
    inside &= view_graph.kind == PairKind.UNCALIBRATED
    matches = view_graph.num_inliers()[inside].astype(np.float64)
    ends = np.concatenate([view_graph.image1[inside], view_graph.image2[inside]])
    total = np.bincount(ends, np.tile(matches, 2), minlength=int(rows.max(initial=0)) + 1)[rows]
    return np.sort(rows[np.argsort(-total, kind="stable")[:MAX_IMAGES]])


def _votes(ballots: list[Ballot], chosen: dict[int, int]) -> float:
    total = 0.0
    for ballot in ballots:
        disagreement = ballot.disagreement[chosen[ballot.first], chosen[ballot.second]]
        total += ballot.weight / (1.0 + (disagreement / WIDTH) ** 2)
    return float(total)


def with_own_cameras(
    cameras: Cameras, camera_of_image: Int32[np.ndarray, " n"], split: list[int]
) -> tuple[Cameras, Int32[np.ndarray, " n"]]:
    """Replace each camera in `split` by one per image; the first image keeps the row, the others get new ones."""
    source, out = list(range(len(cameras))), camera_of_image.copy()
    for c in split:
        for image in np.flatnonzero(camera_of_image == c)[1:]:
            out[image] = len(source)
            source.append(c)
    rows = np.array(source)
    columns = {name: getattr(cameras, name)[rows] for name in cameras.__slots__}
    return Cameras(**columns), out


def with_cameras_of(images: ImageSet, models: Sequence[Reconstruction]) -> ImageSet:
    """Give the images of a further model their own camera if its focal length contradicts that of an earlier one.

    Without EXIF, images of one size count as those of one camera; models know better.
    """
    focal: dict[int, float] = {}
    out, source = images.camera_of_image.copy(), list(range(len(images.cameras)))
    taken = np.zeros(len(images), bool)
    for model in models:
        rows, focals = _focals_in(model, images, taken)
        taken[rows] = True
        for camera in np.unique(images.camera_of_image[rows]).tolist():
            own = rows[images.camera_of_image[rows] == camera]
            here = float(np.median(focals[images.camera_of_image[rows] == camera]))
            before = focal.setdefault(camera, here)
            if not images.cameras.is_constant[camera] and abs(np.log(here / before)) > OTHER_FOCAL:
                out[own] = len(source)
                source.append(camera)
    columns = {name: getattr(images.cameras, name)[np.array(source)] for name in images.cameras.__slots__}
    sources = tuple(images.focal_sources[c] for c in source)
    return replace(images, cameras=Cameras(**columns), camera_of_image=out, focal_sources=sources)


def _focals_in(model: Reconstruction, images: ImageSet, taken: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the images that a model has and that are not taken yet, and their focal lengths in it."""
    row = {name: k for k, name in enumerate(images.names)}
    registered = np.flatnonzero(model.is_registered()).tolist()
    found = [(row[n], k) for k in registered if (n := model.images.name[k]) in row and not taken[row[n]]]
    focals = [model.cameras[int(model.camera_of_image[k])].focal_px for _, k in found]
    return np.array([at for at, _ in found], np.int64), np.array(focals, np.float64)
