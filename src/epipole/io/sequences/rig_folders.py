"""Reading the images of a rig: folders cam0, cam1, ..., as in EuRoC/ASL, or with images of one name or order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole._checks import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.io._time_units import seconds_of
from epipole.io.files import missing_in_words
from epipole.io.images.photographs import list_photographs
from epipole.io.sequences._lists import TIMES, by_number, in_order, timed_names_of_camera, times_of

MOST_APART_S = 0.005
"""Largest time difference between the images of one instant. Meanwhile, a rig that rotates by 30 degrees per second moves the image by
1.3 px at a focal length of 500 px."""
_USUAL_HZ = 30.0
_LEAST_DIGITS = 13
"""Names of at least this many digits are times (milliseconds since 1970 have 13)."""


@dataclass(frozen=True, slots=True)
class RigFiles:
    """The images of one instant."""

    timestamp_s: float
    images: tuple[Path, ...]
    """One per camera."""


@dataclass(frozen=True, slots=True)
class RigSequence:
    """The images of a rig in temporal order."""

    folder: Path
    frames: tuple[RigFiles, ...]
    warnings: tuple[str, ...]


@checked
def read_rig_sequence(folder: str | Path, num_cameras: int, fps: float | None = None) -> RigSequence:
    """Read the folders cam0, cam1, ... of a folder (or of its folder mav0), one for each camera of the calibration.

    A camera's folder has a `data.csv` (EuRoC), or images, possibly in a folder `data`. Images whose names are long numbers have
    these as times; the images of one instant are those less than 5 ms apart. Other images belong together by name, or, if the
    names differ and the numbers of images are equal, by order; their times are those of `times.txt` or `fps`.

    Args:
        folder: the folder.
        num_cameras: number of cameras of the calibration.
        fps: frames per second of images without times; None: 30, with a warning.

    Raises:
        FileFormatError: a camera's folder or its images are missing, or the images do not belong together.
        ConfigError: fps is given for images that have times.
    """
    if not Path(folder).is_dir():
        raise FileFormatError(folder, missing_in_words(Path(folder)))
    at = Path(folder) / "mav0" if (Path(folder) / "mav0" / "cam0").is_dir() else Path(folder)
    cameras = [at / f"cam{k}" for k in range(num_cameras)]
    missing = [camera.name for camera in cameras if not camera.is_dir()]
    if missing:
        raise FileFormatError(
            at,
            f"the calibration has {num_cameras} cameras, but there is no folder {', '.join(missing)}: the images of its cameras"
            " must be in folders cam0, cam1, ...",
        )
    if (at / f"cam{num_cameras}").is_dir():
        raise FileFormatError(
            at, f"there is a folder cam{num_cameras}, but the calibration has only {num_cameras} cameras"
        )
    listed = [_timed(camera) for camera in cameras]
    if all(timed is not None for timed, _ in listed):
        if fps is not None:
            raise ConfigError("fps is only for images without times; these have times")
        warnings = [words for _, own in listed for words in own]
        return _by_time(at, [timed for timed, _ in listed if timed is not None], warnings)
    return _by_name(at, [_images(camera) for camera in cameras], fps)


def _timed(camera: Path) -> tuple[dict[float, Path] | None, tuple[str, ...]]:
    """Images by time, and warnings; None if they have no times."""
    if (camera / "data.csv").is_file():
        rows, warnings = in_order(f"{camera.name}/data.csv", timed_names_of_camera(camera))
        return {ns * 1e-9: path for ns, path in rows if path.is_file()}, warnings
    images = _images(camera)
    if not all(image.stem.isdecimal() and len(image.stem) >= _LEAST_DIGITS for image in images):
        return None, ()
    times, _ = seconds_of(np.array([float(image.stem) for image in images]))
    return dict(sorted(zip(times.tolist(), images))), ()


def _images(camera: Path) -> list[Path]:
    folder = camera / "data" if (camera / "data").is_dir() else camera
    return [folder / name for name in by_number(list_photographs(folder).require_some().names)]


def _by_time(folder: Path, cameras: Sequence[dict[float, Path]], warnings: list[str]) -> RigSequence:
    frames, times = [], [np.array(sorted(timed)) for timed in cameras]
    if min(len(own) for own in times):
        for time in times[0]:
            nearest = [float(own[np.argmin(np.abs(own - time))]) for own in times]
            if max(nearest) - min(nearest) <= MOST_APART_S:
                frames.append(RigFiles(float(time), tuple(c[t] for c, t in zip(cameras, nearest))))
    if not frames:
        raise FileFormatError(
            folder, f"no images of all {len(cameras)} cameras were taken within {1e3 * MOST_APART_S:g} ms"
        )
    lost = len(times[0]) - len(frames)
    if lost:
        warnings.append(
            f"{lost} of the {len(times[0])} images of cam0 are not used: another camera has no image within"
            f" {1e3 * MOST_APART_S:g} ms"
        )
    return RigSequence(folder, tuple(frames), tuple(warnings))


def _by_name(folder: Path, cameras: Sequence[list[Path]], fps: float | None) -> RigSequence:
    stems = [{image.stem: image for image in images} for images in cameras]
    names = [image.stem for image in cameras[0] if all(image.stem in own for own in stems)]
    warnings = []
    if names:
        rows = [tuple(own[name] for own in stems) for name in names]
        lost = len(cameras[0]) - len(names)
        if lost:
            warnings.append(f"{lost} images of cam0 are not used: another camera has no image of that name")
    elif len({len(images) for images in cameras}) == 1:
        rows = list(zip(*cameras))
        warnings.append("the images of the cameras have different names: they are paired in their order")
    else:
        counts = ", ".join(str(len(images)) for images in cameras)
        raise FileFormatError(
            folder,
            f"the images of the cameras have different names and numbers ({counts}): rename them alike",
        )
    if fps is not None and (folder / TIMES).is_file():
        raise ConfigError(f"fps is only for images without times; these have {TIMES}")
    times, more = times_of(folder, tuple(row[0].name for row in rows), fps or _USUAL_HZ)
    if fps is None and not (folder / TIMES).is_file():
        warnings.append(f"the images have no times: {_USUAL_HZ:g} frames per second are assumed (--fps)")
    frames = tuple(RigFiles(time, tuple(row)) for time, row in zip(times, rows))
    return RigSequence(folder, frames, (*warnings, *more))
