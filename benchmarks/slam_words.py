"""Train the visual words with which SLAM finds similar images: `python -m benchmarks.slam_words DATA`.

The training images are photographs of buildings, statues and rooms. None is from a sequence on which SLAM is measured.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from epipole.features import describe_upright, train_vocabulary
from epipole.io.images.photographs import read_gray
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.loops.recognition import WORDS
from epipole.pipelines.slam.tracking.corners import new_corners

SETS = ("sfm", "failure/moving_person", "failure/panorama", "calibration/opencv_stereo", "twoview/graf")
NUM_WORDS = 64


def main(data: Path) -> None:
    """Cluster the descriptors of corners in all photographs, and save the words."""
    described = []
    for folder in SETS:
        for path in sorted(
            p for p in (data / folder).rglob("*") if p.suffix.lower() in (".jpg", ".png", ".ppm")
        ):
            gray = read_gray(path)
            step = max(1, gray.shape[1] // 640)
            gray = np.ascontiguousarray(gray[::step, ::step])
            corners = new_corners(gray, np.zeros((0, 2)), SlamConfig())
            described.append(describe_upright(gray, corners))
    words = train_vocabulary(described, NUM_WORDS, rounds=50)
    np.save(WORDS, np.rint(words).astype(np.uint8))
    print(f"{len(described)} photographs, {len(words)} words")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
