"""Gaussians far from the world's origin, as in UTM coordinates, lose nothing to single precision."""

import json

import numpy as np
import pytest
from fields_scenes import CAMERA, camera, frames_of, scene, views

from epipole import mesh, splat
from epipole.errors import FileFormatError
from epipole.fields.splat.rasterizer import render
from epipole.geometry import Rigid3
from epipole.io.gaussians.files import read_gaussians, write_gaussians
from epipole.io.georeference import georeference_fields
from epipole.io.models.transforms import read_transforms
from epipole.pipelines.fields.cameras import render_views_of_model
from epipole.pipelines.fields.config import RenderConfig
from epipole.pipelines.fields.scene import scene as viewer_scene
from epipole.pipelines.fields.scene import seen_gaussians
from epipole.scene import Georeference
from epipole.scene.local_origin import local_origin

ORIGIN = Georeference(46.5, 7.25, 500.0)
UTM = np.array([500_000.0, 5_200_000.0, 300.0])
OPTIONS = {"steps": 40, "max_gaussians": 300, "sh_degree": 0, "test_every": 7}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Trainings near the origin and in UTM."""
    out = []
    for name, offset in (("near", np.zeros(3)), ("far", UTM)):
        folder = tmp_path_factory.mktemp(name)
        frames = frames_of(views(), folder)
        for frame in frames:
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, 3] += offset
            frame["transform_matrix"] = matrix.tolist()
        located = {"georeference": georeference_fields(ORIGIN)} if name == "far" else {}
        (folder / "transforms.json").write_text(json.dumps(camera() | located | {"frames": frames}))
        out.append((folder, splat(folder, folder / "out", **OPTIONS)))
    return out


def test_training_in_utm_loses_nothing(results):
    (_, near), (_, far) = results
    assert far.summary["psnr"] == pytest.approx(near.summary["psnr"], abs=0.3)
    assert np.abs(far.cloud.means_in_world).max() < 100.0
    assert np.abs(far.cloud.centers_in_world.mean(axis=0) - UTM).max() < 10.0


def test_files_state_their_origin_and_are_read_back(results):
    _, (source, far) = results
    out = far.out
    assert b"comment origin_in_world 50000" in (out / "splat.ply").read_bytes()[:200]
    cloud = read_gaussians(out / "splat.ply")
    np.testing.assert_array_equal(cloud.centers_in_world, far.cloud.centers_in_world)
    given = json.loads((out / "cameras.json").read_text())
    np.testing.assert_array_equal(given["origin_in_world"], cloud.origin_in_world)
    assert np.abs(np.array(given["frames"][0]["transform_matrix"])[:3, 3]).max() < 100.0
    model, truth = read_transforms(out / "cameras.json"), read_transforms(source / "transforms.json")
    rows = [truth.images.name.index(name.removeprefix("images/")) for name in model.images.name]
    wanted = truth.camera_centers_in_world()[rows]
    assert model.georeference == ORIGIN
    np.testing.assert_allclose(model.camera_centers_in_world(), wanted, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(
        json.loads((out / "summary.json").read_text())["origin_in_world"], given["origin_in_world"]
    )


def test_renders_from_cameras_in_the_world(results):
    _, (source, far) = results
    cloud, view = seen_gaussians(far.out)
    assert np.abs(view.position - UTM).max() < 10.0
    for file in (source / "transforms.json", far.out / "cameras.json"):
        shot = next(s for s in render_views_of_model(file, RenderConfig()) if s.name.endswith("03"))
        rendered = render(cloud, shot.camera, shot.cam_from_world).over(np.ones(3, np.float32))
        truth = views()[3].over(np.ones(3, np.float32))
        assert -10 * np.log10(np.mean((rendered - truth) ** 2)) > 15.0


def test_the_viewer_and_meshes_keep_their_places(results, tmp_path):
    _, (_, far) = results
    shown = viewer_scene(far.out)
    assert np.abs(shown.view.position).max() < 10.0
    assert np.abs(shown.cameras.cams_from_world.inverse().translation).max() < 100.0
    found = mesh(far.out, tmp_path / "m.ply", voxels=24)
    assert np.abs(np.median(found.vertices_in_world, axis=0) - UTM).max() < 5.0


@pytest.mark.parametrize("is_double", [True, False])
def test_files_of_others_in_utm_are_drawn_about_a_local_origin(tmp_path, is_double):
    """Another program's PLY with double coordinates, or with those that float leaves."""
    near = scene()
    write_gaussians(tmp_path / "near.ply", near)
    data = (tmp_path / "near.ply").read_bytes()
    head, body = data.split(b"end_header\n", 1)
    kind = "<f8" if is_double else "<f4"
    rows = np.frombuffer(body, "<f4").reshape(len(near), -1)
    words = np.zeros(len(near), [("xyz", kind, 3), ("rest", "<f4", rows.shape[1] - 3)])
    words["xyz"], words["rest"] = rows[:, :3] + UTM, rows[:, 3:]
    for axis in b"xyz" if is_double else b"":
        head = head.replace(b"property float %c\n" % axis, b"property double %c\n" % axis)
    (tmp_path / "far.ply").write_bytes(head + b"end_header\n" + words.tobytes())
    far = read_gaussians(tmp_path / "far.ply")
    assert np.abs(far.means_in_world).max() < 20.0
    if is_double:
        np.testing.assert_allclose(far.centers_in_world - UTM, near.means_in_world, rtol=0, atol=1e-6)
        position = views()[0].cam_from_world
        there = position @ Rigid3(np.eye(3), -UTM)
        difference = render(far, CAMERA, there).color - render(near, CAMERA, position).color
        assert np.abs(difference).max() < 1e-4


def test_a_damaged_origin_is_refused(tmp_path):
    write_gaussians(tmp_path / "a.ply", scene())
    data = (
        (tmp_path / "a.ply").read_bytes().replace(b"element", b"comment origin_in_world 1 two 3\nelement", 1)
    )
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(FileFormatError, match="origin_in_world"):
        read_gaussians(tmp_path / "a.ply")


def test_the_origin_is_zero_near_it_and_heeds_no_infinity():
    points = np.random.default_rng(0).normal(size=(50, 3))
    assert not local_origin(points + 5.0).any()
    assert not local_origin(np.empty((0, 3))).any()
    far = np.concatenate([points + UTM, [[np.inf, 0, 0]]])
    assert np.abs(local_origin(far) - UTM).max() < 2.0
