"""Finished models merged: common images, files of one name, models that do not overlap, and what is missing."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from photographs import FOCAL_35MM, neighboring_views, render_to

from epipole import merge, reconstruct
from epipole.errors import ConfigError, FileFormatError, WorkspaceError
from epipole.geometry import Rigid3, Similarity3, align_points
from epipole.io.colmap.model import read_colmap_model
from epipole.io.images.photographs import write_jpeg_with_exif
from epipole.pipelines.sfm.mappers.joining import _similarity
from epipole.pipelines.sfm.matching import match_stage
from epipole.pipelines.sfm.merge import _free_name, _notes_on_scale, _Part
from epipole.runs import cluster
from whole import in_whole_run

VIEWS = neighboring_views(8)
FIRST, SECOND = np.arange(5), np.arange(3, 8)


@pytest.fixture(scope="module")
def parts(tmp_path_factory) -> Path:
    """Models of the first five and of the last five of eight photographs, which no test changes; two photographs are in both."""
    folder = tmp_path_factory.mktemp("parts")
    names = render_to(folder / "all", VIEWS)
    for name, rows in (("first", FIRST), ("second", SECOND)):
        (folder / f"{name}_images").mkdir()
        for row in rows:
            shutil.copy2(folder / "all" / names[row], folder / f"{name}_images" / names[row])
        reconstruct(folder / f"{name}_images", folder / name)
    return folder


def errors_of(model, rows) -> np.ndarray:
    """Position errors after a similarity, relative to the extent."""
    true = VIEWS.centers()[rows]
    found = model.camera_centers_in_world()
    return np.linalg.norm(align_points(found, true).apply(found) - true, axis=1) / np.linalg.norm(
        np.ptp(true, axis=0)
    )


def test_two_models_become_one_in_the_coordinates_of_the_first(parts, tmp_path, monkeypatch):
    matched = []
    plain = match_stage.match_pair
    monkeypatch.setattr(match_stage, "match_pair", lambda *given: matched.append(1) or plain(*given))
    result = merge([parts / "first", parts / "second"], tmp_path / "out", executor="inline")
    assert result.summary["models"][0]["mapper"] == "grown"
    assert result.model.is_registered().sum() == 8 and len(result.models) == 1
    assert len(matched) == 3 * 3  # only pairs of photographs that no run had together
    assert errors_of(result.model, np.arange(8)).max() < 0.005
    before = read_colmap_model(parts / "first" / "sparse" / "0")
    after = dict(zip(result.model.images.name, result.model.camera_centers_in_world()))
    off = [after[n] - c for n, c in zip(before.images.name, before.camera_centers_in_world())]
    assert np.abs(off).max() < 0.01 * np.linalg.norm(np.ptp(before.camera_centers_in_world(), axis=0))


@in_whole_run
def test_the_merged_model_is_a_workspace(parts, tmp_path):
    result = merge([parts / "first", parts / "second"], tmp_path / "out")
    assert {p.name for p in (result.out / "images").iterdir()} == {p.name for p in (parts / "all").iterdir()}
    again = merge([result.out, parts / "second"], tmp_path / "again")
    assert again.model.is_registered().sum() == 8


@in_whole_run
def test_models_are_merged_on_a_cluster(parts, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "FIRST_WORKER_S", 0.4)
    with pytest.raises(WorkspaceError, match="no Dask scheduler answers"):
        merge([parts / "first", parts / "second"], tmp_path / "none", cluster="tcp://127.0.0.1:1")
    here = merge([parts / "first", parts / "second"], tmp_path / "here")
    there = merge([parts / "first", parts / "second"], tmp_path / "there", cluster="local:1")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        paths = (result.out / "sparse" / "0" / name for result in (here, there))
        assert next(paths).read_bytes() == next(paths).read_bytes()


@in_whole_run
def test_different_files_of_one_name_are_both_kept(parts, tmp_path):
    """The photographs of the second model are renamed to names of the first."""
    shutil.copytree(parts / "second_images", tmp_path / "renamed")
    paths = sorted((tmp_path / "renamed").iterdir())
    for n, path in enumerate(paths):
        path.rename(tmp_path / "renamed" / f"view_0{n}.jpg")
    reconstruct(tmp_path / "renamed", tmp_path / "other")
    result = merge([parts / "first", tmp_path / "other"], tmp_path / "out")
    names = {n for n, k in zip(result.model.images.name, result.model.is_registered()) if k}
    assert len(names) == 8 and {f"other/view_0{n}.jpg" for n in (2, 3, 4)} <= names
    assert result.summary["models"][0]["mapper"] == "grown"


def test_models_that_do_not_overlap_stay_separate(parts, tmp_path):
    (tmp_path / "mirrored").mkdir()
    for path in sorted((parts / "second_images").iterdir()):
        flipped = cv2.imread(str(path))[:, ::-1, ::-1]
        write_jpeg_with_exif(tmp_path / "mirrored" / f"m_{path.name}", flipped.copy(), focal_35mm=FOCAL_35MM)
    reconstruct(tmp_path / "mirrored", tmp_path / "other")
    result = merge([parts / "first", tmp_path / "other"], tmp_path / "out")
    assert [int(m.is_registered().sum()) for m in result.models] == [5, 5]
    assert any("too few points in common" in warning for warning in result.warnings)


def test_what_is_missing_is_named(parts, tmp_path):
    first, second = parts / "first", parts / "second"
    with pytest.raises(ConfigError, match="two models or more, got 1"):
        merge([first], tmp_path / "out")
    for same in (first, first / "sparse" / "0"):
        with pytest.raises(ConfigError, match="given twice"):
            merge([first, same], tmp_path / "twice")
    with pytest.raises(ConfigError, match="is one of the models"):
        merge([first, second], second)
    with pytest.raises(ConfigError, match="masks cannot be used"):
        merge([first, second], tmp_path / "out", masks=tmp_path)
    with pytest.raises(FileFormatError, match="does not exist"):
        merge([first, tmp_path / "nothing"], tmp_path / "out")
    shutil.copytree(second, tmp_path / "bare")
    shutil.rmtree(tmp_path / "bare" / "images")
    with pytest.raises(FileFormatError, match=r"needs the folder images and database.db"):
        merge([first, tmp_path / "bare"], tmp_path / "out")
    shutil.copytree(second, tmp_path / "lost")
    (tmp_path / "lost" / "images" / "view_05.jpg").unlink()
    with pytest.raises(FileFormatError, match=r"it has no view_05.jpg, which the model has registered"):
        merge([first, tmp_path / "lost"], tmp_path / "out2")


@in_whole_run
def test_a_georeferenced_model_keeps_its_coordinates(parts, tmp_path):
    """Also if the images have GPS, which is less precise than control points."""
    from epipole.io.colmap.model import write_colmap_model
    from epipole.io.images.exif import GpsPosition
    from epipole.scene import Georeference

    origin = Georeference(48.2, 11.6, 520.0)
    meters = Similarity3(np.asarray(20.0), np.eye(3), np.array([5.0, 3.0, 1.0]))
    elsewhere = meters.apply(VIEWS.centers()) + np.array([40.0, 0.0, 30.0])
    for name, rows in (("first", FIRST), ("second", SECOND)):
        (tmp_path / f"{name}_images").mkdir()
        for row in rows:
            rgb = cv2.imread(str(parts / "all" / f"view_{row:02d}.jpg"))[..., ::-1]
            gps = GpsPosition(*origin.lat_lon_alt_of(elsewhere[row][None])[0].tolist())
            path = tmp_path / f"{name}_images" / f"view_{row:02d}.jpg"
            write_jpeg_with_exif(path, rgb.copy(), focal_35mm=FOCAL_35MM, gps=gps)
        reconstruct(tmp_path / f"{name}_images", tmp_path / name, use_gps=False)
    model = read_colmap_model(tmp_path / "first" / "sparse" / "0")
    true = VIEWS.centers()[FIRST]
    known = model.transformed(meters @ align_points(model.camera_centers_in_world(), true))
    write_colmap_model(_with_origin(known, origin), tmp_path / "first" / "sparse" / "0")
    result = merge([tmp_path / "first", tmp_path / "second"], tmp_path / "out")
    assert result.model.georeference == origin
    after = dict(zip(result.model.images.name, result.model.camera_centers_in_world()))
    off = [after[n] - c for n, c in zip(known.images.name, known.camera_centers_in_world())]
    assert np.abs(off).max() < 1.0  # GPS is 50 m away


@pytest.mark.usefixtures("unchecked")
def test_a_scale_or_a_position_that_is_lost_is_a_warning(ring, tmp_path):
    from epipole.scene import Georeference

    merged = SimpleNamespace(mapped=SimpleNamespace(methods=["grown"], models=(ring,)))
    bare = _Part(tmp_path / "bare", ring, ())
    located = _Part(tmp_path / "located", _with_origin(ring, Georeference(48.2, 11.6, 520.0)), ())
    (tmp_path / "metric").mkdir()
    (tmp_path / "metric" / "summary.json").write_text('{"anchor": {"relative_sigma": 0.01}}')
    metric = _Part(tmp_path / "metric", ring, ())
    for parts, words in (((bare, located), "has a position on Earth"), ((bare, metric), "is in meters")):
        (note,) = _notes_on_scale(merged, parts, is_measured=False)
        assert words in note and f"give {parts[1].root} first" in note
    for parts in ((bare, bare), (located, bare), (metric, bare)):
        assert not _notes_on_scale(merged, parts, is_measured=False)
    assert not _notes_on_scale(merged, (bare, metric), is_measured=True)
    (note,) = _notes_on_scale(merged, (metric, located), is_measured=True)
    assert "has a position on Earth" in note


def _with_origin(model, origin):
    from dataclasses import replace

    return replace(model, georeference=origin)


def test_names_that_are_taken_get_a_folder(tmp_path, ring):
    part = _Part(tmp_path / "b", ring, ("a.jpg",))
    assert _free_name("a.jpg", part, 1, set()) == "a.jpg"
    assert _free_name("a.jpg", part, 1, {"a.jpg"}) == "b/a.jpg"
    assert _free_name("a.jpg", part, 1, {"a.jpg", "b/a.jpg"}) == "model_2/a.jpg"


def test_chance_gives_no_similarity(rng):
    """Points of models that do not overlap agree by chance only."""
    source, target = rng.normal(size=(300, 3)), rng.normal(size=(300, 3))
    assert _similarity(source, target, 0.02 * 5.0, 0) is None
    moved = Similarity3.exp(np.array([0.3, -1.0, 2.0, 0.1, 0.4, -0.2, 0.5])).apply(source)
    moved[:150] = rng.normal(size=(150, 3))
    found = _similarity(source, moved, 0.02, 0)
    assert found is not None
    np.testing.assert_allclose(found.apply(source[150:]), moved[150:], atol=1e-6)
    assert _similarity(source[:10], moved[:10], 0.02, 0) is None
    assert isinstance(VIEWS, Rigid3)
