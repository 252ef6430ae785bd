"""Folders of frames as data sets bring them: 7-Scenes, TUM RGB-D, EuRoC/ASL, KITTI odometry, or pictures alone."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from epipole._declared import checked
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io.calibration_files import read_calibration, read_stereo_rig
from epipole.io.contents_in_words import with_what_it_is
from epipole.io.files import file_text
from epipole.io.names import path_inside
from epipole.io.photographs import PhotographList, list_photographs, read_header
from epipole.scene import StereoRig

Time = TypeVar("Time", int, float)
_STEREO_FOLDERS = (("image_0", "image_1"), ("image_l", "image_r"), ("image_2", "image_3"), ("left", "right"))
_SEVEN_SCENES = re.compile(r"frame-(\d{6})\.color\.(?:png|jpg)")
_SEVEN_SCENES_HZ, _PLAIN_HZ = 30.0, 30.0
_KITTI_HZ = 10.0
_TUM_DEPTH_SCALE, _MM = 5000.0, 1000.0
_TUM_NEAREST_S = 0.02
_TUM_LENSES = {
    "freiburg1": (517.306, 516.469, 318.643, 255.314, 0.2624, -0.9531, -0.0054, 0.0026),
    "freiburg2": (520.909, 521.007, 325.141, 249.702, 0.2312, -0.7849, -0.0033, -0.0001),
    "freiburg3": (535.4, 539.2, 320.1, 247.6, 0.0, 0.0, 0.0, 0.0),
}
"""fx, fy, cx, cy, k1, k2, p1, p2 as published with the set; its third radial coefficient is left out, where OPENCV has none."""
_SEVEN_SCENES_FOCAL, _SEVEN_SCENES_DEPTH_FOCAL = 525.505, 585.0
_SEVEN_SCENES_PLACE = np.array([0.0386, -0.0052, -0.0033, -0.0059, -0.0076, -0.0029])
_SEVEN_SCENES_SCALE = 1.0 / 1.0051
"""The set brings depth that is not registered, and no place of the sensor. This one (and the unit) was found by laying depth
of RedKitchen on points triangulated by structure-from-motion poses; the sensor's focal length is the set's own."""


class SequenceKind(StrEnum):
    """The layout of a folder of frames."""

    SEVEN_SCENES = "7-Scenes"
    TUM_RGBD = "TUM RGB-D"
    EUROC = "EuRoC"
    KITTI = "KITTI odometry"
    PICTURES = "pictures"


@dataclass(frozen=True, slots=True)
class FrameFiles:
    """The files of one instant."""

    timestamp_s: float
    picture: Path
    right: Path | None = None
    depth: Path | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SensorDepth:
    """How depth pictures are to be read."""

    unit: float
    """Pixel values for a metre."""
    camera: Camera | None = None
    """Of the sensor; None: the colour camera's, pictures being registered."""
    depth_from_color: Rigid3 | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ImageSequence:
    """Frames in order of time, and what the folder tells of the cameras."""

    kind: SequenceKind
    frames: tuple[FrameFiles, ...]
    camera: Camera | None
    """None where the folder does not tell."""
    rig: StereoRig | None = None
    depth: SensorDepth | None = None
    warnings: tuple[str, ...] = ()
    """What is odd about the lists of frames, in words."""

    def __len__(self) -> int:
        return len(self.frames)

    def __repr__(self) -> str:
        seconds = self.frames[-1].timestamp_s - self.frames[0].timestamp_s
        return f"ImageSequence({self.kind.value}, {len(self)} frames over {seconds:.1f} s)"


@checked
def read_sequence(folder: str | Path, fps: float | None = None) -> ImageSequence:
    """What a folder of frames holds; the layout is seen from its files.

    Args:
        folder: of any of the layouts.
        fps: frames a second of pictures that have no times; None: 30, with a warning.

    Raises:
        FileFormatError: there is no picture, or a file that comes with the layout is damaged.
        ConfigError: fps is given for frames that have times of their own.
    """
    found = _read_sequence(Path(folder), fps)
    if fps is not None and (found.kind is not SequenceKind.PICTURES or _times_file(Path(folder)).is_file()):
        raise ConfigError(
            f"fps is for folders of pictures without times; these ({found.kind.value}) have their own"
        )
    return found


def _read_sequence(folder: Path, fps: float | None) -> ImageSequence:
    if not folder.is_dir():
        if not folder.exists():
            raise FileFormatError(folder, "does not exist")
        problem = "is a file, and neither a video nor a recording that is known here"
        raise FileFormatError(folder, with_what_it_is(problem, folder))
    for at in (folder / "mav0", folder):
        if (at / "cam0" / "data.csv").is_file():
            return _euroc(at)
    if (folder / "rgb.txt").is_file():
        return _tum(folder)
    for left, right in _STEREO_FOLDERS:
        if (folder / left).is_dir() and (folder / right).is_dir():
            return _kitti(folder, folder / left, folder / right)
    _refuse_several(folder)
    listed = list_photographs(folder, ignore=[_times_file(folder)])
    names = listed.names
    if any(_SEVEN_SCENES.fullmatch(name) for name in names):
        return _seven_scenes(folder, names)
    if (folder / "image_0").is_dir():
        return _kitti(folder, folder / "image_0", None)
    return _pictures(listed.require_some(), fps)


def _refuse_several(folder: Path) -> None:
    """Sequences beside each other are not one, though their pictures could be read as one."""
    inside = [sub for sub in sorted(folder.iterdir()) if sub.is_dir() and _is_sequence(sub)]
    if len(inside) > 1:
        names = ", ".join(sub.name for sub in inside[:4]) + (", ..." if len(inside) > 4 else "")
        raise FileFormatError(
            folder, f"holds {len(inside)} sequences ({names}): choose one, {inside[0]} for one"
        )


def _is_sequence(folder: Path) -> bool:
    """Whether a folder has a layout of its own, other than pictures alone."""
    if (
        (folder / "mav0").is_dir()
        or (folder / "cam0" / "data.csv").is_file()
        or (folder / "rgb.txt").is_file()
    ):
        return True
    pairs = any((folder / left).is_dir() and (folder / right).is_dir() for left, right in _STEREO_FOLDERS)
    return pairs or (folder / "image_0").is_dir() or any(folder.glob("frame-*.color.*"))


def _seven_scenes(folder: Path, names: tuple[str, ...]) -> ImageSequence:
    found = [(int(match[1]), match[0]) for name in names if (match := _SEVEN_SCENES.fullmatch(name))]
    frames = []
    for number, name in sorted(found):
        depth = folder / f"frame-{number:06d}.depth.png"
        frames.append(
            FrameFiles(number / _SEVEN_SCENES_HZ, folder / name, None, depth if depth.is_file() else None)
        )
    width, height = _size(frames[0].picture)
    camera = _pinhole(_SEVEN_SCENES_FOCAL, width, height)
    has_depth = all(frame.depth is not None for frame in frames)
    place = Rigid3(Rotation3.exp(_SEVEN_SCENES_PLACE[3:]).matrix, _SEVEN_SCENES_PLACE[:3].copy())
    sensor = _pinhole(_SEVEN_SCENES_DEPTH_FOCAL, width, height)
    depth_of = SensorDepth(_MM / _SEVEN_SCENES_SCALE, sensor, place)
    return ImageSequence(
        SequenceKind.SEVEN_SCENES, tuple(frames), camera, None, depth_of if has_depth else None
    )


def _tum(folder: Path) -> ImageSequence:
    pictures, warnings = _in_order("rgb.txt", _timed_names(folder, "rgb.txt"))
    depths: list[tuple[float, Path]] = []
    if (folder / "depth.txt").is_file():
        depths, more = _in_order("depth.txt", _timed_names(folder, "depth.txt"))
        warnings += more
    times = np.array([time for time, _ in depths])
    frames = []
    for time, picture in pictures:
        near = int(np.argmin(np.abs(times - time))) if len(times) else -1
        depth = depths[near][1] if near >= 0 and abs(times[near] - time) <= _TUM_NEAREST_S else None
        if depth is not None or not depths:
            frames.append(FrameFiles(time, picture, None, depth))
    if not frames:
        raise FileFormatError(folder / "depth.txt", "no depth picture belongs to a colour picture")
    width, height = _size(frames[0].picture)
    lens = next((params for name, params in _TUM_LENSES.items() if name in folder.resolve().name), None)
    camera = None if lens is None else Camera(CameraModel.OPENCV, width, height, np.array(lens))
    told = SensorDepth(_TUM_DEPTH_SCALE) if depths else None
    return ImageSequence(SequenceKind.TUM_RGBD, tuple(frames), camera, None, told, warnings)


def _timed_names(folder: Path, name: str) -> list[tuple[float, Path]]:
    """Rows of a time and a file's name."""
    out = []
    for number, line in enumerate(file_text(folder / name).splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            time, file = float(words[0]), words[1]
        except (ValueError, IndexError) as error:
            raise FileFormatError(
                folder / name, f"line {number}: a time and a file's name expected"
            ) from error
        if not np.isfinite(time):
            raise FileFormatError(folder / name, f"line {number}: the time is not finite")
        out.append((time, path_inside(folder, file)))
    if not out:
        raise FileFormatError(folder / name, "names no picture")
    return out


def _in_order(name: str, rows: list[tuple[Time, Path]]) -> tuple[list[tuple[Time, Path]], tuple[str, ...]]:
    """Rows in order of time, each time once, and what had to be done for it, in words."""
    late = sum(later[0] < earlier[0] for earlier, later in pairwise(rows))
    first = dict(reversed(rows))
    doubled = len(rows) - len(first)
    warnings = [f"{name}: {late} lines are earlier than those before them, and are sorted"] if late else []
    if doubled:
        warnings.append(f"{name}: {doubled} lines repeat a time; of each the first is taken")
    return sorted(first.items()), tuple(warnings)


def _euroc(folder: Path) -> ImageSequence:
    lefts, warnings = _in_order("cam0/data.csv", _timed_names_of_camera(folder / "cam0"))
    rights: dict[int, Path] = {}
    has_right = (folder / "cam1" / "data.csv").is_file()
    if has_right:
        others, more = _in_order("cam1/data.csv", _timed_names_of_camera(folder / "cam1"))
        rights, warnings = dict(others), warnings + more
    frames = tuple(
        FrameFiles(ns * 1e-9, picture, rights.get(ns))
        for ns, picture in lefts
        if not has_right or ns in rights
    )
    frames = tuple(f for f in frames if f.picture.is_file() and (f.right is None or f.right.is_file()))
    if not frames:
        raise FileFormatError(folder / "cam0" / "data.csv", "none of its pictures is there, with one of cam1")
    files = [folder / "cam0" / "sensor.yaml"]
    if not has_right:
        camera = read_calibration(*files).cameras[0]
        return ImageSequence(SequenceKind.EUROC, frames, camera, warnings=warnings)
    rig = read_stereo_rig(*files, folder / "cam1" / "sensor.yaml")
    return ImageSequence(SequenceKind.EUROC, frames, rig.left, rig, warnings=warnings)


def _timed_names_of_camera(folder: Path) -> list[tuple[int, Path]]:
    """Nanoseconds and pictures."""
    out = []
    for number, line in enumerate(file_text(folder / "data.csv").splitlines(), 1):
        words = [word.strip() for word in line.split(",")]
        if not words[0] or words[0].startswith("#"):
            continue
        try:
            nanoseconds = int(words[0])
            if abs(nanoseconds) >= 2**63:
                raise ValueError("no clock counts so far")
            out.append((nanoseconds, path_inside(folder / "data", words[1])))
        except (ValueError, IndexError) as error:
            problem = f"line {number}: a whole number of nanoseconds and a file's name expected"
            raise FileFormatError(folder / "data.csv", problem) from error
    if not out:
        raise FileFormatError(folder / "data.csv", "names no picture")
    return out


def _kitti(folder: Path, left: Path, right: Path | None) -> ImageSequence:
    names = list_photographs(left).require_some().names
    times = _times(folder, len(names), _KITTI_HZ)
    frames = tuple(
        FrameFiles(time, left / name, None if right is None else right / name)
        for time, name in zip(times, names)
    )
    calibration = folder / "calib.txt"
    if not calibration.is_file():
        return ImageSequence(SequenceKind.KITTI, frames, None)
    size = _size(frames[0].picture)
    pair = (2, 3) if left.name == "image_2" else None
    found = read_calibration(calibration, size=size)
    if right is None or len(found.cameras) < 2:
        return ImageSequence(SequenceKind.KITTI, frames, found.cameras[0])
    rig = read_stereo_rig(calibration, size=size, cameras=pair or (0, 1))
    return ImageSequence(SequenceKind.KITTI, frames, rig.left, rig)


def _pictures(listed: PhotographList, fps: float | None) -> ImageSequence:
    folder, names = listed.folder, listed.names
    times = _times(folder, len(names), fps or _PLAIN_HZ)
    frames = tuple(FrameFiles(time, folder / name) for time, name in zip(times, names))
    note = (
        f"the pictures have no times: {_PLAIN_HZ:g} a second are assumed (give fps, or a file times.txt with the seconds"
        " of a picture a line)"
    )
    is_told = fps is not None or _times_file(folder).is_file()
    warnings = (*(() if is_told else (note,)), *listed.notes)
    return ImageSequence(SequenceKind.PICTURES, frames, None, warnings=warnings)


def _times_file(folder: Path) -> Path:
    return folder / "times.txt"


def _times(folder: Path, count: int, rate_hz: float) -> list[float]:
    """Of `times.txt`, a number a line; else as the usual rate has them."""
    path = _times_file(folder)
    if not path.is_file():
        return [n / rate_hz for n in range(count)]
    try:
        times = [float(line) for line in file_text(path).split()]
    except ValueError as error:
        raise FileFormatError(path, f"a number a line expected: {error}") from error
    if len(times) != count or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise FileFormatError(path, f"{count} times that rise expected, for as many pictures")
    return times


def _size(picture: Path) -> tuple[int, int]:
    header = read_header(picture)
    return header.width, header.height


def _pinhole(focal_px: float, width: int, height: int) -> Camera:
    center = [width / 2, height / 2]
    return Camera(CameraModel.PINHOLE, width, height, np.array([focal_px, focal_px, *center]))
