"""Match and verify pairs of images, block by block."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int32

from epipole._checks.tables import Arrays
from epipole.cameras import Camera
from epipole.config import MatchConfig, RansacConfig
from epipole.features import Features, match_descriptors
from epipole.features.kinds import SIFT, kind_of
from epipole.geometry import Rigid3
from epipole.pipelines.sfm.matching.feature_stage import load_features
from epipole.pipelines.sfm.matching.pair_blocks import PairBlock, PairResult, block_units, filled, result_of
from epipole.pipelines.sfm.matching.unit_tables import GEOMETRIES, MATCHES, check_matches
from epipole.robust import PairGeometry, PairKind, PairMatches, verify_pairs
from epipole.runs import Unit, digest, load
from epipole.scene import Cameras, ViewGraph

FORMAT = 4
MIN_PREEMPTIVE = 768
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute values."""
NOISE_FACTOR = 5.0
"""Multiple of the standard deviation within which 97 to 99 % of the right matches lie, as SIFT's noise grows with the
size of a feature; measured on fountain-P11, Herz-Jesus-P8, castle-P19 and 7-Scenes."""
MIN_LIMIT_PX = 1.5
"""Smallest limit: the localization error of SIFT's largest features."""


@dataclass(frozen=True, slots=True, eq=False)
class MatchTask:
    """Input for matching and verifying a block."""

    feature_files: dict[int, Path]
    cameras: dict[int, Camera]
    """Camera of each image in the block."""
    is_trusted: dict[int, bool]
    """Whether the focal length of each image is known."""
    seeds: tuple[int, ...]
    """Random seed of each pair, derived from its images only, so that the order of work does not matter."""
    matching: MatchConfig
    verification: RansacConfig
    match_file: Path | None = None
    """File with the matches, for verification."""


@dataclass(frozen=True, slots=True, eq=False)
class PairWork:
    """Input for matching and verification."""

    pairs: Int32[np.ndarray, "p 2"]
    features: Sequence[Unit]
    cameras: Cameras
    camera_of_image: Int32[np.ndarray, " n"]
    matching: MatchConfig
    verification: RansacConfig


def match_units(todo: PairWork, folder: Path) -> list[Unit]:
    """Units that match blocks of pairs."""
    return _units(todo, folder, match_block, None)


def verification_units(todo: PairWork, folder: Path, matches: Sequence[Unit]) -> list[Unit]:
    """Units that verify blocks of matched pairs."""
    return _units(todo, folder, verify_block, matches)


def _units(
    todo: PairWork,
    folder: Path,
    work: Callable[[PairBlock], Arrays],
    matches: Sequence[Unit] | None,
) -> list[Unit]:
    pairs = [(int(i), int(j)) for i, j in todo.pairs]
    camera_of_image, trusted = todo.camera_of_image, todo.cameras.is_focal_trusted | todo.cameras.is_constant
    cameras = [todo.cameras[c] for c in range(len(todo.cameras))]
    key_of = {pair: key for unit in matches or () for pair, key in zip(unit.payload.pairs, unit.payload.keys)}
    matched = [key_of[pair] for pair in pairs] if matches is not None else [""] * len(pairs)
    seeds = [_seed(todo.features[i].key, todo.features[j].key) for i, j in pairs]

    def task_of(block: Sequence[int]) -> MatchTask:
        members = sorted({i for n in block for i in pairs[n]})
        return MatchTask(
            {i: todo.features[i].path for i in members},
            {i: cameras[camera_of_image[i]] for i in members},
            {i: bool(trusted[camera_of_image[i]]) for i in members},
            tuple(seeds[n] for n in block),
            todo.matching,
            todo.verification,
            file_of[pairs[block[0]]] if matches is not None else None,
        )

    file_of = {pair: unit.path for unit in matches or () for pair in unit.payload.pairs}
    keys = [digest(*key) for key in zip(_pair_keys(todo, pairs, work.__name__), matched)]
    if matches is None:
        return block_units(pairs, keys, folder, work, MATCHES, task_of)
    row = {pair: n for n, pair in enumerate(pairs)}
    # A block needs one file of matches.
    blocks = [[row[pair] for pair in unit.payload.pairs] for unit in matches]
    return block_units(pairs, keys, folder, work, GEOMETRIES, task_of, blocks)


def _pair_keys(todo: PairWork, pairs: Sequence[tuple[int, int]], what: str) -> Iterator[str]:
    """Digest of what the result of each pair depends on: images, cameras and options."""
    common = digest(what, FORMAT, asdict(todo.matching), asdict(todo.verification))
    trusted = todo.cameras.is_focal_trusted | todo.cameras.is_constant
    of_camera = [
        digest(todo.cameras.model[c], todo.cameras.params[c], trusted[c]) for c in range(len(todo.cameras))
    ]
    of_image = [unit.key + of_camera[c] for unit, c in zip(todo.features, todo.camera_of_image)]
    return (f"{common}{of_image[i]}{of_image[j]}" for i, j in pairs)


def _seed(first: str, second: str) -> int:
    """31-bit seed from the keys of two images' features."""
    return int(digest(first, second)[:8], 16) >> 1


def match_block(block: PairBlock) -> Arrays:
    """Match a block of pairs."""
    return filled(block, lambda positions: _matched(block, positions))


def _matched(block: PairBlock, positions: Sequence[int]) -> list[PairResult]:
    task: MatchTask = block.task
    pairs = [block.pairs[n] for n in positions]
    features = {i: load_features(task.feature_files[i]) for i in sorted({i for pair in pairs for i in pair})}
    return [{"matches": match_pair(features[i], features[j], task.matching)} for i, j in pairs]


def match_pair(first: Features, second: Features, config: MatchConfig) -> np.ndarray:
    """Match the largest features of a pair and, if enough of them match, all features.

    Most pairs of a large set do not overlap. Matching a third of the features of such a pair costs a ninth (preemptive
    matching: Wu, 3DV 2013).
    """
    preemptive = min(config.preemptive_features, max(MIN_PREEMPTIVE, max(len(first), len(second)) // 3))
    if (
        kind_of(first.descriptors) is not SIFT
        or preemptive == 0
        or max(len(first), len(second)) <= preemptive
    ):
        return match_descriptors(first.descriptors, second.descriptors, config)
    largest = match_descriptors(first.descriptors[:preemptive], second.descriptors[:preemptive], config)
    if len(largest) < config.preemptive_min_matches:
        return largest
    return match_descriptors(first.descriptors, second.descriptors, config)


def verify_block(block: PairBlock) -> Arrays:
    """Verify a block of matched pairs."""
    return filled(block, lambda positions: _verified(block, positions))


def _verified(block: PairBlock, positions: Sequence[int]) -> list[PairResult]:
    task: MatchTask = block.task
    assert task.match_file is not None
    stored = load(task.match_file, MATCHES, p=len(block.pairs))
    putative = [result_of(stored, n)["matches"] for n in positions]
    in_use = sorted({i for n in positions for i in block.pairs[n]})
    pixels = {i: load_features(task.feature_files[i]).pixels for i in in_use}
    for n, matches in zip(positions, putative):
        check_matches(task.match_file, matches, [len(pixels[i]) for i in block.pairs[n]])
    pairs = [
        PairMatches(
            pixels[i][matches[:, 0]].astype(np.float64),
            pixels[j][matches[:, 1]].astype(np.float64),
            task.cameras[i],
            task.cameras[j],
            task.is_trusted[i] and task.is_trusted[j],
            task.seeds[n],
        )
        for n, (i, j), matches in zip(positions, [block.pairs[n] for n in positions], putative)
    ]
    geometries = verify_pairs(pairs, task.verification)
    return [
        {
            "matches": matches[within_noise(g, task.verification.max_error_px)],
            "kind": np.array(int(g.kind), np.int32),
            "num_putative": np.array(len(matches), np.int32),
            "rotation": g.cam2_from_cam1.rotation,
            "translation": g.cam2_from_cam1.translation,
            "essential": g.essential,
            "fundamental": g.fundamental,
            "homography": g.homography,
            "median_angle_rad": np.array(g.median_angle_rad),
        }
        for g, matches in zip(geometries, putative)
    ]


def within_noise(geometry: PairGeometry, max_error_px: float) -> np.ndarray:
    """(n,) inliers whose residuals the noise of the pair can explain.

    A threshold that suits every image is several times the noise of most. The scale of the noise is the median of the
    inliers' residuals (Rousseeuw and Leroy, 1987), so that wrong matches do not raise it.
    """
    inliers = geometry.inlier_mask
    if geometry.kind not in (PairKind.GENERAL, PairKind.PLANAR, PairKind.UNCALIBRATED):
        return inliers
    sigma_px = MAD_TO_SIGMA * float(np.median(geometry.residuals_px[inliers]))
    limit_px = min(max(NOISE_FACTOR * sigma_px, MIN_LIMIT_PX), max_error_px)
    return np.asarray(inliers & (geometry.residuals_px <= limit_px))


def load_putative(units: Sequence[Unit], num_features: Sequence[int]) -> dict[tuple[int, int], np.ndarray]:
    """Putative matches of every pair that has any, sorted; `num_features` of each image.

    Raises:
        WorkspaceError: a file is damaged, or a match refers to a missing feature.
    """
    out = {}
    for unit in units:
        stored = load(unit.path, MATCHES, "offsets", "matches", p=len(unit.payload.pairs))
        for n, pair in enumerate(unit.payload.pairs):
            matches = result_of(stored, n)["matches"]
            check_matches(unit.path, matches, [num_features[i] for i in pair])
            if len(matches):
                out[pair] = matches
    return dict(sorted(out.items()))


def load_view_graph(units: Sequence[Unit], num_features: Sequence[int]) -> ViewGraph:
    """All verified pairs except degenerate ones, sorted; `num_features` of each image.

    Raises:
        WorkspaceError: a file is damaged, or a match refers to a missing feature.
    """
    blocks = [load(unit.path, GEOMETRIES, p=len(unit.payload.pairs)) for unit in units]
    for unit, stored in zip(units, blocks):
        for n, pair in enumerate(unit.payload.pairs):
            check_matches(unit.path, result_of(stored, n)["matches"], [num_features[i] for i in pair])
    pairs = np.array([pair for unit in units for pair in unit.payload.pairs], np.int32).reshape(-1, 2)

    def column(name: str, empty: tuple[int, ...], dtype: type = np.float64) -> np.ndarray:
        return np.concatenate([b[name] for b in blocks]) if blocks else np.zeros((0, *empty), dtype)

    kind = column("kind", (), np.int32)
    counts = np.concatenate([np.diff(b["offsets"]) for b in blocks]) if blocks else np.zeros(0, np.int64)
    matches = column("matches", (2,), np.int32)
    graph = ViewGraph(
        pairs[:, 0].copy(),
        pairs[:, 1].copy(),
        kind,
        column("num_putative", (), np.int32),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        matches[:, 0].copy(),
        matches[:, 1].copy(),
        Rigid3(column("rotation", (3, 3)), column("translation", (3,))),
        column("essential", (3, 3)),
        column("fundamental", (3, 3)),
        column("homography", (3, 3)),
        column("median_angle_rad", ()),
    )
    # Blocks depend on earlier runs; the order of the pairs must not.
    return graph.select(kind != PairKind.DEGENERATE).in_order()
