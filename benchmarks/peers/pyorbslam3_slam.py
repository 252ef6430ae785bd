"""Run ORB-SLAM3 (`pyorbslam3`) on a sequence: `PYTHON -m benchmarks.peers.pyorbslam3_slam FRAMES SENSOR OUT VOCABULARY SLOWER`.

PYTHON needs only NumPy and pyorbslam3. Because of its GPL license, pyorbslam3 runs in a separate process and environment.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

from benchmarks.peers.slam_frames import Metronome, SlamFrames, load_frames, save_answers

SAVE_LIMIT_S = 30
"""Time limit for saving the trajectory, which hangs if there is no map."""


class Pyorbslam3Slam:
    """ORB-SLAM3 with the settings of its examples. It gets frames at the camera's rate, because its threads need the time."""

    def __init__(self, python: Path, vocabulary: Path, slower: float = 1.0) -> None:
        self._python, self._vocabulary, self._slower = python, vocabulary, slower
        self.name = "pyorbslam3" if slower == 1.0 else f"pyorbslam3 {slower:g}x slower"

    def version(self) -> str | None:
        """The installed version; None if pyorbslam3 or the vocabulary is missing."""
        code = "from importlib import metadata; import pyorbslam3; print(metadata.version('pyorbslam3'))"
        try:
            done = subprocess.run(
                [str(self._python), "-c", code], capture_output=True, text=True, check=False
            )
        except OSError:
            return None
        return done.stdout.strip() if done.returncode == 0 and self._vocabulary.is_file() else None

    def command(self, frames: Path, sensor: str, out: Path) -> list[str]:
        """The command line of one run."""
        program = [str(self._python), "-m", "benchmarks.peers.pyorbslam3_slam"]
        return [*program, str(frames), sensor, str(out), str(self._vocabulary), str(self._slower)]


def main() -> None:
    """Track every frame at its time; write the poses as estimated on arrival and the final trajectory."""
    folder, sensor, out, vocabulary = Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]), sys.argv[4]
    import pyorbslam3

    frames = load_frames(folder)
    settings = out / "settings.yaml"
    settings.write_text(settings_of(frames, sensor))
    kind = {"mono": "MONOCULAR", "stereo": "STEREO", "rgbd": "RGBD"}[sensor]
    slam = pyorbslam3.Slam(vocabulary, str(settings), getattr(pyorbslam3.Sensor, kind), use_viewer=False)
    ms, causal = [], []
    states: Counter[str] = Counter()
    num_changes = 0
    metronome = Metronome(frames.timestamp_s, float(sys.argv[5]))
    for n in range(len(frames)):
        left, stamp = np.array(frames.left[n]), float(frames.timestamp_s[n])
        right = None if frames.right is None else np.array(frames.right[n])
        depth = None if frames.depth is None else frames.depth[n].astype(np.float32)
        metronome.wait_for(n)
        start = time.perf_counter()
        if sensor == "mono":
            found = slam.track_monocular(left, stamp)
        elif sensor == "stereo":
            found = slam.track_stereo(left, right, stamp)
        else:
            found = slam.track_rgbd(left, depth, stamp)
        ms.append(1e3 * (time.perf_counter() - start))
        num_changes += bool(slam.map_changed())
        states[found.state.name] += 1
        # In the state RECENTLY_LOST the pose is only a prediction of the motion model.
        causal.append(np.array(found.pose_wc) if found.ok and found.pose_wc is not None else None)
    start = time.perf_counter()
    slam.shutdown()
    finish_s = time.perf_counter() - start
    summary = {"states": states, "finish_s": finish_s, "most_late_s": metronome.most_late_s}
    save_answers(out, ms, causal, **summary, num_map_changes=num_changes)
    signal.alarm(SAVE_LIMIT_S)  # after the poses are saved, because without a map saving hangs
    if sensor == "mono":
        slam.save_trajectory_euroc(str(out / "final.csv"))  # the TUM format has only keyframes for one camera
    else:
        slam.save_trajectory_tum(str(out / "final.txt"))


def settings_of(frames: SlamFrames, sensor: str) -> str:
    """ORB-SLAM3's settings file, with the options of its example for such a camera."""
    about = frames.about
    wide = about["width"] > 1000  # the example for KITTI; else those for EuRoC and TUM
    num_features = 2000 if wide else 1200 if sensor == "stereo" else 1000
    rate_hz = (len(frames) - 1) / float(frames.timestamp_s[-1] - frames.timestamp_s[0])
    lines = ["%YAML:1.0", 'File.version: "1.0"', 'Camera.type: "PinHole"']
    for camera in ("Camera1", "Camera2") if sensor == "stereo" else ("Camera1",):
        for name, value in zip(("fx", "fy", "cx", "cy"), about["params"]):
            lines.append(f"{camera}.{name}: {float(value)!r}")
        lines += [f"{camera}.{name}: 0.0" for name in ("k1", "k2", "p1", "p2")]
    lines += [
        f"Camera.width: {about['width']}",
        f"Camera.height: {about['height']}",
        f"Camera.fps: {round(rate_hz)}",
        "Camera.RGB: 1",
    ]
    if sensor == "stereo":
        matrix = np.eye(4)
        matrix[0, 3] = about["baseline_m"]
        data = ", ".join(repr(float(value)) for value in matrix.ravel())
        lines += [
            f"Stereo.ThDepth: {'40.0' if wide else '60.0'}",
            "Stereo.T_c1_c2: !!opencv-matrix",
            "  rows: 4",
            "  cols: 4",
            "  dt: f",
            f"  data: [{data}]",
        ]
    if sensor == "rgbd":
        factor = float(about["depth_factor"])
        lines += ["Stereo.ThDepth: 40.0", "Stereo.b: 0.0745", f"RGBD.DepthMapFactor: {factor!r}"]
    lines += [
        f"ORBextractor.nFeatures: {num_features}",
        "ORBextractor.scaleFactor: 1.2",
        "ORBextractor.nLevels: 8",
        "ORBextractor.iniThFAST: 20",
        "ORBextractor.minThFAST: 7",
    ]
    for name, value in (("KeyFrameSize", 0.05), ("KeyFrameLineWidth", 1.0), ("GraphLineWidth", 0.9)):
        lines.append(f"Viewer.{name}: {value}")
    for name, value in (("PointSize", 2.0), ("CameraSize", 0.08), ("CameraLineWidth", 3.0)):
        lines.append(f"Viewer.{name}: {value}")
    for name, value in (("X", 0.0), ("Y", -0.7), ("Z", -3.5), ("F", 500.0)):
        lines.append(f"Viewer.Viewpoint{name}: {value}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
