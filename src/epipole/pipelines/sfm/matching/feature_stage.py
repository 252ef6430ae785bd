"""Second stage: features of every image, one file each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import overload

import cv2
import numpy as np

from epipole.config import FeatureConfig
from epipole.errors import FileFormatError, MissingDependencyError
from epipole.features import Features, detect_features
from epipole.features.kinds import SIFT
from epipole.image.encoding import encoded_image
from epipole.io.images.photographs import mask_of, read_header, read_mask_file, read_rgb
from epipole.pipelines.sfm.matching.unit_tables import FEATURES
from epipole.pipelines.sfm.photographs import ImageSet
from epipole.runs import Unit, digest, load

FORMAT = 5
"""Increase when the contents of the files change."""
THUMBNAIL_PX = 320


@dataclass(frozen=True, slots=True)
class FeaturePayload:
    """Input of the unit of one image."""

    path: Path
    name: str
    mask: Path | None
    config: FeatureConfig


def feature_units(images: ImageSet, folder: Path, config: FeatureConfig, masks: Path | None) -> list[Unit]:
    """One unit per image."""
    units = []
    for n, (image, mask) in enumerate(zip(images.fingerprints, images.mask_fingerprints)):
        payload = payload_of(images, n, masks, config)
        key = digest("features", FORMAT, image, mask, asdict(config))
        units.append(Unit(folder / f"{key}.npz", key, detect_in_file, payload))
    return units


def payload_of(images: ImageSet, image: int, masks: Path | None, config: FeatureConfig) -> FeaturePayload:
    """Input of the unit of one image, whose mask is in the folder `masks`."""
    name = images.names[image]
    return FeaturePayload(images.folder / name, name, None if masks is None else mask_of(masks, name), config)


@dataclass(frozen=True, slots=True, eq=False)
class Image:
    """A downscaled image, and its full size."""

    rgb: np.ndarray
    width: int
    height: int


def read_image(path: Path, max_size_px: int) -> Image | str:
    """Read an image, downscaled to `max_size_px`; returns the reason if it is damaged.

    Raises:
        FileFormatError: it is not there. That is no property of the image: a worker may see other folders.
    """
    if not path.exists():
        raise FileFormatError(path, "it does not exist, or is not visible here")
    try:
        header = read_header(path)
        return Image(read_rgb(path, max_size_px), header.width, header.height)
    except (FileFormatError, MissingDependencyError) as error:
        return str(error).removeprefix(f"{path}: ")


def detect_in_file(payload: FeaturePayload) -> dict[str, np.ndarray]:
    """Features of an image, their colors, and a thumbnail; if the image is damaged, the reason instead."""
    image = read_image(payload.path, payload.config.max_size_px)
    if isinstance(image, str):
        return {"failure": np.array(image)}
    rgb = image.rgb
    cv2.setNumThreads(1)  # images are processed in parallel
    small = detect_features(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), payload.config)
    stretch = np.array([image.width / rgb.shape[1], image.height / rgb.shape[0]])
    pixels = ((small.pixels + 0.5) * stretch - 0.5).astype(np.float32)
    try:
        keep = in_mask(payload, image, pixels)
    except (FileFormatError, MissingDependencyError) as error:
        return {"failure": np.array(str(error))}
    scale_px = (small.scale_px * stretch.mean()).astype(np.float32)
    return as_unit_arrays(image, pixels[keep], scale_px[keep], small.angle_rad[keep], small.descriptors[keep])


def in_mask(payload: FeaturePayload, image: Image, pixels: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of the full image that its mask allows; all if there is none.

    Raises:
        FileFormatError: the mask cannot be read, or is of another size.
        MissingDependencyError: its format needs a package that is not installed.
    """
    mask = None
    if payload.mask is not None:
        mask = read_mask_file(payload.mask, payload.name, size=(image.width, image.height))
    if mask is None:
        return np.ones(len(pixels), bool)
    at = np.clip(np.rint(pixels).astype(int), 0, [image.width - 1, image.height - 1])
    return np.asarray(mask[at[:, 1], at[:, 0]])


def as_unit_arrays(
    image: Image, pixels: np.ndarray, scale_px: np.ndarray, angle_rad: np.ndarray, descriptors: np.ndarray
) -> dict[str, np.ndarray]:
    """Arrays stored by a unit: features, their colors, and a thumbnail."""
    rgb = image.rgb
    shrink = np.array([rgb.shape[1] / image.width, rgb.shape[0] / image.height])
    at = np.clip(np.rint((pixels + 0.5) * shrink - 0.5).astype(int), 0, [rgb.shape[1] - 1, rgb.shape[0] - 1])
    factor = min(1.0, THUMBNAIL_PX / max(rgb.shape[:2]))
    size = (max(1, round(rgb.shape[1] * factor)), max(1, round(rgb.shape[0] * factor)))
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    jpeg = np.frombuffer(encoded_image(".jpg", small[..., ::-1], jpeg_quality=80), np.uint8)
    return {
        "pixels": pixels,
        "scale_px": scale_px,
        "angle_rad": angle_rad,
        "descriptors": descriptors,
        "colors": rgb[at[:, 1], at[:, 0]],
        "thumbnail": jpeg,
        "failure": np.array(""),
    }


def load_features(path: Path) -> Features:
    """Features in a unit's file; the most recent ones are cached."""
    return _remembered(path, path.stat().st_mtime_ns)


class FeatureFiles(Sequence[Features]):
    """The features of all images, read when they are needed."""

    def __init__(self, units: Sequence[Unit]) -> None:
        self._paths = [unit.path for unit in units]

    def __len__(self) -> int:
        return len(self._paths)

    @overload
    def __getitem__(self, index: int) -> Features: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Features]: ...
    def __getitem__(self, index: int | slice) -> Features | Sequence[Features]:
        """Features of one image, or of a slice of the images."""
        if isinstance(index, slice):
            return [load_features(path) for path in self._paths[index]]
        return load_features(self._paths[index])


def sift_features(units: Sequence[Unit]) -> FeatureFiles | None:
    """The features of all images; None if they are not SIFT, or a database has no descriptors."""
    files = FeatureFiles(units)
    widths = {load(unit.path, FEATURES, "descriptors")["descriptors"].shape[1] for unit in units}
    return files if widths == {SIFT.width} else None


@lru_cache(maxsize=64)
def _remembered(path: Path, _mtime_ns: int) -> Features:
    return Features(**load(path, FEATURES, "pixels", "scale_px", "angle_rad", "descriptors"))
