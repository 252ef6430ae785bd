"""Sequences for SLAM with ground truth, written once as arrays that both programs read."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from epipole.geometry import Rigid3, Rotation3
from epipole.io.images.depth_maps import read_png16
from epipole.io.images.photographs import read_gray
from epipole.io.sequences.sequence import read_sequence
from epipole.io.trajectories.files import write_trajectory
from epipole.scene import Trajectory
from epipole.synthetic import rides
from epipole.synthetic.ride import Ride

DEPTH_FACTOR = 5000.0
"""Rendered depth is stored as 16 bits in steps of 0.2 mm, up to 13 m."""
FORMAT = 1
"""Version of the cached files; increase it to replace them."""


@dataclass(frozen=True)
class SlamTask:
    """A sequence: its sensors, and a function that writes its frames."""

    sensors: tuple[str, ...]
    write: Callable[[Path, Path], None]
    """Called with the data folder and the folder to write."""
    unit: str = "m"


def prepare(name: str, data: Path, cache: Path) -> Path:
    """The folder with the frames of a sequence, written at the first call.

    Raises:
        FileNotFoundError: the data folder does not have the sequence.
    """
    folder = cache / f"{name}-{FORMAT}"
    if folder.is_dir():
        return folder
    temporary = cache / f".{name}-{os.getpid()}"
    temporary.mkdir(parents=True)
    try:
        TASKS[name].write(data, temporary)
        temporary.rename(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return folder


def truths_of(folder: Path) -> dict[str, Path]:
    """Files of the true trajectories by name, with the timestamps of the frames."""
    return {path.stem.removeprefix("truth_"): path for path in sorted(folder.glob("truth_*.txt"))}


def _arrays(folder: Path, count: int, size: tuple[int, int], names: tuple[str, ...]) -> dict[str, np.memmap]:
    kinds = {"left": np.uint8, "right": np.uint8, "depth": np.uint16}
    shape = (count, size[1], size[0])
    return {
        name: np.lib.format.open_memmap(folder / f"{name}.npy", "w+", kinds[name], shape) for name in names
    }


def _finish(folder: Path, about: dict[str, Any], times: np.ndarray, truths: dict[str, Trajectory]) -> None:
    np.save(folder / "times.npy", times)
    for name, truth in truths.items():
        write_trajectory(truth, folder / f"truth_{name}.txt")
    (folder / "about.json").write_text(json.dumps(about, indent=1))


def _write_ride(make: Callable[[], Ride], *, with_readout: bool = False) -> Callable[[Path, Path], None]:
    def write(_: Path, folder: Path) -> None:
        ride = make()
        camera = ride.camera
        arrays = _arrays(folder, len(ride), (camera.width, camera.height), ("left", "right", "depth"))
        for n in range(len(ride)):
            left = ride.left(n)
            arrays["left"][n], arrays["right"][n] = left.gray, ride.right(n).gray
            arrays["depth"][n] = np.rint(left.depth * DEPTH_FACTOR).astype(np.uint16)
        about = {
            **_camera_facts(camera.width, camera.height, camera.params),
            "baseline_m": ride.baseline,
            "depth_factor": DEPTH_FACTOR,
            "readout_s": ride.shutter.readout_s if with_readout else 0.0,
        }
        _finish(folder, about, ride.timestamp_s, {"exact": ride.truth()})

    return write


def _camera_facts(width: int, height: int, params: np.ndarray) -> dict[str, Any]:
    return {"width": width, "height": height, "params": [float(value) for value in params]}


def _write_7scenes(data: Path, folder: Path) -> None:
    source = _existing(data / "slam" / "7scenes")
    sequence = read_sequence(source)
    camera, depth_sensor, count = sequence.camera, sequence.depth, len(sequence)
    assert camera is not None and depth_sensor is not None and depth_sensor.camera is not None
    assert depth_sensor.depth_from_color is not None
    arrays = _arrays(folder, count, (camera.width, camera.height), ("left", "depth"))
    poses = []
    for n, files in enumerate(sequence.frames):
        assert files.depth is not None
        arrays["left"][n] = read_gray(files.image)
        depth = np.nan_to_num(read_png16(files.depth, 1.0), nan=0.0)
        arrays["depth"][n] = np.where(depth == 65535, 0, depth).astype(np.uint16)
        pose = files.image.name.replace("color.jpg", "pose.txt")
        poses.append(np.loadtxt(source / pose))
    about = {
        **_camera_facts(camera.width, camera.height, camera.params),
        "depth_factor": 1000.0,
        "depth_sensor": {
            "factor": depth_sensor.unit,
            "params": depth_sensor.camera.params.tolist(),
            "depth_from_color": depth_sensor.depth_from_color.as_matrix().tolist(),
        },
    }
    times = np.array([files.timestamp_s for files in sequence.frames])
    rows = np.loadtxt(source / "poses_sfm.txt")
    # The first column has frame numbers at 30 Hz.
    by_sfm = Trajectory(rows[:, 0] / 30.0, Rigid3.from_quat_wxyz(rows[:, [7, 4, 5, 6]], rows[:, 1:4].copy()))
    by_fusion = Trajectory(times, _rigid(np.stack(poses)[:, :3]))
    _finish(folder, about, times, {"sfm": by_sfm, "kinectfusion": by_fusion})


def _write_kitti(name: str, lefts: str, rights: str | None) -> Callable[[Path, Path], None]:
    def write(data: Path, folder: Path) -> None:
        source = _existing(data / "slam" / name)
        files = sorted((source / lefts).glob("*.png"))
        first = read_gray(files[0])
        height, width = first.shape
        arrays = _arrays(folder, len(files), (width, height), ("left", "right") if rights else ("left",))
        for n, file in enumerate(files):
            arrays["left"][n] = read_gray(file)
            if rights:
                arrays["right"][n] = read_gray(source / rights / file.name)
        if rights:
            left, right = np.loadtxt(source / "calib.txt").reshape(2, 3, 4)
            params = left[[0, 1, 0, 1], [0, 1, 2, 2]]
            about = {**_camera_facts(width, height, params), "baseline_m": float(-right[0, 3] / right[0, 0])}
        else:
            about = _camera_facts(width, height, np.loadtxt(source / "intrinsics.txt"))
        times_file = source / "times.txt"
        times = np.loadtxt(times_file) if times_file.is_file() else np.arange(len(files)) / 10.0
        poses = np.loadtxt(source / "poses.txt").reshape(-1, 3, 4)
        _finish(folder, about, times, {"gps": Trajectory(times, _rigid(poses[: len(files)]))})

    return write


def _existing(folder: Path) -> Path:
    if not folder.is_dir():
        raise FileNotFoundError(
            f"There is no folder {folder}: pass the data folder with --data or $EPIPOLE_DATA."
        )
    return folder


def _rigid(matrices: np.ndarray) -> Rigid3:
    """Poses from (n, 3, 4) matrices that a text file has rounded."""
    return Rigid3(Rotation3.nearest(matrices[:, :3, :3]).matrix, matrices[:, :3, 3].copy())


ALL = ("stereo", "rgbd", "mono")
TASKS = {
    "7scenes": SlamTask(("rgbd", "mono"), _write_7scenes),
    "kitti06_stereo": SlamTask(("stereo",), _write_kitti("kitti06_stereo", "image_l", "image_r")),
    "kitti00_mono": SlamTask(("mono",), _write_kitti("kitti00_mono", ".", None)),
    "loop_room": SlamTask(ALL, _write_ride(rides.loop_room)),
    "rotate_only": SlamTask(ALL, _write_ride(rides.rotate_only)),
    "corridor": SlamTask(ALL, _write_ride(rides.corridor)),
    "tiled_room": SlamTask(ALL, _write_ride(rides.tiled_room)),
    "walking_box": SlamTask(ALL, _write_ride(rides.walking_box)),
    "shuttered": SlamTask(ALL, _write_ride(rides.shuttered)),
    "shuttered_told": SlamTask(ALL, _write_ride(rides.shuttered, with_readout=True)),
    "unshuttered": SlamTask(ALL, _write_ride(lambda: rides.shuttered(readout_s=0.0))),
}
