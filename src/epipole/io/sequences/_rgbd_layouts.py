"""RGB-D folders: 7-Scenes and similar, ScanNet, TUM RGB-D."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from epipole.cameras import Camera
from epipole.errors import FileFormatError
from epipole.io.calibration.beside import (
    DEPTH_MATRICES,
    EXTRINSICS,
    CalibrationBeside,
    calibration_beside,
    is_identity,
    read_matrix_camera,
)
from epipole.io.calibration.built_in import (
    SEVEN_SCENES_DEPTH_SCALE,
    seven_scenes_cameras,
    tum_camera,
)
from epipole.io.files import file_text
from epipole.io.images.depth_units import (
    MM_VALUES_PER_M,
    TUM_VALUES_PER_M,
    decide_unit,
    is_plausible,
    sample_depth,
)
from epipole.io.images.photographs import list_photographs, read_header
from epipole.io.sequences._data import FrameFiles, ImageSequence, SensorDepth, SequenceKind
from epipole.io.sequences._lists import in_order, in_seconds, timed_names

NUMBERED_FRAME = re.compile(r"frame-(\d{6,9})\.color\.\w+")
FRAMES_HZ = 30.0
_TUM_NEAREST_S = 0.02
CALIBRATION_NOT_USED = "its calibration is not used"
_SEVEN_SCENES = "7-Scenes by its file names"


def numbered_frames(folder: Path, names: tuple[str, ...]) -> ImageSequence:
    """Read `frame-NNNNNN.color.*` with depth: 7-Scenes, unless a calibration file or the images contradict it."""
    found = sorted((int(match[1]), match[0]) for name in names if (match := NUMBERED_FRAME.fullmatch(name)))
    frames = []
    for number, name in found:
        depth = folder / f"{name.split('.color.')[0]}.depth.png"
        frames.append(FrameFiles(number / FRAMES_HZ, folder / name, None, depth if depth.is_file() else None))
    size = _size(frames[0].image)
    beside = calibration_beside((folder, folder.resolve().parent), size)
    depths = [frame.depth for frame in frames if frame.depth is not None]
    sample = sample_depth(depths)
    warnings = _warnings_about_seven_scenes(size, sample)
    sequence = ImageSequence(SequenceKind.SEVEN_SCENES, tuple(frames), None)
    if (not beside.is_found and not warnings) or _is_seven_scenes_depth_camera(beside.camera):
        return _of_seven_scenes(sequence, has_depth=len(depths) == len(frames))
    sequence = replace(
        sequence,
        kind=SequenceKind.RGBD_FRAMES,
        camera=beside.camera,
        camera_source=beside.source,
        camera_problem=beside.problem,
        warnings=() if beside.is_found else warnings,
    )
    return _with_depth(sequence, sample, beside) if len(depths) == len(frames) else sequence


def _is_seven_scenes_depth_camera(camera: Camera | None) -> bool:
    """3DMatch ships 7-Scenes with a file that describes the depth camera, which is not the color camera."""
    if camera is None:
        return False
    _, depth, _ = seven_scenes_cameras()
    return (camera.width, camera.height) == (depth.width, depth.height) and np.array_equal(
        camera.params, depth.params
    )


def _warnings_about_seven_scenes(size: tuple[int, int], sample: np.ndarray) -> tuple[str, ...]:
    """How the images differ from 7-Scenes; if they do, its calibration is not used."""
    color, _, _ = seven_scenes_cameras()
    words = "the files are named as in 7-Scenes, but"
    if size != (color.width, color.height):
        return (
            f"{words} the images are {size[0]} x {size[1]}, not {color.width} x {color.height}: {CALIBRATION_NOT_USED}",
        )
    if not is_plausible(sample, MM_VALUES_PER_M):
        return (f"{words} the depth is not in millimeters: {CALIBRATION_NOT_USED}",)
    return ()


def _of_seven_scenes(sequence: ImageSequence, *, has_depth: bool) -> ImageSequence:
    color, sensor, depth_from_color = seven_scenes_cameras()
    source = f"assumed to be {_SEVEN_SCENES}"
    depth = SensorDepth(SEVEN_SCENES_DEPTH_SCALE, sensor, depth_from_color, source)
    return replace(sequence, camera=color, camera_source=source, depth=depth if has_depth else None)


def _with_depth(sequence: ImageSequence, sample: np.ndarray, beside: CalibrationBeside) -> ImageSequence:
    """Add depth as in the info file, or else registered to color, in millimeters unless the values contradict it."""
    info = beside.info
    if info is not None and info.problem:
        return replace(
            sequence, warnings=(*sequence.warnings, f"the depth images are not used: {info.problem}")
        )
    camera = None if info is None else info.camera
    if info is not None and info.values_per_m is not None:
        depth = SensorDepth(info.values_per_m, camera, None, f"m_depthShift in {beside.source}")
        return replace(sequence, depth=depth)
    unit = decide_unit(sample, MM_VALUES_PER_M, "millimeters, the default for this layout")
    depth = SensorDepth(unit.values_per_m, camera, None, unit.source)
    return replace(sequence, depth=depth, warnings=(*sequence.warnings, *unit.warnings))


def is_scannet(folder: Path) -> bool:
    """Whether there are images in `color` together with depth, poses, or a calibration in `intrinsic`."""
    return (folder / "color").is_dir() and any(
        (folder / name).is_dir() for name in ("depth", "intrinsic", "pose")
    )


def scannet(folder: Path) -> ImageSequence:
    """Read ScanNet as exported by its reader: `color/N.jpg`, `depth/N.png`, `pose/N.txt`, and matrices in `intrinsic`."""
    names = list_photographs(folder / "color").names
    if not names:
        raise FileFormatError(folder / "color", "it contains no images")
    stems = [Path(name).stem for name in names]
    odd = next((stem for stem in stems if not (stem.isascii() and stem.isdecimal() and len(stem) < 10)), None)
    if odd is not None:
        raise FileFormatError(folder / "color", f"{odd} is not a frame number")
    frames = []
    for number, name in sorted(zip(map(int, stems), names)):
        depth = folder / "depth" / f"{Path(name).stem}.png"
        image = folder / "color" / name
        frames.append(FrameFiles(number / FRAMES_HZ, image, None, depth if depth.is_file() else None))
    beside = calibration_beside((folder,), _size(frames[0].image))
    sequence = ImageSequence(
        SequenceKind.SCANNET,
        tuple(frames),
        beside.camera,
        camera_source=beside.source,
        camera_problem=beside.problem,
    )
    depths = [frame.depth for frame in frames if frame.depth is not None]
    if len(depths) < len(frames):
        return sequence
    moved = next((folder / name for name in EXTRINSICS if not _is_identity_file(folder / name)), None)
    if moved is not None:
        words = f"the depth images are not used: {moved.name} is not the identity, so depth is not registered"
        return replace(sequence, warnings=(words,))
    sequence = _with_depth(sequence, sample_depth(depths), beside)
    return replace(sequence, depth=_own_depth_camera(folder, sequence, depths[0]))


def _own_depth_camera(folder: Path, sequence: ImageSequence, first: Path) -> SensorDepth | None:
    """Depth images that differ in size from the color images have their own camera at the color camera's pose."""
    depth = sequence.depth
    path = next((folder / name for name in DEPTH_MATRICES if (folder / name).is_file()), None)
    if depth is None or depth.camera is not None or path is None:
        return depth
    return replace(depth, camera=read_matrix_camera(path, _size(first)))


def _is_identity_file(path: Path) -> bool:
    if not path.is_file():
        return True
    try:
        return is_identity([float(word) for word in file_text(path).split()])
    except ValueError:
        return False


def tum(folder: Path) -> ImageSequence:
    """Read `rgb.txt` and `depth.txt`, with the camera from a calibration file or else from the folder's name."""
    images, warnings = in_order("rgb.txt", in_seconds(timed_names(folder, "rgb.txt")))
    depths: list[tuple[float, Path]] = []
    if (folder / "depth.txt").is_file():
        depths, more = in_order("depth.txt", in_seconds(timed_names(folder, "depth.txt")))
        warnings += more
    times = np.array([time for time, _ in depths])
    frames = []
    for time, image in images:
        near = int(np.argmin(np.abs(times - time))) if len(times) else -1
        depth = depths[near][1] if near >= 0 and abs(times[near] - time) <= _TUM_NEAREST_S else None
        if depth is not None or not depths:
            frames.append(FrameFiles(time, image, None, depth))
    if not frames:
        raise FileFormatError(folder / "depth.txt", "no depth image matches a color image in time")
    sequence = ImageSequence(SequenceKind.TUM_RGBD, tuple(frames), None, warnings=warnings)
    sequence = _with_tum_camera(sequence, folder)
    if not depths:
        return sequence
    unit = decide_unit(
        sample_depth([frame.depth for frame in frames if frame.depth is not None]),
        TUM_VALUES_PER_M,
        "TUM RGB-D layout",
    )
    sensor = SensorDepth(unit.values_per_m, unit_source=unit.source)
    return replace(sequence, depth=sensor, warnings=(*warnings, *unit.warnings))


def _with_tum_camera(sequence: ImageSequence, folder: Path) -> ImageSequence:
    beside = calibration_beside((folder,), _size(sequence.frames[0].image))
    proposed = tum_camera(folder.resolve().name)
    if beside.is_found or proposed is None:
        return replace(
            sequence, camera=beside.camera, camera_source=beside.source, camera_problem=beside.problem
        )
    name, camera = proposed
    return replace(sequence, camera=camera, camera_source=f"{name} of TUM RGB-D, from the folder name")


def _size(image: Path) -> tuple[int, int]:
    header = read_header(image)
    return header.width, header.height
