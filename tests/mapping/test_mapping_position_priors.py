"""Positions on a line leave the rotation about it free: one direction that points down determines it, and saves most of the steps."""

from dataclasses import replace

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.geometry import Rigid3, Rotation3
from epipole.mapping import PositionPriors
from epipole.optim import BundleConfig, BundleProblem, Loss, adjust_bundle

CAMERA = Camera("PINHOLE", 640, 480, [500.0, 500.0, 319.5, 239.5])
COUNT, SIGMA_M = 60, 2.0
AHEAD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation of a camera that looks along x, with z up."""
DOWN = np.array([0.0, 0.0, -1.0])


def straight_street(rng: np.random.Generator) -> tuple[Rigid3, BundleProblem]:
    """True poses a meter apart between two walls, and the problem of a model that has drifted away from them."""
    centers = np.arange(COUNT)[:, None] * np.array([1.0, 0.0, 0.0])
    rotation = Rotation3.exp(0.05 * rng.normal(size=(COUNT, 3))).matrix @ AHEAD
    true = Rigid3(rotation, -(rotation @ centers[..., None])[..., 0])
    side = rng.choice([-1.0, 1.0], 3000) * rng.uniform(5, 9, 3000)
    points = np.stack([rng.uniform(0, COUNT + 20, 3000), side, rng.uniform(-2, 5, 3000)], axis=1)
    image, point, pixels = [], [], []
    for k in range(COUNT):
        in_cam = true[k].apply(points)
        at = CAMERA.project(in_cam)
        seen = (in_cam[:, 2] > 1) & (in_cam[:, 2] < 25) & (at > 0).all(axis=1) & (at < [639, 479]).all(axis=1)
        image.append(np.full(seen.sum(), k))
        point.append(np.flatnonzero(seen))
        pixels.append(at[seen] + 0.3 * rng.normal(size=(seen.sum(), 2)))
    rows = np.concatenate(point)
    order = np.argsort(rows, kind="stable")
    rows, images, at = rows[order], np.concatenate(image)[order], np.concatenate(pixels)[order]
    often = (np.bincount(rows, minlength=len(points)) >= 3)[rows]
    used, rows = np.unique(rows[often], return_inverse=True)
    images, at = images[often], at[often]
    drifted = Rigid3.exp(np.cumsum(rng.normal(size=(COUNT, 6)) * ([0.03] * 3 + [0.002] * 3), axis=0)) @ true
    first = images[
        np.searchsorted(rows, np.arange(len(used)))
    ]  # a point drifts with the first image that sees it
    moved = (drifted[first].inverse() @ true[first]).apply(points[used])
    return true, BundleProblem.from_tracks(drifted, CAMERA, moved, images, rows, at)


def up_errors_deg(found: Rigid3, true: Rigid3) -> np.ndarray:
    """Angles between the up directions of an image in both worlds."""
    up = (np.swapaxes(found.rotation, 1, 2) @ true.rotation) @ -DOWN
    return np.degrees(np.arccos(np.clip(up[:, 2], -1.0, 1.0)))


@pytest.mark.parametrize("seed", [1, 2])
def test_one_down_direction_keeps_a_straight_street_upright(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, problem = straight_street(rng)
    fixes = true.centers() + SIGMA_M * rng.normal(size=(COUNT, 3))
    down = np.full((COUNT, 3), np.nan)
    down[COUNT // 2] = true.rotation[COUNT // 2] @ DOWN
    config = BundleConfig(loss=Loss.CAUCHY, loss_scale_px=0.6, function_tolerance=1e-5)
    sigma = np.full((COUNT, 3), SIGMA_M)
    free, kept = (
        adjust_bundle(replace(problem, priors=priors.of_bundle()), config)
        for priors in (PositionPriors(fixes, sigma), PositionPriors(fixes, sigma, down, 0.07))
    )
    assert kept.converged and all(step.is_accepted for step in kept.history)
    assert kept.num_iterations < 0.7 * free.num_iterations
    assert up_errors_deg(kept.rig_from_world, true).max() < 1.5
    assert up_errors_deg(kept.rig_from_world, true).mean() < up_errors_deg(free.rig_from_world, true).mean()
    assert kept.final_cost == pytest.approx(free.final_cost, rel=1e-4)  # the images do not tell
