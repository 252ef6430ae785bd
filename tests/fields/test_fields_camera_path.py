"""The default camera path: along the training cameras, smooth, in their order or a shorter one."""

import numpy as np
import pytest
from fields_scenes import scene

from epipole.cameras import Camera
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.io.gaussians.ply import write_gaussian_ply
from epipole.pipelines.fields.camera_path import path_along
from epipole.pipelines.fields.cameras import RenderView
from epipole.pipelines.fields.rendering import render
from epipole.synthetic import look_at

CAMERA = Camera("PINHOLE", 64, 48, [60.0, 60.0, 31.5, 23.5])


def arc(angles_deg, jitter=0.0):
    """Cameras on a circle of radius 4 that look at the origin."""
    rng, out = np.random.default_rng(0), []
    for n, angle in enumerate(np.deg2rad(angles_deg)):
        center = 4 * np.array([np.cos(angle), np.sin(angle), 0.2]) + jitter * rng.normal(size=3)
        out.append(RenderView(f"{n:03d}", CAMERA, look_at(center, (0, 0, 0))))
    return out


def centers_of(views):
    return np.stack([view.cam_from_world.inverse().translation for view in views])


@pytest.mark.parametrize("shuffled", [False, True])
def test_it_covers_the_arc_and_stays_near_the_cameras(shuffled):
    angles = np.linspace(-60, 60, 13)
    views = path_along(arc(np.random.default_rng(1).permutation(angles) if shuffled else angles), 50)
    assert len(views) == 50 and len({view.name for view in views}) == 50
    centers = centers_of(views)
    along = np.rad2deg(np.arctan2(centers[:, 1], centers[:, 0]))
    assert abs(along[-1] - along[0]) > 100 and (np.diff(along) * np.sign(along[-1] - along[0]) > 0).all()
    assert np.abs(np.linalg.norm(centers[:, :2], axis=1) - 4).max() < 0.2
    for view, center in zip(views, centers):
        ahead = view.cam_from_world.rotation[2]
        assert ahead @ center / np.linalg.norm(center) < -0.98  # towards the middle
        np.testing.assert_allclose(
            view.cam_from_world.rotation @ view.cam_from_world.rotation.T, np.eye(3), atol=1e-12
        )


def test_it_is_smoother_than_the_cameras():
    views = arc(np.linspace(-60, 60, 40), jitter=0.05)
    bend = [
        np.linalg.norm(np.diff(centers_of(part), n=2, axis=0), axis=1).max()
        for part in (views, path_along(views, 40))
    ]
    assert bend[1] < 0.4 * bend[0]


def test_few_cameras_and_one_position():
    one = arc([0.0])
    assert len(path_along(one, 3)) == 3
    same = [RenderView(str(n), CAMERA, Rigid3.exp([0, 0, 0, 0, 0.1 * n, 0])) for n in range(3)]
    rotated = path_along(same, 5)
    assert np.allclose(centers_of(rotated), 0)
    assert np.isfinite([view.cam_from_world.rotation for view in rotated]).all()


def test_a_file_without_cameras_has_no_such_path(tmp_path):
    write_gaussian_ply(tmp_path / "cloud.ply", scene())
    with pytest.raises(ConfigError, match="path=cameras needs"):
        render(tmp_path / "cloud.ply", tmp_path / "out", path="cameras")
    assert render(tmp_path / "cloud.ply", tmp_path / "out", frames=2, width=32).num_frames == 2
