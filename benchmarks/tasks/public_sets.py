"""Scenes of public benchmarks that a user has downloaded: ETH3D, the Image Matching Challenge and 1DSfM, recognized by their files.

| set | images | ground truth |
|---|---|---|
| ETH3D, undistorted (Schoeps et al. 2017) | `images/*_images_undistorted/` | COLMAP model `*_calibration_undistorted/` |
| Image Matching Challenge 2023, 2024 (and any scene in this layout) | `images/` | COLMAP model `sfm/` |
| 1DSfM (Wilson and Snavely 2014) | `images/` | Bundler's `gt_bundle.out`, with names in `list.txt` |
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from benchmarks.tasks.sfm import IMAGE_SUFFIXES, SfmTask

MAX_DEPTH = 4
"""Levels of folders below the given one that are searched for scenes."""


def tasks_in(root: Path, work: Path) -> list[SfmTask]:
    """One task per scene in or below a folder, named by its path; links to the images go under `work`.

    Raises:
        FileNotFoundError: no scene of a known layout is there.
    """
    found = [task for folder in _folders(root, MAX_DEPTH) if (task := _task(folder, root, work)) is not None]
    if not found:
        raise FileNotFoundError(
            f"{root} has no scene with images/ and *_calibration_undistorted/ (ETH3D), sfm/ (Image Matching Challenge) or "
            "gt_bundle.out (1DSfM)."
        )
    return found


def _folders(root: Path, depth: int) -> Iterator[Path]:
    yield root
    if depth and not (root / "images").is_dir():
        for folder in sorted(path for path in root.iterdir() if path.is_dir()):
            yield from _folders(folder, depth - 1)


def _task(scene: Path, root: Path, work: Path) -> SfmTask | None:
    """The task of a scene, whose images have the names of the ground truth; None if it is in no known layout."""
    images = scene / "images"
    if not images.is_dir():
        return None
    calibrations = sorted(scene.glob("*_calibration_undistorted"))
    name = "_".join(scene.resolve().parts[-1 - len(scene.relative_to(root).parts) :])
    if calibrations:
        kinds = sorted(images.glob("*_images_undistorted"))
        return _linked(name, images, kinds, calibrations[0], work)
    if (scene / "sfm").is_dir():
        return _linked(name, images, [images], scene / "sfm", work)
    if (scene / "gt_bundle.out").is_file():  # without the prefix images/, as epipole reads it
        return _linked(name, images, [images], scene / "gt_bundle.out", work)
    return None


def _linked(name: str, base: Path, folders: list[Path], truth: Path, work: Path) -> SfmTask | None:
    """A task with links to the images of these folders, named relative to `base`; None without images."""
    names = sorted(
        str((Path(at) / file).relative_to(base))
        for folder in folders
        for at, _, files in os.walk(folder)
        for file in files
        if Path(file).suffix.lower() in IMAGE_SUFFIXES
    )
    for image in names:
        link = work / name / image
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to((base / image).resolve())
    return SfmTask(name, work / name, tuple(names), "EXIF where there is any", truth=truth) if names else None
