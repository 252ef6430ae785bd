"""Learned features and SIFT on wide pairs: `python -m benchmarks.learned_matches FOLDER_WITH_WEIGHTS`.

Pairs are grouped by the angle between their viewing directions; those that are rolled against each other, as half of the temple
ring's, are left out, because the networks match upright images only. A match is right if both pixels are within 4 px of each other's epipolar line, with the true poses and intrinsics; one
match in a hundred is so by chance. Pairs are then verified as in structure-from-motion. Times are of one thread.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.matches import WRONG_PX, epipolar_distances
from benchmarks.measure import REPOSITORY, describe_machine
from benchmarks.tasks.sfm import SfmTask, data_root, prepare
from epipole._parallel import set_num_threads
from epipole.cameras import Camera
from epipole.config import RansacConfig
from epipole.features import detect_features, match_descriptors
from epipole.features.learned import LearnedFeatures, match_mutual_nearest
from epipole.geometry.epipolar import essential_from_cam2_from_cam1, fundamental_from_essential
from epipole.io.truth import read_truth
from epipole.robust import PairKind, PairMatches, verify_pairs

BANDS_DEG = {
    "fountain-P11": ((30.0, 60.0), (60.0, 120.0)),
    "temple_ring": ((30.0, 45.0), (45.0, 60.0), (60.0, 90.0)),
}
"""Ranges of the angle between viewing directions, in degrees."""
MAX_ROLL_DEG = 45.0
MIN_RIGHT = 30
"""A pair with fewer right matches can hardly be verified."""
MAX_ROTATION_DEG = 3.0
"""Rotation error up to which a pose is right."""
Detect = Callable[[np.ndarray], Any]
Match = Callable[[Any, Any, tuple[int, int]], np.ndarray]


def main() -> None:
    """Match the pairs by every method, and print a table for each set."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("weights", type=Path)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--most-pairs", type=int, default=8, help="per range, evenly spaced in angle")
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    arguments = parser.parse_args()
    set_num_threads(1)
    cv2.setNumThreads(1)
    xfeat, aliked = LearnedFeatures(arguments.weights), LearnedFeatures(arguments.weights, "aliked")

    methods: dict[str, tuple[Detect, Match]] = {
        "SIFT": (
            lambda rgb: detect_features(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)),
            lambda first, second, _: match_descriptors(first.descriptors, second.descriptors),
        ),
        "XFeat 4096, mutual nearest": (
            lambda rgb: xfeat.detect(rgb, 4096),
            lambda first, second, _: match_mutual_nearest(first.descriptors, second.descriptors),
        ),
        "XFeat 2048, LighterGlue": (
            lambda rgb: xfeat.detect(rgb, 2048),
            lambda first, second, size: xfeat.match(first, size, second, size)[0],
        ),
        "XFeat 4096, LighterGlue": (
            lambda rgb: xfeat.detect(rgb, 4096),
            lambda first, second, size: xfeat.match(first, size, second, size)[0],
        ),
        "ALIKED 2048, LightGlue": (
            lambda rgb: aliked.detect(rgb, 2048),
            lambda first, second, size: aliked.match(first, size, second, size)[0],
        ),
    }
    report: dict[str, Any] = {"machine": describe_machine(1)}
    for name, bands in BANDS_DEG.items():
        task = prepare(name, data_root(arguments.data).resolve(), Path())
        report[name] = {
            method: measure(task, detect, match, bands, arguments.most_pairs)
            for method, (detect, match) in methods.items()
        }
        for method, result in report[name].items():
            for band in result["bands"]:
                print(name, method, json.dumps({key: value for key, value in band.items() if key != "pairs"}))
    (arguments.results / "learned_matches.json").write_text(json.dumps(report, indent=1) + "\n")


def measure(
    task: SfmTask, detect: Detect, match: Match, bands: tuple[tuple[float, float], ...], most_pairs: int
) -> dict[str, Any]:
    """Matches, right ones and poses of the pairs in each range of angles, and the times."""
    assert task.truth is not None and task.camera_params is not None
    truth = read_truth(task.truth)
    row = {Path(name).name: k for k, name in enumerate(truth.names)}
    cams_from_world = [truth.cams_from_world[row[Path(name).name]] for name in task.image_names]
    images = [
        cv2.cvtColor(cv2.imread(str(task.images / name)), cv2.COLOR_BGR2RGB) for name in task.image_names
    ]
    height, width = images[0].shape[:2]
    fx, fy, cx, cy = task.camera_params
    camera = Camera("PINHOLE", width, height, np.array([fx, fy, cx - 0.5, cy - 0.5]))
    detect(images[0])  # compiles kernels
    features: dict[int, Any] = {}
    detect_s, out = [], []
    for band in bands:
        pairs, match_s = [], []
        for i, j, angle in wide_pairs(cams_from_world, band, most_pairs):
            for k in {i, j} - features.keys():
                start = time.perf_counter()
                features[k] = detect(images[k])
                detect_s.append(time.perf_counter() - start)
            start = time.perf_counter()
            matches = match(features[i], features[j], (width, height))
            match_s.append(time.perf_counter() - start)
            pixels = [
                features[k].pixels[matches[:, side]].astype(np.float64) for side, k in enumerate((i, j))
            ]
            motion = cams_from_world[j] @ cams_from_world[i].inverse()
            pairs.append({"images": [i, j], "angle_deg": angle} | score(pixels, motion, camera))
        out.append({"angles_deg": band} | summary(pairs) | {"seconds_per_pair": float(np.median(match_s))})
    return {
        "features": float(np.median([len(each) for each in features.values()])),
        "seconds_per_image": float(np.median(detect_s)),
        "bands": out,
    }


def summary(pairs: list[dict[str, Any]]) -> dict[str, Any]:
    """Sums over the pairs of a range of angles."""
    return {
        "num_pairs": len(pairs),
        "matches": sum(pair["matches"] for pair in pairs),
        "right": sum(pair["right"] for pair in pairs),
        "right_median": float(np.median([pair["right"] for pair in pairs])),
        f"pairs_with_{MIN_RIGHT}_right": sum(pair["right"] >= MIN_RIGHT for pair in pairs),
        "verified": sum(pair["verified"] for pair in pairs),
        "right_poses": sum(pair["rotation_deg"] <= MAX_ROTATION_DEG for pair in pairs),
        "pairs": pairs,
    }


def wide_pairs(
    cams_from_world: list[Any], angles_deg: tuple[float, float], most: int
) -> list[tuple[int, int, float]]:
    """Pairs whose optical axes differ by such an angle, evenly spaced in its order: image, image, degrees."""
    rotations = np.array([pose.rotation for pose in cams_from_world])
    axes = rotations[:, 2]
    angle = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    between = np.einsum("jab,icb->ijac", rotations, rotations)
    roll = np.arctan2(between[..., 1, 0] - between[..., 0, 1], between[..., 0, 0] + between[..., 1, 1])
    is_wide = (angle >= angles_deg[0]) & (angle <= angles_deg[1])
    i, j = np.nonzero(np.triu(is_wide & (np.abs(np.degrees(roll)) <= MAX_ROLL_DEG), 1))
    order = np.argsort(angle[i, j], kind="stable")
    order = order[np.unique(np.linspace(0, len(order) - 1, min(most, len(order))).round().astype(int))]
    return [(int(i[n]), int(j[n]), round(float(angle[i[n], j[n]]), 1)) for n in order]


def score(pixels: list[np.ndarray], motion: Any, camera: Any) -> dict[str, Any]:
    """Number of matches and of right ones, and the error of the rotation that they give (180: none)."""
    fx, fy, cx, cy = camera.params
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    F = fundamental_from_essential(essential_from_cam2_from_cam1(motion), K, K)
    right = epipolar_distances(F, pixels[0], pixels[1]) <= WRONG_PX
    geometry = verify_pairs([PairMatches(pixels[0], pixels[1], camera, camera, True, 0)], RansacConfig())[0]
    is_verified, rotation_deg = geometry.kind is not PairKind.DEGENERATE, 180.0
    if is_verified and np.isfinite(geometry.cam2_from_cam1.rotation).all():
        turn = geometry.cam2_from_cam1.rotation @ motion.rotation.T
        rotation_deg = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    return {
        "matches": len(right),
        "right": int(right.sum()),
        "verified": is_verified,
        "kind": geometry.kind.name,
        "rotation_deg": round(rotation_deg, 2),
    }


if __name__ == "__main__":
    main()
