"""The renderer against analytic intersections, and its pictures against each other."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from epipole import _parallel
from epipole.cameras import Camera, CameraModel
from epipole.errors import DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3
from epipole.synthetic import (
    Box,
    HeightField,
    Plane,
    Rendering,
    Sphere,
    SyntheticScene,
    Texture,
    courtyard,
    courtyard_views,
    look_at,
    render,
)
from epipole.synthetic import _render_kernels as kernels

WIDTH, HEIGHT = 96, 64
CAMERAS = [
    Camera(CameraModel.PINHOLE, WIDTH, HEIGHT, np.array([80.0, 78.0, 47.5, 31.5])),
    Camera(CameraModel.OPENCV, WIDTH, HEIGHT, np.array([80.0, 78.0, 46.0, 33.0, -0.1, 0.02, 1e-3, -2e-3])),
    Camera(CameraModel.OPENCV_FISHEYE, WIDTH, HEIGHT, np.array([60.0, 60.0, 47.5, 31.5, 0.02, 0, 0, 0])),
]
CENTER = np.array([4.0, -3.0, 2.5])
VIEW = look_at(CENTER, (0.1, 0.2, 0.4))

anycamera = pytest.mark.parametrize("camera", [pytest.param(c, id=c.model.name) for c in CAMERAS])


def world_rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions in world and z in camera of every pixel, (h, w, 3) and (h, w)."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    rays = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1).astype(float))
    return (rays @ VIEW.rotation).reshape(HEIGHT, WIDTH, 3), rays[:, 2].reshape(HEIGHT, WIDTH)


def check_depth(depth: np.ndarray, distance: np.ndarray, z_of_ray: np.ndarray) -> None:
    """Equal where both see the surface; a sky pixel more or less only for rays that graze the outline."""
    seen = np.isfinite(distance)
    assert 200 < seen.sum() < seen.size
    np.testing.assert_array_equal(np.isfinite(depth), seen)
    np.testing.assert_allclose(depth[seen], (distance * z_of_ray)[seen], rtol=1e-9)


@anycamera
def test_sphere_depth(camera: Camera) -> None:
    center, radius = np.array([0.2, 0.3, 0.4]), 1.1
    depth = render(SyntheticScene.of([Sphere(center=tuple(center), radius=radius)]), camera, VIEW).depth
    directions, z = world_rays(camera)
    # |c + t d - m|^2 = r^2, the smaller root of the polynomial.
    b, c = 2 * directions @ (CENTER - center), (CENTER - center) @ (CENTER - center) - radius**2
    under = b * b - 4 * c
    distance = np.where(under >= 0, (-b - np.sqrt(np.maximum(under, 0))) / 2, np.nan)
    check_depth(depth, distance, z)


@anycamera
def test_plane_depth(camera: Camera) -> None:
    plane = Plane(
        center=(0, 0.5, 0.4), direction_u=(1, 0, 0), direction_v=(0, 0.6, 0.8), half_size=(1.3, 0.9)
    )
    depth = render(SyntheticScene.of([plane]), camera, VIEW).depth
    directions, z = world_rays(camera)
    # c + t d = m + a u + b v: three linear equations in (a, b, t).
    u, v = np.array(plane.direction_u, float), np.array(plane.direction_v, float)
    columns = np.stack([np.broadcast_to(u, directions.shape), np.broadcast_to(v, directions.shape)], axis=-1)
    system = np.concatenate([columns, -directions[..., None]], axis=-1)
    a, b, t = np.moveaxis(np.linalg.solve(system, (CENTER - plane.center)[:, None])[..., 0], -1, 0)
    check_depth(depth, np.where((abs(a) <= 1.3) & (abs(b) <= 0.9) & (t > 0), t, np.nan), z)


@anycamera
def test_box_depth(camera: Camera) -> None:
    angle, half = 0.4, np.array([0.9, 0.6, 0.5])
    box = Box(center=(0.1, 0.2, 0.3), half_size=tuple(half), angle_rad=angle)
    depth = render(SyntheticScene.of([box]), camera, VIEW).depth
    directions, z = world_rays(camera)
    c, s = np.cos(angle), np.sin(angle)
    local_from_world = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    start, along = local_from_world @ (CENTER - np.array(box.center)), directions @ local_from_world.T
    # The nearest of the six faces whose crossing lies inside the face.
    distance = np.full((HEIGHT, WIDTH), np.inf)
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for side in (-half[axis], half[axis]):
            t = (side - start[axis]) / along[..., axis]
            at = start + t[..., None] * along
            on_face = (np.abs(at[..., others]) <= half[others]).all(axis=-1) & (t > 0)
            distance = np.where(on_face & (t < distance), t, distance)
    check_depth(depth, np.where(np.isfinite(distance), distance, np.nan), z)


@anycamera
def test_ground_depth_lies_on_the_ground(camera: Camera) -> None:
    ground = HeightField(center=(0, 0, 0.2), half_size=(2, 2), amplitude=0.15, wavelength=1.1, seed=5)
    depth = render(SyntheticScene.of([ground]), camera, VIEW).depth
    directions, z = world_rays(camera)
    seen = np.isfinite(depth)
    assert seen.sum() > 500
    at = CENTER + (depth / z)[seen][:, None] * directions[seen]
    heights = np.array([0.2 + kernels.height_at(x, y, 0.15, 1.1, 5) for x, y in at[:, :2]])
    np.testing.assert_allclose(at[:, 2], heights, atol=1e-9)
    assert np.ptp(heights) > 0.1
    assert (np.abs(at[:, :2]) <= 2).all()


def test_the_nearer_surface_hides_the_farther() -> None:
    near, far = Sphere(center=(2.0, -1.4, 1.45), radius=0.4), Sphere(center=(0, 0, 0.4), radius=1.2)
    both, swapped, alone = (
        render(SyntheticScene.of(p), CAMERAS[0], VIEW).depth for p in ([near, far], [far, near], [near])
    )
    np.testing.assert_array_equal(both, swapped)
    seen = np.isfinite(alone)
    assert seen.sum() > 50
    np.testing.assert_array_equal(both[seen], alone[seen])


def test_plain_texture_gives_a_blank_picture() -> None:
    def wall(texture: Texture) -> SyntheticScene:
        return SyntheticScene.of(
            [
                Plane(
                    center=(0, 0, 0), direction_u=(1, 0, 0), direction_v=(0, 0, 1), half_size=(50, 50),
                    texture=texture,
                )
            ]
        )  # fmt: skip

    blank, rich = (
        render(wall(t), CAMERAS[0], look_at((0, -3, 0), (0, 0, 0))).rgb for t in (Texture.PLAIN, Texture.RICH)
    )
    assert (blank == blank[0, 0]).all()
    assert rich.std() > 10


def test_sensor_noise() -> None:
    plain = Plane(
        center=(0, 0, 0),
        direction_u=(1, 0, 0),
        direction_v=(0, 0, 1),
        half_size=(50, 50),
        texture=Texture.PLAIN,
    )
    scene = SyntheticScene.of([plain])
    clean = render(scene, CAMERAS[0], VIEW).rgb.astype(float)
    noisy = render(scene, CAMERAS[0], VIEW, noise_sigma=4.0, seed=3).rgb.astype(float)
    # Rounding adds 1/12 to the variance; 18432 values know their deviation to 0.5 %.
    assert (noisy - clean).std() == pytest.approx(np.sqrt(16 + 1 / 12), rel=0.03)
    again, other = (render(scene, CAMERAS[0], VIEW, noise_sigma=4.0, seed=s).rgb for s in (3, 4))
    np.testing.assert_array_equal(again, noisy)
    assert (other != again).any()


@pytest.fixture
def thread_count() -> object:
    yield _parallel.set_num_threads
    _parallel.set_num_threads(None)


def test_threads_change_nothing(thread_count: Callable[[int], None]) -> None:
    scene, view = courtyard(), courtyard_views(3)[1]
    pictures: list[Rendering] = []
    for count in (1, 2, 5):
        thread_count(count)
        pictures.append(render(scene, CAMERAS[1], view, noise_sigma=1.0, seed=1))
    for picture in pictures[1:]:
        np.testing.assert_array_equal(picture.rgb, pictures[0].rgb)
        np.testing.assert_array_equal(picture.depth, pictures[0].depth)


def courtyard_camera(width: int, height: int) -> Camera:
    params = np.array([0.78 * width, (width - 1) / 2, (height - 1) / 2, -0.05])
    return Camera(CameraModel.SIMPLE_RADIAL, width, height, params)


def test_points_keep_place_and_colour_between_views() -> None:
    scene, views, camera = courtyard(), courtyard_views(24), courtyard_camera(480, 320)
    one, two = render(scene, camera, views[10]), render(scene, camera, views[11])
    v, u = np.mgrid[4:316:4, 4:476:4]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    depth = one.depth[pixels[:, 1], pixels[:, 0]]
    rays = camera.unproject(pixels.astype(float))
    in_cam1 = rays / rays[:, 2:] * depth[:, None]
    in_cam2 = (views[11] @ views[10].inverse()).apply(in_cam1[np.isfinite(depth)])
    pixels = pixels[np.isfinite(depth)]
    there = camera.project(in_cam2)
    inside = ((there > 2) & (there < (477, 317))).all(axis=1)
    there, z, pixels = there[inside], in_cam2[inside, 2], pixels[inside]
    x, y = there.astype(np.float32).T
    depth_there = cv2.remap(two.depth.astype(np.float32), x, y, cv2.INTER_LINEAR)[0]
    same = np.abs(depth_there - z) < 0.01 * z
    assert same.mean() > 0.95  # the rest is hidden, or on an edge
    # Compared after a blur, which takes away what the two pixel grids sample differently.
    blurred = [cv2.GaussianBlur(r.rgb.astype(np.float32), (0, 0), 1.5) for r in (one, two)]
    here = blurred[0][pixels[same, 1], pixels[same, 0]]
    colour = cv2.remap(blurred[1], x[same], y[same], cv2.INTER_LINEAR)[0]
    typical = float(np.median(np.abs(colour - here)))
    shuffled = float(np.median(np.abs(colour - np.roll(here, 977, axis=0))))
    assert typical < 5
    assert shuffled > 4 * typical


def test_courtyard_is_rich() -> None:
    camera = courtyard_camera(960, 640)
    rgb = render(courtyard(), camera, courtyard_views()[6], noise_sigma=2.0).rgb
    keypoints = cv2.SIFT_create().detect(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY))
    places = np.array([k.pt for k in keypoints])
    assert len(np.unique(places.round(1), axis=0)) > 2000
    assert ((rgb == 255) | (rgb == 0)).mean() < 0.02


def test_neighbouring_views_overlap() -> None:
    views = courtyard_views(24)
    assert len(views) == 24
    centers, axes = views.centers(), views.rotation[:, 2]
    turns = np.degrees(np.arccos(np.clip((axes[1:] * axes[:-1]).sum(axis=1), -1, 1)))
    assert turns.max() < 20
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.min() > 0.02
    assert steps.max() < 1.5


def test_look_at() -> None:
    view = look_at((1.0, 2.0, 3.0), (4.0, -1.0, 0.5))
    np.testing.assert_allclose(view.rotation @ view.rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(view.rotation) == pytest.approx(1)
    np.testing.assert_allclose(view.centers(), [1, 2, 3], atol=1e-14)
    target = view.apply([4.0, -1.0, 0.5])
    np.testing.assert_allclose(target[:2], 0, atol=1e-14)
    assert target[2] > 0
    above = view.apply([4.0, -1.0, 0.6])
    assert above[1] < 0  # upwards in the picture
    assert above[0] == pytest.approx(0, abs=1e-14)


def test_look_at_refuses_what_has_no_answer() -> None:
    with pytest.raises(DegenerateGeometryError):
        look_at((1, 1, 1), (1, 1, 1))
    with pytest.raises(DegenerateGeometryError):
        look_at((1, 1, 1), (1, 1, 5))


def test_an_empty_scene_is_refused() -> None:
    with pytest.raises(ShapeError, match="at least one"):
        SyntheticScene.of([])


def test_a_camera_that_sees_nothing() -> None:
    scene = SyntheticScene.of([Sphere(center=(0, 0, 0), radius=0.5)])
    away: Rigid3 = look_at((4, 0, 0), (8, 0, 0))
    picture = render(scene, CAMERAS[0], away)
    assert np.isnan(picture.depth).all()
    assert (picture.rgb == picture.rgb[0, 0]).all()
