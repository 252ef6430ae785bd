"""The rotation that a video's metadata tell, and the cameras of its upright frames."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from epipole.errors import ConfigError
from epipole.io.images.video import frame_orientation
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.photographs import read_image_set
from epipole.pipelines.slam.config import CameraOptions
from epipole.pipelines.slam.sources.streams import open_video_frames
from epipole.runs import ignore_progress

W, H = 96, 64
MATRICES = {0: (1, 0, 0, 1), 90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}


def video(path: Path, angle_deg: int) -> Path:
    """Four frames of 96x64, stored, with the rotation in the track's header (ISO 14496-12, tkhd)."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (W, H))
    small = np.random.default_rng(3).integers(0, 255, (4, 6, 3), np.uint8)
    for _ in range(4):
        writer.write(cv2.resize(small, (W, H), interpolation=cv2.INTER_CUBIC))
    writer.release()
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    a, b, c, d = (value * 65536 for value in MATRICES[angle_deg])
    data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(bytes(data))
    return path


@pytest.mark.parametrize(("angle_deg", "orientation"), [(0, 1), (90, 6), (180, 3), (270, 8)])
def test_the_rotation_is_that_of_the_frames(tmp_path, angle_deg, orientation):
    assert frame_orientation(video(tmp_path / "a.mp4", angle_deg)) == orientation


@pytest.mark.parametrize("angle_deg", [90, 270])
def test_the_camera_of_a_portrait_video_is_turned_with_it(tmp_path, angle_deg):
    path = video(tmp_path / "a.mp4", angle_deg)
    landscape = CameraOptions(camera_params="80,81,50,30")
    source = open_video_frames(path, landscape)
    camera = source.camera.camera
    assert (camera.width, camera.height) == (H, W)
    cx, cy = (H - 30.0, 50.0) if angle_deg == 90 else (30.0, W - 50.0)
    np.testing.assert_allclose(camera.params, [81.0, 80.0, cx - 0.5, cy - 0.5])
    assert any("the stored pixels" in note for note in source.notes())
    portrait = open_video_frames(path, CameraOptions(camera_params="80,81,30,50"))
    np.testing.assert_allclose(portrait.camera.camera.params, [80.0, 81.0, 29.5, 49.5])
    assert portrait.notes() == []


def test_landscape_parameters_of_a_portrait_video_without_rotation_are_swapped_and_said(tmp_path):
    path = tmp_path / "a.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 10.0, (H, W))
    for value in range(3):
        writer.write(np.full((W, H, 3), 40 * value, np.uint8))
    writer.release()
    source = open_video_frames(path, CameraOptions(camera_params="80,81,48,32"))
    np.testing.assert_allclose(source.camera.camera.params, [81.0, 80.0, 31.5, 47.5])
    assert "96x64" in source.notes()[0] and "64x96" in source.notes()[0]


def test_frames_of_a_video_are_turned_as_it_says(tmp_path):
    for n in range(2):
        cv2.imwrite(str(tmp_path / f"frame_{n}.jpg"), np.full((W, H, 3), 90, np.uint8))
    options = {"memory": tmp_path / "contents.npz", "progress": ignore_progress}
    config = ReconstructConfig(camera_params="80,81,50,30")
    found = read_image_set(tmp_path, config, **options, video_orientation=6)
    np.testing.assert_allclose(found.cameras[0].params, [81.0, 80.0, H - 30.5, 49.5])
    with pytest.raises(ConfigError, match="one size"):
        cv2.imwrite(str(tmp_path / "frame_2.jpg"), np.full((H, H, 3), 90, np.uint8))
        read_image_set(tmp_path, config, **options)
