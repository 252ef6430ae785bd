"""Images added to a finished model: the earlier ones keep their matches, their poses as a start, and the coordinates."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from epipole import reconstruct
from epipole.errors import ConfigError, WorkspaceError
from epipole.geometry import align_points
from epipole.io.colmap.model import read_colmap_model, write_colmap_model
from epipole.pipelines.sfm.matching import match_stage
from epipole.runs import overwriting
from epipole.runs.folder import MARK
from whole import in_whole_run


@pytest.fixture(scope="session")
def finished(few, tmp_path_factory) -> Path:
    """A folder with four photographs and their reconstruction, which no test changes."""
    folder = tmp_path_factory.mktemp("finished") / "now"
    shutil.copytree(few, folder / "images")
    reconstruct(folder / "images", folder / "out")
    folder.rename(folder.with_name("stored"))
    return folder


@pytest.fixture
def work(finished, rendered) -> Path:
    """A copy of this folder in its original position, to which two photographs are added."""
    shutil.rmtree(finished, ignore_errors=True)
    shutil.copytree(finished.with_name("stored"), finished)
    shutil.copytree(rendered, finished / "images", dirs_exist_ok=True)
    return finished


@pytest.fixture
def grown(work):
    """The model of four images, and that of six that grew from it."""
    earlier = read_colmap_model(work / "out" / "sparse" / "0")
    return earlier, reconstruct(work / "images", work / "out", grow=True)


def test_further_images_are_registered_in_the_same_coordinates(grown, reconstructed):
    earlier, later = grown
    assert earlier.is_registered().sum() == 4 and later.model.is_registered().sum() == 6
    assert later.summary["models"][0]["mapper"] == "grown"
    before, after = earlier.camera_centers_in_world(), later.model.camera_centers_in_world()
    size = np.linalg.norm(np.ptp(before, axis=0))
    assert np.abs(after[:4] - before).max() < 0.01 * size
    # As accurate as a model of all six from the start.
    fresh = reconstructed.model.camera_centers_in_world()
    difference = align_points(after, fresh).apply(after) - fresh
    assert np.linalg.norm(difference, axis=1).max() < 0.005 * np.linalg.norm(np.ptp(fresh, axis=0))


@in_whole_run
def test_only_pairs_with_further_images_are_matched(work, monkeypatch):
    matched = []
    plain = match_stage.match_pair
    monkeypatch.setattr(match_stage, "match_pair", lambda *given: matched.append(1) or plain(*given))
    reconstruct(work / "images", work / "out", grow=True, executor="inline")
    assert len(matched) == 6 * 5 // 2 - 4 * 3 // 2


@in_whole_run
def test_the_same_whatever_the_number_of_threads(work):
    found = {}
    for threads in (1, 2):
        shutil.rmtree(work / "out")
        shutil.copytree(work.with_name("stored") / "out", work / "out")
        reconstruct(work / "images", work / "out", grow=True, threads=threads)
        found[threads] = {p.name: p.read_bytes() for p in (work / "out" / "sparse" / "0").iterdir()}
    assert found[1] == found[2]


def test_a_wrong_earlier_model_is_not_used(work):
    """A model that disagrees with the matches is mapped anew."""
    out = work / "out"
    model = read_colmap_model(out / "sparse" / "0")
    rotated = model.frames.rig_from_world[np.roll(np.arange(len(model.frames)), 1)]
    frames = type(model.frames)(model.frames.rig, rotated, model.frames.timestamp_s)
    write_colmap_model(
        type(model)(model.cameras, model.rigs, frames, model.images, model.points, model.tracks),
        out / "sparse" / "0",
    )
    found = reconstruct(work / "images", out, grow=True)
    assert found.model.is_registered().all()
    assert found.summary["models"][0]["mapper"] != "grown"


def test_images_that_are_gone_and_nothing_to_grow_from(work, tmp_path):
    for path in sorted((work / "images").iterdir())[:1]:
        path.unlink()
    found = reconstruct(work / "images", work / "out", grow=True)
    assert found.model.is_registered().sum() == 5
    with pytest.raises(ConfigError, match="grow needs an earlier model"):
        reconstruct(work / "images", tmp_path / "empty", grow=True)


@in_whole_run
def test_a_replaced_image_is_another_image(work):
    """The file of an earlier image now shows what another one showed: its old pose does not count."""
    paths = sorted((work / "images").iterdir())
    content = paths[5].read_bytes()
    paths[5].unlink()
    paths[0].write_bytes(content)
    found = reconstruct(work / "images", work / "out", grow=True)
    assert found.model.is_registered().sum() == 5
    centers = found.model.camera_centers_in_world()
    order = np.argsort([int(name[5:7]) for name in found.model.images.name])
    steps = np.linalg.norm(np.diff(centers[order], axis=0), axis=1)
    assert steps[0] > 2.0 * steps[1:].max()  # from the position of view 5 to that of view 1


def test_a_model_that_did_not_grow_is_reported(work):
    for path in sorted((work / "images").iterdir())[:4]:
        path.unlink()
    for path in sorted((work / "images").iterdir()):
        shutil.copy(path, path.with_name(f"copy_{path.name}"))
    shutil.copytree(work.with_name("stored") / "images", work / "images", dirs_exist_ok=True)
    for number, path in enumerate(sorted((work / "images").glob("view_0[0-3]*"))):
        path.rename(path.with_name(f"renamed_{number}.jpg"))  # no image of the earlier model has its name
    found = reconstruct(work / "images", work / "out", grow=True)
    assert any("mapped anew" in warning for warning in found.warnings)


@in_whole_run
def test_a_model_grows_from_another_folder_of_images(work, rendered):
    """The further images are in a new folder, with copies of the earlier ones."""
    found = reconstruct(rendered, work / "out", grow=True)
    assert found.summary["models"][0]["mapper"] == "grown" and found.model.is_registered().sum() == 6


@pytest.mark.parametrize(
    ("kind", "words"), [("georeference", "georeference it again"), ("merge", "merge the two")]
)
def test_models_of_other_commands_do_not_grow_and_stay(work, kind, words):
    mark = work / "out" / MARK
    mark.write_text(mark.read_text().replace('"kind": "reconstruct"', f'"kind": "{kind}"'))
    before = {path: path.read_bytes() for path in (work / "out").rglob("*") if path.is_file()}
    with overwriting(), pytest.raises(WorkspaceError, match=words):
        reconstruct(work / "images", work / "out", grow=True)
    assert {path: path.read_bytes() for path in (work / "out").rglob("*") if path.is_file()} == before
