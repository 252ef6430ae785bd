"""Where Gaussians begin: stereo of neighboring views against true surfaces, what cameras look into, and other fields."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fields_scenes import CAMERA, scene, views

from epipole.cameras import Camera
from epipole.errors import DegenerateGeometryError, FileFormatError
from epipole.fields.config import SplatTraining
from epipole.fields.splat.starting import (
    EMPTY_PARTS,
    POINTS_OF_PART,
    have_one_direction,
    points_in_empty_parts,
    points_in_frusta,
)
from epipole.fields.training_view import TrainingView
from epipole.io.gaussians.ply import write_gaussian_ply
from epipole.pipelines.fields.dense_points import dense_points, neighbors_of
from epipole.pipelines.fields.first_gaussians import first_gaussians
from epipole.pipelines.fields.images import FieldImages
from epipole.synthetic import courtyard, courtyard_views, look_at, render

YARD = Camera("PINHOLE", 160, 120, [150.0, 150.0, 79.5, 59.5])


@cache
def yard():
    """Views of the courtyard with the points that they see, of 200 random pixels of each view, and true depths."""
    positions, rng, points = courtyard_views(48)[:6], np.random.default_rng(3), []
    rendered = [render(courtyard(), YARD, positions[n]) for n in range(6)]
    for n, image in enumerate(rendered):
        row, column = (rng.integers(0, size, 200) for size in image.depth.shape)
        depth = image.depth[row, column]
        rays = YARD.unproject(np.stack([column, row], axis=1).astype(float))
        points.append(positions[n].inverse().apply(rays / rays[:, 2:] * depth[:, None])[np.isfinite(depth)])
    every, out = np.concatenate(points), []
    for n, image in enumerate(rendered):
        in_cam = positions[n].apply(every)
        pixels = np.rint(YARD.project(in_cam))
        inside = np.flatnonzero(
            (in_cam[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels < [160, 120]).all(axis=1)
        )
        column, row = pixels[inside].astype(int).T
        seen = inside[np.abs(image.depth[row, column] - in_cam[inside, 2]) < 0.05 * in_cam[inside, 2]]
        out.append(TrainingView(f"{n}", image.rgb, YARD, positions[n], points_in_world=every[seen]))
    return tuple(out), [image.depth for image in rendered]


def images(of, points=None):
    points = np.empty((0, 3)) if points is None else points
    return FieldImages(list(of), [], points, np.full(points.shape, 128, np.uint8), False, [])


def untold(*_):
    """Nothing is done with the progress."""


def test_neighbors_see_the_same_from_angles_that_tell():
    pairs = neighbors_of(yard()[0])
    assert {0, 1, 2, 3, 4, 5} == {n for pair in pairs for n in pair}
    assert all(one < other for one, other in pairs) and len(pairs) <= 12
    assert neighbors_of([replace(view, points_in_world=None) for view in yard()[0]]) == []


def test_points_of_stereo_lie_on_the_surfaces():
    given = []
    found = dense_points(yard()[0], 5000, 1, lambda *counts: given.append(counts))
    assert len(found.points_in_world) == 5000 and given[0][0] == 0 and given[-1][0] == given[-1][1] > 2
    off = np.full((6, 5000), np.inf)
    for n, (view, depth) in enumerate(zip(*yard())):
        positions = view.cam_from_world.apply(found.points_in_world)
        pixels = np.rint(YARD.project(positions))
        inside = (pixels >= 1).all(axis=1) & (pixels < [158, 118]).all(axis=1) & (positions[:, 2] > 0)
        column, row = pixels[inside].astype(int).T
        off[n, inside] = np.nan_to_num(np.abs(positions[inside, 2] / depth[row, column] - 1.0), nan=np.inf)
    # Where another surface hides a point its depth is another one: the view counts that fits best.
    best = off.min(axis=0)
    assert np.median(best) < 0.005 and np.mean(best < 0.05) > 0.95
    again = dense_points(yard()[0], 5000, 1, untold)
    np.testing.assert_array_equal(found.points_in_world, again.points_in_world)
    assert len(dense_points(yard()[0][:1], 100, 0, untold).rgb) == 0


def test_masked_pixels_give_no_points():
    mask = np.ones((120, 160), bool)
    mask[:, :80] = False
    of = [replace(view, used_mask=mask) for view in yard()[0]]
    found = dense_points(of, 10**6, 0, untold)
    whole = dense_points(yard()[0], 10**6, 0, untold)
    assert 0 < len(found.rgb) < 0.7 * len(whole.rgb)


def test_what_is_missing_is_filled_up_by_stereo():
    of, points = yard()[0], yard()[0][2].points_in_world[::5]
    given = []
    plain = first_gaussians(images(of, points), SplatTraining(start="points"), 5000, untold).cloud
    assert len(points) <= len(plain) < 1.1 * len(points)  # and a few distant ones
    dense, _ = first_gaussians(
        images(of, points), SplatTraining(start="dense"), 5000, lambda *counts: given.append(counts)
    )
    assert 3000 <= len(dense) <= 3500 and given[-1][0] == given[-1][1] > 0
    known = [cloud.means_in_world[: len(points)] for cloud in (dense, plain)]
    np.testing.assert_array_equal(*known)
    enough = first_gaussians(images(of, points), SplatTraining(start="dense"), 200, untold).cloud
    assert len(points) <= len(enough) <= len(points) + 20


def test_cameras_that_look_the_same_way_start_in_what_they_see():
    positions = [look_at((0.2 * n, 0.1 * n, 0), (0.2 * n, 0.1 * n + 5, 0)) for n in range(4)]
    of = [replace(view, cam_from_world=position) for view, position in zip(views(), positions)]
    assert have_one_direction(of) and not have_one_direction(views())
    points, rgb = points_in_frusta(of, 100, seed=2)
    apart = np.linalg.norm([0.2, 0.1])
    depths = of[0].cam_from_world.apply(points[:25])[:, 2]
    assert len(points) == len(rgb) == 100
    assert (depths > 1.99 * apart).all() and (depths < 101 * apart).all() and depths.max() > 6 * apart
    pixels = CAMERA.project(of[0].cam_from_world.apply(points[:25])).round().astype(int)
    np.testing.assert_array_equal(rgb[:25], of[0].image[pixels[:, 1], pixels[:, 0], :3])
    assert (of[0].image[pixels[:, 1], pixels[:, 0], 3] > 0).all()
    started = first_gaussians(images(of), SplatTraining(), 2000, untold).cloud
    assert len(started) == 200
    with pytest.raises(DegenerateGeometryError, match="have the same position"):
        points_in_frusta([of[0], of[0]], 10)
    with pytest.raises(DegenerateGeometryError, match="transparent or masked"):
        points_in_frusta([replace(view, used_mask=np.zeros((48, 64), bool)) for view in of], 10)


def test_another_field_is_begun_with(tmp_path):
    write_gaussian_ply(tmp_path / "a.ply", scene())
    for degree, start_from in ((0, tmp_path / "a.ply"), (3, tmp_path / "a.ply")):
        config = SplatTraining(start_from=start_from, sh_degree=degree)
        found = first_gaussians(images(views()), config, 1000, untold).cloud
        np.testing.assert_array_equal(found.means_in_world, scene().means_in_world)
        assert found.sh.shape[1] == 1
    with pytest.raises(FileFormatError):
        first_gaussians(images(views()), SplatTraining(start_from=tmp_path / "b.ply"), 1000, untold)


def test_points_can_be_left_aside():
    config = SplatTraining(start="random")
    found = first_gaussians(images(views(), np.ones((500, 3))), config, 5000, untold).cloud
    assert len(found) == 500 and len(np.unique(found.means_in_world, axis=0)) > 400


def test_parts_of_images_without_points_get_distant_ones():
    of, _ = yard()
    points = np.concatenate([view.points_in_world for view in of])
    points = points[points[:, 2] < np.median(points[:, 2])]
    far, rgb = points_in_empty_parts(of[:1], points)
    local = of[0].cam_from_world.apply(far)
    pixels = YARD.project(local)
    at = pixels.round().astype(int)
    np.testing.assert_allclose(pixels, at, atol=1e-6)
    np.testing.assert_array_equal(rgb, of[0].image[at[:, 1], at[:, 0], :3])
    shown = YARD.project(of[0].cam_from_world.apply(points))
    shown = shown[((shown >= 0) & (shown < [160, 120])).all(axis=1)]
    side = max(160 / EMPTY_PARTS, (POINTS_OF_PART * 160 * 120 / len(shown)) ** 0.5)
    parts = np.round([160 / side, 120 / side])
    known, empty = ({tuple(p) for p in (at * parts / [160, 120]).astype(int)} for at in (shown, pixels))
    assert known and empty and not known & empty and len(known) + len(empty) == parts.prod()
    near = np.linalg.norm(of[0].cam_from_world.apply(points), axis=1)
    assert np.ptp(np.linalg.norm(local, axis=1)) < 1e-9 and np.linalg.norm(local[0]) > np.median(near)


def test_transparent_and_masked_parts_get_none():
    of, _ = yard()
    points = of[0].points_in_world
    masked = replace(of[0], used_mask=np.zeros((120, 160), bool))
    assert len(points_in_empty_parts([masked], points)[0]) == 0
    clear = np.concatenate([of[0].image[..., :3], np.zeros((120, 160, 1), np.uint8)], axis=2)
    assert len(points_in_empty_parts([replace(of[0], image=clear)], points)[0]) == 0
    away = replace(of[0], cam_from_world=look_at((50, 0, 0), (100, 0, 0)))
    assert len(points_in_empty_parts([away], points)[0]) == 0
