"""Frames of a folder: one sensor, whatever EXIF says of single images; and its camera turned and scaled with them."""

import numpy as np
import pytest
from PIL import Image

from epipole.cameras import Camera
from epipole.cameras.image_fit import ImageShape
from epipole.errors import ConfigError
from epipole.geometry import Rigid3
from epipole.io.calibration.files import CalibrationFile, write_calibration
from epipole.io.images.photographs import read_gray
from epipole.io.sequences.sequence import read_sequence
from epipole.pipelines.slam import run
from epipole.pipelines.slam.config import CameraOptions, JobOptions
from epipole.pipelines.slam.sources.folder import open_sequence

W, H = 64, 48


def folder_of(path, orientations, rng):
    path.mkdir()
    for n, orientation in enumerate(orientations):
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.fromarray(rng.integers(0, 255, (H, W), np.uint8)).save(path / f"{n}.png", exif=exif)
    return path


@pytest.mark.parametrize("first", [1, 3, 6])
def test_all_frames_are_turned_as_the_first(tmp_path, rng, first):
    folder = folder_of(tmp_path / "frames", (first, 1, 3, 6), rng)
    size = (H, W) if first == 6 else (W, H)
    camera = Camera("PINHOLE", *size, [60.0, 60.0, size[0] / 2, size[1] / 2])
    source = open_sequence(read_sequence(folder, 10.0), "mono", camera)
    for n, queued in enumerate(source.frames()):
        np.testing.assert_array_equal(queued.read().gray, read_gray(folder / f"{n}.png", orientation=first))


@pytest.mark.parametrize(("first", "is_said"), [(1, False), (3, True)])
def test_a_calibration_beside_turned_images_is_taken_as_of_the_upright_ones_and_said(
    tmp_path, rng, first, is_said
):
    folder = folder_of(tmp_path / "frames", (first, first), rng)
    (folder / "intrinsics.txt").write_text(f"60 60 {W / 2 + 4} {H / 2}")
    source = open_sequence(read_sequence(folder, 10.0), "mono", None)
    words = "the camera (intrinsics.txt) is assumed to describe the upright images"
    assert any(note.startswith(words) for note in source.notes()) == is_said
    assert source.about["camera_source"] == "intrinsics.txt"


def test_a_calibration_is_turned_and_scaled_and_said(tmp_path):
    path = tmp_path / "calibration.json"
    write_calibration(
        path, CalibrationFile((Camera("PINHOLE", 2 * W, 2 * H, [120, 122, 70, 40]),), Rigid3.identity(1))
    )
    options = CameraOptions(calibration=path)
    camera, notes = options.fitted_camera(ImageShape(W, H))
    np.testing.assert_allclose(camera.params, [60.0, 61.0, 34.75, 19.75])
    assert notes == [f"calibration {path} is for images of {2 * W}x{2 * H} and was scaled to {W}x{H}"]
    camera, notes = options.fitted_camera(ImageShape(2 * H, 2 * W, 8))
    np.testing.assert_allclose(camera.params, [122.0, 120.0, 40.0, 2 * W - 1 - 70])
    assert "the stored pixels" in notes[0]
    with pytest.raises(ConfigError, match=f"is for images of {2 * W}x{2 * H}, but these are {H}x{W}"):
        options.camera((H, W))


def test_the_source_of_a_scaled_camera_is_said_beside_its_note(tmp_path, rng):
    folder, path = folder_of(tmp_path / "frames", (1, 1), rng), tmp_path / "calibration.json"
    camera = Camera("PINHOLE", 2 * W, 2 * H, [120, 122, 70, 40])
    write_calibration(path, CalibrationFile((camera,), Rigid3.identity(1)))
    source = run._open(folder, JobOptions(), CameraOptions(calibration=path), None)
    assert source.about["camera_source"] == "given" and source.camera.camera.width == W
    assert any(f"was scaled to {W}x{H}" in note for note in source.notes())
