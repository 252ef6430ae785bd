"""Frames of a sequence as arrays on disk, from which both SLAM programs read. Needs only NumPy."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class SlamFrames:
    """A sequence on disk."""

    about: dict[str, Any]
    """width, height, params (fx, fy, cx, cy), baseline_m, depth_factor (depth values per meter), ..."""
    timestamp_s: np.ndarray
    left: np.ndarray
    """(n, h, w), grayscale."""
    right: np.ndarray | None
    depth: np.ndarray | None
    """(n, h, w), 16 bits; 0 is unknown."""

    def __len__(self) -> int:
        return len(self.timestamp_s)


def load_frames(folder: Path) -> SlamFrames:
    """Open the arrays that `tasks.slam.prepare` wrote."""

    def opened(name: str) -> np.ndarray | None:
        path = folder / f"{name}.npy"
        return np.load(path, mmap_mode="r") if path.is_file() else None

    left = opened("left")
    assert left is not None
    about = json.loads((folder / "about.json").read_text())
    return SlamFrames(about, np.load(folder / "times.npy"), left, opened("right"), opened("depth"))


class Metronome:
    """Clock that releases frames at the camera's rate; late frames are released at once, and none is dropped."""

    def __init__(self, timestamp_s: np.ndarray, slower: float = 1.0) -> None:
        self._due = slower * (timestamp_s - timestamp_s[0])
        self._start = time.perf_counter()
        self.most_late_s = 0.0

    def wait_for(self, frame: int) -> None:
        """Sleep until the camera would have delivered the frame."""
        ahead = self._start + self._due[frame] - time.perf_counter()
        self.most_late_s = max(self.most_late_s, -ahead)
        if ahead > 0:
            time.sleep(ahead)


def save_answers(out: Path, ms: list[float], causal: list[np.ndarray | None], **summary: Any) -> None:
    """Write milliseconds and world_from_camera (n, 4, 4) of each frame as estimated on arrival, and a summary."""
    poses = np.stack([np.full((4, 4), np.nan) if pose is None else pose for pose in causal])
    np.savez(out / "causal.npz", ms=np.array(ms), world_from_camera=poses)
    (out / "summary.json").write_text(json.dumps(summary))
