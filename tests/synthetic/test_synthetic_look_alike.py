"""Scenes in which different surfaces look the same: cameras see the scene, and equal facades have equal images."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError
from epipole.synthetic import SyntheticScene, Texture, look_at, render
from epipole.synthetic.look_alike import BLOCK_HEIGHT_M, city_of_like_blocks, tiled_room

CAMERA = Camera(CameraModel.PINHOLE, 96, 72, np.array([60.0, 60.0, 47.5, 35.5]))
SCENES = pytest.mark.parametrize("make", [city_of_like_blocks, tiled_room])


def facades(scene: SyntheticScene) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Seed, middle and outward direction of each facade: the tiled planes."""
    planes = (scene.kind == scene.kind[0]) & (scene.texture == Texture.TILED)
    out = []
    for row in np.flatnonzero(planes):
        middle, right = scene.params[row, :3], scene.params[row, 3:6]
        out.append((int(scene.seed[row]), middle, np.array([right[1], -right[0], 0.0])))
    return out


@SCENES
def test_every_camera_sees_the_scene_and_no_two_images_are_the_same(make) -> None:
    scene, cams_from_world = make(0)
    images = [render(scene, CAMERA, view) for view in cams_from_world]
    assert min(np.isfinite(image.depth).mean() for image in images) > 0.7
    assert min(np.nanmin(image.depth) for image in images) > 0.5
    gray = np.stack([image.rgb.astype(float).mean(axis=2) for image in images])
    assert min(image.std() for image in gray) > 10
    for k, image in enumerate(gray):
        others = np.delete(gray, k, axis=0)
        assert np.abs(others - image).mean(axis=(1, 2)).min() > 5


@SCENES
def test_the_seed_determines_the_scene_and_the_cameras(make) -> None:
    (scene, views), (again, views_again), (other, other_views) = make(3), make(3), make(4)
    np.testing.assert_array_equal(views.translation, views_again.translation)
    np.testing.assert_array_equal(render(scene, CAMERA, views[0]).rgb, render(again, CAMERA, views[0]).rgb)
    assert np.abs(views.translation - other_views.translation).min() > 0
    assert (render(scene, CAMERA, views[0]).rgb != render(other, CAMERA, views[0]).rgb).mean() > 0.6
    with pytest.raises(ConfigError, match="seed"):
        make(-1)


def test_facades_of_different_blocks_look_the_same_and_those_of_one_block_differ() -> None:
    scene, _ = city_of_like_blocks(1)
    narrow = Camera(CameraModel.PINHOLE, 96, 72, np.array([240.0, 240.0, 47.5, 35.5]))
    images: dict[int, list[np.ndarray]] = {}
    for seed, middle, out in facades(scene):
        target = np.array([middle[0], middle[1], BLOCK_HEIGHT_M - 0.6])  # above the balcony and the posters
        image = render(scene, narrow, look_at(target + 1.5 * out, target)).rgb.astype(float)
        images.setdefault(seed, []).append(image)
    assert [len(group) for group in images.values()] == [4, 4, 4, 4]
    for group in images.values():
        for image in group[1:]:
            assert np.abs(image - group[0]).mean() < 1
    firsts = [group[0] for group in images.values()]
    assert min(np.abs(firsts[a] - firsts[b]).mean() for a in range(4) for b in range(a)) > 10


def test_walls_of_the_tiled_room_share_a_tile_and_each_wall_has_unique_posters() -> None:
    scene, views = tiled_room(2)
    is_tiled = scene.texture == Texture.TILED
    assert is_tiled.sum() == 5 and len(set(scene.seed[is_tiled].tolist())) == 1
    unique = scene.seed[scene.texture == Texture.RICH].tolist()
    assert len(unique) == len(set(unique)) == 4 * (2 + 1)
    assert np.abs(views.centers()[:, :2]).max() < 1.5
