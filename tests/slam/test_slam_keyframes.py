"""When a frame becomes a keyframe: parallax, which rotation does not give."""

from __future__ import annotations

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.pipelines.slam.tracking.points import Tracks
from epipole.scene import CameraRig

CAMERA = Camera("PINHOLE", 640, 480, [500.0, 500.0, 320.0, 240.0])
RIG = CameraRig((CAMERA, CAMERA), Rigid3(np.stack([np.eye(3)] * 2), np.array([[0.0, 0, 0], [-0.5, 0, 0]])))


def tracks_after(camera: Camera | CameraRig, motion: Rigid3, depth: float) -> Tracks:
    """Tracks of points at a depth, in every camera of a rig."""
    at = np.stack(np.meshgrid([200.0, 300, 400], [150.0, 240, 330]), axis=-1).reshape(-1, 2)
    points = (at - [320.0, 240.0]) / 500.0 * depth
    in_body = np.column_stack([points, np.full(len(at), depth)])
    if isinstance(camera, Camera):
        return Tracks(CAMERA.project(motion.apply(in_body)), np.arange(len(at)), at)
    which = np.repeat([0, 1], len(at))
    in_body = np.concatenate([in_body, in_body + np.array([0.5, 0.0, 0.0])])
    start = np.concatenate([at, at + np.array([0.0, camera.tops[1]])])
    return Tracks(camera.project(motion.apply(in_body), which), np.arange(len(start)), start)


@pytest.mark.parametrize("camera", [CAMERA, RIG], ids=["camera", "rig"])
def test_only_translation_gives_parallax(camera):
    turn = Rigid3.exp(np.array([0.0, 0, 0, 0.02, 0.1, -0.03]))
    rotated = tracks_after(camera, turn, 1e6)
    assert rotated.shift_px() > 40.0
    assert rotated.parallax_px(camera, turn) < 0.01
    moved = tracks_after(camera, Rigid3(np.eye(3), np.array([0.1, 0.0, 0.0])), 2.0)
    assert moved.parallax_px(camera, Rigid3.identity()) == pytest.approx(25.0)  # f t / z
    assert moved.shift_px() == pytest.approx(25.0)


def test_without_points_there_is_no_parallax():
    assert Tracks.none().parallax_px(CAMERA, Rigid3.identity()) == 0.0
