"""Points on the surfaces of a radiance field, from depth at training views: on the surface, colored, without borders and fog."""

import json
import re

import numpy as np
import pytest
from fields_scenes import CAMERA, views

from epipole import nerf
from epipole.pipelines.fields import surface_points as module
from epipole.pipelines.fields.surface_points import scene_of_surface, surface_points
from epipole.pipelines.fields.surfaces import Seen
from whole import in_whole_run

FIRST = {"position": [0.0, -3.0, -1.0], "look_at": [0.0, 0.0, 0.0], "up": [0.0, 0.0, 1.0]}
RADIUS = 0.5


def ball_seen_from(view, coverage=1.0):
    """A ball at the origin, whose color is its normal; some depths are wrong in each view at other pixels."""
    v, u = np.mgrid[: view.camera.height, : view.camera.width]
    rays = view.camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1).astype(float))
    directions = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ view.cam_from_world.rotation
    center = view.cam_from_world.inverse().translation
    half, rest = directions @ center, center @ center - RADIUS**2
    root = half**2 - rest
    hit = root > 0
    length = np.where(hit, -half - np.sqrt(np.maximum(root, 0)), 0.0)
    points = center + length[:, None] * directions
    depth = view.cam_from_world.apply(points)[:, 2]
    wrong = np.random.default_rng(abs(int(1e3 * center[0]))).random(len(depth)) < 0.05
    depth = np.where(wrong, 0.7 * depth, depth)
    covered = np.where(hit, coverage, 0.0)
    shape = v.shape
    color = np.where(hit[:, None], 0.5 + 0.5 * points / RADIUS, 0.0) * covered[:, None]
    return Seen((depth * covered).reshape(shape), covered.reshape(shape), color.reshape(*shape, 3))


def test_points_are_on_the_surface_and_have_its_color() -> None:
    found = surface_points(ball_seen_from, views())
    assert 2_000 < len(found.points_in_world) <= module.MOST_POINTS
    radius = np.linalg.norm(found.points_in_world, axis=1)
    assert np.abs(radius - RADIUS).max() < 0.02 * RADIUS + module.AGREEING
    np.testing.assert_allclose(found.rgb / 255.0, 0.5 + 0.5 * found.points_in_world / RADIUS, atol=0.05)
    few = surface_points(ball_seen_from, views(), 100)
    assert len(few.points_in_world) == len(few.rgb) == 100


def test_fog_and_no_views_give_no_points() -> None:
    assert scene_of_surface(lambda view: ball_seen_from(view, 0.5), views(), FIRST, "fog") is None
    assert len(surface_points(ball_seen_from, []).points_in_world) == 0


def test_a_single_view_needs_no_other() -> None:
    assert len(surface_points(ball_seen_from, views()[:1]).points_in_world) > 100


def test_a_slow_field_is_rendered_with_fewer_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SECONDS", 0.0)
    sizes = []

    def counted(view):
        sizes.append(view.camera.width * view.camera.height)
        return ball_seen_from(view)

    surface_points(counted, views())
    assert sum(sizes[1:]) < 1.2 * module.LEAST_PIXELS and CAMERA.width * CAMERA.height > max(sizes)


@in_whole_run
@pytest.mark.usefixtures("small_hash", "unchecked")
def test_the_report_of_a_radiance_field_shows_its_surface(source, tmp_path) -> None:
    found = nerf(source, tmp_path / "out", test_every=7, steps=80, kind="grid")
    page = (found.out / "report.html").read_text()
    data = json.loads(re.search(r'id="space-data">(.*?)</script>', page, re.DOTALL)[1])
    (layer,) = data["points"]
    assert layer["name"] == "Surface points" and layer["count"] > 500 and len(data["cameras"]["names"]) == 12
