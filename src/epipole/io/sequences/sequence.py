"""Reading folders of frames: 7-Scenes, ScanNet, TUM RGB-D, EuRoC/ASL, KITTI odometry, or images only."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from epipole._checks import checked
from epipole.errors import ConfigError, EpipoleError, FileFormatError
from epipole.io.calibration.beside import CalibrationBeside, calibration_beside, check_fits
from epipole.io.calibration.files import read_calibration, read_stereo_rig
from epipole.io.contents_in_words import with_what_it_is
from epipole.io.files import missing_in_words
from epipole.io.images.photographs import PhotographList, list_photographs, read_header
from epipole.io.sequences._data import FrameFiles as FrameFiles
from epipole.io.sequences._data import ImageSequence as ImageSequence
from epipole.io.sequences._data import SensorDepth as SensorDepth
from epipole.io.sequences._data import SequenceKind as SequenceKind
from epipole.io.sequences._lists import TIMES, by_number, in_order, timed_names_of_camera, times_of
from epipole.io.sequences._rgbd_layouts import CALIBRATION_NOT_USED as CALIBRATION_NOT_USED
from epipole.io.sequences._rgbd_layouts import FRAMES_HZ as FRAMES_HZ
from epipole.io.sequences._rgbd_layouts import NUMBERED_FRAME, is_scannet, numbered_frames, scannet, tum

_STEREO_FOLDERS = (("image_0", "image_1"), ("image_l", "image_r"), ("image_2", "image_3"), ("left", "right"))
_PLAIN_HZ, _KITTI_HZ = 30.0, 10.0
_GIVEN = "given"


@checked
def read_sequence(
    folder: str | Path, fps: float | None = None, depth_scale: float | None = None
) -> ImageSequence:
    """Read a folder of frames. File names suggest the layout; calibration files and image content confirm it.

    Args:
        folder: a folder in any of the supported layouts.
        fps: frames per second of images without times; None: 30, with a warning.
        depth_scale: stored depth values per meter, such as 1000 for millimeters; None: from the files and the layout.

    Raises:
        FileFormatError: there are no images, or a file that belongs to the layout is damaged.
        ConfigError: fps is given for frames that have times, or depth_scale for frames without depth.
    """
    found = _read_sequence(Path(folder), fps)
    if fps is not None and (found.kind is not SequenceKind.IMAGES or (Path(folder) / TIMES).is_file()):
        raise ConfigError(
            f"fps is only for folders of images without times; these ({found.kind.value}) have times"
        )
    if depth_scale is None:
        return found
    if not 0 < depth_scale < 1e6:
        raise ConfigError(f"depth_scale must be positive and below a million, got {depth_scale}")
    if found.depth is None:
        raise ConfigError(
            f"depth_scale = {depth_scale:g} needs depth images, but {folder} has none for its frames"
        )
    warnings = tuple(words for words in found.warnings if not words.startswith("depth is read with"))
    depth = replace(found.depth, unit=float(depth_scale), unit_source=_GIVEN)
    return replace(found, depth=depth, warnings=warnings)


def _read_sequence(folder: Path, fps: float | None) -> ImageSequence:
    if not folder.is_dir():
        if not folder.exists():
            raise FileFormatError(folder, missing_in_words(folder))
        problem = "a file that is neither a supported video nor a supported recording"
        raise FileFormatError(folder, with_what_it_is(problem, folder))
    for at in (folder / "mav0", folder):
        if (at / "cam0" / "data.csv").is_file():
            return _euroc(at)
    if (folder / "rgb.txt").is_file():
        return tum(folder)
    for left, right in _STEREO_FOLDERS:
        if (folder / left).is_dir() and (folder / right).is_dir():
            return _kitti(folder, folder / left, folder / right)
    if is_scannet(folder):
        return scannet(folder)
    _refuse_several(folder)
    listed = list_photographs(folder, ignore=[folder / TIMES])
    names = listed.names
    if any(NUMBERED_FRAME.fullmatch(name) for name in names):
        return numbered_frames(folder, names)
    if (folder / "image_0").is_dir():
        return _kitti(folder, folder / "image_0", None)
    return _images(listed.require_some(), fps)


def _refuse_several(folder: Path) -> None:
    """Reject a folder that contains several sequences, whose images could otherwise be read as one."""
    inside = [sub for sub in sorted(folder.iterdir()) if sub.is_dir() and _is_sequence(sub)]
    if len(inside) > 1:
        names = ", ".join(sub.name for sub in inside[:4]) + (", ..." if len(inside) > 4 else "")
        raise FileFormatError(
            folder, f"it contains {len(inside)} sequences ({names}): choose one, for example {inside[0]}"
        )


def _is_sequence(folder: Path) -> bool:
    if (
        (folder / "mav0").is_dir()
        or (folder / "cam0" / "data.csv").is_file()
        or (folder / "rgb.txt").is_file()
    ):
        return True
    pairs = any((folder / left).is_dir() and (folder / right).is_dir() for left, right in _STEREO_FOLDERS)
    return pairs or is_scannet(folder) or (folder / "image_0").is_dir() or any(folder.glob("frame-*.color.*"))


def _euroc(folder: Path) -> ImageSequence:
    lefts, warnings = in_order("cam0/data.csv", timed_names_of_camera(folder / "cam0"))
    rights: dict[int, Path] = {}
    has_right = (folder / "cam1" / "data.csv").is_file()
    if has_right:
        others, more = in_order("cam1/data.csv", timed_names_of_camera(folder / "cam1"))
        rights, warnings = dict(others), warnings + more
    frames = tuple(
        FrameFiles(ns * 1e-9, image, rights.get(ns)) for ns, image in lefts if not has_right or ns in rights
    )
    frames = tuple(f for f in frames if f.image.is_file() and (f.right is None or f.right.is_file()))
    if not frames:
        raise FileFormatError(
            folder / "cam0" / "data.csv",
            "none of its images exists (in stereo, together with the matching one of cam1)",
        )
    files, source = [folder / "cam0" / "sensor.yaml"], "cam0/sensor.yaml"
    sequence = ImageSequence(SequenceKind.EUROC, frames, None, warnings=warnings, camera_source=source)
    if not has_right:
        return replace(sequence, camera=read_calibration(*files).cameras[0])
    rig = read_stereo_rig(*files, folder / "cam1" / "sensor.yaml")
    return replace(sequence, camera=rig.left, rig=rig, camera_source=f"{source} and cam1/sensor.yaml")


def _kitti(folder: Path, left: Path, right: Path | None) -> ImageSequence:
    names = by_number(list_photographs(left).require_some().names)
    times, warnings = times_of(folder, names, _KITTI_HZ)
    frames = tuple(
        FrameFiles(time, left / name, None if right is None else right / name)
        for time, name in zip(times, names)
    )
    calibration = folder / "calib.txt"
    sequence = ImageSequence(SequenceKind.KITTI, frames, None, warnings=warnings)
    size = _size(frames[0].image)
    if not calibration.is_file():
        return _with_camera(sequence, calibration_beside((folder, left), size))
    pair = (2, 3) if left.name == "image_2" else (0, 1)
    found = read_calibration(calibration, size=size)
    try:
        for camera in found.cameras:
            check_fits(calibration, camera, (camera.width, camera.height))
    except EpipoleError as error:
        return replace(sequence, camera_problem=str(error))
    if right is None or len(found.cameras) < 2:
        return replace(sequence, camera=found.cameras[0], camera_source=f"P0 of {calibration.name}")
    rig = read_stereo_rig(calibration, size=size, cameras=pair)
    source = f"P{pair[0]} and P{pair[1]} of {calibration.name}"
    return replace(sequence, camera=rig.left, rig=rig, camera_source=source)


def _images(listed: PhotographList, fps: float | None) -> ImageSequence:
    folder, names = listed.folder, by_number(listed.names)
    times, warnings = times_of(folder, names, fps or _PLAIN_HZ)
    frames = tuple(FrameFiles(time, folder / name) for time, name in zip(times, names))
    note = (
        f"the images have no times, so {_PLAIN_HZ:g} per second are assumed (pass fps, or write a file times.txt with the time of one"
        " image in seconds per line)"
    )
    is_given = fps is not None or (folder / TIMES).is_file()
    warnings = (*warnings, *(() if is_given else (note,)), *listed.notes)
    sequence = ImageSequence(SequenceKind.IMAGES, frames, None, warnings=warnings)
    return _with_camera(sequence, calibration_beside((folder,), _size(frames[0].image)))


def _with_camera(sequence: ImageSequence, beside: CalibrationBeside) -> ImageSequence:
    return replace(sequence, camera=beside.camera, camera_source=beside.source, camera_problem=beside.problem)


def _size(image: Path) -> tuple[int, int]:
    header = read_header(image)
    return header.width, header.height
