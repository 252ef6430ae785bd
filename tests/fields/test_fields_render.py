"""`epipole.render`: circles and given cameras, to images and a video."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from fields_scenes import CAMERA, WHITE, camera, frames_of, scene, views

from epipole import render, splat
from epipole.cameras import Camera
from epipole.errors import ConfigError, FileFormatError, ShapeError, WorkspaceError
from epipole.fields.normals import normals_of
from epipole.fields.splat.rasterizer import RenderOptions
from epipole.fields.splat.rasterizer import render as draw
from epipole.image import color_map
from epipole.io import write_colmap_model
from epipole.io.gaussians.files import write_gaussians
from epipole.io.gaussians.ply import read_gaussian_ply
from epipole.io.images.photographs import read_rgb
from epipole.pipelines.fields.cameras import orbit
from epipole.pipelines.fields.config import RenderConfig
from epipole.synthetic.problems import bundle_problem


@pytest.fixture
def splats(tmp_path):
    write_gaussians(tmp_path / "splat.ply", scene())
    return tmp_path / "splat.ply"


def test_given_cameras(splats, tmp_path):
    content = camera() | {"frames": frames_of(views()[:3], tmp_path)}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    done = render(splats, tmp_path / "out", cameras=tmp_path / "transforms.json")
    assert done.num_frames == 3 and done.frames_per_s > 0
    for seen in views()[:3]:
        found = read_rgb(tmp_path / "out" / f"{seen.name[:2]}.png")
        wanted = draw(scene(), CAMERA, seen.cam_from_world).over(np.zeros(3, np.float32))
        assert np.abs(found / 255.0 - np.clip(wanted, 0, 1)).max() < 0.01
    render(splats, tmp_path / "out", cameras=tmp_path / "transforms.json", width=32, background="white")
    small = read_rgb(tmp_path / "out" / "00.png")
    assert small.shape == (24, 32, 3) and small[0, 0].min() == 255


def test_depth_normals_and_coverage(splats, tmp_path):
    content = camera() | {"frames": frames_of(views()[:2], tmp_path)}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    rendered = draw(scene(), CAMERA, views()[0].cam_from_world)
    shown = rendered.coverage > 0.5
    depth = np.where(shown, rendered.depth / np.maximum(rendered.coverage, 0.5), np.nan)
    wanted = {
        "depth": color_map(depth) / 255.0,
        "normals": np.nan_to_num(0.5 + 0.5 * normals_of(depth, CAMERA)),
        "coverage": np.repeat(rendered.coverage[..., None], 3, axis=2),
    }
    for output, image in wanted.items():
        render(splats, tmp_path / output, cameras=tmp_path / "transforms.json", output=output)
        found = read_rgb(tmp_path / output / "00.png") / 255.0
        assert np.abs(found - image).max() < 0.01, output
        assert (tmp_path / output / "01.png").is_file()


def test_normals_of_a_plane_and_of_nothing():
    camera = Camera("PINHOLE", 40, 30, [35.0, 36.0, 19.0, 14.0])
    normal = np.array([0.3, -0.5, -0.8])
    normal /= np.linalg.norm(normal)
    row, column = np.mgrid[:30, :40]
    rays = camera.unproject(np.stack([column, row], axis=2).reshape(-1, 2).astype(float))
    depth = (-2.0 / (rays / rays[:, 2:] @ normal)).reshape(30, 40)
    found = normals_of(depth, camera)
    assert np.isnan(found[0]).all() and np.isnan(found[:, -1]).all()
    np.testing.assert_allclose(found[1:-1, 1:-1], np.broadcast_to(normal, (28, 38, 3)), atol=1e-9)
    depth[10, 10] = np.nan
    unknown = np.isnan(normals_of(depth, camera)[1:-1, 1:-1, 0])
    assert {(10, 9), (10, 11), (9, 10), (11, 10)} <= {(r + 1, c + 1) for r, c in np.argwhere(unknown)}
    with pytest.raises(ShapeError):
        normals_of(depth[:5], camera)


def test_a_filter_is_used_again_that_was_trained_with(tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "transforms.json").write_text(json.dumps(camera() | {"frames": frames_of(views(), folder)}))
    splat(folder, tmp_path / "out", steps=5, max_gaussians=200, sh_degree=0, antialiased=True)
    cloud = read_gaussian_ply(tmp_path / "out" / "splat.ply")
    render(tmp_path / "out", tmp_path / "drawn", cameras=folder / "transforms.json")
    render(tmp_path / "out", tmp_path / "other", cameras=folder / "transforms.json", antialiased=False)
    for name, requested in (("drawn", True), ("other", False)):
        wanted = draw(cloud, CAMERA, views()[0].cam_from_world, RenderOptions(antialiased=requested))
        found = read_rgb(tmp_path / name / "00.png") / 255.0
        assert np.abs(found - np.clip(wanted.over(WHITE), 0, 1)).max() < 0.01


def test_a_circle_goes_round_and_looks_at_the_middle():
    middle, up = np.array([1.0, 2.0, 3.0]), np.array([0.0, -2.0, 0.0])
    views = orbit(middle + np.array([3.0, -1.0, 0.0]), middle, up, RenderConfig(frames=8, width=100))
    centers = np.array([view.cam_from_world.centers() for view in views])
    assert np.linalg.norm(centers - middle, axis=1) == pytest.approx(np.full(8, np.sqrt(10.0)))
    assert centers.mean(axis=0) == pytest.approx(middle - np.array([0, 1, 0]))
    for view in views:
        assert view.camera.project(view.cam_from_world.apply(middle[None]))[0] == pytest.approx([49.5, 37.0])
        above = view.camera.project(view.cam_from_world.apply(middle[None] + [0, -0.1, 0]))[0]
        assert above[1] < 37.0  # up in the world is up in the image
    half = orbit(middle + np.array([3.0, 0.0, 0.0]), middle, up, RenderConfig(frames=3, rotation_deg=180.0))
    assert half[2].cam_from_world.centers() == pytest.approx(middle - [3, 0, 0])
    straight = orbit(middle + np.array([0.0, -3.0, 0.0]), middle, up, RenderConfig(frames=2))
    assert np.isfinite(straight[0].cam_from_world.rotation).all()


def test_a_video(splats, tmp_path):
    render(splats, tmp_path / "a.mp4", frames=5, width=64, height=48)
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    images = []
    while (read := video.read())[0]:
        images.append(read[1])
    assert len(images) == 5 and images[0].shape == (48, 64, 3)
    assert np.abs(images[0].astype(int) - images[2]).mean() > 1 and max(p.max() for p in images) > 100


def test_what_does_not_fit(splats, tmp_path):
    with pytest.raises(FileFormatError, match="it does not exist"):
        render(tmp_path / "none", tmp_path / "out")
    with pytest.raises(ConfigError, match="frames"):
        render(splats, tmp_path / "out", frames=0)
    with pytest.raises(ConfigError, match="fov_deg"):
        render(splats, tmp_path / "out", fov_deg=180.0)
    frames = [
        frame | camera() | {"w": 64 - 8 * k} for k, frame in enumerate(frames_of(views()[:2], tmp_path))
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(ConfigError, match="the same size"):
        render(splats, tmp_path / "a.mp4", cameras=tmp_path / "transforms.json")
    assert not (tmp_path / "a.mp4").exists()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    with pytest.raises(WorkspaceError):
        render(splats, tmp_path / "full", frames=2, width=32)
    assert (tmp_path / "full" / "mine.txt").read_text() == "mine"


def test_images_of_like_names_are_all_rendered(splats, tmp_path):
    """None replaces another: the count that is given is that of the files."""
    model, names = bundle_problem(4, 30, 3).truth, ("b/c.png", "b_c.png", "a.png", "a.jpg")
    write_colmap_model(replace(model, images=replace(model.images, name=names)), tmp_path / "model")
    done = render(splats, tmp_path / "out", cameras=tmp_path / "model", width=32)
    assert done.num_frames == 4 and len(list((tmp_path / "out").glob("*.png"))) == 4


def test_held_out_images_of_like_names_are_all_rendered(tmp_path):
    (tmp_path / "scene").mkdir()
    frames = frames_of(views()[:6], tmp_path / "scene")
    for frame, name in zip(frames[:3], ("x/y.png", "x_y.png", "x/y.jpg")):
        (tmp_path / "scene" / "x").mkdir(exist_ok=True)
        image = cv2.imread(str(tmp_path / "scene" / frame["file_path"]))
        cv2.imwrite(str(tmp_path / "scene" / name), image)
        frame["file_path"] = name
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(camera() | {"frames": frames}))
    done = splat(tmp_path / "scene", tmp_path / "out", steps=2, test="x/y.png,x_y.png,x/y.jpg", sh_degree=0)
    assert done.summary["num_test"] == 3 and len(list((tmp_path / "out" / "test").iterdir())) == 3
