"""Ground-truth camera trajectories, from a file or a dataset folder."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from epipole.errors import FileFormatError
from epipole.geometry import Rigid3
from epipole.io.calibration.files import read_body_from_camera
from epipole.io.files import file_text
from epipole.io.sequences.sequence import FRAMES_HZ
from epipole.io.trajectories.files import TrajectoryReading, read_pose_matrix, read_trajectory_columns
from epipole.scene import Trajectory

FILES_OF_FOLDERS = ("groundtruth.txt", "poses.txt")
"""TUM RGB-D and KITTI."""
FILES_OF_EUROC = tuple(f"{root}state_groundtruth_estimate0/data.csv" for root in ("mav0/", ""))
_POSES = (("", re.compile(r"frame-(\d{6,9})\.pose\.txt")), ("pose", re.compile(r"(\d{1,9})\.txt")))
"""Sub-folder and file names: 7-Scenes and similar, ScanNet."""
_INFINITE = re.compile(r"[-+]?(?:inf|nan)", re.IGNORECASE)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """A ground-truth trajectory."""

    path: Path
    """The file it was read from."""
    trajectory: Trajectory
    assumptions: tuple[str, ...] = ()
    """Assumptions made where the file is ambiguous, as sentences."""

    @property
    def has_times(self) -> bool:
        """Whether the file has times; otherwise it has one row per frame (KITTI)."""
        return self.trajectory.is_timed


def true_path_at(path: Path) -> Truth:
    """Read a ground-truth trajectory from a file or a dataset folder (7-Scenes, ScanNet, TUM RGB-D, KITTI, EuRoC).

    EuRoC's is that of the IMU; within a EuRoC folder it is converted to the left camera with T_BS.

    Raises:
        FileFormatError: the file is not a trajectory, or the folder has none.
    """
    if path.is_dir():
        return _of_folder(path)
    return truth_of_camera(path, read_trajectory_columns(path))


def truth_of_camera(path: Path, reading: TrajectoryReading) -> Truth:
    """The trajectory of a file, converted to the left camera in a EuRoC folder."""
    said = () if reading.columns.is_plain else (f"{path.name}: {reading.columns.words()}",)
    sensor = camera_of_euroc(path)
    if reading.columns.format != "euroc" or sensor is None:
        return Truth(path, reading.trajectory, said)
    trajectory = reading.trajectory
    positions = trajectory.world_from_body @ read_body_from_camera(sensor)
    words = f"{path.name}: converted from the IMU to the left camera with T_BS from cam0/sensor.yaml"
    return Truth(path, Trajectory(trajectory.timestamp_s, positions), (*said, words))


def camera_of_euroc(path: Path) -> Path | None:
    """The file with the left camera's extrinsics, if the given file is in a EuRoC folder."""
    folder = path.resolve().parent
    for at in (folder.parent, folder, folder / "mav0"):
        if (at / "cam0" / "sensor.yaml").is_file():
            return at / "cam0" / "sensor.yaml"
    return None


def has_true_path(folder: Path) -> bool:
    """Whether a folder has a trajectory that `true_path_at` can read."""
    return _file_of(folder) is not None or bool(_poses_of(folder))


def _file_of(folder: Path) -> Path | None:
    for name in FILES_OF_FOLDERS:
        if (folder / name).is_file():
            return folder / name
    for path in (*(folder / name for name in FILES_OF_EUROC), *sorted(folder.glob("*.csv"))):
        if path.is_file() and camera_of_euroc(path) is not None:
            return path
    return None


def _poses_of(folder: Path) -> list[tuple[int, Path]]:
    for inside, pattern in _POSES:
        at = folder / inside
        names = sorted(at.iterdir()) if at.is_dir() else []
        found = [(int(match[1]), path) for path in names if (match := pattern.fullmatch(path.name))]
        if found:
            return sorted(found)
    return []


def _of_folder(folder: Path) -> Truth:
    path = _file_of(folder)
    if path is not None:
        return true_path_at(path)
    files = _poses_of(folder)
    known = [(number, read_pose_matrix(file)) for number, file in files if not _is_unknown(file)]
    if not known:
        raise FileFormatError(
            folder,
            f"found no ground-truth trajectory ({', '.join(FILES_OF_FOLDERS)}, frame-*.pose.txt, pose/*.txt)",
        )
    positions = Rigid3(
        np.stack([pose.rotation for _, pose in known]), np.stack([pose.translation for _, pose in known])
    )
    times = np.array([number / FRAMES_HZ for number, _ in known])
    lacking = len(files) - len(known)
    said = (
        (f"{lacking} of {len(files)} pose files have no finite numbers and are skipped",) if lacking else ()
    )
    pattern = f"*{files[0][1].suffixes[0]}{''.join(files[0][1].suffixes[1:])}"
    return Truth(files[0][1].parent / pattern, Trajectory(times, positions), said)


def _is_unknown(path: Path) -> bool:
    """Whether at least half of a pose file's numbers are infinite or NaN, as ScanNet writes for a frame without a pose."""
    words = file_text(path).split()
    return bool(words) and sum(bool(_INFINITE.fullmatch(word)) for word in words) >= len(words) // 2
