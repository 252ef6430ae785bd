"""Image pairs of known kind: synthetic matches, and matches of rendered images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from epipole.cameras import Camera, CameraModel
from epipole.config import FeatureConfig
from epipole.features import Features, detect_features, match_descriptors
from epipole.geometry import Rigid3
from epipole.synthetic import courtyard, courtyard_views, render
from epipole.synthetic.courtyard import look_at
from epipole.synthetic.problems import two_view_problem
from epipole.synthetic.scene import Plane, SyntheticScene

KINDS = ("general", "planar", "rotation", "rest")
NOISE_PX = 1.0
SENSOR_NOISE = 4.0
"""Standard deviation of the image noise in gray levels (of 255)."""


class KnownPair(NamedTuple):
    """Matches of an image pair, and its kind of motion or scene."""

    pixels1: np.ndarray
    pixels2: np.ndarray
    kind: str
    camera: Camera
    """Camera of both images."""


def synthetic_pairs(count: int, num_matches: int, outliers: float) -> list[KnownPair]:
    """Matches of general, planar, rotating and static pairs, with one pixel of noise."""
    out = []
    for seed in range(count):
        name = KINDS[seed % 4]
        p = two_view_problem(
            num_matches, outliers, NOISE_PX, seed, kind="general" if name == "rest" else name
        )
        second = p.pixels2
        if name == "rest":
            noise = NOISE_PX * np.random.default_rng(seed).standard_normal(second.shape)
            second = np.where(p.inlier_mask[:, None], p.pixels1 + noise, second)
        out.append(KnownPair(p.pixels1, second, name, p.camera1))
    return out


def rendered_pairs(count: int) -> list[KnownPair]:
    """SIFT matches of rendered images with noise.

    Pairs are neighboring views of the courtyard, two views of a floor, a rotating camera, or a static camera.
    """
    camera = Camera(CameraModel.PINHOLE, 640, 480, np.array([520.0, 520.0, 319.5, 239.5]))
    yard, floor = courtyard(), _floor()
    views = courtyard_views(max(count, 24))
    out = []
    for seed in range(count):
        kind, rng = KINDS[seed % 4], np.random.default_rng(seed)
        scene = floor if kind == "planar" else yard
        first = _above(rng) if kind == "planar" else views[seed % len(views)]
        if kind == "general":
            circle = courtyard_views()
            row = (len(circle) - 2) * seed // count
            first, second = circle[row], circle[row + 2]
        elif kind == "planar":
            second = _above(rng)
        elif kind == "rotation":
            rotation = Rigid3.exp(np.concatenate([np.zeros(3), rng.uniform(-0.15, 0.15, 3)]))
            second = rotation @ first
        else:
            second = first
        one, two = (_features(scene, camera, view, 2 * seed + k) for k, view in enumerate((first, second)))
        matches = match_descriptors(one.descriptors, two.descriptors)
        pixels = [f.pixels[matches[:, k]].astype(np.float64) for k, f in enumerate((one, two))]
        out.append(KnownPair(*pixels, kind, camera))
    return out


def _features(scene: SyntheticScene, camera: Camera, cam_from_world: Rigid3, seed: int) -> Features:
    rgb = render(scene, camera, cam_from_world, noise_sigma=SENSOR_NOISE, seed=seed).rgb
    gray = np.rint(rgb @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)
    return detect_features(gray, FeatureConfig())


def _floor() -> SyntheticScene:
    plane = Plane(
        center=(0, 0, 0),
        direction_u=(1, 0, 0),
        direction_v=(0, 1, 0),
        half_size=(6, 6),
        color=(0.5, 0.5, 0.4),
        seed=5,
    )
    return SyntheticScene.of([plane])


def _above(rng: np.random.Generator) -> Rigid3:
    """A camera 1.5 to 2.2 m above the floor that looks at its center."""
    center = np.array([*rng.uniform(-0.6, 0.6, 2) - (0.0, 1.5), rng.uniform(1.5, 2.2)])
    return look_at(center, (*rng.uniform(-0.2, 0.2, 2), 0.0))
