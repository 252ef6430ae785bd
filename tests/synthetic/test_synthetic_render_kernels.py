"""The ray caster against equations written out: every shape and lens, occlusion and sampling."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.synthetic import Box, HeightField, Plane, Sphere, SyntheticScene, Texture, look_at, render
from epipole.synthetic._surface_kernels import height_at

WIDTH, HEIGHT = 96, 64
CAMERAS = [
    Camera(CameraModel.PINHOLE, WIDTH, HEIGHT, np.array([80.0, 78.0, 47.5, 31.5])),
    Camera(CameraModel.OPENCV, WIDTH, HEIGHT, np.array([80.0, 78.0, 46.0, 33.0, -0.1, 0.02, 1e-3, -2e-3])),
    Camera(CameraModel.OPENCV_FISHEYE, WIDTH, HEIGHT, np.array([60.0, 60.0, 47.5, 31.5, 0.02, 0, 0, 0])),
]
CENTER = np.array([4.0, -3.0, 2.5])
VIEW = look_at(CENTER, (0.1, 0.2, 0.4))

every_lens = pytest.mark.parametrize("camera", [pytest.param(c, id=c.model.name) for c in CAMERAS])


def world_rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions in world and z in camera of every pixel, (h, w, 3) and (h, w)."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    rays = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1).astype(float))
    return (rays @ VIEW.rotation).reshape(HEIGHT, WIDTH, 3), rays[:, 2].reshape(HEIGHT, WIDTH)


def check_depth(depth: np.ndarray, distance: np.ndarray, z_of_ray: np.ndarray) -> None:
    seen = np.isfinite(distance)
    assert 200 < seen.sum() < seen.size
    np.testing.assert_array_equal(np.isfinite(depth), seen)
    np.testing.assert_allclose(depth[seen], (distance * z_of_ray)[seen], rtol=1e-9)


@every_lens
def test_sphere(camera: Camera) -> None:
    center, radius = np.array([0.2, 0.3, 0.4]), 1.1
    depth = render(SyntheticScene.of([Sphere(center=(0.2, 0.3, 0.4), radius=radius)]), camera, VIEW).depth
    directions, z = world_rays(camera)
    # |c + t d - m|^2 = r^2: the smaller root.
    b, c = 2 * directions @ (CENTER - center), (CENTER - center) @ (CENTER - center) - radius**2
    under = b * b - 4 * c
    check_depth(depth, np.where(under >= 0, (-b - np.sqrt(np.maximum(under, 0))) / 2, np.nan), z)


@every_lens
def test_plane(camera: Camera) -> None:
    u, v, middle = np.array([1.0, 0, 0]), np.array([0, 0.6, 0.8]), np.array([0, 0.5, 0.4])
    plane = Plane(
        center=(0, 0.5, 0.4), direction_u=(1, 0, 0), direction_v=(0, 0.6, 0.8), half_size=(1.3, 0.9)
    )
    depth = render(SyntheticScene.of([plane]), camera, VIEW).depth
    directions, z = world_rays(camera)
    # c + t d = m + a u + b v: three linear equations in (a, b, t).
    columns = np.stack([np.broadcast_to(u, directions.shape), np.broadcast_to(v, directions.shape)], axis=-1)
    system = np.concatenate([columns, -directions[..., None]], axis=-1)
    a, b, t = np.moveaxis(np.linalg.solve(system, (CENTER - middle)[:, None])[..., 0], -1, 0)
    check_depth(depth, np.where((abs(a) <= 1.3) & (abs(b) <= 0.9) & (t > 0), t, np.nan), z)


@every_lens
def test_turned_box(camera: Camera) -> None:
    angle, half, middle = 0.4, np.array([0.9, 0.6, 0.5]), np.array([0.1, 0.2, 0.3])
    box = Box(center=(0.1, 0.2, 0.3), half_size=(0.9, 0.6, 0.5), angle_rad=angle)
    depth = render(SyntheticScene.of([box]), camera, VIEW).depth
    directions, z = world_rays(camera)
    c, s = np.cos(angle), np.sin(angle)
    local_from_world = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    start, along = local_from_world @ (CENTER - middle), directions @ local_from_world.T
    # The nearest of the six faces whose plane is crossed inside the face.
    distance = np.full((HEIGHT, WIDTH), np.inf)
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for side in (-half[axis], half[axis]):
            t = (side - start[axis]) / along[..., axis]
            at = start + t[..., None] * along
            on_face = (np.abs(at[..., others]) <= half[others]).all(axis=-1) & (t > 0)
            distance = np.where(on_face & (t < distance), t, distance)
    check_depth(depth, np.where(np.isfinite(distance), distance, np.nan), z)


@every_lens
def test_ground_is_hit_on_its_surface_and_nothing_stands_before(camera: Camera) -> None:
    ground = HeightField(center=(0, 0, 0.2), half_size=(2, 2), amplitude=0.15, wavelength=1.1, seed=5)
    depth = render(SyntheticScene.of([ground]), camera, VIEW).depth
    directions, z = world_rays(camera)
    seen = np.isfinite(depth)
    assert seen.sum() > 500
    distance, directions = (depth / z)[seen], directions[seen]

    def above_ground(t: np.ndarray) -> np.ndarray:
        at = CENTER + t[:, None] * directions
        return at[:, 2] - 0.2 - np.array([height_at(x, y, 0.15, 1.1, 5) for x, y in at[:, :2]])

    np.testing.assert_allclose(above_ground(distance), 0, atol=1e-9)
    for fraction in (0.2, 0.6, 0.9, 0.99):
        assert (above_ground(fraction * distance) > 0).all()
    at = CENTER + distance[:, None] * directions
    assert (np.abs(at[:, :2]) <= 2).all()
    assert np.ptp(at[:, 2]) > 0.1


def test_the_nearer_surface_hides_the_farther() -> None:
    near, far = Sphere(center=(2.0, -1.4, 1.45), radius=0.4), Sphere(center=(0, 0, 0.4), radius=1.2)
    both, swapped, alone = (
        render(SyntheticScene.of(p), CAMERAS[0], VIEW).depth for p in ([near, far], [far, near], [near])
    )
    np.testing.assert_array_equal(both, swapped)
    seen = np.isfinite(alone)
    assert seen.sum() > 50
    np.testing.assert_array_equal(both[seen], alone[seen])


def test_colors_are_sampled_evenly_around_the_pixel() -> None:
    camera = Camera(CameraModel.PINHOLE, WIDTH, HEIGHT, np.array([80.0, 80.0, 47.5, 31.5]))
    # The edges project to 20.5 and 10.5 pixels from the middle: through pixel centers, on every side.
    plate = Plane(
        center=(0, 0, 0),
        direction_u=(1, 0, 0),
        direction_v=(0, 0, 1),
        half_size=(20.5 / 20, 10.5 / 20),
        texture=Texture.PLAIN,
    )
    rgb = render(SyntheticScene.of([plate]), camera, look_at((0, -4, 0), (0, 0, 0))).rgb.astype(int)
    sky, surface = rgb[0, 0], rgb[32, 48]
    assert np.abs(sky - surface).min() > 20
    for edge in (rgb[32, 27], rgb[32, 68], rgb[21, 48], rgb[42, 48]):
        np.testing.assert_allclose(edge, (sky + surface) / 2, atol=1)
    np.testing.assert_array_equal(rgb, rgb[:, ::-1])
    np.testing.assert_array_equal(rgb, rgb[::-1])


def test_a_camera_that_sees_nothing() -> None:
    scene = SyntheticScene.of([Sphere(center=(0, 0, 0), radius=0.5)])
    image = render(scene, CAMERAS[0], look_at((4, 0, 0), (8, 0, 0)))
    assert np.isnan(image.depth).all()
    assert (image.rgb == image.rgb[0, 0]).all()


def test_sensor_noise_has_the_asked_size() -> None:
    scene = SyntheticScene.of([Sphere(center=(0, 0, 0), radius=0.5, texture=Texture.PLAIN)])
    away = look_at((4, 0, 0), (8, 0, 0))
    clean = render(scene, CAMERAS[0], away).rgb.astype(float)
    noisy = render(scene, CAMERAS[0], away, noise_sigma=4.0, seed=3).rgb.astype(float)
    # Rounding adds 1/12 to the variance; 18432 values know their deviation to 0.5 %.
    assert (noisy - clean).std() == pytest.approx(np.sqrt(16 + 1 / 12), rel=0.03)
