"""Matching and verification: blocks of pairs, one file each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Int32

from epipole.cameras import Camera
from epipole.config import MatchConfig, RansacConfig
from epipole.features import Features, match_along_epipolar_lines, match_descriptors
from epipole.geometry import Rigid3
from epipole.pipelines.sfm.feature_stage import load_features
from epipole.robust import PairKind, PairMatches, fundamental_for_guided_matching, verify_pairs
from epipole.runs import Unit, digest, load
from epipole.scene import Cameras, ViewGraph

Result = TypeVar("Result")

FORMAT = 2
MOST_BLOCKS, MOST_BLOCK_PAIRS = 64, 64
"""Pairs are cut into about this many blocks: enough for many workers, not too many files."""
MIN_PREEMPTIVE = 768


@dataclass(frozen=True, slots=True, eq=False)
class MatchPayload:
    """What the unit of one block of pairs needs."""

    pairs: tuple[tuple[int, int], ...]
    feature_files: dict[int, Path]
    cameras: dict[int, Camera]
    """Of each image in the block."""
    is_trusted: dict[int, bool]
    """Whether each image's focal length is known."""
    matching: MatchConfig
    verification: RansacConfig
    match_file: Path | None = None
    """For verification: the file that holds the matches."""


@dataclass(frozen=True, slots=True, eq=False)
class PairWork:
    """What matching and verification work on."""

    pairs: Int32[np.ndarray, "p 2"]
    features: Sequence[Unit]
    cameras: Cameras
    camera_of_image: Int32[np.ndarray, " n"]
    matching: MatchConfig
    verification: RansacConfig


def pair_blocks(pairs: Sequence[tuple[int, int]]) -> list[tuple[tuple[int, int], ...]]:
    """The pairs in order, cut into blocks."""
    size = max(1, min(MOST_BLOCK_PAIRS, -(-len(pairs) // MOST_BLOCKS)))
    return [tuple(pairs[start : start + size]) for start in range(0, len(pairs), size)]


def _units(
    todo: PairWork,
    folder: Path,
    work: Callable[[MatchPayload], dict[str, np.ndarray]],
    match_units: Sequence[Unit] | None,
) -> list[Unit]:
    pairs, feature_units, cameras = todo.pairs, todo.features, todo.cameras
    camera_of_image, configs = todo.camera_of_image, (todo.matching, todo.verification)
    units = []
    single = [cameras[c] for c in range(len(cameras))]
    trusted = cameras.is_focal_trusted | cameras.is_constant
    for number, block in enumerate(pair_blocks([(int(i), int(j)) for i, j in pairs])):
        members = sorted({i for pair in block for i in pair})
        camera_rows = sorted({int(camera_of_image[i]) for i in members})
        key = digest(
            *(work.__name__, FORMAT, block, [feature_units[i].key for i in members]),
            *(asdict(configs[0]), asdict(configs[1]), [int(camera_of_image[i]) for i in members]),
            *(cameras.model[camera_rows], cameras.params[camera_rows], trusted[camera_rows]),
            match_units[number].key if match_units is not None else "",
        )
        payload = MatchPayload(
            block,
            {i: feature_units[i].path for i in members},
            {i: single[camera_of_image[i]] for i in members},
            {i: bool(trusted[camera_of_image[i]]) for i in members},
            *configs,
            match_units[number].path if match_units is not None else None,
        )
        units.append(Unit(folder / f"block_{number:05d}.npz", key, work, payload, len(block)))
    return units


def match_units(todo: PairWork, folder: Path) -> list[Unit]:
    """Units that match blocks of pairs."""
    return _units(todo, folder, match_block, None)


def verification_units(todo: PairWork, folder: Path, matches: Sequence[Unit]) -> list[Unit]:
    """Units that verify blocks of matched pairs."""
    return _units(todo, folder, verify_block, matches)


def match_block(payload: MatchPayload) -> dict[str, np.ndarray]:
    """Putative matches of a block of pairs."""
    features = {i: load_features(path) for i, path in payload.feature_files.items()}
    found = [match_pair(features[i], features[j], i, j, payload) for i, j in payload.pairs]
    return stacked_matches(found)


def stacked_matches(found: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Matches of a block of pairs as a unit stores them."""
    return {"offsets": _offsets(found), "matches": _stacked(found)}


def match_pair(first: Features, second: Features, i: int, j: int, payload: MatchPayload) -> np.ndarray:
    """Matches of one pair: the largest features with each other; then the rest along the epipolar lines that these give.

    Comparing n with n features costs n^2; n / 4 of them and one band around each epipolar line cost about a tenth of
    it and find more matches, since fewer wrong candidates compete (preemptive matching: Wu, 3DV 2013; guided
    matching: HZ section 11.6).
    """
    config = payload.matching
    preemptive = min(config.preemptive_features, max(MIN_PREEMPTIVE, max(len(first), len(second)) // 3))
    if first.descriptors.shape[1] != 128 or preemptive == 0 or max(len(first), len(second)) <= preemptive:
        return match_descriptors(first.descriptors, second.descriptors, config)
    matches = match_descriptors(first.descriptors[:preemptive], second.descriptors[:preemptive], config)
    if len(matches) < config.preemptive_min_matches:
        return matches
    needed = replace(payload.verification, min_inliers=config.preemptive_min_inliers)
    fundamental = fundamental_for_guided_matching(
        first.pixels[matches[:, 0]].astype(np.float64),
        second.pixels[matches[:, 1]].astype(np.float64),
        payload.cameras[i],
        payload.cameras[j],
        is_calibrated=payload.is_trusted[i] and payload.is_trusted[j],
        config=replace(needed, seed=needed.seed + _seed(i, j)),
    )
    if fundamental is None:
        return match_descriptors(first.descriptors, second.descriptors, config)
    return match_along_epipolar_lines(first, second, fundamental, config.band_px, config)


def verify_block(payload: MatchPayload) -> dict[str, np.ndarray]:
    """Geometry of a block of matched pairs."""
    assert payload.match_file is not None
    pixels = {i: load_features(path).pixels for i, path in payload.feature_files.items()}
    stored = load(payload.match_file)
    putative = [
        stored["matches"][stored["offsets"][n] : stored["offsets"][n + 1]] for n in range(len(payload.pairs))
    ]
    pairs = [
        PairMatches(
            pixels[i][matches[:, 0]].astype(np.float64),
            pixels[j][matches[:, 1]].astype(np.float64),
            payload.cameras[i],
            payload.cameras[j],
            payload.is_trusted[i] and payload.is_trusted[j],
            _seed(i, j),
        )
        for (i, j), matches in zip(payload.pairs, putative)
    ]
    geometries = verify_pairs(pairs, payload.verification)
    found = [(g, matches[g.inlier_mask]) for g, matches in zip(geometries, putative)]
    inliers = [m for _, m in found]
    return {
        "kind": np.array([int(g.kind) for g, _ in found], np.int32),
        "num_putative": np.diff(stored["offsets"]).astype(np.int32),
        "offsets": _offsets(inliers),
        "matches": _stacked(inliers),
        "rotation": np.stack([g.cam2_from_cam1.rotation for g, _ in found]),
        "translation": np.stack([g.cam2_from_cam1.translation for g, _ in found]),
        "essential": np.stack([g.essential for g, _ in found]),
        "fundamental": np.stack([g.fundamental for g, _ in found]),
        "homography": np.stack([g.homography for g, _ in found]),
        "median_angle_rad": np.array([g.median_angle_rad for g, _ in found]),
    }


def _seed(i: int, j: int) -> int:
    """A pair's own seed makes its result independent of the order of work."""
    return 1_000_003 * i + j


def _offsets(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate([[0], np.cumsum([len(p) for p in parts])]).astype(np.int64)


def _stacked(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate(list(parts)).astype(np.int32) if parts else np.zeros((0, 2), np.int32)


def load_putative(units: Sequence[Unit]) -> dict[tuple[int, int], np.ndarray]:
    """Putative matches of every pair that has any."""
    out = {}
    for unit in units:
        stored = load(unit.path)
        for n, pair in enumerate(unit.payload.pairs):
            matches = stored["matches"][stored["offsets"][n] : stored["offsets"][n + 1]]
            if len(matches):
                out[pair] = matches
    return out


def load_view_graph(units: Sequence[Unit]) -> ViewGraph:
    """All verified pairs, without the degenerate ones."""
    blocks = [load(unit.path) for unit in units]
    pairs = np.array([pair for unit in units for pair in unit.payload.pairs], np.int32).reshape(-1, 2)

    def column(name: str, empty: tuple[int, ...], dtype: type = np.float64) -> np.ndarray:
        return np.concatenate([b[name] for b in blocks]) if blocks else np.zeros((0, *empty), dtype)

    kind = column("kind", (), np.int32)
    counts = np.concatenate([np.diff(b["offsets"]) for b in blocks]) if blocks else np.zeros(0, np.int64)
    matches = column("matches", (2,), np.int32)
    keep = kind != PairKind.DEGENERATE
    kept_matches = matches[np.repeat(keep, counts)]
    return ViewGraph(
        pairs[keep, 0].copy(),
        pairs[keep, 1].copy(),
        kind[keep],
        column("num_putative", (), np.int32)[keep],
        np.concatenate([[0], np.cumsum(counts[keep])]).astype(np.int64),
        kept_matches[:, 0].copy(),
        kept_matches[:, 1].copy(),
        Rigid3(column("rotation", (3, 3))[keep], column("translation", (3,))[keep]),
        column("essential", (3, 3))[keep],
        column("fundamental", (3, 3))[keep],
        column("homography", (3, 3))[keep],
        column("median_angle_rad", ())[keep],
    )
