"""First stage: list the images and group them by camera."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC
from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int32

from epipole.errors import ConfigError, FileFormatError, MissingDependencyError, NoModelError
from epipole.io.colmap.rig_config import read_rig_config
from epipole.io.images.image_names import depth_among, fits
from epipole.io.images.photographs import (
    PhotographHeader,
    PhotographList,
    list_photographs,
    mask_names,
    mask_of,
    read_header,
)
from epipole.pipelines.sfm.cameras import GroupedCameras, group_cameras
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.known_poses import KnownPoses
from epipole.pipelines.sfm.rigs.assignment import with_rig_cameras
from epipole.runs import Progress, ProgressCallback, content_digests
from epipole.scene import Cameras

MIN_SIZE_PX = 32
NAMES_SHOWN = 3


@dataclass(frozen=True, slots=True, eq=False)
class ImageSet:
    """The images that are used, sorted by name."""

    folder: Path
    names: tuple[str, ...]
    cameras: Cameras
    camera_of_image: Int32[np.ndarray, " n"]
    focal_sources: tuple[str, ...]
    """Source of each camera's focal length, in words."""
    lat_lon_alt: Float64[np.ndarray, "n 3"]
    """GPS from EXIF; NaN altitude if not recorded, NaN rows for none."""
    up_in_cams: Float64[np.ndarray, "n 3"]
    """Up direction in camera coordinates, measured by a gimbal; NaN rows for none."""
    timestamps_s: Float64[np.ndarray, " n"]
    fingerprints: tuple[str, ...]
    """Digest of each image's file."""
    mask_fingerprints: tuple[str, ...]
    """Digest of each image's mask; empty for none."""
    left_out: dict[str, str]
    """Reason for each image that cannot be used."""
    is_video: bool = False
    notes: tuple[str, ...] = ()
    """Notes on the choice of images and masks."""
    known_poses: KnownPoses | None = None
    """Poses that are known approximately."""
    taken_s: Float64[np.ndarray, " n"] | None = None
    """When each photograph was taken by its EXIF, in seconds of the camera's clock; NaN where unknown; None: all."""

    def __len__(self) -> int:
        return len(self.names)

    @property
    def num_masked(self) -> int:
        """Images that have a mask."""
        return sum(map(bool, self.mask_fingerprints))

    def without(self, failures: dict[int, str]) -> ImageSet:
        """Remove the images in these rows, with reasons."""
        if not failures:
            return self
        keep = np.array([i not in failures for i in range(len(self))], bool)
        return replace(
            self,
            names=tuple(n for n, k in zip(self.names, keep) if k),
            camera_of_image=self.camera_of_image[keep],
            lat_lon_alt=self.lat_lon_alt[keep],
            up_in_cams=self.up_in_cams[keep],
            timestamps_s=self.timestamps_s[keep],
            fingerprints=tuple(f for f, k in zip(self.fingerprints, keep) if k),
            mask_fingerprints=tuple(f for f, k in zip(self.mask_fingerprints, keep) if k),
            known_poses=None if self.known_poses is None else self.known_poses.of(keep),
            taken_s=None if self.taken_s is None else self.taken_s[keep],
            left_out={**self.left_out, **{self.names[i]: why for i, why in failures.items()}},
        )


def read_image_set(
    folder: Path,
    config: ReconstructConfig,
    memory: Path,
    *,
    ignore: tuple[Path, ...] = (),
    timestamps_s: dict[str, float] | None = None,
    video_orientation: int = 1,
    progress: ProgressCallback,
) -> ImageSet:
    """Read the headers of all images of a folder and group them by camera.

    Args:
        folder: folder of the images.
        config: options: which images, cameras and masks.
        memory: file that caches the digests of images, by size and time.
        ignore: subfolders to skip.
        timestamps_s: time of each frame of a video, by name.
        video_orientation: EXIF orientation with which its frames were made upright.
        progress: called with the number of headers read.

    Raises:
        NoModelError: no image can be read.
        ConfigError: the camera options do not match, or patterns or masks match no image.
    """
    listed = list_photographs(folder, ignore=[*ignore, *config.named_files()])
    if not listed.names:
        raise NoModelError(_nothing_in(listed))
    names, notes = _chosen(listed.names, config)
    headers, left_out = _read_headers(folder, names, progress, video_orientation)
    unreadable = dict.fromkeys((n for n in listed.unreadable if _is_wanted(n, config)), listed.advice)
    left_out = {**listed.unusable, **unreadable, **left_out}
    if not (config.include or config.exclude) and (note := _take_out_depth(headers)):
        notes.append(note)
    if listed.unusable:
        notes.append(f"{_counted(len(listed.unusable), 'file')} left out: {_some(listed.unusable)}")
    if timestamps_s is None:  # the folder of video frames has no user files
        notes += listed.passed_over
    if not headers:
        reasons = "; ".join(f"{n}: {why}" for n, why in list(left_out.items())[:NAMES_SHOWN])
        raise NoModelError(f"none of the images in {folder} can be used ({reasons})")
    grouped = _cameras_of(headers, config)
    masks, mask_note = _masks_of(tuple(headers), config.masks)
    digests = content_digests([*(folder / name for name in headers), *masks.values()], memory, progress)
    return ImageSet(
        folder,
        tuple(headers),
        grouped.cameras,
        grouped.camera_of_image,
        grouped.sources,
        np.array([_gps_row(h) for h in headers.values()]),
        np.array([h.up_in_camera or (np.nan,) * 3 for h in headers.values()]),
        np.array([(timestamps_s or {}).get(n, np.nan) for n in headers]),
        tuple(digests[folder / n] for n in headers),
        tuple(digests[masks[n]] if n in masks else "" for n in headers),
        left_out,
        bool(timestamps_s),
        tuple(filter(None, [*notes, *grouped.notes, mask_note])),
        taken_s=np.array([_taken_s(h) for h in headers.values()]),
    )


def _taken_s(header: PhotographHeader) -> float:
    """Seconds on a clock without time zones: EXIF's times usually have none."""
    time = header.capture_time
    return float("nan") if time is None else time.replace(tzinfo=UTC).timestamp()


def _cameras_of(headers: dict[str, PhotographHeader], config: ReconstructConfig) -> GroupedCameras:
    """Cameras of the images; those of rigs have the intrinsics of the rig file, where it has them."""
    grouped = group_cameras(headers, config)
    if config.rigs is None:
        return grouped
    return with_rig_cameras(grouped, headers, read_rig_config(config.rigs), config)


def _nothing_in(listed: PhotographList) -> str:
    unusable = [f"{name} {why}" for name, why in list(listed.unusable.items())[:NAMES_SHOWN]]
    hints = filter(None, [listed.advice, *unusable, *listed.passed_over])
    return " ".join([f"{listed.folder} holds no photographs (JPEG, PNG, TIFF, WebP).", *hints])


def _read_headers(
    folder: Path, names: Sequence[str], progress: ProgressCallback, video_orientation: int
) -> tuple[dict[str, PhotographHeader], dict[str, str]]:
    """Headers of usable images, and reasons for the others."""
    headers: dict[str, PhotographHeader] = {}
    left_out: dict[str, str] = {}
    progress(Progress("read", 0, len(names)))
    for n, name in enumerate(names):
        try:
            header = read_header(folder / name)
            if video_orientation != 1:
                header = replace(header, orientation=video_orientation)
            if min(header.width, header.height) < MIN_SIZE_PX:
                left_out[name] = f"too small ({header.width}x{header.height}) for feature detection"
            else:
                headers[name] = header
        except (FileFormatError, MissingDependencyError) as error:
            left_out[name] = str(error).removeprefix(f"{folder / name}: ")
        progress(Progress("read", n + 1, len(names)))
    return headers, left_out


def _chosen(names: Sequence[str], config: ReconstructConfig) -> tuple[list[str], list[str]]:
    """Names that match the patterns, and notes.

    Raises:
        ConfigError: a pattern in `include` matches no name, or no name is left.
    """
    there = f"there are {_some(names)}"
    for pattern in config.include:
        if not any(fits(name, pattern) for name in names):
            raise ConfigError(f"include {pattern!r} matches none of the images: {there}")
    kept = [name for name in names if _is_wanted(name, config)]
    if not kept:
        raise ConfigError(f"exclude {' '.join(map(repr, config.exclude))} leaves no image: {there}")
    idle = [pattern for pattern in config.exclude if not any(fits(name, pattern) for name in names)]
    return kept, [f"exclude {pattern!r} matches none of the images: {there}" for pattern in idle]


def _is_wanted(name: str, config: ReconstructConfig) -> bool:
    is_included = not config.include or any(fits(name, pattern) for pattern in config.include)
    return is_included and not any(fits(name, pattern) for pattern in config.exclude)


def _take_out_depth(headers: dict[str, PhotographHeader]) -> str:
    """Remove depth images from the headers; returns a note, empty if there are none."""
    deep_gray = frozenset(name for name, header in headers.items() if header.is_deep_gray_png)
    depth = depth_among(tuple(headers), deep_gray)
    if not depth:
        return ""
    note = (
        f"{len(depth)} of {len(headers)} images are 16-bit gray PNGs next to color images of similar names "
        f"({_some(depth)}): left out as depth images (--include '*' uses all)"
    )
    for name in depth:
        del headers[name]
    return note


def _masks_of(names: Sequence[str], masks: Path | None) -> tuple[dict[str, Path], str]:
    """Mask of each image that has one, and a note if some have none.

    Raises:
        ConfigError: no image has a mask.
    """
    if masks is None:
        return {}, ""
    found = {name: path for name in names if (path := mask_of(masks, name)) is not None}
    if not found:
        first, second = mask_names(names[0])
        present = sorted(
            p.relative_to(masks).as_posix() for p in islice(masks.rglob("*"), 1000) if p.is_file()
        )
        there = f"there are {_some(present)}" if present else "it is empty"
        raise ConfigError(
            f"masks {masks} has no mask for any of the {_counted(len(names), 'image')}: looked for {first} or {second}, "
            f"and so on; {there}"
        )
    without = [name for name in names if name not in found]
    if not without:
        return found, ""
    return (
        found,
        f"masks for {len(found)} of {len(names)} images: the others are used without a mask ({_some(without)})",
    )


def _some(names: Iterable[str]) -> str:
    """The first few names, and how many more."""
    listed = list(names)
    more = len(listed) - NAMES_SHOWN
    return ", ".join(listed[:NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _gps_row(header: PhotographHeader) -> tuple[float, float, float]:
    if header.gps is None:
        return (np.nan, np.nan, np.nan)
    alt_m = np.nan if header.gps.alt_m is None else header.gps.alt_m
    return (header.gps.lat_deg, header.gps.lon_deg, alt_m)
