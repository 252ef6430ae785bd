"""Pairs and models of rendered scenes against exact depth and poses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from benchmarks.score import cams_in_order
from benchmarks.tasks.look_alike import RenderedTask, common_fraction, project_into
from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rotation3
from epipole.io.colmap.database import DatabaseContents, read_database
from epipole.metrics import camera_errors
from epipole.scene import Reconstruction

MIN_OVERLAP = 0.05
"""Two images see different things if a smaller fraction of the pixels of both shows a common surface."""
WRONG_ROTATION_DEG = 10.0
WRONG_MATCH_PX = 4.0
"""A match is wrong if it is farther from the projection of its surface point."""
WRONG_FRACTION = 0.5
RIGHT_PERCENT, WRONG_PERCENT = 1.0, 5.0
"""Largest position error of a right model, and that beyond which an image is wrong, in percent of the scene's size."""


@dataclass(frozen=True, slots=True)
class PairScore:
    """One verified pair."""

    MIN_MATCHES: ClassVar[int] = 15
    """Pairs with fewer verified matches do not count; COLMAP's limit."""

    images: tuple[str, str]
    num_matches: int
    is_kept: bool
    """Used for mapping."""
    overlap: float
    """Fraction of the pixels of one image whose surface the other image shows; the larger of both directions."""
    rotation_error_deg: float
    """NaN if the pair has no motion, or is not kept."""
    wrong_fraction: float
    """Fraction of wrong matches."""
    has_no_overlap: bool
    has_wrong_rotation: bool
    has_wrong_matches: bool

    @property
    def is_false(self) -> bool:
        """Whether the pair would mislead a mapper."""
        return self.has_no_overlap or self.has_wrong_rotation or self.has_wrong_matches


@dataclass(frozen=True, slots=True)
class ModelScore:
    """One model, after the similarity that fits its camera centers best; percentages are of the scene's size."""

    num_registered: int
    position_median_m: float
    position_max_m: float
    position_median_percent: float
    position_max_percent: float
    rotation_median_deg: float
    num_wrong: int
    """Images with an error of more than 5 percent."""


def score_pairs(scene: RenderedTask, out: Path) -> list[PairScore]:
    """Score the pairs that a run kept and those that it dropped as contradicting.

    The database has the matches of kept pairs only. For a dropped pair, all right matches before verification count as verified, so its
    fraction of wrong matches is a lower bound, and its rotation is not scored.
    """
    contents, row = read_database(out / "database.db"), {n: k for k, n in enumerate(scene.task.image_names)}
    graph, names = contents.view_graph, contents.images.name
    assert graph is not None
    scores = []
    for n, (i, j) in enumerate(zip(graph.image1, graph.image2)):
        at = slice(graph.match_offsets[n], graph.match_offsets[n + 1])
        matches = np.stack([graph.keypoint1[at], graph.keypoint2[at]], axis=1)
        is_right = _right_matches(scene, contents, (int(i), int(j)), matches)
        true = scene.cams_from_world[row[names[j]]] @ scene.cams_from_world[row[names[i]]].inverse()
        difference = Rotation3(graph.cam2_from_cam1.rotation[n]) @ Rotation3(true.rotation).inverse()
        off_deg = float(np.degrees(difference.angle_rad()))
        scores.append(_pair(scene, (names[i], names[j]), len(matches), int(is_right.sum()), off_deg))
    index = {name: k for k, name in enumerate(names)}
    for pair in _dropped(out):
        first, second = sorted(pair["images"], key=index.__getitem__)
        putative = contents.matches[index[first], index[second]]
        is_right = _right_matches(scene, contents, (index[first], index[second]), putative)
        scores.append(_pair(scene, (first, second), pair["num_matches"], int(is_right.sum()), None))
    return [score for score in scores if score.num_matches >= PairScore.MIN_MATCHES]


def _dropped(out: Path) -> list[dict]:
    """The pairs that a run verified but did not use, from its summary."""
    summary = out / "summary.json"
    return json.loads(summary.read_text()).get("contradicting_pairs", []) if summary.is_file() else []


def _right_matches(
    scene: RenderedTask, contents: DatabaseContents, images: tuple[int, int], matches: np.ndarray
) -> np.ndarray:
    """Mask of matches (m, 2) between two images of the database: whether the surface point projects onto the match."""
    i, j = images
    row1, row2 = (scene.task.image_names.index(contents.images.name[image]) for image in images)
    pixels1 = contents.images.keypoints_of(i)[matches[:, 0]].astype(np.float64)
    pixels2 = contents.images.keypoints_of(j)[matches[:, 1]].astype(np.float64)
    at, _ = project_into(scene, row1, row2, pixels1)
    return np.asarray(np.linalg.norm(at - pixels2, axis=1) <= WRONG_MATCH_PX)


def _pair(
    scene: RenderedTask, images: tuple[str, str], num_matches: int, num_right: int, off_deg: float | None
) -> PairScore:
    """The score of one pair; `off_deg` is None if the pair is not kept."""
    i, j = (scene.task.image_names.index(name) for name in images)
    overlap = max(common_fraction(scene, i, j), common_fraction(scene, j, i))
    wrong_fraction = max(0.0, 1.0 - num_right / max(num_matches, 1))
    return PairScore(
        images,
        num_matches,
        off_deg is not None,
        overlap,
        np.nan if off_deg is None else off_deg,
        wrong_fraction,
        has_no_overlap=overlap < MIN_OVERLAP,
        has_wrong_rotation=off_deg is not None and off_deg > WRONG_ROTATION_DEG,
        has_wrong_matches=wrong_fraction > WRONG_FRACTION,
    )


def score_model(scene: RenderedTask, model: Reconstruction) -> ModelScore:
    """Errors of the registered images; NaN if there are too few images to align."""
    num_registered = int(model.is_registered().sum())
    try:
        errors = camera_errors(cams_in_order(model, scene.task.image_names), scene.cams_from_world)
    except DegenerateGeometryError:
        return ModelScore(num_registered, *([float("nan")] * 5), num_wrong=0)
    percent = 100.0 / scene.size_m
    return ModelScore(
        num_registered,
        errors.median_position,
        errors.max_position,
        errors.median_position * percent,
        errors.max_position * percent,
        errors.median_rotation_deg,
        int((errors.position * percent > WRONG_PERCENT).sum()),
    )


def shared_points(model: Reconstruction, pair: PairScore) -> int:
    """Number of points of a model that both images of a pair observe."""
    row = {name: k for k, name in enumerate(model.images.name)}
    if not all(name in row for name in pair.images):
        return 0
    point, image = model.tracks.point_of_observation(), model.tracks.image
    seen = (point[image == row[name]] for name in pair.images)
    return len(np.intersect1d(*seen))


def verdict(models: Sequence[ModelScore]) -> str:
    """right, wrong model, split, inaccurate (errors of 1 to 5 percent) or no model."""
    if not models:
        return "no model"
    if any(model.num_wrong for model in models):
        return "wrong model"
    if not all(model.position_max_percent <= RIGHT_PERCENT for model in models):
        return "inaccurate"
    return "right" if len(models) == 1 else "split"
