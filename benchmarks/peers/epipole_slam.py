"""Run epipole's `Slam` on a sequence: `python -m benchmarks.peers.epipole_slam FRAMES SENSOR OUT`."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import numpy as np

from benchmarks.peers.slam_frames import SlamFrames, load_frames, save_answers

WARM_UP_FRAMES = 12


class EpipoleSlam:
    """epipole's `Slam`, which gets frames as fast as it processes them because its results do not depend on time."""

    name = "epipole"

    def version(self) -> str | None:
        """The installed version; None if it is not installed."""
        try:
            return metadata.version("epipole")
        except metadata.PackageNotFoundError:
            return None

    def command(self, frames: Path, sensor: str, out: Path) -> list[str]:
        """The command line of one run."""
        return [sys.executable, "-m", "benchmarks.peers.epipole_slam", str(frames), sensor, str(out)]


def main() -> None:
    """Track every frame, then finish the map; write the poses as estimated on arrival and the final trajectory."""
    folder, sensor, out = Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3])
    from epipole.io.trajectories.files import write_trajectory
    from epipole.pipelines.slam.shutter.check import find_readout
    from epipole.pipelines.slam.slam import Slam

    frames = load_frames(folder)
    camera = camera_of(frames, sensor)
    warm_up = Slam(camera)  # compiles the kernels, or reads them from disk
    for frame in frames_of(frames, sensor, WARM_UP_FRAMES):
        warm_up.track(frame)
    warm_up.finish()
    slam, ms, causal = Slam(camera), [], []
    states: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    for frame in frames_of(frames, sensor, len(frames)):
        start = time.perf_counter()
        found = slam.track(frame)
        ms.append(1e3 * (time.perf_counter() - start))
        causal.append(None if found.world_from_body is None else found.world_from_body.as_matrix())
        states[found.state.value] += 1
        if found.world_from_body is None:
            reasons["".join("#" if c.isdigit() else c for c in found.reason)] += 1
    start = time.perf_counter()
    slam.finish()
    finish_s = time.perf_counter() - start
    trajectory = slam.trajectory()
    readout = None if camera.readout_s else find_readout(slam.odometry.mapper, trajectory)
    if len(trajectory):
        write_trajectory(trajectory, out / "final.txt")
    summary = {
        "states": states,
        "reasons": reasons,
        "finish_s": finish_s,
        "num_keyframes": len(slam.map.keyframes),
        "readout_found_s": None if readout is None else readout.readout_s,
    }
    save_answers(out, ms, causal, **summary)


def camera_of(frames: SlamFrames, sensor: str):
    """The camera of a sequence as `Slam` takes it."""
    from epipole.cameras import Camera, CameraModel
    from epipole.geometry import Rigid3
    from epipole.pipelines.slam.frames import DepthCamera, SlamCamera

    about = frames.about
    size = (about["width"], about["height"])
    camera = Camera(CameraModel.PINHOLE, *size, np.array(about["params"]))
    readout_s = about.get("readout_s", 0.0)
    if sensor == "stereo":
        return SlamCamera(camera, about["baseline_m"], readout_s=readout_s)
    if sensor == "mono":
        return SlamCamera(camera, readout_s=readout_s)
    depth_sensor, depth = about.get("depth_sensor"), DepthCamera(camera, Rigid3.identity())
    if depth_sensor is not None:
        depth_from_color = Rigid3.from_matrix(np.array(depth_sensor["depth_from_color"]))
        depth_camera = Camera(CameraModel.PINHOLE, *size, np.array(depth_sensor["params"]))
        depth = DepthCamera(depth_camera, depth_from_color)
    return SlamCamera(camera, None, depth, readout_s)


def frames_of(frames: SlamFrames, sensor: str, count: int) -> Iterator:
    """The first `count` frames as `Slam` takes them."""
    from epipole.pipelines.slam.frames import Frame

    factor = frames.about.get("depth_sensor", {}).get("factor", frames.about.get("depth_factor"))
    for n in range(min(count, len(frames))):
        right, depth = None, None
        if sensor == "stereo":
            right = np.array(frames.right[n])
        if sensor == "rgbd":
            depth = (frames.depth[n] / np.float32(factor)).astype(np.float32)
        yield Frame(float(frames.timestamp_s[n]), np.array(frames.left[n]), right, depth)


if __name__ == "__main__":
    main()
