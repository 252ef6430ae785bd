"""What the tests of kernel modes compute in processes of their own; `python kernel_mode_jobs.py JOB ...` writes it.

Every job is small, and goes through many kernels.
"""

import hashlib
import json
import sys
from collections.abc import Iterable

import numpy as np

from epipole._jit.mode import kernel_mode
from epipole.cameras import Camera, CameraModel
from epipole.config import RansacConfig
from epipole.geometry import Rigid3

CAMERA = Camera(CameraModel.OPENCV, 640, 480, np.array([500.0, 505.0, 319.5, 239.5, -0.1, 0.02, 1e-3, -1e-3]))


def two_views() -> tuple[np.ndarray, np.ndarray]:
    """Pixels of 60 points in two images, a fifth of them wrong."""
    random = np.random.default_rng(1)
    points = random.uniform([-2, -1.5, 4], [2, 1.5, 7], (60, 3))
    motion = Rigid3.exp(np.array([-0.8, 0.0, 0.1, 0.02, 0.1, 0.0]))
    first, second = CAMERA.project(points), CAMERA.project(motion.apply(points))
    second[:12] = random.uniform([0, 0], [639, 479], (12, 2))
    return first, second + random.normal(0, 0.3, second.shape)


def cameras() -> Iterable[np.ndarray]:
    """Projection, and rays back."""
    pixels, _ = two_views()
    rays = CAMERA.unproject(pixels)
    return rays, CAMERA.project(rays)


def homography() -> Iterable[np.ndarray]:
    """The robust loop."""
    from epipole.robust import estimate_homography

    found = estimate_homography(*two_views(), RansacConfig(max_iterations=30, max_error_px=30.0))
    return found.model, found.inlier_mask


def adjustment() -> Iterable[np.ndarray]:
    """Bundle adjustment of two images and their points."""
    from epipole.optim import BundleProblem, adjust_bundle

    first, second = two_views()
    n = len(first) - 12
    depths = np.random.default_rng(2).uniform(4, 7, (n, 1))
    pixels = np.stack([first[12:], second[12:]], axis=1).reshape(-1, 2)
    problem = BundleProblem(
        rig_from_world=Rigid3.exp(np.array([[0.0] * 6, [-0.79, 0.01, 0.1, 0.02, 0.11, 0.0]])),
        cam_from_rig=Rigid3.exp(np.zeros((1, 6))),
        camera_model=np.array([int(CAMERA.model)], np.int32),
        camera_params=CAMERA.padded_params()[None],
        points_in_world=CAMERA.unproject(first[12:]) * depths,
        offsets=2 * np.arange(n + 1, dtype=np.int64),
        frame=np.tile(np.array([0, 1], np.int32), n),
        sensor=np.zeros(2 * n, np.int32),
        camera=np.zeros(2 * n, np.int32),
        pixels=pixels,
        frame_free=np.array([[0.0] * 6, [0.0, 1.0, 1.0, 1.0, 1.0, 1.0]]),
        params_free=np.zeros((1, 12)),
        point_free=np.ones(n),
    )
    result = adjust_bundle(problem)
    return result.rig_from_world.translation, result.points_in_world


def stereo() -> Iterable[np.ndarray]:
    """Semi-global matching of a shifted image."""
    from epipole.disparity_search.config import DisparityConfig
    from epipole.disparity_search.search import match_stereo

    random = np.random.default_rng(3)
    texture = random.integers(0, 255, (24, 80)).astype(np.uint8)
    found = match_stereo(texture[:, :64], texture[:, 6:70], DisparityConfig(max_disparity_px=15))
    return found.disparity_px, found.sigma_px


JOBS = {job.__name__: job for job in (cameras, homography, adjustment, stereo)}


def digest(arrays: Iterable[np.ndarray]) -> str:
    """Of all bytes."""
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()


if __name__ == "__main__":
    found = {name: list(JOBS[name]()) for name in sys.argv[1:]}
    answer = {name: {"digest": digest(a), "values": [x.tolist() for x in a]} for name, a in found.items()}
    json.dump({"mode": str(kernel_mode()), **answer}, sys.stdout)
