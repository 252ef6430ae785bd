"""`epipole surface` on rendered images: results, continuation after a kill, stages, masks, and sources that cannot work."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from benchmarks.tasks.surfaces import prepare_scene
from scipy.spatial import cKDTree

import epipole
from epipole import SurfaceConfig, surface
from epipole.cameras import Camera
from epipole.cli.main import main
from epipole.errors import (
    ConfigError,
    DegenerateGeometryError,
    FileFormatError,
    NoModelError,
    WorkspaceError,
)
from epipole.geometry import Rigid3
from epipole.io.colmap.model import read_colmap_model, write_colmap_model
from epipole.io.images.rgba import write_png
from epipole.io.meshes.gltf import read_glb
from epipole.io.meshes.mesh_ply import read_mesh_ply
from epipole.io.meshes.ply import read_points_ply
from epipole.io.models.images import ModelImage
from epipole.io.models.transforms import write_transforms
from epipole.io.survey.point_clouds import read_laz
from epipole.pipelines.surfaces import depth_stage
from epipole.pipelines.surfaces.depth_views import read_depth_views
from epipole.pipelines.surfaces.inputs import cropped_notes
from epipole.pipelines.surfaces.scene import scene as viewer_scene
from epipole.pipelines.surfaces.view_files import ViewFile, pinhole_of, shown_fraction
from epipole.runs import overwriting
from whole import in_whole_run

VIEWS = 6
pytestmark = pytest.mark.usefixtures("unchecked_module")


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    return prepare_scene("courtyard", tmp_path_factory.mktemp("surfaces"), (384, 256), VIEWS)


@pytest.fixture(scope="module")
def done(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("surface") / "out"
    return surface(scene.folder, out, texture_px=1024, formats=("glb", "obj"))


@pytest.fixture(scope="module")
def small(scene, tmp_path_factory):
    """The same of a quarter of the pixels."""
    return surface(scene.folder, tmp_path_factory.mktemp("small") / "out", max_size_px=192, texture_px=1024)


def copied(scene, path):
    shutil.copytree(scene.folder, path)
    return path


def test_all_results_are_written_and_agree(done, scene):
    summary = json.loads((done.out / "summary.json").read_text())
    assert summary["num_views"] == VIEWS and summary["density"] > 0.5 and 0 < summary["relative_sigma"] < 0.01
    cloud = read_points_ply(done.out / "cloud.ply")
    assert len(cloud.xyz) == summary["num_points"] > 50_000
    mesh = read_mesh_ply(done.out / "mesh.ply")
    assert len(mesh.faces) == summary["num_faces"] == len(done.mesh)
    textured = read_glb(done.out / "textured.glb")
    assert len(textured) == len(done.mesh) and textured.textures[0].shape[1] == 1024
    assert {"textured.obj", "textured.mtl", "report.html"} <= {path.name for path in done.out.iterdir()}
    assert "done" not in done.warnings and repr(done).startswith("SurfaceResult(")
    assert set(summary["views"]) == set(scene.names)


@pytest.mark.parametrize("name", ["textured.glb", "textured.obj"])
def test_another_program_reads_the_textured_mesh(done, name):
    """trimesh has the same triangles, vertices in meters with y up (GLB), texture coordinates, and the texture."""
    found = trimesh.load(done.out / name, force="mesh", process=False)
    textured = read_glb(done.out / "textured.glb")
    assert len(found.faces) == len(textured)
    sides = np.linalg.norm(np.diff(found.triangles, axis=1), axis=2)
    ours = np.linalg.norm(np.diff(textured.vertices_in_world[textured.faces], axis=1), axis=2)
    np.testing.assert_allclose(np.sort(sides.ravel()), np.sort(ours.ravel()), atol=1e-5)
    assert found.visual.uv.shape == (len(found.vertices), 2)
    image = found.visual.material.baseColorTexture if name.endswith("glb") else found.visual.material.image
    assert image.size == (1024, textured.textures[0].shape[0])
    rgb = np.asarray(image.convert("RGB")).astype(float)
    assert np.abs(rgb - textured.textures[0]).mean() < 3.0


def test_holes_are_closed_and_the_mesh_simplified_on_request(done, scene, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(done.out, out)
    options = {"texture_px": 1024, "formats": ("ply", "usdz"), "close": 0.1, "faces": 6000}
    again = surface(scene.folder, out, **options)
    assert len(again.mesh) == again.summary["num_faces"] <= 6000 and again.summary["num_holes_closed"] > 0
    assert {"textured.ply", "textured.usdz"} <= {path.name for path in out.iterdir()}
    assert not (out / "textured.glb").exists()  # of the earlier run
    before, after = (cKDTree(mesh.vertices_in_world) for mesh in (done.mesh, again.mesh))
    distance = before.query(again.mesh.vertices_in_world)[0]
    assert np.quantile(distance, 0.95) < 2 * again.summary["voxel"]
    assert np.median(after.query(done.mesh.vertices_in_world)[0]) < 8 * again.summary["voxel"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"close": -0.1}, "close must not be negative"),
        ({"close": 1.5}, "close must be from 0 to 1"),
        ({"faces": 2}, "faces must be"),
        ({"crop": (1.0, 0.0, 0.0, 1.0)}, "west < east"),
        ({"contour_m": 0.0}, "contour_m must be"),
    ],
)
def test_wrong_options_are_named(options, words):
    with pytest.raises(ConfigError, match=words):
        SurfaceConfig(**options)


def test_the_cloud_is_on_the_surfaces(done, scene):
    cloud = read_points_ply(done.out / "cloud.ply").xyz[::50]
    near = np.zeros(len(cloud), bool)
    for k in range(VIEWS):
        in_cam = scene.cams_from_world[k].apply(cloud)
        pixels = np.rint(scene.camera.project(in_cam))
        inside = (in_cam[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels < [384, 256]).all(axis=1)
        column, row = pixels[inside].astype(int).T
        depth = scene.depth(k)[row, column]
        near[np.flatnonzero(inside)[np.abs(depth / in_cam[inside, 2] - 1) < 0.02]] = True
    assert near.mean() > 0.97


def test_the_same_options_give_the_same_bytes_from_depth_ins(scene, done, monkeypatch):
    before = {name: (done.out / name).read_bytes() for name in ("cloud.ply", "mesh.ply", "textured.glb")}
    monkeypatch.setattr(depth_stage, "view_depth", lambda *_: pytest.fail("depths are stored"))
    surface(scene.folder, done.out, texture_px=1024, formats=("glb", "obj"), threads=2)
    assert before == {name: (done.out / name).read_bytes() for name in before}


def test_it_ends_at_the_requested_stage(scene, tmp_path):
    found = surface(scene.folder, tmp_path / "out", SurfaceConfig(until="cloud", max_size_px=128))
    assert (found.out / "cloud.ply").is_file() and not (found.out / "mesh.ply").exists()
    assert found.mesh is None and (found.out / "report.html").is_file()
    with pytest.raises(WorkspaceError, match=r"results of later stages \(cloud\)"):
        surface(scene.folder, found.out, until="depth", max_size_px=128)
    assert (found.out / "cloud.ply").is_file()
    with overwriting():
        surface(scene.folder, found.out, until="depth", max_size_px=128)
    assert not (found.out / "cloud.ply").exists()  # it may be of other depths
    with pytest.raises(ConfigError, match="is the output of `epipole surface`"):
        surface(found.out, tmp_path / "again")
    shown = viewer_scene(found.out)  # the model's points, and depth for each camera
    assert shown.mesh is None and len(shown.points[0].xyz_in_world) and shown.cameras.load_depth is not None
    with pytest.raises(FileFormatError, match="`epipole view` shows the depth"):
        epipole.load(found.out)


def test_the_depth_of_each_image_is_listed_with_its_camera(done, scene):
    views = read_depth_views(done.out)
    assert [view.name for view in views] == sorted(scene.names)
    cloud = cKDTree(read_points_ply(done.out / "cloud.ply").xyz)
    for view in views[:3]:
        depth = view.depth().depth
        row, column = np.nonzero(depth > 0)
        rays = view.camera.unproject(np.stack([column, row], axis=1).astype(float))
        in_cam = rays / rays[:, 2:] * depth[row, column, None]
        distance, _ = cloud.query(view.cam_from_world.inverse().apply(in_cam)[::50])
        assert np.median(distance) < 0.02  # of a scene of several meters
    cameras = viewer_scene(done.out).cameras
    image, colored = (load(views[0].name) for load in (cameras.load_image, cameras.load_depth))
    assert image.shape == colored.shape and (colored.std(axis=2)[views[0].depth().depth > 0] > 5).mean() > 0.9
    assert cameras.load_depth("no such image") is None


@in_whole_run
def test_a_cluster_gives_the_same_bytes(scene, tmp_path):
    pytest.importorskip("distributed")
    options = {"until": "cloud", "max_size_px": 128}
    here = surface(scene.folder, tmp_path / "here", **options).out
    there = surface(scene.folder, tmp_path / "there", cluster="local:2", shared_folder=False, **options).out
    files = sorted(path.relative_to(here) for path in here.rglob("*") if path.suffix in (".npz", ".ply"))
    assert len(files) > 3 * VIEWS
    for name in files:
        assert (here / name).read_bytes() == (there / name).read_bytes(), name
    with pytest.raises(ConfigError, match="is no address"):
        SurfaceConfig(cluster="nowhere")


def test_a_damaged_list_of_depths_is_named(done, tmp_path):
    for name in ("depths.json", "epipole.json"):
        shutil.copyfile(done.out / name, tmp_path / name)
    content = json.loads((done.out / "depths.json").read_text())
    content["views"][0]["file"] = "../elsewhere.npz"
    (tmp_path / "depths.json").write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=r"depths\.json: a view is damaged: .*elsewhere"):
        read_depth_views(tmp_path)
    content["views"] = 3
    (tmp_path / "depths.json").write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match="no list of views"):
        read_depth_views(tmp_path)


def test_the_cloud_is_also_written_as_laz(scene, done, tmp_path):
    out = surface(scene.folder, tmp_path / "out", until="cloud", max_size_px=128, laz=True).out
    found, cloud = read_laz(out / "cloud.laz"), read_points_ply(out / "cloud.ply")
    assert found.crs is None and found.sigma is not None
    np.testing.assert_allclose(found.points, cloud.xyz, atol=1e-3)
    np.testing.assert_array_equal(found.rgb, cloud.rgb)
    again = surface(scene.folder, out, until="cloud", max_size_px=128, crs="EPSG:32632")
    assert not (out / "cloud.laz").exists()
    assert any("--crs has no effect" in warning for warning in again.warnings)
    with pytest.raises(ConfigError, match="laz needs the cloud"):
        SurfaceConfig(laz=True, until="depth")


def test_options_of_later_stages_are_named():
    assert SurfaceConfig(until="survey", crs="EPSG:32632", faces=100, formats=("obj",)).unused() == []
    assert SurfaceConfig(laz=True, crs="EPSG:32632", voxel=0.1).unused() == []
    crs, crop = SurfaceConfig(crs="EPSG:32632", crop=(0.0, 0.0, 1.0, 1.0)).unused()
    assert "--crs has no effect" in crs and "it is used by survey and --laz" in crs and "--crop" in crop
    (faces,) = SurfaceConfig(until="cloud", faces=100).unused()
    assert "--faces" in faces and "ends with cloud (--until): it is used by mesh" in faces


def test_images_of_which_little_can_be_undistorted_are_said(tmp_path):
    def views(model, params):
        camera = Camera(model, 384, 256, params)
        image = ModelImage(tmp_path / "a.jpg", camera, 1)
        return [ViewFile("a.jpg", image, pinhole_of(camera, 384), Rigid3.identity(), None, None, "")]

    focal = 384 / np.pi  # 180 degrees from left to right
    fisheye = views("OPENCV_FISHEYE", [focal, focal, 191.5, 127.5, 0, 0, 0, 0])
    plain = views("OPENCV", [300, 300, 191.5, 127.5, -0.2, 0.05, 0, 0])
    assert cropped_notes(plain) == [] and shown_fraction(plain[0].image.camera) > 0.8
    (told,) = cropped_notes([*plain, *fisheye])
    assert told.startswith("1 of 2 images have a very wide field of view") and "71 degrees" in told


def test_large_coordinates_give_the_same_mesh(scene, small, tmp_path):
    source = copied(scene, tmp_path / "source")
    model = read_colmap_model(source / "sparse" / "0")
    offset = np.array([500_000.0, 5_300_000.0, 400.0])
    poses = model.frames.rig_from_world
    moved = replace(poses, translation=poses.translation - poses.rotation @ offset)
    points = replace(model.points, xyz_in_world=model.points.xyz_in_world + offset)
    write_colmap_model(
        replace(model, points=points, frames=replace(model.frames, rig_from_world=moved)),
        source / "sparse" / "0",
    )
    found = surface(source, tmp_path / "out", max_size_px=192, texture_px=1024)
    assert len(found.mesh) == pytest.approx(len(small.mesh), rel=0.06)  # voxels lie elsewhere
    assert found.summary["num_points"] == pytest.approx(small.summary["num_points"], rel=1e-3)
    tree = cKDTree(small.mesh.vertices_in_world)
    for vertices in (found.mesh.vertices_in_world, read_glb(found.out / "textured.glb").vertices_in_world):
        distance = tree.query(vertices - offset)[0]
        assert np.median(distance) < 0.6 * small.summary["voxel"]


def test_a_mesh_that_cannot_be_textured_is_a_warning_and_no_old_texture_stays(
    scene, small, tmp_path, monkeypatch
):
    def fail(*_):
        raise DegenerateGeometryError("no view shows the mesh")

    out = shutil.copytree(small.out, tmp_path / "out")
    assert (out / "textured.glb").is_file()
    with monkeypatch.context() as patch:
        patch.setattr("epipole.pipelines.surfaces.run.texture_of", fail)
        found = surface(scene.folder, out, max_size_px=192, texture_px=256)
    assert any("the mesh has no texture: no view" in warning for warning in found.warnings)
    assert not (out / "textured.glb").exists()
    with overwriting():
        surface(scene.folder, out, max_size_px=192, until="mesh")
    assert not (out / "textured.glb").exists() and (out / "mesh.ply").is_file()


def test_a_killed_run_continues(scene, small, tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "epipole", "surface", str(scene.folder), str(out), "--until", "cloud"]
    command += ["--max-size-px", "192"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    limit = time.monotonic() + 120
    while len(list((out / "units" / "depth").glob("[0-9a-f]*.npz"))) < 2 and time.monotonic() < limit:
        assert process.poll() is None
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    stored = {path: path.stat().st_mtime_ns for path in (out / "units" / "depth").glob("[0-9a-f]*.npz")}
    assert len(stored) >= 2 and not (out / "cloud.ply").exists()
    surface(scene.folder, out, until="cloud", max_size_px=192)
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in stored.items())
    assert (out / "cloud.ply").read_bytes() == (small.out / "cloud.ply").read_bytes()


def test_masked_pixels_have_no_depth(scene, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    for name in scene.names:
        mask = np.full((256, 384, 3), 255, np.uint8)
        mask[:, :200] = 0
        write_png(masks / f"{name}.png", mask)
    found = surface(scene.folder, tmp_path / "out", until="depth", masks=masks, max_size_px=128)
    assert found.summary["reasons"]["masked"] > 0.5 and found.summary["density"] < 0.5
    for name in scene.names:
        write_png(masks / f"{name}.png", np.zeros((256, 384, 3), np.uint8))
    with pytest.raises(DegenerateGeometryError, match=r"no pixel has a depth.*: masked \(100 %"):
        surface(scene.folder, tmp_path / "nothing", until="depth", masks=masks, max_size_px=128)
    for name in scene.names:
        write_png(masks / f"{name}.png", np.full((128, 192, 3), 255, np.uint8))
    with pytest.raises(ConfigError, match=r"no mask for any image that is used .*192"):
        surface(scene.folder, tmp_path / "half", masks=masks, max_size_px=128)
    with pytest.raises(ConfigError, match="has no mask"):
        (tmp_path / "empty").mkdir()
        surface(scene.folder, tmp_path / "none", masks=tmp_path / "empty")


def test_nearly_opaque_pixels_and_images_without_a_mask(scene, tmp_path):
    """Alpha of 254, as some programs write it; and a mask for one image only, which is reported."""
    source, masks = copied(scene, tmp_path / "source"), tmp_path / "masks"
    for name in scene.names:
        rgb = cv2.imread(str(source / "images" / name))
        alpha = np.full((*rgb.shape[:2], 1), 254, np.uint8)
        png = cv2.imencode(".png", np.concatenate([rgb, alpha], axis=2))[1]
        (source / "images" / name).write_bytes(png.tobytes())
    masks.mkdir()
    write_png(masks / f"{scene.names[0]}.png", np.full((256, 384, 3), 255, np.uint8))
    found = surface(source, tmp_path / "out", until="depth", masks=masks, max_size_px=128)
    assert found.summary["density"] > 0.5 and found.summary["reasons"]["masked"] < 0.05
    assert any(f"masks for 1 of {VIEWS} images" in warning for warning in found.warnings)


@in_whole_run
def test_an_unreadable_image_is_left_out_and_said(scene, tmp_path):
    source = copied(scene, tmp_path / "source")
    (source / "images" / scene.names[2]).write_bytes(b"nothing")
    found = surface(source, tmp_path / "out", until="depth", max_size_px=128)
    assert found.summary["num_images"] == VIEWS - 1
    assert any(scene.names[2] in warning for warning in found.warnings)


def test_truncated_images_are_left_out_unless_too_few_remain(scene, tmp_path):
    source = copied(scene, tmp_path / "source")
    for name in scene.names[2:4]:
        content = (scene.folder / "images" / name).read_bytes()
        (source / "images" / name).write_bytes(content[: len(content) // 2])
    found = surface(source, tmp_path / "out", until="depth", max_size_px=128)
    assert found.summary["num_images"] == VIEWS - 2
    for name in scene.names[2:4]:
        assert any(
            f"{name} is left out: " in warning and "truncated" in warning for warning in found.warnings
        )
    for name in scene.names[1:]:
        content = (scene.folder / "images" / name).read_bytes()
        (source / "images" / name).write_bytes(content[: len(content) // 2])
    with pytest.raises(NoModelError, match=r"1 images can be used, .* is left out: .*truncated"):
        surface(source, tmp_path / "out", until="depth", max_size_px=128)
    shutil.rmtree(source / "images")
    shutil.copytree(scene.folder / "images", source / "images")
    assert surface(source, tmp_path / "out", until="depth", max_size_px=128).summary["num_images"] == VIEWS


def test_views_at_one_position_have_no_surface(scene, tmp_path):
    source = copied(scene, tmp_path / "source")
    model = read_colmap_model(source / "sparse" / "0")
    poses = model.frames.rig_from_world
    same = replace(poses, translation=-np.einsum("nij,j->ni", poses.rotation, np.array([0.0, -4.0, 1.0])))
    write_colmap_model(
        replace(model, frames=replace(model.frames, rig_from_world=same)), source / "sparse" / "0"
    )
    with pytest.raises(NoModelError, match="different positions"):
        surface(source, tmp_path / "out")


def test_sources_without_points_images_or_cameras_are_refused(scene, tmp_path):
    source = copied(scene, tmp_path / "source")
    model = read_colmap_model(source / "sparse" / "0")
    tracks = replace(
        model.tracks,
        offsets=np.zeros(1, np.int64),
        image=np.empty(0, np.int32),
        keypoint=np.empty(0, np.int32),
    )
    points = replace(
        model.points,
        **{n: getattr(model.points, n)[:0] for n in model.points.__slots__ if n != "__weakref__"},
    )
    write_colmap_model(replace(model, points=points, tracks=tracks), source / "sparse" / "0")
    with pytest.raises(NoModelError, match="has no points"):
        surface(source, tmp_path / "out")
    with pytest.raises(FileFormatError):
        surface(tmp_path / "missing", tmp_path / "out")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("keep")
    with pytest.raises(WorkspaceError):
        surface(scene.folder, tmp_path / "mine")
    with pytest.raises(ConfigError, match="texture_px"):
        SurfaceConfig(texture_px=1)


def test_points_without_observations_are_projected_into_the_images(scene, small, tmp_path):
    source = tmp_path / "source"
    shutil.copytree(scene.folder / "images", source / "images")
    write_transforms(read_colmap_model(scene.folder / "sparse" / "0"), source / "transforms.json")
    found = surface(source / "transforms.json", tmp_path / "out", until="cloud", max_size_px=192)
    assert found.summary["num_images"] == VIEWS and any("see all points" in w for w in found.warnings)
    assert found.summary["density"] > 0.95 * small.summary["density"]
    distance = cKDTree(read_points_ply(small.out / "cloud.ply").xyz).query(
        read_points_ply(found.out / "cloud.ply").xyz[::20]
    )[0]
    assert np.quantile(distance, 0.9) < 2 * small.summary["voxel"]
    (source / "sparse_pc.ply").unlink()
    with pytest.raises(NoModelError, match=r"has no points .*ply_file_path"):
        surface(source / "transforms.json", tmp_path / "none")


def test_the_command_prints_what_it_wrote(scene, tmp_path, capsys):
    main(["surface", str(scene.folder), str(tmp_path / "out"), "--until", "cloud", "--max-size-px", "128"])
    printed = "".join(capsys.readouterr().out.split())
    assert "points" in printed and "cloud.ply" in printed


def test_two_images_are_enough(scene, tmp_path):
    source = copied(scene, tmp_path / "source")
    for k, name in enumerate(scene.names):
        if k not in (3, 4):
            (source / "images" / name).unlink()
    found = surface(source, tmp_path / "out", until="mesh")
    assert found.summary["num_views"] == 2 and found.summary["density"] > 0.4
    assert found.mesh is not None and len(found.mesh) > 1000


def test_images_without_overlap_are_refused(scene, tmp_path):
    source = copied(scene, tmp_path / "source")
    model = read_colmap_model(source / "sparse" / "0")
    first = np.flatnonzero(model.tracks.image == 0)
    point = model.tracks.point_of_observation()
    alone = replace(
        model.tracks,
        offsets=np.searchsorted(point[first], np.arange(len(model.points) + 1)).astype(np.int64),
        image=model.tracks.image[first],
        keypoint=model.tracks.keypoint[first],
    )
    write_colmap_model(replace(model, tracks=alone), source / "sparse" / "0")
    with pytest.raises(NoModelError, match="overlapping images"):
        surface(source, tmp_path / "out")
