"""Texture: neighbors, charts, atlas, seams and views of a known room; kernels against Python."""

from dataclasses import replace

import numpy as np
import pytest
from dense_scenes import CAMERA

from epipole.dense.texturing import _choice_kernels, _raster_kernels, texture, view_choice
from epipole.dense.texturing.charts import charts_of, pack
from epipole.dense.texturing.rendering import render_textured
from epipole.dense.texturing.seams import color_offsets
from epipole.dense.texturing.texture import texture_mesh
from epipole.dense.texturing.texture_view import TextureView
from epipole.dense.texturing.view_choice import FaceViews, choose_views, face_neighbors
from epipole.dense.view import DenseView
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.scene import Mesh
from epipole.synthetic import Plane, SyntheticScene, look_at
from epipole.synthetic.render import render
from kernel_references import assert_same_as_python, record_calls, reference_of

WALL = SyntheticScene.of(
    [Plane(center=(0, 0, 0), direction_u=(1, 0, 0), direction_v=(0, 0, 1), half_size=(2, 1.5), seed=5)]
)
POSES = [look_at((x, -3.0, 0.3 * x), (0.3 * x, 0, 0)) for x in (-1.2, -0.4, 0.4, 1.2)]


def wall_mesh(side=12):
    """The wall as triangles; counterclockwise seen from the cameras at y < 0."""
    u, v = np.linspace(-2, 2, side + 1), np.linspace(-1.5, 1.5, side + 1)
    x, z = np.meshgrid(u, v)
    vertices = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    k = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    one, two = np.stack([k, k + 1, k + side + 2], axis=1), np.stack([k, k + side + 2, k + side + 1], axis=1)
    return Mesh(vertices, np.concatenate([one, two]), np.zeros((len(vertices), 3), np.uint8))


def wall_views(gains=(1.0, 1.0, 1.0, 1.0), change=lambda n, rgb: rgb):
    out = []
    for n, (pose, gain) in enumerate(zip(POSES, gains)):
        rgb = render(WALL, CAMERA, pose).rgb
        rgb = change(n, np.clip(gain * rgb, 0, 255).astype(np.uint8))
        view = DenseView(f"{n}.jpg", rgb, CAMERA, pose)
        out.append(
            TextureView(view.name, CAMERA, pose, CAMERA, lambda view=view: view, lambda view=view: view.rgb)
        )
    return out


def error_from(found, x=0.0, gain=1.0):
    """RMS difference of a rendered texture from the truth, in gray levels, over the pixels it covers."""
    pose = look_at((x, -3.0, 0.1), (0.2 * x, 0, 0))
    rgb, depth = render_textured(found, CAMERA, pose)
    inside = np.isfinite(depth)
    assert inside.mean() > 0.5
    truth = gain * render(WALL, CAMERA, pose).rgb[inside].astype(float)
    return float(np.sqrt(((rgb[inside] - truth) ** 2).mean()))


def test_a_new_view_of_a_textured_wall_is_right():
    found = texture_mesh(wall_mesh(), wall_views(), 1024)
    assert error_from(found) < 12.0 and error_from(found, 0.8) < 12.0
    assert found.textures[0].shape[1] == 1024


def test_someone_who_walks_by_is_not_in_the_texture():
    def passer(n, rgb):
        if n == 1:
            rgb = rgb.copy()
            rgb[60:200, 120:220] = (250, 20, 250)
        return rgb

    found = texture_mesh(wall_mesh(24), wall_views(change=passer), 1024)
    pose = look_at((0, -3.0, 0.1), (0, 0, 0))
    rgb, _ = render_textured(found, CAMERA, pose)
    magenta = (rgb[..., 0] > 200) & (rgb[..., 1] < 80) & (rgb[..., 2] > 200)
    assert magenta.mean() < 0.01


def test_different_exposures_meet_without_a_step():
    gains = (0.8, 1.0, 0.9, 1.1)
    found = texture_mesh(wall_mesh(), wall_views(gains), 1024)
    plain = texture_mesh(wall_mesh(), wall_views(), 1024)
    pose = look_at((0, -3.0, 0.1), (0, 0, 0))
    one, depth = render_textured(found, CAMERA, pose)
    other, _ = render_textured(plain, CAMERA, pose)
    inside = np.isfinite(depth)
    ratio = np.where(inside, one.mean(axis=2) / np.maximum(other.mean(axis=2), 1), np.nan)
    steps = np.abs(np.diff(ratio, axis=1))
    assert np.nanpercentile(steps, 99) < 0.25
    assert 0.75 < np.nanmedian(ratio) < 1.15


def test_hidden_faces_take_the_color_around_them():
    mesh = wall_mesh()
    mask = np.ones((240, 320), bool)
    views = wall_views()
    for view in views:
        in_cam = view.cam_from_world.apply(np.array([[0.0, 0.0, 0.0]]))
        column, row = np.rint(CAMERA.project(in_cam)).astype(int)[0]
        hidden = mask.copy()
        hidden[row - 25 : row + 25, column - 25 : column + 25] = False
        masked = replace(view.read(), used_mask=hidden)
        views[views.index(view)] = replace(view, read=lambda masked=masked: masked)
    found = texture_mesh(mesh, views, 1024)
    middle = np.flatnonzero(np.abs(mesh.vertices_in_world[mesh.faces].mean(axis=1)).max(axis=1) < 0.2)
    texel = np.rint(found.uv[middle].mean(axis=1) * found.textures[0].shape[1::-1] - 0.5).astype(int)
    colors = found.textures[0][texel[:, 1], texel[:, 0]]
    assert (np.abs(colors.astype(int) - 128) <= 90).all() and (colors.max(axis=1) > 20).all()


def test_neighbors_are_across_the_edges():
    mesh = wall_mesh(3)
    neighbors = face_neighbors(mesh.faces)
    for face, row in enumerate(neighbors):
        for edge, other in enumerate(row):
            ends = {mesh.faces[face, edge], mesh.faces[face, (edge + 1) % 3]}
            sharing = [n for n in range(len(mesh)) if n != face and ends <= set(mesh.faces[n].tolist())]
            assert sharing == ([] if other < 0 else [other])
    fan = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert (face_neighbors(fan)[:, 0] == -1).all()


def test_one_bad_face_does_not_break_a_chart():
    mesh = wall_mesh(8)
    neighbors = face_neighbors(mesh.faces)
    m = len(mesh)
    label = np.tile(np.array([0, 1], np.int32), (m, 1))
    size = np.tile(np.array([10.0, 9.0], np.float32), (m, 1))
    size[50] = 9.0, 10.0
    rgb = np.full((m, 2, 3), 100.0, np.float32)
    assert (choose_views(FaceViews(label, size, rgb), neighbors) == 0).all()
    size[mesh.vertices_in_world[mesh.faces].mean(axis=1)[:, 0] > 0] = 1.0, 10.0
    found = choose_views(FaceViews(label, size, rgb), neighbors)
    assert len(charts_of(found, neighbors)) == 2


def test_charts_do_not_overlap_in_the_atlas():
    mesh = wall_mesh(8)
    rng = np.random.default_rng(0)
    label = rng.integers(-1, 3, len(mesh)).astype(np.int32)
    charts = charts_of(label, face_neighbors(mesh.faces))
    pixels = rng.uniform(0, 20, (len(mesh), 3, 2)) + rng.uniform(0, 300, (len(mesh), 1, 2))
    atlas = pack(charts, pixels, 512)
    covered = np.zeros((atlas.height_px, 512), int)
    for (x, y), (w, h) in zip(atlas.corner, atlas.size):
        covered[y : y + h, x : x + w] += 1
    assert covered.max() == 1 and covered.sum() == atlas.size.prod(axis=1).sum()
    with pytest.raises(ConfigError, match="too small"):
        pack(charts, pixels * 1000, 256)


def test_offsets_close_a_seam_and_vanish_without_one():
    mesh = wall_mesh(6)
    left = mesh.vertices_in_world[mesh.faces].mean(axis=1)[:, 0] < 0
    charts = charts_of(left.astype(np.int32), face_neighbors(mesh.faces))
    colors = np.where(left[:, None, None], 100.0, 120.0) * np.ones((len(mesh), 3, 3))
    found = colors + color_offsets(mesh.faces, charts, colors)
    at_seam = np.abs(mesh.vertices_in_world[mesh.faces, 0]) < 1e-9
    assert np.ptp(found[at_seam]) < 2.0
    none = color_offsets(mesh.faces, charts, np.full((len(mesh), 3, 3), 77.0))
    np.testing.assert_allclose(none, 0.0, atol=1e-9)


def test_wrong_arguments_are_refused():
    with pytest.raises(ConfigError, match="side_px"):
        texture_mesh(wall_mesh(), wall_views(), 10)
    with pytest.raises(DegenerateGeometryError, match="no view"):
        texture_mesh(wall_mesh(), [], 512)
    behind = replace(wall_mesh(), faces=wall_mesh().faces[:, ::-1].copy())
    with pytest.raises(DegenerateGeometryError, match="no view shows"):
        texture_mesh(behind, wall_views(), 512)


@reference_of(
    _raster_kernels.render_faces,
    _raster_kernels.paint_values,
    _choice_kernels.send_messages,
    _choice_kernels.choose_labels,
)
def test_kernels_do_what_their_python_does(monkeypatch):
    calls = {
        _raster_kernels.render_faces: record_calls(monkeypatch, view_choice, _raster_kernels.render_faces),
        _raster_kernels.paint_values: record_calls(monkeypatch, texture, _raster_kernels.paint_values),
        _choice_kernels.send_messages: record_calls(monkeypatch, view_choice, _choice_kernels.send_messages),
        _choice_kernels.choose_labels: record_calls(monkeypatch, view_choice, _choice_kernels.choose_labels),
    }
    texture_mesh(wall_mesh(3), wall_views(), 256)
    for kernel, recorded in calls.items():
        arguments = list(recorded[-1])
        if kernel is _raster_kernels.render_faces:
            arguments[2] = arguments[2][:2]
        if kernel is _raster_kernels.paint_values:
            arguments[:2] = arguments[0][:2], arguments[1][:2]
        assert_same_as_python(kernel, *arguments, rtol=1e-5, atol=1e-4)
