"""Folders of frames are known by their files, and damaged lists name the line."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from epipole.errors import FileFormatError
from epipole.io import SequenceKind, read_sequence


def image(path, size=(64, 48)):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.zeros(size[::-1], np.uint8))


@pytest.mark.parametrize(
    ("name", "kind", "count", "has"),
    [
        ("7scenes", SequenceKind.SEVEN_SCENES, 325, "depth"),
        ("kitti06_stereo", SequenceKind.KITTI, 51, "rig"),
        ("kitti00_mono", SequenceKind.IMAGES, 50, ""),
        ("euroc_static", SequenceKind.EUROC, 6, "rig"),
    ],
)
def test_real_folders(data_dir, name, kind, count, has):
    found = read_sequence(data_dir / "slam" / name)
    assert (found.kind, len(found)) == (kind, count)
    assert (found.rig is not None, found.depth is not None) == (has == "rig", has == "depth")
    assert found.camera is not None and found.camera_source and not found.camera_problem
    assert (np.diff([frame.timestamp_s for frame in found.frames]) > 0).all()
    if kind is SequenceKind.KITTI:
        assert found.rig.baseline == pytest.approx(0.5371, abs=1e-4)


def test_tum_frames_get_the_nearest_depth(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg3_office"
    for name in ("rgb/1.png", "rgb/2.png"):
        image(folder / name)
    (folder / "rgb.txt").write_text("# color\n2.0 rgb/2.png\n1.0 rgb/1.png\n")
    (folder / "depth.txt").write_text("1.012 depth/1.png\n1.5 depth/x.png\n2.5 depth/2.png\n")
    found = read_sequence(folder)
    assert [(f.timestamp_s, f.image.name, f.depth.name) for f in found.frames] == [(1.0, "1.png", "1.png")]
    assert found.camera.params[0] == pytest.approx(535.4) and found.depth.unit == 5000
    folder = folder.rename(tmp_path / "my_room")
    assert read_sequence(folder).camera is None
    (folder / "depth.txt").unlink()
    assert len(read_sequence(folder)) == 2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "lists no images"),
        ("1.0\n", "line 1: expected a time and a file name"),
        ("x rgb/1.png\n", "line 1: expected a time"),
        ("1.0 rgb/1.png\nnan rgb/1.png\n", "line 2: the time is not finite"),
        ("1.0 ../../etc/passwd\n", "does not name a file inside"),
    ],
)
def test_lists_that_are_damaged(tmp_path, text, words):
    image(tmp_path / "rgb" / "1.png")
    (tmp_path / "rgb.txt").write_text(text)
    with pytest.raises(FileFormatError, match=words):
        read_sequence(tmp_path)


def test_times_beside_pictures(tmp_path):
    for n in range(3):
        image(tmp_path / f"{n}.png")
    assert [f.timestamp_s for f in read_sequence(tmp_path).frames] == [0.0, 1 / 30, 2 / 30]
    (tmp_path / "times.txt").write_text("0.5\n0.7\n1.0\n")
    assert [f.timestamp_s for f in read_sequence(tmp_path).frames] == [0.5, 0.7, 1.0]
    for wrong in ("0.5\n0.7\n", "0.5\n0.7\n0.6\n", "0.5 0.6 x\n"):
        (tmp_path / "times.txt").write_text(wrong)
        with pytest.raises(FileFormatError, match=r"times\.txt"):
            read_sequence(tmp_path)


def test_folders_that_are_none(tmp_path, data_dir):
    for wrong, words in (
        (tmp_path / "nothing", "it does not exist"),
        (tmp_path, "no image"),
        (Path(__file__), "a file that is neither a supported video"),
    ):
        with pytest.raises(FileFormatError, match=words):
            read_sequence(wrong)
    shutil.copytree(data_dir / "slam" / "euroc_static" / "mav0" / "cam0", tmp_path / "cam0")
    shutil.rmtree(tmp_path / "cam0" / "data")
    with pytest.raises(FileFormatError, match="none of its images exists"):
        read_sequence(tmp_path)


def test_sequences_beside_each_other_are_not_one(tmp_path):
    for name in ("seq-01", "seq-02"):
        (tmp_path / name).mkdir()
        for n in range(2):
            cv2.imwrite(str(tmp_path / name / f"frame-{n:06d}.color.png"), np.zeros((48, 64), np.uint8))
    with pytest.raises(
        FileFormatError, match=r"contains 2 sequences \(seq-01, seq-02\): choose one, for example .*seq-01"
    ):
        read_sequence(tmp_path)
    assert len(read_sequence(tmp_path / "seq-01").frames) == 2
