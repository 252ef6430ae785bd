"""Whether the standard deviations of points hold: `python -m benchmarks.point_sigma`.

The rendered courtyard of `epipole demo` is reconstructed and aligned with its true cameras. The depth of each point is
compared with the exact depth of the pixel that it projects to, or of a neighboring one, in the image that fits best.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from epipole.geometry import align_points
from epipole.pipelines.demo.run import demo, demo_camera
from epipole.scene import Reconstruction
from epipole.scene.point_accuracy import covariances_of_points, pixel_noise
from epipole.synthetic.courtyard import courtyard, courtyard_views
from epipole.synthetic.render import render

NEIGHBORS = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]


def main() -> None:
    """Print how many points are off by more than 1, 2, 3 and 5 standard deviations."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=24)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="epipole-bench-") as scratch:
        model = demo(Path(scratch) / "demo", num_views=arguments.views).reconstruction.model
        ratio = errors_in_sigmas(model, arguments.views)
    print(f"{len(ratio)} points, noise {pixel_noise(model):.3f} px")
    for limit in (1, 2, 3, 5):
        print(f"off by more than {limit} standard deviations: {100 * np.mean(ratio > limit):.2f} %")


def errors_in_sigmas(model: Reconstruction, num_views: int) -> np.ndarray:
    """(n,) error of each point's depth, in standard deviations of the depth."""
    truth, camera, scene = courtyard_views(num_views), demo_camera(), courtyard()
    registered = np.flatnonzero(model.is_registered())
    truth_from_model = align_points(model.camera_centers_in_world()[registered], truth.centers()[registered])
    xyz = truth_from_model.apply(model.points.xyz_in_world)
    turn = truth_from_model.scale * truth_from_model.rotation
    covariances = turn @ covariances_of_points(model, pixel_noise(model)) @ turn.T
    point, best = model.tracks.point_of_observation(), np.full(len(xyz), np.inf)
    for image in registered:
        own = np.unique(point[model.tracks.image == image])
        inside = truth[image].apply(xyz[own])
        off = depth_errors(render(scene, camera, truth[image]).depth, camera.project(inside), inside[:, 2])
        axis = truth[image].rotation[2]
        sigma = np.sqrt(np.einsum("a,kab,b->k", axis, covariances[own], axis))
        best[own] = np.minimum(best[own], off / sigma)
    return best


def depth_errors(depth: np.ndarray, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(n,) smallest difference of z from the depth image at a pixel or one of its eight neighbors; infinite outside."""
    height, width = depth.shape
    at, off = np.rint(pixels).astype(int), np.full(len(z), np.inf)
    for dx, dy in NEIGHBORS:
        x, y = at[:, 0] + dx, at[:, 1] + dy
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        found = np.abs(z[inside] - depth[y[inside], x[inside]])
        off[inside] = np.fmin(off[inside], found)
    return off


if __name__ == "__main__":
    main()
