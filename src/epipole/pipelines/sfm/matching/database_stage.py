"""Use an existing COLMAP database instead of detection and matching."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from epipole._checks.tables import Arrays
from epipole.errors import ConfigError
from epipole.io.colmap.database import DatabaseContents, read_database
from epipole.io.images.photographs import read_header
from epipole.pipelines.sfm.matching.feature_stage import as_unit_arrays, read_image
from epipole.pipelines.sfm.matching.pair_blocks import PairBlock, block_units, filled
from epipole.pipelines.sfm.matching.unit_tables import MATCHES
from epipole.pipelines.sfm.photographs import ImageSet
from epipole.runs import Unit, digest, has_own_model

FORMAT = 2
Matches = dict[tuple[int, int], np.ndarray]


@dataclass(frozen=True, slots=True, eq=False)
class GivenFeatures:
    """Input of the unit of one image: its file, and its rows of the database."""

    path: Path
    max_size_px: int
    pixels: np.ndarray
    descriptors: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class DatabaseSource:
    """A database, and its row for each image."""

    path: Path
    contents: DatabaseContents
    row_of_name: dict[str, int]

    def matches(self, names: Sequence[str]) -> Matches:
        """Matches between these images, before verification if the database has them, else verified ones."""
        position = {self.row_of_name[name]: i for i, name in enumerate(names)}
        found: Matches = dict(self.contents.matches)
        graph = self.contents.view_graph
        for edge in range(0 if graph is None else len(graph)):
            assert graph is not None
            rows = slice(graph.match_offsets[edge], graph.match_offsets[edge + 1])
            pair = int(graph.image1[edge]), int(graph.image2[edge])
            if pair not in found:
                found[pair] = np.stack([graph.keypoint1[rows], graph.keypoint2[rows]], axis=1)
        out = {}
        for (i, j), matches in sorted(found.items()):
            if i in position and j in position and len(matches):
                a, b = position[i], position[j]
                out[min(a, b), max(a, b)] = (matches if a < b else matches[:, ::-1]).astype(np.int32)
        return out


def open_source(path: Path, images: ImageSet, *, keep_cameras: bool) -> tuple[DatabaseSource, ImageSet]:
    """Read a database and match its images by name to those of a folder.

    Args:
        path: the database.
        images: images of the folder.
        keep_cameras: whether to keep the cameras of `images`, because they were given; else the database's are used.

    Returns:
        The source, and the images that are in the database; others are left out with the reason.

    Raises:
        FileFormatError: it is not a COLMAP database.
        ConfigError: none of the images is in it, or an image has another size there.
    """
    contents = read_database(path)
    row_of_name = {str(name): row for row, name in enumerate(contents.images.name)}
    source = DatabaseSource(path, contents, row_of_name)
    missing = {i: f"not in {path.name}" for i, n in enumerate(images.names) if n not in source.row_of_name}
    if len(missing) == len(images):
        raise ConfigError(f"{path} has none of the images in {images.folder}: image names must be the same")
    images = images.without(missing)
    rows = np.array([source.row_of_name[name] for name in images.names])
    camera_rows = contents.rigs.sensor_camera[contents.images.sensor[rows]]
    for i, c in enumerate(camera_rows):
        own, theirs = images.cameras[int(images.camera_of_image[i])], contents.cameras[int(c)]
        if (own.width, own.height) != (theirs.width, theirs.height):
            raise ConfigError(
                f"{images.names[i]} is {own.width}x{own.height} upright, but {theirs.width}x{theirs.height} in {path}"
            )
    if not has_own_model(path.resolve().parent):
        _refuse_rotated(path, images)
    if keep_cameras:
        return source, images
    sources = tuple(
        f"{path.name}, {'known' if trusted else 'a guess'}" for trusted in contents.cameras.is_focal_trusted
    )
    return source, replace(
        images, cameras=contents.cameras, camera_of_image=camera_rows.astype(np.int32), focal_sources=sources
    )


def _refuse_rotated(path: Path, images: ImageSet) -> None:
    """Reject images with an EXIF orientation, as keypoints may refer to stored pixels (COLMAP ignores the orientation).

    Rotations by 90 degrees are already detected by the image size.
    """
    for name in images.names:
        header = read_header(images.folder / name)
        if header.orientation in (2, 3, 4) or (header.orientation != 1 and header.width == header.height):
            raise ConfigError(
                f"{name} has EXIF orientation {header.orientation}, so the keypoints in {path} may refer to its stored pixels:"
                " store the images upright, without orientation, and extract features again"
            )


def feature_units(source: DatabaseSource, images: ImageSet, folder: Path, max_size_px: int) -> list[Unit]:
    """One unit per image, with the database's features and colors from the image."""
    contents, units = source.contents, []
    for name, fingerprint in zip(images.names, images.fingerprints):
        row = source.row_of_name[name]
        pixels = contents.images.keypoints_of(row).astype(np.float32)
        stored = contents.descriptors[row] if contents.descriptors is not None else None
        descriptors = np.zeros((len(pixels), 0), np.uint8) if stored is None else stored
        key = digest("database features", FORMAT, fingerprint, pixels, descriptors, max_size_px)
        payload = GivenFeatures(images.folder / name, max_size_px, pixels, descriptors)
        units.append(Unit(folder / f"{key}.npz", key, features_with_colors, payload))
    return units


def features_with_colors(payload: GivenFeatures) -> dict[str, np.ndarray]:
    """Arrays of the unit; if the image is damaged, the reason instead."""
    image = read_image(payload.path, payload.max_size_px)
    if isinstance(image, str):
        return {"failure": np.array(image)}
    nothing = np.zeros(len(payload.pixels), np.float32)
    return as_unit_arrays(image, payload.pixels, nothing, nothing, payload.descriptors)


def match_units(matches: Matches, folder: Path) -> list[Unit]:
    """Units with the database's matches, in the blocks of the matching stage."""
    pairs = sorted(matches)
    keys = [digest("database matches", FORMAT, matches[pair]) for pair in pairs]
    return block_units(
        pairs, keys, folder, given_matches, MATCHES, lambda block: [matches[pairs[n]] for n in block]
    )


def given_matches(block: PairBlock) -> Arrays:
    """Matches in the format of the matching stage."""
    return filled(block, lambda positions: [{"matches": block.task[n]} for n in positions])
