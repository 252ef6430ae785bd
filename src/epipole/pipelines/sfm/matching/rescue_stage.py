"""Learned features for images that SIFT connects to few others: beside SIFT's, in these images and in those that may show the same.

The keypoints of a network follow those of SIFT in each image, so that earlier matches keep their numbers. Its matches join those of
SIFT before the pair is verified. A network finds matches between images that only resemble each other, so a pair that it helps
needs more of them that agree.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Int32
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from epipole._checks.tables import Arrays, Expected, Table
from epipole.config import FeatureConfig
from epipole.features.learned import CHECKSUMS, LearnedFeatures, ScoredFeatures
from epipole.geometry import Rotation3
from epipole.pipelines.sfm.matching.feature_stage import (
    FeaturePayload,
    as_unit_arrays,
    in_mask,
    load_features,
    payload_of,
    read_image,
)
from epipole.pipelines.sfm.matching.pair_blocks import PairBlock, PairResult, block_units, filled
from epipole.pipelines.sfm.matching.unit_tables import FEATURES, MATCHES
from epipole.pipelines.sfm.photographs import ImageSet
from epipole.runs import Unit, digest, load
from epipole.scene import ViewGraph

FORMAT = 1
MIN_PAIRS, MIN_MATCHES = 2, 50
"""An image with fewer pairs that have this number of verified matches is connected weakly."""
MAX_PARTNERS = 20
"""Images that a weakly connected image is matched with again: those with the most matches, then those next to it by name."""
MAX_FEATURES = 2048
MIN_INLIERS, MIN_INLIER_RATIO = 30, 0.3
"""Matches of a pair that must agree. False pairs of a temple's images had up to 117, and up to 0.8 of all; their rotations show them."""
MAX_ANGLE_RAD = np.deg2rad(5.0)
"""Largest angle between rotations that confirm each other."""
SCALE_PX = 4.0
"""Size of a learned feature, which has none; that of SIFT's smaller features."""

LEARNED: Table = {
    "pixels": Expected("float32", "n 2"),
    "scores": Expected("float32", "n"),
    "descriptors": Expected("float32", "n d"),
}

NetworkName = Literal["xfeat", "aliked"]


@dataclass(frozen=True, slots=True)
class Choice:
    """A network, and the folder of its weights."""

    folder: Path
    network: NetworkName

    def load(self) -> LearnedFeatures:
        """The network; the last one stays in memory.

        Raises:
            FileFormatError: a file is missing, damaged, or was made by another program.
            MissingDependencyError: onnxruntime is not installed.
        """
        return _loaded(self.folder, self.network, self.checksums())

    def checksums(self) -> str:
        """Of the weights; empty if the folder has none."""
        file = self.folder / CHECKSUMS
        return file.read_text(errors="replace") if file.is_file() else ""


@lru_cache(maxsize=1)
def _loaded(folder: Path, network: NetworkName, _checksums: str) -> LearnedFeatures:
    """The network; loaded again if the weights were replaced."""
    return LearnedFeatures(folder, network)


def weak_images(view_graph: ViewGraph, num_images: int) -> Bool[np.ndarray, " n"]:
    """Images that few pairs connect to others, or not to most others."""
    strong = view_graph.num_inliers() >= MIN_MATCHES
    first, second = view_graph.image1[strong], view_graph.image2[strong]
    counts = np.bincount(np.concatenate([first, second]), minlength=num_images)
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(num_images, num_images))
    _, part = connected_components(graph, directed=False)
    return (counts < MIN_PAIRS) | (part != np.argmax(np.bincount(part)))


def rescue_pairs(
    weak: Bool[np.ndarray, " n"],
    pairs: Int32[np.ndarray, "p 2"],
    putative: Mapping[tuple[int, int], np.ndarray],
) -> list[tuple[int, int]]:
    """Of the pairs that were matched, those of weak images that are most likely to overlap, sorted."""
    chosen: set[tuple[int, int]] = set()
    for image in np.flatnonzero(weak):
        own = [(int(i), int(j)) for i, j in pairs[(pairs == image).any(axis=1)]]
        own.sort(key=lambda pair: (-len(putative.get(pair, ())), abs(pair[0] - pair[1])))
        near = sorted(own, key=lambda pair: abs(pair[0] - pair[1]))
        chosen.update([*own[: MAX_PARTNERS // 2], *near[: MAX_PARTNERS // 2]])
    return sorted(chosen)


@dataclass(frozen=True, slots=True)
class _Detection:
    """Input of the unit of one image."""

    image: FeaturePayload
    choice: Choice


def learned_units(
    images: ImageSet,
    members: Sequence[int],
    folder: Path,
    choice: Choice,
    config: FeatureConfig,
    masks: Path | None,
) -> dict[int, Unit]:
    """One unit for each of these images."""
    weights = digest(choice.network, choice.checksums())
    units = {}
    for i in members:
        key = digest(
            "learned",
            FORMAT,
            weights,
            images.fingerprints[i],
            images.mask_fingerprints[i],
            config.max_size_px,
        )
        payload = _Detection(payload_of(images, i, masks, config), choice)
        units[i] = Unit(folder / f"{key}.npz", key, detect_learned, payload)
    return units


def detect_learned(payload: _Detection) -> Arrays:
    """Learned features of an image that SIFT has read."""
    image = read_image(payload.image.path, payload.image.config.max_size_px)
    assert not isinstance(image, str), image
    found = payload.choice.load().detect(image.rgb, MAX_FEATURES)
    stretch = np.array([image.width / image.rgb.shape[1], image.height / image.rgb.shape[0]])
    pixels = ((found.pixels + 0.5) * stretch - 0.5).astype(np.float32)
    keep = in_mask(payload.image, image, pixels)
    return {"pixels": pixels[keep], "scores": found.scores[keep], "descriptors": found.descriptors[keep]}


def combined_units(sift: Sequence[Unit], learned: Mapping[int, Unit], folder: Path) -> tuple[Unit, ...]:
    """Units of all images, with the features of both kinds where there are learned ones."""
    units = list(sift)
    for i, unit in learned.items():
        key = digest("combined", FORMAT, sift[i].key, unit.key)
        units[i] = Unit(folder / f"{key}.npz", key, combine_features, (sift[i].path, unit))
    return tuple(units)


def combine_features(payload: tuple[Path, Unit]) -> Arrays:
    """SIFT's features, then the learned ones; these have no SIFT descriptor, which zeros express."""
    path, unit = payload
    stored, learned = load(path, FEATURES), load(unit.path, LEARNED)
    detection: _Detection = unit.payload
    image = read_image(detection.image.path, detection.image.config.max_size_px)
    assert not isinstance(image, str), image
    count, width = len(learned["pixels"]), stored["descriptors"].shape[1]
    return as_unit_arrays(
        image,
        np.concatenate([stored["pixels"], learned["pixels"]]),
        np.concatenate([stored["scale_px"], np.full(count, SCALE_PX, np.float32)]),
        np.concatenate([stored["angle_rad"], np.zeros(count, np.float32)]),
        np.concatenate([stored["descriptors"], np.zeros((count, width), np.uint8)]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Matching:
    """Input for matching a block."""

    learned: Mapping[int, Path]
    sift: Mapping[int, Path]
    sizes: Mapping[int, tuple[int, int]]
    putative: Mapping[tuple[int, int], np.ndarray]
    choice: Choice


def learned_match_units(
    pairs: Sequence[tuple[int, int]],
    learned: Mapping[int, Unit],
    sift: Sequence[Unit],
    sizes: Mapping[int, tuple[int, int]],
    putative: Mapping[tuple[int, int], np.ndarray],
    folder: Path,
) -> list[Unit]:
    """Units that match blocks of pairs with the network, and add SIFT's matches."""
    none = np.zeros((0, 2), np.int32)
    matches = {pair: putative.get(pair, none) for pair in pairs}
    keys = [
        digest("rescue", FORMAT, learned[i].key, learned[j].key, sift[i].key, sift[j].key, matches[i, j])
        for i, j in pairs
    ]

    def task_of(block: Sequence[int]) -> _Matching:
        in_block = [pairs[n] for n in block]
        members = sorted({i for pair in in_block for i in pair})
        return _Matching(
            {i: learned[i].path for i in members},
            {i: sift[i].path for i in members},
            {i: sizes[i] for i in members},
            {pair: matches[pair] for pair in in_block},
            learned[members[0]].payload.choice,
        )

    return block_units(pairs, keys, folder, match_learned_block, MATCHES, task_of)


def match_learned_block(block: PairBlock) -> Arrays:
    """Match a block of pairs."""
    return filled(block, lambda positions: [_matched(block.task, *block.pairs[n]) for n in positions])


def _matched(task: _Matching, i: int, j: int) -> PairResult:
    features = [
        ScoredFeatures(**load(task.learned[k], LEARNED, "pixels", "scores", "descriptors")) for k in (i, j)
    ]
    found, _ = task.choice.load().match(features[0], task.sizes[i], features[1], task.sizes[j])
    starts = np.array([len(load_features(task.sift[k])) for k in (i, j)], np.int32)
    return {"matches": np.concatenate([task.putative[i, j], found + starts]).astype(np.int32)}


def merged(before: ViewGraph, after: ViewGraph) -> tuple[ViewGraph, int]:
    """The pairs of a view graph, with those of another one that are better; and the number of these.

    A pair must have enough matches that agree, and more than before. Its rotation must agree with the one before, if there was one,
    and otherwise with a triangle of pairs: the false pairs of a network have any rotation.
    """
    enough = after.num_inliers() >= np.maximum(MIN_INLIERS, MIN_INLIER_RATIO * after.num_putative)
    after = after.select(enough)
    rotations = _rotations_from((after, before))
    known = {pair: n for n, pair in enumerate(zip(before.image1.tolist(), before.image2.tolist()))}
    better = np.zeros(len(after), bool)
    for n, pair in enumerate(zip(after.image1.tolist(), after.image2.tolist())):
        own = after.cam2_from_cam1.rotation[n]
        if (row := known.get(pair)) is None:
            better[n] = _is_confirmed(*pair, own, rotations)
        elif after.num_inliers()[n] > before.num_inliers()[row]:
            better[n] = _agree(own, before.cam2_from_cam1.rotation[row])
    after = after.select(better)
    replaced = [known[p] for p in zip(after.image1.tolist(), after.image2.tolist()) if p in known]
    kept = np.ones(len(before), bool)
    kept[replaced] = False
    return before.select(kept).joined(after), len(after)


def _rotations_from(graphs: Sequence[ViewGraph]) -> dict[int, dict[int, np.ndarray]]:
    """For each image, other_from_image of the images that it has a pair of known rotation with; the last graph counts."""
    found: dict[int, dict[int, np.ndarray]] = defaultdict(dict)
    for graph in graphs:
        for i, j, rotation in zip(
            graph.image1.tolist(), graph.image2.tolist(), graph.cam2_from_cam1.rotation
        ):
            if np.isfinite(rotation).all():
                found[i][j], found[j][i] = rotation, rotation.T
    return found


def _agree(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two rotations are similar; one that is unknown agrees with any."""
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        return True
    return float(Rotation3(first @ second.T).angle_rad()) <= MAX_ANGLE_RAD


def _is_confirmed(
    i: int, j: int, rotation: np.ndarray, rotations: Mapping[int, Mapping[int, np.ndarray]]
) -> bool:
    """Whether the way over a third image leads to the same rotation."""
    if not np.isfinite(rotation).all():
        return False
    thirds = sorted(rotations[i].keys() & rotations[j].keys())
    return any(_agree(rotations[k][j] @ rotations[i][k], rotation) for k in thirds)
