"""Images are localized where they were taken, and images that cannot be are said to be."""

import json
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from photographs import CAMERA, FOCAL_35MM, HEIGHT, WIDTH

import epipole
from epipole.errors import ConfigError, FileFormatError, NoModelError, ShapeError, WorkspaceError
from epipole.geometry import Rotation3, align_points
from epipole.io.colmap.model import read_colmap_model, write_colmap_model
from epipole.io.images.photographs import read_rgb, write_jpeg_with_exif
from epipole.pipelines.localization.extended_model import names_in_model, with_localized
from epipole.pipelines.localization.localized_image import LocalizationReason
from epipole.pipelines.localization.query_cameras import QueryCamera
from epipole.pipelines.localization.results import image_summary
from epipole.scene import Georeference
from whole import IS_WHOLE


@pytest.fixture(scope="module")
def localizer(workspace):
    return epipole.Localizer.open(workspace)


@pytest.fixture(scope="module")
def result(photographs, workspace, tmp_path_factory):
    return epipole.localize(photographs, workspace, tmp_path_factory.mktemp("localized") / "out")


def map_from_truth(model, views):
    """Similarity that maps true positions to those of the model."""
    order = [int(name[5:7]) for name in model.images.name]
    return align_points(views.centers()[order], model.camera_centers_in_world())


def assert_near_the_truth(found, pose, to_model):
    expected = to_model.apply(pose.centers()[None])[0]
    off = np.linalg.norm(found.position_in_world() - expected) / float(to_model.scale)
    rotated = Rotation3(
        found.cam_from_world.rotation @ (pose.rotation @ np.asarray(to_model.rotation).T).T
    ).log()
    # The scene is about 10 m wide; six photographs of 480 x 320 know it within millimeters.
    assert off < 0.02, off
    assert np.degrees(np.linalg.norm(rotated)) < 0.3
    assert 0 < found.position_sigma() / float(to_model.scale) < 0.02


def test_images_are_localized_where_they_were_taken(result, views, truth, workspace):
    to_model = map_from_truth(read_colmap_model(workspace / "sparse" / "0"), views)
    assert result.num_localized == 3 and not result.reasons and not result.warnings
    for k, found in enumerate(result.images.values()):
        assert_near_the_truth(found, truth[k], to_model)
        assert not found.is_focal_contradicted and abs(found.focal_correction) < 0.01


@pytest.mark.parametrize("factor", [0.95] + IS_WHOLE * [0.85, 1.05, 1.2])
def test_a_wrong_focal_length_is_named_in_every_image(factor, photographs, workspace):
    """Also where most matches agree with it within the threshold."""
    localizer = epipole.Localizer.open(workspace)
    right = localizer.reference.model.cameras[0]
    params = right.params.copy()
    params[0] *= factor
    for path in sorted(photographs.iterdir()):
        assert localizer.localize(
            path, epipole.Camera(right.model, right.width, right.height, params)
        ).is_focal_contradicted


def test_the_model_is_unchanged_and_the_images_are_added(result, workspace):
    before = read_colmap_model(workspace / "sparse" / "0")
    after = read_colmap_model(result.out / "sparse" / "0")
    assert after.images.name[:6] == before.images.name and len(after.images) == 9
    assert np.array_equal(after.points.xyz_in_world, before.points.xyz_in_world)
    assert len(after.cameras) == len(before.cameras)  # the EXIF says that it is the same camera
    errors = after.reprojection_errors_px()[after.tracks.image >= 6]
    assert len(errors) > 300 and np.median(errors) < 1.0


def test_the_files_have_the_same_poses(result):
    lines = (result.out / "poses.txt").read_text().splitlines()
    entries = json.loads((result.out / "localized.json").read_text())
    for line, (name, found) in zip(lines, result.images.items(), strict=True):
        words = line.split()
        assert words[0] == name
        assert np.allclose([float(w) for w in words[5:]], found.cam_from_world.translation)
        entry = entries[name]["cam_from_world"]
        assert np.allclose([float(w) for w in words[1:5]], entry["quaternion_wxyz"])
        assert entries[name]["focal_source"] == "the model's camera"
        assert np.shape(entries[name]["covariance"]) == (6, 6)


def test_a_position_in_a_georeferenced_model_has_latitude_and_longitude(result, workspace):
    origin = Georeference(46.5, 7.25, 500.0)
    model = read_colmap_model(workspace / "sparse" / "0")
    camera = QueryCamera(model.cameras[0], is_known=True, is_given=False, source="")
    image = next(iter(result.images.values()))
    assert "lat_lon_alt" not in image_summary(image, model, camera=camera)
    entry = image_summary(image, replace(model, georeference=origin), camera=camera)
    in_world = origin.enu_of(np.array([entry["lat_lon_alt"]]))[0]
    assert np.allclose(in_world, image.position_in_world(), atol=1e-6)


def test_one_image_from_python(localizer, photographs, result):
    name = sorted(p.name for p in photographs.iterdir())[1]
    image = read_rgb(photographs / name)
    found = localizer.localize(image)
    assert found.success
    assert np.allclose(
        found.cam_from_world.translation, result.images[name].cam_from_world.translation, atol=1e-6
    )
    assert np.array_equal(localizer.localize(photographs / name).covariance, found.covariance)
    given = localizer.localize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), CAMERA)
    assert given.success
    with pytest.raises(ConfigError, match="480x320"):
        localizer.localize(image[:100], CAMERA)
    with pytest.raises(ShapeError):
        localizer.localize(np.zeros((4, 4, 4, 4), np.uint8))


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_whatever_the_number_of_threads(photographs, workspace, result, tmp_path, threads):
    again = epipole.localize(photographs, workspace, tmp_path / "out", threads=threads)
    first = (result.out / "localized.json").read_bytes()
    assert (again.out / "localized.json").read_bytes() == first


def test_another_scene_is_not_localized(localizer, rng):
    noise = cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, WIDTH)).astype(np.uint8), (0, 0), 2.0)
    noise = cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX)
    found = localizer.localize(noise)
    assert not found.success and np.isnan(found.cam_from_world.translation).all()
    assert found.reason in (LocalizationReason.FEW_MATCHES, LocalizationReason.FEW_INLIERS)
    blank = localizer.localize(np.full((HEIGHT, WIDTH), 128, np.uint8))
    assert blank.reason is LocalizationReason.FEW_FEATURES


def test_images_of_another_scene_alone_end_with_a_warning(photographs, workspace, tmp_path):
    """Mirror images, which show no scene of the model."""
    (tmp_path / "others").mkdir()
    for path in sorted(photographs.iterdir()):
        mirrored = cv2.imread(str(path))[:, ::-1, ::-1].copy()
        write_jpeg_with_exif(tmp_path / "others" / path.name, mirrored, focal_35mm=FOCAL_35MM)
    found = epipole.localize(tmp_path / "others", workspace, tmp_path / "out")
    assert found.num_localized == 0 and len(found.reasons) == 3
    assert any("no image of 3 is localized" in warning for warning in found.warnings)


@pytest.mark.parametrize("zoom", [1.06] + IS_WHOLE * [1.4])
def test_another_zoom_without_exif_is_noticed(workspace, photographs, views, truth, tmp_path, zoom):
    """Images without EXIF have the size of the model's images, but were cropped: they have another focal length."""
    without = tmp_path / "model"
    shutil.copytree(workspace, without)
    folder = tmp_path / "zoomed"
    folder.mkdir()
    for path in (without / "images").iterdir():  # the model's images lose their EXIF, too
        cv2.imwrite(str(path), cv2.imread(str(path)))
    for path in photographs.iterdir():
        large = cv2.resize(cv2.imread(str(path)), None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
        y, x = (large.shape[0] - HEIGHT) // 2, (large.shape[1] - WIDTH) // 2
        cv2.imwrite(str(folder / path.name), large[y : y + HEIGHT, x : x + WIDTH])
    found = epipole.localize(folder, without)
    assert found.out == without / "localized"
    assert any("another focal length" in warning for warning in found.warnings)
    for image in found.images.values():
        assert image.success
        assert image.camera.focal_px == pytest.approx(zoom * FOCAL_35MM / 36 * WIDTH, rel=0.03)
    given = f"{CAMERA.focal_px},240,160,-0.04"
    again = epipole.localize(
        folder, without, tmp_path / "given", camera_model="SIMPLE_RADIAL", camera_params=given
    )
    assert again.num_localized
    assert any("contradict the given focal length" in warning for warning in again.warnings)


def test_an_image_of_an_unknown_camera_gets_a_focal_length(workspace, truth, views, tmp_path):
    """Images of another size have another camera, without a focal length in their EXIF."""
    from epipole.cameras import Camera
    from epipole.synthetic import courtyard, render

    camera = Camera("PINHOLE", 400, 400, [500.0, 500.0, 199.5, 199.5])
    folder = tmp_path / "images"
    folder.mkdir()
    for k in range(3):
        cv2.imwrite(str(folder / f"{k}.png"), render(courtyard(), camera, truth[k]).rgb[..., ::-1])
    found = epipole.localize(folder, workspace, tmp_path / "out")
    to_model = map_from_truth(read_colmap_model(workspace / "sparse" / "0"), views)
    for k, image in enumerate(found.images.values()):
        assert image.success and image.camera.focal_px == pytest.approx(500.0, rel=0.02)
        off = image.position_in_world() - to_model.apply(truth[k].centers()[None])[0]
        assert np.linalg.norm(off) / float(to_model.scale) < 0.1


def test_damaged_images_and_missing_models(workspace, photographs, tmp_path):
    folder = tmp_path / "images"
    shutil.copytree(photographs, folder)
    damaged = sorted(folder.iterdir())[0]
    damaged.write_bytes(damaged.read_bytes()[:2000])
    found = epipole.localize(folder, workspace, tmp_path / "out")
    assert found.num_localized == 2 and damaged.name in found.reasons
    with pytest.raises(NoModelError, match="does not exist"):
        epipole.localize(tmp_path / "missing", workspace, tmp_path / "out2")
    with pytest.raises(FileFormatError, match="does not exist"):
        epipole.localize(folder, tmp_path / "missing", tmp_path / "out2")
    with pytest.raises(FileFormatError, match="no model"):
        epipole.localize(folder, photographs, tmp_path / "out2")
    bare = tmp_path / "bare"
    shutil.copytree(workspace / "sparse" / "0", bare)
    with pytest.raises(FileFormatError, match=r"no database\.db"):
        epipole.localize(folder, bare, tmp_path / "out2")
    with pytest.raises(ConfigError, match="one image"):
        epipole.localize(sorted(photographs.iterdir())[0], workspace, tmp_path / "out2", include=("*.jpg",))


def test_a_damaged_photograph_or_database_is_named(workspace, photographs, tmp_path):
    junk = tmp_path / "junk.jpg"
    junk.write_text("no image")
    with pytest.raises(FileFormatError, match=r"junk\.jpg: not an image"):
        epipole.localize(junk, workspace, tmp_path / "out")
    with pytest.raises(WorkspaceError, match="the folder of the model"):
        epipole.localize(photographs, workspace, workspace)
    copy = tmp_path / "copy"
    shutil.copytree(workspace, copy)
    content = (copy / "database.db").read_bytes()
    (copy / "database.db").write_bytes(content[: len(content) // 2])
    with pytest.raises(FileFormatError, match=r"database\.db"):
        epipole.localize(photographs, copy, tmp_path / "out")


def test_a_model_of_another_run_is_refused(workspace, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(workspace, copy)
    model = read_colmap_model(copy / "sparse" / "0")
    moved = replace(model, images=replace(model.images, keypoints_px=model.images.keypoints_px + 1.0))
    write_colmap_model(moved, copy / "sparse" / "0")
    with pytest.raises(FileFormatError, match="different runs"):
        epipole.Localizer.open(copy)


def test_names_that_the_model_has_get_a_prefix(localizer, result):
    model = localizer.reference.model
    first = next(iter(result.images.values()))
    names = names_in_model(model, ["view_00.jpg", "b.jpg"])
    assert names == ("localized/view_00.jpg", "b.jpg")
    grown = with_localized(model, names[:1], [first], np.array([np.nan]))
    assert len(set(grown.images.name)) == 7 and grown.is_registered().all()
    assert with_localized(model, [], [], np.zeros(0)) is model


def test_the_folder_of_the_model_stands_for_its_workspace(workspace, photographs, result, tmp_path):
    """Not only the model, but also its images and its unit are found."""
    copy = tmp_path / "out"
    shutil.copytree(workspace, copy)
    found = epipole.localize(photographs, copy / "sparse" / "0")
    assert found.out == copy / "localized"
    first = (result.out / "localized.json").read_bytes()
    assert (found.out / "localized.json").read_bytes() == first  # the EXIF of the model's images was read


def test_images_without_descriptors_are_left_out(workspace, photographs, tmp_path):
    """A database may lack the SIFT descriptors of some images, but not of all."""
    copy = tmp_path / "out"
    shutil.copytree(workspace, copy)
    with closing(sqlite3.connect(copy / "database.db")) as database:
        database.execute("DELETE FROM descriptors WHERE image_id = 1")
        database.commit()
        localizer = epipole.Localizer.open(copy)
        assert localizer.localize(sorted(photographs.iterdir())[1]).success
        database.execute("DELETE FROM descriptors")
        database.commit()
    with pytest.raises(FileFormatError, match="no SIFT descriptors"):
        epipole.Localizer.open(copy)


def test_a_single_photograph_and_the_command(photographs, workspace, tmp_path, capsys):
    from epipole.cli.main import main

    path = sorted(photographs.iterdir())[0]
    main(["localize", str(path), str(workspace), str(tmp_path / "out")])
    assert "1 of 1" in capsys.readouterr().out
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert path.name in page and "Localized images" in page
    assert epipole.load(tmp_path / "out").is_registered().sum() == 7


def test_the_view_shows_localized_images_in_another_color(result):
    from epipole.pipelines.viewing.run import scene_of

    scene = scene_of(Path(result.out))
    assert len(scene.cameras.names) == 6
    assert [curve.name for curve in scene.curves] == ["Localized images"]
    assert "3 localized images" in scene.words


def test_exif_of_another_camera_of_the_same_size(workspace, photographs, tmp_path):
    """The EXIF focal length tells two cameras of one size apart."""
    folder = tmp_path / "images"
    folder.mkdir()
    for path in photographs.iterdir():
        large = cv2.resize(read_rgb(path), None, fx=1.5, fy=1.5, interpolation=cv2.INTER_CUBIC)
        y, x = (large.shape[0] - HEIGHT) // 2, (large.shape[1] - WIDTH) // 2
        write_jpeg_with_exif(folder / path.name, large[y : y + HEIGHT, x : x + WIDTH], focal_35mm=45.0)
    found = epipole.localize(folder, workspace, tmp_path / "out")
    assert found.num_localized == 3 and not found.warnings
    for image in found.images.values():
        assert image.camera.focal_px == pytest.approx(600.0, rel=0.03)


def test_a_minority_with_another_zoom_gets_its_own_focal_length(
    workspace, photographs, views, truth, tmp_path
):
    """Two of three images have the model's focal length, one was cropped."""
    without = tmp_path / "model"
    shutil.copytree(workspace, without)
    folder = tmp_path / "images"
    folder.mkdir()
    for path in (without / "images").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path)))
    for k, path in enumerate(sorted(photographs.iterdir())):
        image = cv2.imread(str(path))
        if k == 1:
            large = cv2.resize(image, None, fx=1.1, fy=1.1, interpolation=cv2.INTER_CUBIC)
            y, x = (large.shape[0] - HEIGHT) // 2, (large.shape[1] - WIDTH) // 2
            image = large[y : y + HEIGHT, x : x + WIDTH]
        cv2.imwrite(str(folder / path.name), image)
    found = list(epipole.localize(folder, without, tmp_path / "out").images.values())
    to_model = map_from_truth(read_colmap_model(workspace / "sparse" / "0"), views)
    for k, (image, zoom) in enumerate(zip(found, (1.0, 1.1, 1.0), strict=True)):
        assert image.success
        assert image.camera.focal_px == pytest.approx(zoom * FOCAL_35MM / 36 * WIDTH, rel=0.03)
        off = image.position_in_world() - to_model.apply(truth[k].centers()[None])[0]
        assert np.linalg.norm(off) / float(to_model.scale) < 0.1


def test_a_photograph_is_one_file_whatever_its_name(photographs, workspace, tmp_path):
    folder = tmp_path / "images"
    (folder / "below").mkdir(parents=True)
    first = sorted(photographs.iterdir())[0]
    for name in ("photo[1].jpg", "below/photo[1].jpg", "notes.txt"):
        shutil.copy(first, folder / name)
    found = epipole.localize(folder / "photo[1].jpg", workspace, tmp_path / "out")
    assert list(found.images) == ["photo[1].jpg"] and not found.reasons
    with pytest.raises(WorkspaceError):  # another photograph has other results
        epipole.localize(first, workspace, tmp_path / "out")


def test_an_image_of_the_same_camera_from_an_array_with_another_zoom(localizer, photographs):
    image = read_rgb(sorted(photographs.iterdir())[1])
    large = cv2.resize(image, None, fx=1.2, fy=1.2, interpolation=cv2.INTER_CUBIC)
    y, x = (large.shape[0] - HEIGHT) // 2, (large.shape[1] - WIDTH) // 2
    found = localizer.localize(np.ascontiguousarray(large[y : y + HEIGHT, x : x + WIDTH]))
    assert found.success
    assert found.camera.focal_px == pytest.approx(1.2 * FOCAL_35MM / 36 * WIDTH, rel=0.02)
