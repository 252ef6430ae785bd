"""Surfaces from images in memory."""

import numpy as np
import pytest
from dense_scenes import CAMERA, RANGE, rendered
from scipy.spatial import cKDTree

from epipole.cameras import Camera
from epipole.dense import estimate_depth, fuse_depths, mesh_depths, texture_from_images
from epipole.dense.texturing.rendering import render_textured
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3
from whole import in_whole_run

ROWS = tuple(range(6, 13))


@pytest.fixture(scope="module")
def given():
    views, _ = rendered()
    rotation = np.stack([views[k].cam_from_world.rotation for k in ROWS])
    translation = np.stack([views[k].cam_from_world.translation for k in ROWS])
    return [views[k].rgb for k in ROWS], [CAMERA] * len(ROWS), Rigid3(rotation, translation)


@pytest.fixture(scope="module")
def depths(given):
    return estimate_depth(*given, RANGE, num_sources=4)


@in_whole_run
def test_images_become_depth_points_a_mesh_and_a_texture(given, depths):
    images, cameras, poses = given
    truth = [rendered()[1][k] for k in ROWS]
    for depth, exact in zip(depths, truth):
        error = np.abs(depth.depth / exact - 1.0)[np.isfinite(depth.depth) & np.isfinite(exact)]
        assert depth.density > 0.6 and np.median(error) < 0.004
    fused = fuse_depths(*given, depths)
    assert len(fused.points) > 50_000 and len(fused.depths) == len(ROWS)
    mesh = mesh_depths(cameras, poses, fused.depths)
    assert len(mesh) > 20_000
    textured = texture_from_images(mesh, images, cameras, poses, side_px=2048)
    shown, depth = render_textured(textured, CAMERA, poses[3])
    covered = np.isfinite(depth)
    error = shown[covered].astype(float) - images[3][covered]
    assert covered.mean() > 0.6 and 20 * np.log10(255 / np.sqrt((error**2).mean())) > 22


def test_a_model_far_from_the_origin_gives_the_same_mesh(given, depths):
    _, cameras, poses = given
    shift = np.array([5e5, 5.6e6, 200.0])
    here = mesh_depths(cameras, poses, depths, 0.08)
    there = mesh_depths(cameras, poses @ Rigid3(np.eye(3), -shift), depths, 0.08)
    assert len(there) == pytest.approx(len(here), rel=0.2)
    distance = cKDTree(here.vertices_in_world).query(there.vertices_in_world - shift)[0]
    assert np.median(distance) < 0.5 * 0.08 and np.quantile(distance, 0.95) < 0.08


def test_what_does_not_fit_is_named(given, depths):
    images, cameras, poses = given
    with pytest.raises(ShapeError, match="cameras must have 7 entries"):
        estimate_depth(images, cameras[:-1], poses, RANGE)
    with pytest.raises(ShapeError, match="cams_from_world must have 7 poses"):
        estimate_depth(images, cameras, poses[0], RANGE)
    with pytest.raises(ShapeError, match="depths must have 7 entries"):
        fuse_depths(images, cameras, poses, depths[:-1])
    with pytest.raises(ConfigError, match="undistort"):
        radial = Camera("SIMPLE_RADIAL", 320, 240, [290.0, 159.5, 119.5, 0.1])
        estimate_depth(images, [radial] * 7, poses, RANGE)
    with pytest.raises(ConfigError, match="increasing"):
        estimate_depth(images[:2], cameras[:2], poses[:2], (9.0, 1.0))
    with pytest.raises(ShapeError, match="depths must be a pair"):
        estimate_depth(images, cameras, poses, np.ones((3, 2)))
    with pytest.raises(DegenerateGeometryError, match="no pixel"):
        mesh_depths([], Rigid3(np.empty((0, 3, 3)), np.empty((0, 3))), [])
    alone = estimate_depth(images[:1], cameras[:1], poses[:1], RANGE)
    assert alone[0].density == 0.0


def test_masked_pixels_have_no_depth(given):
    images, cameras, poses = given
    masks = [np.ones(image.shape[:2], bool) for image in images[:3]]
    masks[0][:, :160] = False
    found = estimate_depth(images[:3], cameras[:3], poses[:3], RANGE, masks=masks)
    assert np.isnan(found[0].depth[:, :160]).all() and np.isfinite(found[0].depth[:, 160:]).any()
