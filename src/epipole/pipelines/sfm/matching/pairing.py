"""Third stage: choose the pairs of images to match."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int32

from epipole.errors import ConfigError, FileFormatError
from epipole.features import describe_images, most_similar, train_vocabulary
from epipole.io.colmap.database import read_database, read_matched_pairs
from epipole.io.files import file_text
from epipole.pipelines.sfm.config import PairingConfig
from epipole.pipelines.sfm.gps.alignment import is_wide_enough
from epipole.scene.georeference import gps_to_enu

SAME_PIXEL = 0.01
"""Difference between pixels that are the same, but stored with different precision."""
MOSTLY, LEAST_EXTENT_M = 0.9, 20.0
"""Fraction of images with GPS, and extent of their positions, above which near images are chosen by GPS."""
NEXT_IN_TIME = 2
"""Number of following photographs, in the order of time, that each photograph is matched with."""
LONGEST_PAUSE_S = 60.0
"""Longest time between two of them: after a pause the photographer has usually moved on. Not tuned on any set."""
ALL_AT_ONCE = 60
"""Images of which all pairs are matched in one round. Of more, most pairs of images that see the same would observe the same points
once more: pairs with the nearest neighbors come first, and of all others those whose images have few points in common by then."""
ROWS_AT_ONCE = 1024
"""Images that are compared with all others at once, which limits the memory."""


@dataclass(frozen=True, slots=True)
class EarlierDatabase:
    """Database of an earlier run, some of whose images have other names now."""

    path: Path
    names: Mapping[str, str] = field(default_factory=dict)
    """Present name by the name in the database, where they differ."""


@dataclass(frozen=True, slots=True, eq=False)
class ChosenPairs:
    """Pairs (i, j), i < j, sorted."""

    first: Int32[np.ndarray, "p 2"]
    later: Int32[np.ndarray, "q 2"] = field(default_factory=lambda: np.zeros((0, 2), np.int32))
    """Those of the more distant neighbors, which are matched only if the first ones leave their images unconnected."""


def choose_pairs(
    descriptors: Sequence[np.ndarray],
    lat_lon_alt: Float64[np.ndarray, "n 3"],
    config: PairingConfig,
    *,
    is_video: bool,
    names: Sequence[str] = (),
    taken_s: Float64[np.ndarray, " n"] | None = None,
) -> ChosenPairs:
    """Pairs by the method of the options, or by the one that fits the images.

    Args:
        descriptors: of each image.
        lat_lon_alt: GPS of each image; NaN for none.
        config: options.
        is_video: whether they are frames of a video, in order.
        names: of the images, whose order is that of the sequence; numbers in them count as such. Empty: the images are in order.
        taken_s: when they were taken; NaN where unknown. None: all.

    Raises:
        ConfigError: spatial pairs are requested, but fewer than two images have GPS.
    """
    n, method = len(descriptors), method_of(lat_lon_alt, config, is_video=is_video)
    has_gps = np.isfinite(lat_lon_alt[:, :2]).all(axis=1)
    if method == "exhaustive" and (config.method != "auto" or n <= ALL_AT_ONCE):
        return ChosenPairs(np.stack(np.triu_indices(n, 1), axis=1).astype(np.int32))
    if method == "sequential":
        reach = min(config.overlap, n - 1)
        order = _in_sequence(range(n), names)
        pairs = [
            (order[i], order[i + step]) for i in range(n) for step in range(1, reach + 1) if i + step < n
        ]
        return ChosenPairs(
            sorted_pairs([*pairs, *_pairs_of(_similar_images(descriptors, min(config.neighbors, 10)))])
        )
    if method in ("exhaustive", "retrieval"):
        similar = _similar_images(descriptors, n - 1 if method == "exhaustive" else config.neighbors)
        return _with_first(_in_two_rounds(similar, config.first_neighbors), _next_in_time(taken_s, names))
    if has_gps.sum() < 2:
        raise ConfigError("spatial pairs need GPS in the images' EXIF")
    near = _in_two_rounds(_spatial(lat_lon_alt, has_gps, config.neighbors), config.first_neighbors)
    alike = _pairs_of(_similar_images(descriptors, 5))
    return _with_first(near, [*alike, *_next_in_time(taken_s, names)])


def _in_sequence(rows: Iterable[int], names: Sequence[str]) -> list[int]:
    return sorted(rows, key=lambda i: _natural(names[i])) if names else list(rows)


def _next_in_time(taken_s: np.ndarray | None, names: Sequence[str]) -> list[tuple[int, int]]:
    """Pairs of photographs of one folder that were taken one after the other, which probably show the same scene.

    Folders are separate, because cameras of a rig, or of several people, usually have one each.
    """
    if taken_s is None:
        return []
    # Photographs taken in the same second are in the order of their names.
    named = _in_sequence(np.flatnonzero(np.isfinite(taken_s)).tolist(), names)
    folders: dict[str, list[int]] = {}
    for i in sorted(named, key=lambda i: float(taken_s[i])):
        folders.setdefault(names[i].rpartition("/")[0] if names else "", []).append(i)
    pairs = [
        (i, j)
        for order in folders.values()
        for step in range(1, NEXT_IN_TIME + 1)
        for i, j in zip(order, order[step:])
    ]
    return [(i, j) for i, j in pairs if taken_s[j] - taken_s[i] <= LONGEST_PAUSE_S]


def _natural(name: str) -> list[tuple[int, str]]:
    """Key of the order in which frame_2 comes before frame_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _pairs_of(neighbors: Mapping[int, Sequence[int]]) -> list[tuple[int, int]]:
    return [(i, j) for i, nearest in neighbors.items() for j in nearest]


def _in_two_rounds(neighbors: Mapping[int, Sequence[int]], num_first: int) -> ChosenPairs:
    """Pairs of each image with its nearest neighbors, and with those after them."""
    first = [(i, j) for i, nearest in neighbors.items() for j in nearest[:num_first]]
    return _with_first(ChosenPairs(sorted_pairs([]), sorted_pairs(_pairs_of(neighbors))), first)


def _with_first(chosen: ChosenPairs, pairs: Sequence[tuple[int, int]]) -> ChosenPairs:
    """The same with further pairs in the first round, which are not matched again later."""
    first = sorted_pairs([*map(tuple, chosen.first.tolist()), *pairs])
    taken = {*map(tuple, first.tolist())}
    return ChosenPairs(first, sorted_pairs([(i, j) for i, j in chosen.later.tolist() if (i, j) not in taken]))


def further_pairs(
    descriptors: Sequence[np.ndarray],
    keypoints: Sequence[np.ndarray],
    names: Sequence[str],
    databases: Sequence[EarlierDatabase],
    neighbors: int,
) -> Int32[np.ndarray, "p 2"]:
    """Pairs (i, j), i < j, sorted: those that match in earlier runs, and the most similar images of further ones and of other runs.

    Args:
        descriptors: of each image.
        keypoints: of each image; one that has others in a database is another image of that name.
        names: of each image.
        databases: databases of the earlier runs.
        neighbors: pairs of each image that the databases do not have.

    Raises:
        FileFormatError: a database is missing or damaged.
    """
    is_in, pairs = np.zeros((len(databases), len(names)), bool), list[tuple[int, int]]()
    for k, database in enumerate(databases):
        rows, matched = _stored_pairs(database, keypoints, names)
        is_in[k, rows] = True
        pairs += matched
    further = np.flatnonzero(~is_in.any(axis=0)).tolist()
    if not further and len(databases) < 2:
        return sorted_pairs(pairs)
    vectors = describe_images(descriptors, train_vocabulary(descriptors))
    nearest = most_similar(vectors, neighbors)
    pairs += [(i, int(j)) for i in further for j in nearest[i]]
    return sorted_pairs([*pairs, *_pairs_between(vectors, is_in, neighbors)])


def _stored_pairs(
    database: EarlierDatabase, keypoints: Sequence[np.ndarray], names: Sequence[str]
) -> tuple[list[int], list[tuple[int, int]]]:
    """Rows of the images that a database has, and pairs of them that match there."""
    stored = read_database(database.path, with_pairs=False)
    row = {name: i for i, name in enumerate(names)}
    rows = [row.get(database.names.get(name, name), -1) for name in stored.images.name]
    for k, i in enumerate(rows):
        if i >= 0 and not has_same_keypoints(keypoints[i], stored.images.keypoints_of(k)):
            rows[k] = -1
    pairs = [
        (rows[a], rows[b])
        for a, b in read_matched_pairs(database.path).tolist()
        if min(rows[a], rows[b]) >= 0
    ]
    return [i for i in rows if i >= 0], pairs


def _pairs_between(vectors: np.ndarray, is_in: np.ndarray, count: int) -> list[tuple[int, int]]:
    """The most similar images of each image among those that no run had together with it."""
    earlier = np.flatnonzero(is_in.any(axis=0))
    member = is_in[:, earlier].astype(np.float32)
    out = []
    for start in range(0, len(earlier), ROWS_AT_ONCE):
        rows = np.arange(start, min(start + ROWS_AT_ONCE, len(earlier)))
        similarity = vectors[earlier[rows]] @ vectors[earlier].T
        similarity[member[:, rows].T @ member > 0] = -np.inf
        best = np.argsort(-similarity, axis=1, kind="stable")[:, :count]
        for n, row in enumerate(rows.tolist()):
            found = best[n][np.isfinite(similarity[n, best[n]])]
            out += [(int(earlier[row]), int(earlier[j])) for j in found]
    return out


def has_same_keypoints(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two lists of pixels are those of one image; files store them in single precision."""
    return first.shape == second.shape and bool((np.abs(first - second) < SAME_PIXEL).all())


def method_of(
    lat_lon_alt: Float64[np.ndarray, "n 3"], config: PairingConfig, *, is_video: bool
) -> Literal["exhaustive", "sequential", "spatial", "retrieval"]:
    """The method of the options, or the one that fits the images."""
    if config.method != "auto":
        return config.method
    if is_video:
        return "sequential"
    if len(lat_lon_alt) <= config.exhaustive_limit:
        return "exhaustive"
    has_gps = np.isfinite(lat_lon_alt[:, :2]).all(axis=1)
    # Positions that are nearly the same, as indoors, do not say which images are near each other.
    if has_gps.mean() > MOSTLY and is_wide_enough(gps_to_enu(lat_lon_alt[has_gps]), LEAST_EXTENT_M):
        return "spatial"
    return "retrieval"


def _similar_images(descriptors: Sequence[np.ndarray], count: int) -> dict[int, list[int]]:
    """The most similar images of each one."""
    words = train_vocabulary(descriptors)
    nearest = most_similar(describe_images(descriptors, words), count)
    return {i: [int(j) for j in row] for i, row in enumerate(nearest)}


def _spatial(lat_lon_alt: np.ndarray, has_gps: np.ndarray, count: int) -> dict[int, list[int]]:
    """The nearest images of each one that has GPS."""
    rows = np.flatnonzero(has_gps)
    east_north = gps_to_enu(lat_lon_alt[rows])[:, :2]
    from scipy.spatial import cKDTree  # slow to import, and needed for GPS only

    _, near = cKDTree(east_north).query(east_north, k=min(count + 1, len(rows)))
    return {int(rows[a]): [int(rows[b]) for b in np.atleast_1d(near[a]) if a != b] for a in range(len(rows))}


def sorted_pairs(pairs: Sequence[tuple[int, int]]) -> Int32[np.ndarray, "p 2"]:
    """Unique pairs, smaller index first, sorted."""
    unique = sorted({(min(i, j), max(i, j)) for i, j in pairs if i != j})
    return np.array(unique, np.int32).reshape(-1, 2)


def read_pairs(path: Path, names: Sequence[str]) -> Int32[np.ndarray, "p 2"]:
    """Read pairs from a text file with two names per line; blank lines and lines that start with # are skipped.

    Names may have spaces, if only one division of the line gives two images.

    Raises:
        FileFormatError: the file cannot be read, a line does not have two names, or an image is unknown.
    """
    row = {name: i for i, name in enumerate(names)}
    try:
        lines = file_text(path).splitlines()
    except FileFormatError as error:
        raise FileFormatError(path, f"cannot be read as a list of pairs: {error}") from error
    pairs = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) > 2:
            words = _two_names(line, row) or words
        if len(words) != 2:
            raise FileFormatError(path, f"line {number}: expected two image names, got {len(words)}")
        missing = [w for w in words if w not in row]
        if missing:
            raise FileFormatError(path, f"line {number}: image {missing[0]!r} does not exist or is unusable")
        pairs.append((row[words[0]], row[words[1]]))
    return sorted_pairs(pairs)


def _two_names(line: str, row: Mapping[str, int]) -> list[str]:
    """The two image names of a line, some of which have spaces; empty if no or several divisions of the line give two images."""
    divided = {(line[:k].strip(), line[k:].strip()) for k in range(1, len(line)) if line[k].isspace()}
    named = [one for one in divided if one[0] in row and one[1] in row]
    return list(named[0]) if len(named) == 1 else []
