"""Photographs of a plane by cameras of unknown focal lengths: the summary says that the model's shape may be wrong."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from epipole import reconstruct
from epipole.cameras import Camera, CameraModel
from epipole.io.colmap.database import DatabaseContents, write_database
from epipole.pipelines.sfm import notes
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.scale import MetricScale, ScaleEstimate
from epipole.scene import Cameras, Frames, Images, Rigs, unregistered
from epipole.synthetic import look_at
from whole import IS_WHOLE

pytestmark = pytest.mark.usefixtures("unchecked_module")

NUM_CAMERAS, NUM_POINTS, WRONG = 10, 400, 0.05


def keypoints_of_cameras(rng, relief, tilt, noise_px):
    """Sizes, keypoints and point numbers of ten cameras above a square of points, which look down with a tilt."""
    points = np.c_[rng.uniform(-1, 1, (NUM_POINTS, 2)), relief * rng.normal(size=NUM_POINTS)]
    widths = 640 + 2 * np.arange(NUM_CAMERAS)  # different sizes, so that no two images share a camera
    keypoints, numbers = [], []
    for width in widths:
        intrinsics = np.array([rng.uniform(500, 900), (width - 1) / 2, 239.5])
        camera = Camera(CameraModel.SIMPLE_PINHOLE, int(width), 480, intrinsics)
        side = tilt * rng.uniform(-1.2, 1.2, 2)
        cam_from_world = look_at((*side, rng.uniform(2.0, 3.0)), (*rng.uniform(-0.2, 0.2, 2), 0.0))
        pixels = camera.project(cam_from_world.apply(points)) + noise_px * rng.normal(size=(NUM_POINTS, 2))
        inside = ((pixels > 0) & (pixels < [width - 1, 479])).all(axis=1)
        keypoints.append(pixels[inside])
        numbers.append(np.flatnonzero(inside))
    return widths, keypoints, numbers


def matches_of(rng, numbers):
    """Matches of all pairs with 30 common points, some of them wrong."""
    out = {}
    for i in range(NUM_CAMERAS):
        for j in range(i + 1, NUM_CAMERAS):
            _, first, second = np.intersect1d(numbers[i], numbers[j], return_indices=True)
            if len(first) >= 30:
                wrong = np.flatnonzero(rng.random(len(second)) < WRONG)
                second[wrong] = rng.permutation(second[wrong])
                out[i, j] = np.stack([first, second], axis=1).astype(np.int32)
    return out


def write_photographs(folder, seed, relief, tilt, noise_px):
    """Images of noise, and a database with keypoints, matches and guessed focal lengths."""
    rng = np.random.default_rng(seed)
    widths, keypoints, numbers = keypoints_of_cameras(rng, relief, tilt, noise_px)
    (folder / "images").mkdir()
    names = tuple(f"{k:02d}.png" for k in range(NUM_CAMERAS))
    for name, width in zip(names, widths):
        Image.fromarray(rng.integers(0, 255, (480, width), dtype=np.uint8)).save(folder / "images" / name)
    guesses = [
        Camera(CameraModel.SIMPLE_RADIAL, int(w), 480, np.array([1.2 * w, (w - 1) / 2, 239.5, 0.0]))
        for w in widths
    ]
    cameras = Cameras.from_list(guesses, is_focal_trusted=np.zeros(NUM_CAMERAS, bool))
    rows = np.arange(NUM_CAMERAS, dtype=np.int32)
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])]).astype(np.int64)
    contents = DatabaseContents(
        cameras,
        Rigs.of_single_cameras(NUM_CAMERAS),
        Frames(rows, unregistered(NUM_CAMERAS), np.full(NUM_CAMERAS, np.nan)),
        Images(names, rows, rows, offsets, np.concatenate(keypoints)),
        None,
        matches_of(rng, numbers),
    )
    write_database(folder / "given.db", contents)


def summary_of(folder, seed, relief, tilt, noise_px):
    write_photographs(folder, seed, relief, tilt, noise_px)
    return reconstruct(
        folder / "images", folder / "out", ReconstructConfig(database=folder / "given.db")
    ).summary


@pytest.mark.parametrize("seed", range(20) if IS_WHOLE else range(1))
def test_a_plane_does_not_determine_ten_focal_lengths(tmp_path, seed):
    summary = summary_of(tmp_path, seed, 0.0, (0.15, 0.5, 1.0)[seed % 3], 0.5)
    assert not summary["is_shape_determined"]
    assert any("the shape of the model may be wrong" in warning for warning in summary["warnings"])


def test_depth_determines_them(tmp_path):
    summary = summary_of(tmp_path, 0, 0.5, 1.0, 0.2)
    assert summary["num_registered"] == NUM_CAMERAS and summary["is_shape_determined"]
    assert not any("shape" in warning for warning in summary["warnings"])


@pytest.mark.parametrize("is_determined", [True, False])
def test_a_known_scale_is_not_that_of_an_undetermined_shape(monkeypatch, is_determined):
    """Distances between cameras from GPS are right while depths are wrong with the focal length."""
    monkeypatch.setattr(notes, "undetermined_focals", lambda _: [] if is_determined else [0])
    gps = ScaleEstimate("GPS", "GPS", 1.0, 0.01, 0.0, "GPS of 9 images")
    scale = MetricScale(1.0, 0.01, (gps,), np.ones(1, bool))
    words = notes.scale_in_words(SimpleNamespace(mapped=SimpleNamespace(scale=scale)))
    assert words.startswith("meters, from GPS")
    assert ("for distances between cameras" in words) != is_determined
