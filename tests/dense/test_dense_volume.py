"""Sparse volumes: a ball becomes a closed surface of its size; blocks, neighbors; kernels against Python."""

from dataclasses import replace

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.dense import _volume_kernels, volume
from epipole.dense.volume import SparseVolume, blocks_of_depth, blocks_of_keys, neighbors_of
from epipole.dense.volume_building import DepthImage, build_volume
from epipole.errors import ConfigError, DegenerateGeometryError, ShapeError
from epipole.geometry import Rigid3
from epipole.scene.view_depth import ViewDepth
from epipole.synthetic import look_at
from kernel_references import assert_same_as_python, record_calls, reference_of

CAMERA = Camera("PINHOLE", 160, 120, [150.0, 150.0, 79.5, 59.5])
AROUND = [
    look_at(
        3.0 * np.array([np.sqrt(1 - z * z) * np.cos(2.4 * n), np.sqrt(1 - z * z) * np.sin(2.4 * n), z]),
        (0, 0, 0),
    )
    for n, z in enumerate(np.linspace(-0.9, 0.9, 24))
]
RADIUS = 0.8


def ball_seen(cam_from_world):
    """Depth of a ball at the origin."""
    v, u = np.mgrid[:120, :160]
    rays = np.stack([(u - 79.5) / 150.0, (v - 59.5) / 150.0, np.ones(u.shape)], axis=2)
    middle = cam_from_world.apply(np.zeros((1, 3)))[0]
    a, b, c = (rays**2).sum(2), rays @ middle, middle @ middle - RADIUS**2
    root = b * b - a * c
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.nan).astype(np.float32)
    ok = np.isfinite(depth).astype(np.uint8)
    return ViewDepth(depth, np.float32(0.003) * depth, np.where(ok, 0, 3).astype(np.uint8), 3 * ok)


def ball(voxel=0.05, poses=AROUND):
    keys = np.unique(
        np.concatenate([blocks_of_depth(CAMERA, pose, ball_seen(pose), voxel) for pose in poses])
    )
    out = SparseVolume(blocks_of_keys(keys), voxel)
    for pose in poses:
        out.add(CAMERA, pose, ball_seen(pose))
    return out


def test_a_ball_is_a_closed_surface_of_its_size():
    found = ball().mesh()
    radius = np.linalg.norm(found.vertices_in_world, axis=1)
    assert np.percentile(np.abs(radius - RADIUS), 95) < 0.5 * 0.05
    ends = np.sort(found.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(ends, axis=0, return_counts=True)[1] % 2 == 0).all()  # no border
    a, b, c = (found.vertices_in_world[found.faces[:, n]] for n in range(3))
    inside = (np.cross(a, b) * c).sum() / 6.0  # above 0 where faces look outward
    assert inside == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.04)
    assert len(found.without_small_components(0.1)) == len(found)


def test_what_no_view_sees_stays_a_hole():
    half = [pose for pose in AROUND if pose.inverse().translation[2] > 0.5]
    found = ball(poses=half).mesh()
    assert found.vertices_in_world[:, 2].min() > -0.75 * RADIUS
    assert found.vertices_in_world[:, 2].max() > 0.9 * RADIUS


def test_neighbors_are_the_blocks_at_the_offsets():
    rng = np.random.default_rng(0)
    blocks = np.unique(rng.integers(-2, 3, (60, 3)), axis=0)
    for step in (1, -1):
        found = neighbors_of(blocks, step)
        for row, block in enumerate(blocks):
            for n in range(8):
                wanted = block + step * np.array([n >> 2, (n >> 1) & 1, n & 1])
                rows = np.flatnonzero((blocks == wanted).all(axis=1))
                assert found[row, n] == (rows[0] if len(rows) else -1)


def test_wrong_arguments_are_refused():
    depth = ball_seen(AROUND[0])
    with pytest.raises(ConfigError, match="voxel"):
        SparseVolume(np.zeros((1, 3), np.int64), 0.0)
    with pytest.raises(ConfigError, match="too large for the voxels"):
        blocks_of_depth(CAMERA, AROUND[0], depth, 1e-9)
    out = ball(poses=AROUND[:1])
    with pytest.raises(ShapeError, match="different sizes"):
        out.add(Camera("PINHOLE", 80, 60, [75.0, 75.0, 39.5, 29.5]), AROUND[0], depth)
    radial = Camera("RADIAL", 160, 120, [150.0, 79.5, 59.5, 0.1, 0.1])
    two = Rigid3.identity(2)
    nowhere = Rigid3(np.eye(3), np.full(3, np.nan))
    for camera, pose, error in (
        (radial, AROUND[0], ConfigError), (CAMERA, two, ShapeError), (CAMERA, nowhere, ShapeError)
    ):  # fmt: skip
        with pytest.raises(error):
            out.add(camera, pose, depth)
        with pytest.raises(error):
            blocks_of_depth(camera, pose, depth, 0.1)
    with pytest.raises(DegenerateGeometryError, match="no surface"):
        SparseVolume(np.zeros((1, 3), np.int64), 0.1).mesh()


def test_free_space_removes_a_surface_that_one_view_has_wrong():
    def beside(elsewhere):
        """Number of vertices beside the ball; pixels that do not show it have this depth, but some of the first view."""
        depths = []
        for pose in AROUND:
            seen = ball_seen(pose)
            depth = np.where(np.isnan(seen.depth), np.float32(elsewhere), seen.depth)
            depths.append(replace(seen, depth=depth, sigma=np.nan_to_num(seen.sigma)))
        depths[0].depth[:20, :20] = 3.0
        images = [DepthImage(CAMERA, pose, lambda seen=seen: seen) for pose, seen in zip(AROUND, depths)]
        found = build_volume(images, 0.05).mesh()
        return (np.linalg.norm(found.vertices_in_world, axis=1) > RADIUS + 0.1).sum()

    assert beside(np.nan) > 50 and beside(np.inf) == 0


def test_a_box_limits_the_volume_to_its_blocks():
    images = [DepthImage(CAMERA, pose, lambda pose=pose: ball_seen(pose)) for pose in AROUND]
    low, high = np.array([-1.0, -1.0, 0.0]), np.ones(3)
    whole, part = build_volume(images, 0.05), build_volume(images, 0.05, box=(low, high))
    assert len(part.blocks) < 0.7 * len(whole.blocks)
    corners = 8 * 0.05 * part.blocks
    assert ((corners + 8 * 0.05 > low) & (corners < high)).all()
    upper = part.mesh().vertices_in_world
    every = {row.tobytes() for row in whole.mesh().vertices_in_world}
    assert len(upper) > 1000 and all(row.tobytes() in every for row in upper)
    with pytest.raises(DegenerateGeometryError, match="within the box"):
        build_volume(images, 0.05, box=(np.full(3, 5.0), np.full(3, 6.0)))
    nothing = replace(ball_seen(AROUND[0]), depth=np.full((120, 160), np.inf, np.float32))
    with pytest.raises(DegenerateGeometryError, match="no pixel has a depth"):
        build_volume([DepthImage(CAMERA, AROUND[0], lambda: nothing)], 0.05)


@reference_of(
    _volume_kernels.touched_blocks,
    _volume_kernels.integrate,
    _volume_kernels.net_vertices,
    _volume_kernels.net_faces,
)
def test_kernels_do_what_their_python_does(monkeypatch):
    kernels = (
        _volume_kernels.touched_blocks,
        _volume_kernels.integrate,
        _volume_kernels.net_vertices,
        _volume_kernels.net_faces,
    )
    calls = {kernel: record_calls(monkeypatch, volume, kernel) for kernel in kernels}
    ball(0.15, AROUND[:3]).mesh()
    first = dict(zip(kernels, (5, 6, 6, 5)))
    for kernel, recorded in calls.items():
        arguments = list(recorded[len(recorded) // 2])
        start = first[kernel]
        arguments[start + 1] = min(arguments[start] + 6, arguments[start + 1])
        assert_same_as_python(kernel, *arguments, rtol=1e-5, atol=1e-6)
