"""One model through every format, with its images, and nothing of anyone's overwritten."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pxr import Usd

from epipole.cameras import Camera
from epipole.errors import ConfigError, FileFormatError, WorkspaceError
from epipole.io import (
    read_colmap_model,
    read_model,
    read_points_ply,
    read_transforms,
    write_colmap_model,
    write_opensfm,
)
from epipole.io.convert import content_not_stored
from epipole.io.gaussians.files import read_gaussians, write_gaussians
from epipole.io.meshes.ply import num_cameras_of_scene
from epipole.pipelines.conversion.run import convert
from epipole.pipelines.undistortion.run import undistort
from epipole.runs import Job, open_run
from epipole.scene import Cameras, Georeference, Reconstruction
from epipole.scene.gaussian_cloud import GaussianCloud
from io_models import mappable_model, small_model


def names_in(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def output_folder(root: Path, model: Reconstruction) -> Path:
    """A model and its images, laid out as `reconstruct` does."""
    write_colmap_model(model, root / "sparse" / "0")
    for name in model.images.name:
        (root / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        (root / "images" / name).write_text(f"{root.name} {name}")
    return root


def test_every_format(tmp_path: Path) -> None:
    model = mappable_model()
    expected = model.cams_from_world().as_matrix()
    write_colmap_model(model, tmp_path / "bin")
    assert convert(tmp_path / "bin", tmp_path / "txt", "txt").out == tmp_path / "txt"
    back = convert(tmp_path / "txt", tmp_path / "back", "bin").out
    for name in ("cameras", "rigs", "frames", "images", "points3D"):
        assert (tmp_path / "txt" / f"{name}.txt").is_file()
    np.testing.assert_allclose(read_colmap_model(back).cams_from_world().as_matrix(), expected, atol=1e-12)
    cloud = convert(tmp_path / "bin", tmp_path / "deep" / "my.ply", "ply").out
    assert len(read_points_ply(cloud)) == len(model.points) + 5 * len(model.images)
    nerf = convert(tmp_path / "bin", tmp_path / "nerf", "transforms").out / "transforms.json"
    np.testing.assert_allclose(read_transforms(nerf).cams_from_world().as_matrix(), expected, atol=1e-12)
    bundler = convert(nerf, tmp_path / "bundler", "bundler").out
    assert (bundler / "bundle.out").read_text().startswith("# Bundle file v0.3\n6 200\n")


@pytest.mark.parametrize("given", ["out", "out/sparse/0"])
def test_paths_in_the_files_lead_to_pictures(tmp_path: Path, given: str) -> None:
    model = mappable_model()
    output_folder(tmp_path / "out", model)
    done = convert(tmp_path / given, tmp_path / "away" / "nerf", "transforms")
    content = json.loads((done.out / "transforms.json").read_text())
    paths = [done.out / frame["file_path"] for frame in content["frames"]]
    assert [p.read_text() for p in paths] == [f"out {name}" for name in model.images.name]
    assert (done.out / content["ply_file_path"]).is_file()
    assert (done.num_images, done.missing) == (len(paths), ())
    bundler = convert(tmp_path / given, tmp_path / "away" / "bundler", "bundler").out
    listed = (bundler / "list.txt").read_text().splitlines()
    assert all((bundler / line).is_file() for line in listed) and len(listed) == len(paths)
    assert sorted(p.name for p in (tmp_path / "away").iterdir()) == ["bundler", "nerf"]  # nothing beside


def test_pictures_that_are_not_there_are_named(tmp_path: Path) -> None:
    model = mappable_model()
    output_folder(tmp_path / "out", model)
    (tmp_path / "out" / "images" / model.images.name[2]).unlink()
    done = convert(tmp_path / "out", tmp_path / "nerf", "transforms")
    assert done.missing == (model.images.name[2],) and done.num_images == len(model.images) - 1


def test_two_models_do_not_mix(tmp_path: Path) -> None:
    """The second conversion to a folder comes beside the first if it is of the same model, and is refused if not."""
    model = mappable_model()
    one, two = (output_folder(tmp_path / name, model) for name in ("one", "two"))
    target = tmp_path / "target"
    convert(one, target, "transforms")
    before = names_in(target)
    with pytest.raises(WorkspaceError, match=r"contains the results of `epipole convert` for .*one"):
        convert(two, target, "transforms")
    assert names_in(target) == before
    convert(one, target, "txt")
    texts = [f"{n}.txt" for n in ("cameras", "rigs", "frames", "images", "points3D")]
    assert names_in(target) == sorted([*before, *texts])


def test_what_is_there_is_kept(tmp_path: Path) -> None:
    model = mappable_model()
    out = output_folder(tmp_path / "out", model)
    mine = tmp_path / "mine"
    mine.mkdir()
    names = (
        "cameras.txt",
        "cameras.bin",
        "transforms.json",
        "scene.ply",
        "tracks.csv",
        "cameras.xml",
        "cameras.csv",
    )
    for name in (*names, "sensors/sensors.txt"):
        (mine / name).parent.mkdir(exist_ok=True)
        (mine / name).write_text("mine")
    for form in (
        "txt",
        "bin",
        "transforms",
        "bundler",
        "opensfm",
        "metashape",
        "realityscan",
        "kapture",
        "ply",
    ):
        with pytest.raises(WorkspaceError):
            convert(out, mine, form)
    with pytest.raises(WorkspaceError, match="is the folder of"):
        convert(out, out, "txt")
    assert {(mine / name).read_text() for name in names_in(mine)} == {"mine"}
    assert names_in(out) == sorted([*(f"images/{n}" for n in model.images.name), *model_files("sparse/0")])


def model_files(folder: str) -> list[str]:
    return [f"{folder}/{name}.bin" for name in ("cameras", "rigs", "frames", "images", "points3D")]


@pytest.mark.parametrize("name", ["../secret.jpg", "/etc/passwd", "a/../../../secret.jpg"])
def test_names_that_lead_out_are_refused(tmp_path: Path, name: str) -> None:
    model = mappable_model()
    (tmp_path / "secret.jpg").write_text("mine")
    names = (name, *model.images.name[1:])
    write_colmap_model(replace(model, images=replace(model.images, name=names)), tmp_path / "bin")
    with pytest.raises(FileFormatError, match="does not name a file inside"):
        convert(tmp_path / "bin", tmp_path / "nerf", "transforms")
    assert not (tmp_path / "nerf").exists()


def test_misuse_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError,
        match="supported are txt, bin, ply, transforms, bundler, opensfm, metashape, realityscan, kapture, chan, usd, splat",
    ):
        convert(tmp_path, tmp_path / "out", "obj")
    with pytest.raises(FileFormatError, match="it does not exist"):
        convert(tmp_path / "nothing", tmp_path / "out", "ply")
    with pytest.raises(FileFormatError, match="contains no model"):
        convert(tmp_path, tmp_path / "out", "ply")
    write_colmap_model(mappable_model(), tmp_path / "bin")
    with pytest.raises(WorkspaceError, match="several files; pass the name of a folder"):
        convert(tmp_path / "bin", tmp_path / "nerf.json", "transforms")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bin"]


def test_only_a_file_of_an_earlier_conversion_is_replaced(tmp_path: Path) -> None:
    """An image of the model, or the model itself, as a mistyped target."""
    model = mappable_model()
    out = output_folder(tmp_path / "out", model)
    for name in (f"images/{model.images.name[0]}", "sparse/0/points3D.bin"):
        before = (out / name).read_bytes()
        with pytest.raises(WorkspaceError, match="was not written by epipole convert"):
            convert(out, out / name, "ply")
        assert (out / name).read_bytes() == before
    for _ in range(2):
        assert len(read_points_ply(convert(out, tmp_path / "a.ply", "ply").out))


def test_what_convert_wrote_can_be_read_and_a_ply_is_no_model(tmp_path: Path) -> None:
    one = output_folder(tmp_path / "one", mappable_model())
    convert(one, tmp_path / "nerf", "transforms")
    again = convert(tmp_path / "nerf", tmp_path / "text", "txt")
    assert (again.out / "cameras.txt").is_file()
    convert(one, tmp_path / "scene.ply", "ply")
    with pytest.raises(FileFormatError, match="points but no cameras"):
        convert(tmp_path / "scene.ply", tmp_path / "x", "txt")


OTHERS = {
    "opensfm": ("reconstruction.json", "images"),
    "metashape": ("cameras.xml", "images"),
    "kapture": ("sensors/sensors.txt", "sensors/records_data"),
    "bundler": ("bundle.out", "images"),
    "transforms": ("transforms.json", "images"),
}


def with_images(root: Path, model: Reconstruction) -> Path:
    """An output folder whose images can be read."""
    output_folder(root, model)
    for image, name in enumerate(model.images.name):
        camera = model.cameras[int(model.camera_of_image[image])]
        Image.new("RGB", (camera.width, camera.height), (image, 0, 0)).save(
            root / "images" / name, format="PNG"
        )
    return root


@pytest.mark.parametrize("form", OTHERS)
def test_every_format_of_other_programs_is_read_again(tmp_path: Path, form: str) -> None:
    """By its folder and by its file, with its images."""
    model = mappable_model()
    source = with_images(tmp_path / "one", model)
    file, images = OTHERS[form]
    done = convert(source, tmp_path / form, form)
    assert done.num_images == len(model.images) and not done.missing
    assert (done.out / file).is_file()
    assert sorted(path.name for path in (done.out / images).iterdir()) == sorted(model.images.name)
    again = convert(done.out, tmp_path / "again", "bin")
    expected = model.cams_from_world().as_matrix()
    found = read_colmap_model(again.out)
    assert found.images.name == model.images.name and not again.warnings
    np.testing.assert_allclose(found.cams_from_world().as_matrix(), expected, atol=1e-12)
    if form != "kapture":
        np.testing.assert_allclose(
            read_model(done.out / file).cams_from_world().as_matrix(), expected, atol=1e-12
        )
    nerf = convert(done.out, tmp_path / "nerf", "transforms")
    assert nerf.num_images == len(model.images)


def test_content_that_a_format_cannot_store_is_named(tmp_path: Path) -> None:
    model = replace(small_model(), georeference=Georeference(48.0, 11.0, 500.0))
    write_colmap_model(model, tmp_path / "bin")
    assert convert(tmp_path / "bin", tmp_path / "a", "opensfm").losses == ()
    losses = convert(tmp_path / "bin", tmp_path / "b", "metashape").losses
    assert losses == ("metashape cannot store points and tracks", "metashape cannot store rigs")
    assert convert(tmp_path / "bin", tmp_path / "c", "kapture").losses == (
        "kapture cannot store the position on Earth",
    )
    timed = replace(
        model, frames=replace(model.frames, timestamp_s=np.arange(len(model.frames), dtype=float))
    )
    write_colmap_model(timed, tmp_path / "timed")
    for form, target in (("transforms", "d"), ("ply", "e.ply")):
        losses = content_not_stored(timed, form)
        assert losses == tuple(f"{form} cannot store {what}" for what in ("tracks", "rigs", "capture times"))
        done = convert(tmp_path / "bin", tmp_path / target, form)
        assert set(done.losses) <= set(losses) and f"{form} cannot store tracks" in done.losses
    assert b"latitude 48.0000000000 longitude 11.0000000000" in (tmp_path / "e.ply").read_bytes()
    assert num_cameras_of_scene(tmp_path / "e.ply") == model.is_registered().sum()
    assert {"bundler cannot store the position on Earth", "bundler cannot store capture times"} <= {
        *content_not_stored(timed, "bundler")
    }


def test_content_of_the_source_that_is_not_read_is_named(tmp_path: Path) -> None:
    write_opensfm(mappable_model(), tmp_path / "reconstruction.json")
    content = json.loads((tmp_path / "reconstruction.json").read_text())
    (tmp_path / "reconstruction.json").write_text(json.dumps([*content, {"cameras": {}, "shots": {}}]))
    done = convert(tmp_path / "reconstruction.json", tmp_path / "txt", "txt")
    assert len(done.warnings) == 1 and "2 disconnected reconstructions" in done.warnings[0]


def test_the_name_of_a_file_only_suggests_its_format(tmp_path: Path) -> None:
    model = mappable_model()
    write_opensfm(model, tmp_path / "model.xml")
    (tmp_path / "transforms.json").write_bytes((tmp_path / "model.xml").read_bytes())
    assert len(read_model(tmp_path / "model.xml").images) == len(model.images)
    assert len(read_model(tmp_path).images) == len(model.images)


def test_gaussians_are_written_in_the_format_of_the_name(tmp_path: Path, rng) -> None:
    shapes = ((9, 3), (9, 3), (9, 4), (9,), (9, 4, 3))
    cloud = GaussianCloud(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))
    (tmp_path / "trained").mkdir()
    write_gaussians(tmp_path / "trained" / "splat.ply", cloud)
    for name in ("a.spz", "a.compressed.ply", "a.splat", "a.sog", "a.spz", "a.sog", "a.ply"):
        assert convert(tmp_path / "trained", tmp_path / name, "splat").out == tmp_path / name
        found = read_gaussians(tmp_path / name)
        order = np.argsort(found.means_in_world[:, 0]), np.argsort(cloud.means_in_world[:, 0])
        assert found.means_in_world[order[0]] == pytest.approx(cloud.means_in_world[order[1]], abs=3e-3)
    with pytest.raises(WorkspaceError, match="choose another name"):
        convert(tmp_path / "a.ply", tmp_path / "a.splat", "splat")
    with pytest.raises(ConfigError, match="are written to"):
        convert(tmp_path / "a.ply", tmp_path / "b.txt", "splat")
    with pytest.raises(WorkspaceError, match="is a folder"):
        convert(tmp_path / "a.ply", tmp_path / "trained", "splat")


def test_formats_of_visual_effects(tmp_path: Path) -> None:
    """One file each, whose suffix gives the format, from a model and back."""
    model = mappable_model()
    out = output_folder(tmp_path / "out", model)
    for row, name in enumerate(model.images.name):
        camera = model.cameras[int(model.camera_of_image[row])]
        Image.new("L", (camera.width, camera.height)).save(out / "images" / name)
    chan = convert(out, tmp_path / "vfx" / "shot.chan")
    assert chan.losses == ("chan cannot store points and tracks",)
    (tmp_path / "vfx" / "images").symlink_to(out / "images")
    found = read_colmap_model(convert(chan.out, tmp_path / "back", "bin").out)
    np.testing.assert_allclose(
        found.cams_from_world().as_matrix(), model.cams_from_world().as_matrix(), atol=1e-12
    )
    for suffix in ("usda", "usdc", "usdz"):
        done = convert(out, tmp_path / f"a.{suffix}")
        assert done.out.is_file() and done.losses == ("usd cannot store tracks",)
        stage = Usd.Stage.Open(str(done.out))
        assert stage.GetPrimAtPath("/model/camera").IsValid()
    for suffix in ("usda", "usdz"):  # sealed, so an unchanged file is replaced
        convert(out, tmp_path / f"a.{suffix}")
    (tmp_path / "folder").mkdir()
    assert convert(out, tmp_path / "folder", "usd").out.name == "cameras.usdc"
    assert convert(out, tmp_path / "folder", "chan").out.name == "camera.chan"
    done = convert(out, tmp_path / "rs", "realityscan")
    assert (done.out / "cameras.csv").is_file() and done.num_images == len(model.images)
    assert all((done.out / "images" / name).is_file() for name in model.images.name)
    np.testing.assert_allclose(
        read_model(done.out).cams_from_world().as_matrix(), model.cams_from_world().as_matrix(), atol=1e-12
    )


def test_what_one_file_cannot_store_is_named(tmp_path: Path) -> None:
    camera = Camera("PINHOLE", 640, 480, [500.0, 501.0, 300.0, 239.5])
    model = replace(mappable_model(), cameras=Cameras.from_list([camera]))
    write_colmap_model(model, tmp_path / "m")
    assert convert(tmp_path / "m", tmp_path / "a.chan").losses == (
        "chan cannot store points and tracks",
        "chan cannot store different focal lengths in x and y",
        "chan cannot store principal points that are not the image center",
    )
    assert "realityscan cannot store different focal lengths in x and y" in (
        convert(tmp_path / "m", tmp_path / "rs", "realityscan").losses
    )
    distorted = replace(
        model, cameras=Cameras.from_list([Camera("RADIAL", 640, 480, [500, 320, 240, 0.1, 0])])
    )
    write_colmap_model(distorted, tmp_path / "d")
    for name in ("b.chan", "b.usda"):
        with pytest.raises(ConfigError, match="undistort the images first"):
            convert(tmp_path / "d", tmp_path / name)
        assert not (tmp_path / name).exists()


def test_usd_rotates_the_upward_direction_to_y(tmp_path: Path) -> None:
    """+z in models of epipole, and in georeferenced ones; else that of the cameras."""
    model = mappable_model()
    write_colmap_model(model, tmp_path / "m")
    write_opensfm(
        replace(model, georeference=Georeference(48.0, 11.0, 500.0)), tmp_path / "reconstruction.json"
    )
    mean = -model.cams_from_world().rotation[:, 1].mean(axis=0)
    for source, up in (
        (tmp_path / "m", mean / np.linalg.norm(mean)),
        (tmp_path / "reconstruction.json", [0, 0, 1]),
    ):
        convert(source, tmp_path / f"{source.stem}.usda", "usd")
        stage = Usd.Stage.Open(str(tmp_path / f"{source.stem}.usda"))
        np.testing.assert_allclose(stage.GetRootLayer().customLayerData["up_in_world"], up, atol=1e-12)


@pytest.mark.parametrize("given", ["out", "out/sparse/0", "out/undistorted", "out/undistorted/sparse/0"])
def test_usd_of_an_undistorted_model_keeps_the_upward_direction(tmp_path: Path, given: str) -> None:
    """`reconstruct` makes +z the upward direction, and the undistorted model has the same coordinates."""
    model = mappable_model()
    with open_run(Job(kind="reconstruct", inputs=(), settings={}), tmp_path / "out") as run:
        with run.folder.publish("model") as aside:
            write_colmap_model(model, aside / "sparse" / "0")
        (run.root / "images").mkdir()
        for name in model.images.name:
            Image.new("RGB", (640, 480)).save(run.root / "images" / name)
        run.finish({})
    undistort(tmp_path / "out")
    convert(tmp_path / given, tmp_path / "a.usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    np.testing.assert_array_equal(stage.GetRootLayer().customLayerData["up_in_world"], [0, 0, 1])
