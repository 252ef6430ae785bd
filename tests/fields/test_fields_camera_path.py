"""The default camera path: along the training cameras, smooth, in their order or a shorter one."""

import json

import numpy as np
import pytest
from fields_scenes import CAMERA as CAMERA_OF_SCENE
from fields_scenes import camera, frames_of, scene, views
from PIL import Image

from epipole.cameras import Camera
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.io.gaussians.ply import write_gaussian_ply
from epipole.pipelines.fields.cameras import RenderView
from epipole.pipelines.fields.config import RenderConfig
from epipole.pipelines.fields.rendering.camera_path import path_along
from epipole.pipelines.fields.rendering.run import render
from epipole.pipelines.fields.run import splat
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
        assert ahead @ center / np.linalg.norm(center) < -0.98  # toward the middle
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


@pytest.mark.parametrize("option", [{"rotation_deg": 90.0}, {"fov_deg": 70.0}, {"height": 24}])
def test_options_of_the_orbit_ask_for_an_orbit(option):
    assert RenderConfig(**option).orbit_options == tuple(option) and not RenderConfig(width=32).orbit_options
    with pytest.raises(ConfigError, match="is an option of the orbit"):
        RenderConfig(path="cameras", **option)


def test_a_training_is_rendered_along_its_cameras_or_from_an_orbit(tmp_path):
    (tmp_path / "transforms.json").write_text(json.dumps(camera() | {"frames": frames_of(views(), tmp_path)}))
    result = splat(tmp_path, tmp_path / "result", steps=2, max_gaussians=200)
    sizes = {}
    for name, options in {"along": {}, "around": {"path": "orbit"}, "turned": {"rotation_deg": 90.0}}.items():
        render(result.out, tmp_path / name, frames=2, **options)
        sizes[name] = Image.open(tmp_path / name / "00000.png").size
    assert sizes == {
        "along": (CAMERA_OF_SCENE.width, CAMERA_OF_SCENE.height),
        "around": (800, 600),
        "turned": (800, 600),
    }
