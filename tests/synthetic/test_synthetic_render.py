"""Rendered depth is exact, colors stay with the surface, results do not depend on threads."""

import cv2
import numpy as np
import pytest

from epipole import _parallel
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.features import detect_features
from epipole.geometry import Rigid3
from epipole.synthetic import (
    Box,
    Plane,
    Sphere,
    SyntheticScene,
    Texture,
    courtyard,
    courtyard_views,
    look_at,
    render,
    render_exposures,
)

CAMERA = Camera(CameraModel.SIMPLE_RADIAL, 120, 80, np.array([110.0, 59.5, 39.5, -0.1]))


def rays():
    u, v = np.meshgrid(np.arange(120.0), np.arange(80.0))
    return CAMERA.unproject(np.stack([u.ravel(), v.ravel()], axis=1))


def test_depth_of_a_plane_is_analytic():
    wall = Plane(center=(0, 5, 0), direction_u=(1, 0, 0), direction_v=(0, 0, 1), half_size=(50, 50))
    view = look_at((0, 0, 0), (0.3, 1, 0.1))
    depth = render(SyntheticScene.of([wall]), CAMERA, view).depth.ravel()
    in_world = rays() @ view.rotation
    np.testing.assert_allclose(depth, 5.0 / in_world[:, 1] * rays()[:, 2], rtol=1e-12)


def test_depth_of_a_sphere_and_a_box_is_analytic():
    view = look_at((0, -4, 0), (0, 0, 0))
    ball = render(SyntheticScene.of([Sphere(center=(0, 0, 0), radius=1)]), CAMERA, view).depth.ravel()
    direction = rays()
    forward = direction[:, 2] * 4
    root = forward**2 - 15
    expected = np.where(root > 0, (forward - np.sqrt(np.maximum(root, 0))) * direction[:, 2], np.nan)
    np.testing.assert_allclose(ball, expected, rtol=1e-9)
    box = render(SyntheticScene.of([Box(center=(0, 0, 0), half_size=(1, 1, 1))]), CAMERA, view).depth
    assert box[40, 60] == pytest.approx(3.0)


def test_the_same_point_has_the_same_color_in_another_view():
    scene, camera = courtyard(), Camera(CameraModel.PINHOLE, 240, 160, np.array([190.0, 190.0, 119.5, 79.5]))
    views = courtyard_views(24)
    first, second = (render(scene, camera, views[k]) for k in (8, 9))
    random = np.random.default_rng(1)
    pixels = np.stack([random.integers(0, 240, 2000), random.integers(0, 160, 2000)], axis=1)
    depth = first.depth[pixels[:, 1], pixels[:, 0]]
    rays1 = camera.unproject(pixels.astype(float))
    points = views[8].inverse().apply(rays1 * (depth / rays1[:, 2])[:, None])
    in_second = views[9].apply(points)
    at = np.rint(np.nan_to_num(camera.project(in_second), nan=-9)).astype(int)
    inside = (at >= 0).all(axis=1) & (at[:, 0] < 240) & (at[:, 1] < 160)
    at, depth2, source = at[inside], in_second[inside, 2], pixels[inside]
    visible = np.abs(second.depth[at[:, 1], at[:, 0]] - depth2) < 0.02
    assert visible.sum() > 800
    a = first.rgb[source[visible, 1], source[visible, 0]].astype(float)
    b = second.rgb[at[visible, 1], at[visible, 0]].astype(float)
    assert np.median(np.abs(a - b)) < 12 < np.median(np.abs(a - b[random.permutation(len(b))]))


def test_noise_is_seeded_and_threads_do_not_matter():
    scene, view = courtyard(), courtyard_views(24)[3]
    _parallel.set_num_threads(1)
    one = render(scene, CAMERA, view, noise_sigma=3, seed=5)
    _parallel.set_num_threads(3)
    three = render(scene, CAMERA, view, noise_sigma=3, seed=5)
    _parallel.set_num_threads(None)
    np.testing.assert_array_equal(one.rgb, three.rgb)
    np.testing.assert_array_equal(one.depth, three.depth)
    assert (render(scene, CAMERA, view, noise_sigma=3, seed=6).rgb != one.rgb).any()


def test_a_plain_wall_has_no_features_and_the_courtyard_has_many():
    wall = Plane(
        center=(0, 2, 0),
        direction_u=(1, 0, 0),
        direction_v=(0, 0, 1),
        half_size=(50, 50),
        texture=Texture.PLAIN,
    )
    camera = Camera(CameraModel.PINHOLE, 960, 640, np.array([750.0, 750.0, 479.5, 319.5]))
    blank = render(SyntheticScene.of([wall]), camera, look_at((0, 0, 0), (0, 1, 0)))
    assert np.ptp(blank.rgb.reshape(-1, 3), axis=0).max() == 0
    rich = render(courtyard(), camera, courtyard_views(24)[10])
    assert len(detect_features(cv2.cvtColor(rich.rgb, cv2.COLOR_RGB2GRAY))) > 2000


def test_impossible_views_and_empty_scenes_raise():
    with pytest.raises(DegenerateGeometryError):
        look_at((0, 0, 0), (0, 0, 0))
    with pytest.raises(DegenerateGeometryError):
        look_at((0, 0, 0), (0, 0, 3))
    with pytest.raises(ShapeError):
        SyntheticScene.of([])


def test_no_views_raise():
    with pytest.raises(ConfigError, match="at least 1"):
        courtyard_views(0)


def test_a_tiled_wall_repeats_and_moves_with_its_wall():
    camera = Camera(CameraModel.PINHOLE, 200, 60, np.array([200.0, 200.0, 99.5, 29.5]))

    def image(shift: float, texture: Texture = Texture.TILED) -> np.ndarray:
        wall = Plane(
            center=(shift, 2, 0), direction_u=(1, 0, 0), direction_v=(0, 0, 1), half_size=(2, 1),
            texture=texture, tile_m=0.5, seed=3,
        )  # fmt: skip
        return render(SyntheticScene.of([wall]), camera, look_at((0, 0, 0), (0, 1, 0))).rgb.astype(float)

    # A tile is half a meter, 2 m away: 50 pixels.
    tiled = image(0.0)
    # What a pixel covers grows a little from the middle outward, and with it the blur.
    assert np.abs(tiled[:, :150] - tiled[:, 50:]).mean() < 1.5
    assert np.abs(tiled[:, :175] - tiled[:, 25:]).mean() > 5
    assert np.abs(image(0.1)[:, 10:] - tiled[:, :-10]).mean() < 1.5
    rich = image(0.0, Texture.RICH)
    assert np.abs(rich[:, :150] - rich[:, 50:]).mean() > 5
    np.testing.assert_allclose(image(0.1, Texture.RICH), rich, atol=1)


def test_boxes_of_one_seed_look_alike_wherever_they_stand():
    camera = Camera(CameraModel.PINHOLE, 120, 90, np.array([110.0, 110.0, 59.5, 44.5]))

    def image(x: float, y: float, angle: float) -> np.ndarray:
        box = Box(
            center=(x, y, 0),
            half_size=(0.5, 0.4, 0.3),
            angle_rad=angle,
            texture=Texture.TILED,
            tile_m=3.0,
            seed=4,
        )
        direction = np.array([np.cos(angle + 0.4), np.sin(angle + 0.4), 0.3])
        view = look_at(np.array([x, y, 0]) - 2.5 * direction, (x, y, 0))
        return render(SyntheticScene.of([box], light=(0, 0, 1)), camera, view).rgb.astype(float)

    np.testing.assert_allclose(image(3.0, -2.0, 1.1), image(0.0, 0.0, 0.0), atol=1)


def test_exposures_are_refused_where_places_do_not_fit():
    scene, view = courtyard(), courtyard_views(4)
    for shape in ((4,), (2, 3), (0, 1)):
        positions = Rigid3(np.zeros((*shape, 3, 3)) + np.eye(3), np.zeros((*shape, 3)))
        with pytest.raises(ShapeError, match="exposures"):
            render_exposures(scene, CAMERA, positions)
    with pytest.raises(ConfigError, match="gain"):
        render_exposures(scene, CAMERA, Rigid3(view.rotation[:, None], view.translation[:, None]), gain=-1.0)
    with pytest.raises(ConfigError, match="tile_m"):
        SyntheticScene.of([Sphere(center=(0, 0, 0), radius=1.0, tile_m=0.0)])
