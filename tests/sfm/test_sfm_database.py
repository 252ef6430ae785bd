"""A COLMAP database as the source of features and matches."""

import shutil
import sqlite3
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

from epipole import reconstruct
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rotation3
from epipole.pipelines.sfm import inputs
from epipole.pipelines.sfm.config import ReconstructConfig

pytestmark = pytest.mark.usefixtures("unchecked_module")


@pytest.fixture(scope="module")
def first(few, tmp_path_factory, unchecked_module):
    return reconstruct(few, tmp_path_factory.mktemp("first") / "out")


@pytest.fixture
def database(first, tmp_path):
    return shutil.copyfile(first.out / "database.db", tmp_path / "given.db")


def run(statement, database):
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute(statement)


def test_the_same_features_and_matches_give_the_same_model(few, first, database, tmp_path):
    again = reconstruct(few, tmp_path / "out", ReconstructConfig(database=database))
    assert again.model.is_registered().all()
    assert len(again.model.tracks.image) == pytest.approx(len(first.model.tracks.image), rel=0.01)
    np.testing.assert_array_equal(again.model.images.keypoint_offsets, first.model.images.keypoint_offsets)
    np.testing.assert_allclose(again.model.images.keypoints_px, first.model.images.keypoints_px, atol=1e-3)
    assert_same_places(again.model, first.model)


def assert_same_places(model, expected):
    """To rounding: features keep single precision in a run, too, so that a database takes nothing from them."""
    found, positions = model.cams_from_world(), expected.cams_from_world()
    assert model.images.name == expected.images.name
    size = np.linalg.norm(np.ptp(positions.centers(), axis=0))
    np.testing.assert_allclose(found.centers(), positions.centers(), atol=1e-6 * size)
    rotated = Rotation3(found.rotation @ np.swapaxes(positions.rotation, 1, 2)).angle_rad()
    assert np.rad2deg(rotated).max() < 1e-4
    np.testing.assert_allclose(model.cameras[0].focal_px, expected.cameras[0].focal_px, rtol=1e-6)


def test_without_matches_before_verification_the_verified_ones_serve(few, database, tmp_path):
    run("DELETE FROM matches", database)
    again = reconstruct(few, tmp_path / "out", ReconstructConfig(database=database))
    assert again.model.is_registered().all()


def test_features_alone_are_matched_here(few, database, tmp_path):
    run("DELETE FROM matches", database)
    run("DELETE FROM two_view_geometries", database)
    again = reconstruct(few, tmp_path / "out", ReconstructConfig(database=database))
    assert again.model.is_registered().all()


def test_pairs_choose_among_the_databases(few, database, tmp_path):
    (tmp_path / "pairs.txt").write_text("view_00.jpg view_01.jpg\nview_01.jpg view_02.jpg\n")
    config = ReconstructConfig(database=database, pairs=tmp_path / "pairs.txt")
    again = reconstruct(few, tmp_path / "out", config)
    assert again.model.is_registered().sum() == 3


def test_a_picture_that_the_database_lacks_is_left_out_with_the_reason(few, database, tmp_path):
    folder = shutil.copytree(few, tmp_path / "pictures")
    shutil.copyfile(folder / "view_00.jpg", folder / "another.jpg")
    again = reconstruct(folder, tmp_path / "out", ReconstructConfig(database=database))
    assert again.model.is_registered().sum() == 4
    assert again.reasons == {"another.jpg": "not in given.db"}


def test_a_database_of_other_pictures_is_refused(few, database, tmp_path):
    run("UPDATE images SET name = 'other' || name", database)
    with pytest.raises(ConfigError, match="has none of the images"):
        reconstruct(few, tmp_path / "out", ReconstructConfig(database=database))


def test_pictures_of_another_size_are_refused(few, database, tmp_path):
    run("UPDATE cameras SET width = 999", database)
    with pytest.raises(ConfigError, match="480x320 upright, but 999x320"):
        reconstruct(few, tmp_path / "out", ReconstructConfig(database=database))


def test_what_is_no_database_is_refused(few, tmp_path):
    (tmp_path / "given.db").write_text("no database at all")
    with pytest.raises(FileFormatError):
        reconstruct(few, tmp_path / "out", ReconstructConfig(database=tmp_path / "given.db"))


def test_the_runs_own_database_is_not_read_over(few, first):
    with pytest.raises(ConfigError, match="copy it elsewhere"):
        reconstruct(few, first.out, ReconstructConfig(database=first.out / "database.db"))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("offsets", "number"), [([0, 1, 2], 0), ([0, 2], 1)])
def test_rigs_that_are_not_used_are_a_warning(monkeypatch, tmp_path, offsets, number):
    contents = SimpleNamespace(rigs=SimpleNamespace(sensor_offsets=np.array(offsets)))
    monkeypatch.setattr(
        inputs, "open_source", lambda *_, **__: (SimpleNamespace(contents=contents), "images")
    )
    run = SimpleNamespace(root=tmp_path / "out", warnings=[])
    config = ReconstructConfig(database=tmp_path / "given.db")
    assert inputs.open_database("images", run, config)[1] == "images"
    assert len(run.warnings) == number and all("the rigs in given.db" in text for text in run.warnings)
