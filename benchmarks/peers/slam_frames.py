"""Frames of a sequence as both SLAM programs get them: arrays on disk, read before the clock runs. Needs NumPy alone."""

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
    """Width, height, params (fx, fy, cx, cy), baseline_m, depth_factor (values for a metre, as the depth comes), ..."""
    timestamp_s: np.ndarray
    left: np.ndarray
    """(n, h, w) grey."""
    right: np.ndarray | None
    depth: np.ndarray | None
    """(n, h, w) of 16 bits, 0 for none."""

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
    """Gives the frames one at a time at the rate of the camera; one that comes late is given at once, none is dropped."""

    def __init__(self, timestamp_s: np.ndarray, slower: float = 1.0) -> None:
        self._due = slower * (timestamp_s - timestamp_s[0])
        self._start = time.perf_counter()
        self.most_late_s = 0.0

    def wait_for(self, frame: int) -> None:
        """Sleep until the frame would have come from the camera."""
        ahead = self._start + self._due[frame] - time.perf_counter()
        self.most_late_s = max(self.most_late_s, -ahead)
        if ahead > 0:
            time.sleep(ahead)


def save_answers(out: Path, ms: list[float], causal: list[np.ndarray | None], **more: Any) -> None:
    """Write what a program answered while the frames came: milliseconds, world_from_camera (n, 4, 4), and a summary."""
    positions = np.stack([np.full((4, 4), np.nan) if position is None else position for position in causal])
    np.savez(out / "causal.npz", ms=np.array(ms), world_from_camera=positions)
    (out / "summary.json").write_text(json.dumps(more))
