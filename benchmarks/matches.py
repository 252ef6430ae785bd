"""Matches, pairs and points against ground truth: `python -m benchmarks.matches --set fountain-P11 castle-P19`.

A match is wrong if a pixel is more than 4 px from the epipolar line of the other, with the true poses and intrinsics; a
pair is false if less than half its matches are right. Each program's pairs come from the database that it writes. In the
kitchen, the points of the model are also compared with a depth camera. Results go to benchmarks/results/matches.json.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.measure import REPOSITORY, describe_machine, run_measured
from benchmarks.peers.base import Limits, SfmPeer
from benchmarks.peers.epipole_sfm import EpipoleSfm
from benchmarks.peers.pycolmap_sfm import PycolmapSfm
from benchmarks.score import Score, cams_in_order, largest_model, score_models
from benchmarks.tasks.sfm import SfmTask, data_root, prepare
from epipole.geometry.epipolar import essential_from_cam2_from_cam1, fundamental_from_essential
from epipole.geometry.homogeneous import point_line_distance, to_homogeneous
from epipole.io.colmap.database import read_database
from epipole.io.truth import read_truth
from epipole.metrics import align_cameras
from epipole.scene import Reconstruction

WRONG_PX = 4.0
MIN_MATCHES = 15
"""Pairs with fewer verified matches do not count; COLMAP's limit."""
OFF = 0.2
"""Relative error of a point's depth beyond which it is off."""
COLOR_FOCAL_PX, DEPTH_FOCAL_PX = 525.5, 585.0
PATCH = 5
"""Half width, in pixels, of the patch of the depth image that may have the point's depth: the cameras stand apart."""
ROWS = {
    "pairs": "verified pairs",
    "false_pairs": "false pairs",
    "matches": "matches",
    "wrong_percent": "wrong matches (%)",
    "registered": "images registered",
    "position_mean": "position mean (m)",
    "position_median": "position median (m)",
    "points": "points",
    "two_view_percent": "points in two images (%)",
    "depth_off_percent": "points off by more than 20 % (%)",
    "wall_s": "total time (s)",
}


def main() -> None:
    """Run the programs on the chosen sets and print a table for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--set", nargs="+", default=["fountain-P11", "Herz-Jesus-P8", "castle-P19"])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--results", type=Path, default=REPOSITORY / "benchmarks" / "results")
    parser.add_argument("--option", nargs="+", default=[], help="options of epipole reconstruct, without --")
    arguments = parser.parse_args()
    console = Console(width=max(110, Console().width))
    options = tuple(f"--{option}" for option in arguments.option)
    peers: list[SfmPeer] = [EpipoleSfm(), PycolmapSfm("incremental")]
    report = {}
    for name in arguments.set:
        with tempfile.TemporaryDirectory(prefix="epipole-bench-") as scratch:
            task = prepare(name, data_root(arguments.data).resolve(), Path(scratch) / "data")
            scores = {
                peer.name: run_and_score(task, peer, Path(scratch), options if peer.name == "epipole" else ())
                for peer in peers
                if peer.version() is not None
            }
        report[name] = scores
        console.print(_table(name, scores))
    if not options:
        report = {"machine": describe_machine(2), "sets": report}
        (arguments.results / "matches.json").write_text(json.dumps(report, indent=1) + "\n")


def run_and_score(task: SfmTask, peer: SfmPeer, work: Path, options: tuple[str, ...] = ()) -> Score:
    """Run one program and compare its matches and its largest model with the ground truth."""
    out = work / peer.name
    measure = run_measured([*peer.command(task, out, Limits()), *options], work / f"{peer.name}.log", 2)
    score = {"wall_s": asdict(measure)["wall_s"]} | score_models(task, out / "sparse")
    score |= score_matches(out / "database.db", task)
    model, _ = largest_model(out / "sparse")
    if model is not None:
        score |= score_points(model, task)
    return score


def score_matches(database: Path, task: SfmTask) -> Score:
    """Verified matches in a database against the ground truth."""
    assert task.truth is not None and task.camera_params is not None
    truth, contents = read_truth(task.truth), read_database(database)
    row = {Path(name).name: k for k, name in enumerate(truth.names)}
    fx, fy, cx, cy = task.camera_params
    K = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    graph, wrong = contents.view_graph, []
    assert graph is not None
    for n, (i, j) in enumerate(zip(graph.image1, graph.image2)):
        at = slice(graph.match_offsets[n], graph.match_offsets[n + 1])
        k1, k2 = (row.get(Path(contents.images.name[image]).name) for image in (i, j))
        if k1 is None or k2 is None or at.stop - at.start < MIN_MATCHES:
            continue
        motion = truth.cams_from_world[k2] @ truth.cams_from_world[k1].inverse()
        F = fundamental_from_essential(essential_from_cam2_from_cam1(motion), K, K)
        pixels1 = contents.images.keypoints_of(int(i))[graph.keypoint1[at]]
        pixels2 = contents.images.keypoints_of(int(j))[graph.keypoint2[at]]
        wrong.append(epipolar_distances(F, pixels1, pixels2) > WRONG_PX)
    everything = np.concatenate(wrong) if wrong else np.zeros(0, bool)
    return {
        "pairs": len(wrong),
        "false_pairs": sum(float(part.mean()) > 0.5 for part in wrong),
        "matches": len(everything),
        "wrong_percent": 100.0 * float(everything.mean()) if len(everything) else 0.0,
    }


def epipolar_distances(F: np.ndarray, pixels1: np.ndarray, pixels2: np.ndarray) -> np.ndarray:
    """(n,) the larger distance of each match from its epipolar lines in both images, in pixels."""
    in_second = point_line_distance(pixels2, to_homogeneous(pixels1) @ F.T)
    in_first = point_line_distance(pixels1, to_homogeneous(pixels2) @ F)
    return np.maximum(in_first, in_second)


def score_points(model: Reconstruction, task: SfmTask) -> Score:
    """Fraction of points in two images and, where there are depth images, of points at a wrong depth."""
    point, image = model.tracks.point_of_observation(), model.tracks.image
    seen = np.unique(np.stack([point, image]), axis=1)
    lengths = np.bincount(seen[0], minlength=len(model.points))
    score = {"two_view_percent": 100.0 * float((lengths == 2).mean()) if len(lengths) else 0.0}
    depths = {name: depth_image(task.images / name) for name in model.images.name}
    if all(depth is not None for depth in depths.values()) and task.truth is not None:
        score["depth_off_percent"] = 100.0 * float(depth_is_off(model, task, seen, depths).mean())
    return score


def depth_image(image: Path) -> np.ndarray | None:
    """(h, w) meters of the depth camera beside a frame, 0 where unknown; None if there is none."""
    file = Path(str(image.resolve()).replace(".color.jpg", ".depth.png"))
    if file.suffix != ".png" or not file.is_file() or file == image.resolve():
        return None
    depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    return np.where(depth == 65535, 0, depth) / 1000.0


def depth_is_off(
    model: Reconstruction, task: SfmTask, seen: np.ndarray, depths: dict[str, np.ndarray | None]
) -> np.ndarray:
    """Mask of the points with a measured depth: whether most images say that the depth is more than 20 % off."""
    assert task.truth is not None
    truth = read_truth(task.truth)
    scale = align_cameras(cams_in_order(model, truth.names), truth.cams_from_world).truth_from_estimated.scale
    cams_from_world, camera = model.cams_from_world(), model.cameras[0]
    votes = np.zeros((len(model.points), 2), int)
    for k, name in enumerate(model.images.name):
        points = seen[0][seen[1] == k]
        inside = cams_from_world[k].apply(model.points.xyz_in_world[points])
        pixels, depth = camera.project(inside), depths[name]
        assert depth is not None
        center = (np.array(depth.shape[::-1]) - 1) / 2
        at = np.rint(center + (pixels - center) * DEPTH_FOCAL_PX / COLOR_FOCAL_PX).astype(int)
        for p, (u, v), z in zip(points, at, inside[:, 2] * scale):
            patch = depth[max(v - PATCH, 0) : v + PATCH + 1, max(u - PATCH, 0) : u + PATCH + 1]
            measured = patch[patch > 0]
            if len(measured):
                votes[p, int(not np.any(np.abs(z / measured - 1.0) <= OFF))] += 1
    has_depth = votes.sum(axis=1) > 0
    return np.asarray(votes[has_depth, 1] > votes[has_depth, 0])


def _table(name: str, scores: dict[str, Score]) -> Table:
    table = Table(title=name)
    table.add_column("")
    for program in scores:
        table.add_column(program, justify="right")
    for key, label in ROWS.items():
        if any(key in score for score in scores.values()):
            table.add_row(label, *(f"{score[key]:.4g}" if key in score else "" for score in scores.values()))
    return table


if __name__ == "__main__":
    main()
