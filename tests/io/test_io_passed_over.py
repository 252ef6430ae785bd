"""Files and folders that are no photographs to a list are counted and named, by all jobs that take a folder."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image

import epipole
from epipole.errors import EpipoleError
from epipole.io.images.photographs import list_photographs, read_header
from epipole.io.sequences.sequence import read_sequence
from epipole.pipelines.calibration import run as calibration
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.photographs import read_image_set
from epipole.pipelines.stereo.run import stereo_many


@pytest.fixture
def folder(tmp_path):
    """Three photographs, five files that are none by their names, and a folder with a config.json of another program."""
    path = tmp_path / "photos"
    path.mkdir()
    random = np.random.default_rng(0)
    for n in range(3):
        cv2.imwrite(str(path / f"{n}.png"), random.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    image = Image.fromarray(random.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    image.save(path / "a.xyz", "JPEG")
    image.save(path / "b.xyz", "JPEG")
    image.save(path / "c.thm", "GIF")
    (path / "notes.txt").write_text("a walk")
    (path / "nosuffix").write_text("?")
    (path / ".hidden").write_text("?")
    for n in range(2):
        (path / "day" / "deep").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path / "day" / "deep" / f"{n}.png"), np.zeros((48, 64, 3), np.uint8))
    (path / "day" / "config.json").write_text("{}")
    return path


FILES = "Skipped 5 files without a supported image suffix"
FOLDER = "Skipped the folder day (3 files, 2 of them images): its config.json"


def test_they_are_counted_and_named(folder):
    found = list_photographs(folder)
    assert len(found) == 3 and len(found.passed_over) == 2 and found.notes == list(found.passed_over)
    files, results = found.passed_over
    assert files.startswith(FILES) and results.startswith(FOLDER)
    for words in ("2 .xyz (a.xyz, a JPEG image)", "1 .thm (c.thm, a GIF image)", "1 .txt (notes.txt)"):
        assert words in files
    assert (
        "1 without a suffix (nosuffix)" in files
        and "to use the images among them, convert or rename them" in files
    )
    assert not list_photographs(folder / "day").passed_over[1:]
    fewer = list_photographs(folder, ignore=[folder / "day", folder / "notes.txt"])
    assert len(fewer.passed_over) == 1 and fewer.passed_over[0].startswith("Skipped 4 files")


def test_a_folder_of_them_alone_says_what_is_in_it(folder, tmp_path):
    gifs = tmp_path / "gifs"
    gifs.mkdir()
    for n in range(3):
        Image.new("RGB", (64, 48)).save(gifs / f"{n}.gifx", "GIF")
    said = r"Skipped 3 files .*3 \.gifx \(0\.gifx, a GIF image\); to use .*convert or rename"
    for job in (
        lambda: epipole.reconstruct(gifs, tmp_path / "a"),
        lambda: epipole.slam(gifs, tmp_path / "b"),
        lambda: epipole.calibrate(gifs, tmp_path / "c"),
        lambda: epipole.splat(gifs, tmp_path / "d", steps=1),
        lambda: stereo_many(gifs, folder, tmp_path / "e"),
    ):
        with pytest.raises(EpipoleError, match=said):
            job()


def test_every_job_reports_them(folder, tmp_path):
    images = read_image_set(
        folder,
        ReconstructConfig(pairs=folder / "notes.txt"),
        tmp_path / "memory.npz",
        progress=lambda _: None,
    )
    assert any(note.startswith("Skipped 4 files") for note in images.notes) and FOLDER in " ".join(
        images.notes
    )
    assert FILES in " ".join(read_sequence(folder, 10.0).warnings)


def test_stereo_reports_them(folder, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    for n in range(3):
        cv2.imwrite(str(other / f"{n}.png"), cv2.imread(str(folder / f"{n}.png")))
    batch = stereo_many(folder, other, tmp_path / "stereo", max_disparity_px=16)
    assert FILES in batch.warnings[str(folder)][0] and str(other) not in batch.warnings
    summary = json.loads((tmp_path / "stereo" / "summary.json").read_text())
    assert summary["warnings"][str(folder)][1].startswith(FOLDER)


@pytest.mark.usefixtures("unchecked")
def test_calibration_reports_them(folder, tmp_path, monkeypatch):
    found = SimpleNamespace(problems={})
    monkeypatch.setattr(calibration, "_measure", lambda *_: found)
    monkeypatch.setattr(calibration, "write_results", lambda *_: None)
    monkeypatch.setattr(calibration, "render_page", lambda _: "")
    epipole.calibrate(folder, tmp_path / "out")
    said = list(found.problems.values())
    assert len(said) == 2 and said[0].startswith(FILES) and said[1].startswith(FOLDER)


@pytest.mark.parametrize("name", ["loop", "loop.txt"])
def test_a_link_to_itself_is_passed_over(folder, name):
    before = list_photographs(folder)
    (folder / name).symlink_to(folder / name)
    assert list_photographs(folder).names == before.names


def test_a_photograph_that_links_to_itself_is_an_error_to_read(folder):
    (folder / "loop.jpg").symlink_to(folder / "loop.jpg")
    assert "loop.jpg" in list_photographs(folder).names
    with pytest.raises(EpipoleError):
        read_header(folder / "loop.jpg")
