"""Images of several cameras: together by time, by name, or in order; what does not belong together is refused."""

import numpy as np
import pytest
from PIL import Image

from epipole.errors import ConfigError, FileFormatError
from epipole.io.sequences.rig_folders import read_rig_sequence


def images(folder, names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.fromarray(np.zeros((8, 10), np.uint8)).save(folder / name)


def names_of(found):
    return [tuple(image.name for image in files.images) for files in found.frames]


def test_long_numbers_are_times_and_images_within_5_ms_belong_together(tmp_path):
    start = 1_700_000_000_000_000_000
    images(tmp_path / "cam0", [f"{start + n * 100_000_000}.png" for n in range(4)])
    # 2 ms late, 8 ms late, missing, in time
    late = [2_000_000, 108_000_000, 300_000_000]
    images(tmp_path / "cam1", [f"{start + n}.png" for n in late])
    found = read_rig_sequence(tmp_path, 2)
    assert [round(f.timestamp_s - start * 1e-9, 3) for f in found.frames] == [0.0, 0.3]
    assert "2 of the 4 images of cam0 are not used" in found.warnings[0]
    with pytest.raises(ConfigError, match="these have times"):
        read_rig_sequence(tmp_path, 2, fps=10)


def test_euroc_lists_give_the_times(tmp_path):
    for k in range(3):
        folder = tmp_path / "mav0" / f"cam{k}"
        images(folder / "data", ["a.png", "b.png"])
        (folder / "data.csv").write_text("#timestamp,filename\n1000000000,a.png\n1100000000,b.png\n")
    found = read_rig_sequence(tmp_path, 3)
    assert names_of(found) == [("a.png",) * 3, ("b.png",) * 3]
    assert [f.timestamp_s for f in found.frames] == [1.0, 1.1] and found.folder.name == "mav0"


def test_images_of_one_name_belong_together(tmp_path):
    images(tmp_path / "cam0", ["1.png", "2.png", "10.png"])
    images(tmp_path / "cam1", ["2.jpg", "10.jpg", "11.jpg"])
    found = read_rig_sequence(tmp_path, 2, fps=5)
    assert names_of(found) == [("2.png", "2.jpg"), ("10.png", "10.jpg")]
    assert [f.timestamp_s for f in found.frames] == [0.0, 0.2]
    assert found.warnings == ("1 images of cam0 are not used: another camera has no image of that name",)


def test_other_images_are_paired_in_order_if_their_numbers_are_equal(tmp_path):
    images(tmp_path / "cam0", ["a1.png", "a2.png"])
    images(tmp_path / "cam1", ["b1.png", "b2.png"])
    found = read_rig_sequence(tmp_path, 2)
    assert names_of(found) == [("a1.png", "b1.png"), ("a2.png", "b2.png")]
    assert "paired in their order" in found.warnings[0] and "30 frames per second" in found.warnings[1]
    images(tmp_path / "cam1", ["b3.png"])
    with pytest.raises(FileFormatError, match=r"different names and numbers \(2, 3\)"):
        read_rig_sequence(tmp_path, 2)


def test_folders_and_calibration_must_have_the_same_number_of_cameras(tmp_path):
    images(tmp_path / "cam0", ["1.png"])
    images(tmp_path / "cam1", ["1.png"])
    with pytest.raises(FileFormatError, match="no folder cam2"):
        read_rig_sequence(tmp_path, 3)
    images(tmp_path / "cam2", ["1.png"])
    with pytest.raises(FileFormatError, match="only 2 cameras"):
        read_rig_sequence(tmp_path, 2)


def test_images_that_are_never_taken_together_are_refused(tmp_path):
    images(tmp_path / "cam0", ["1700000000000000000.png"])
    images(tmp_path / "cam1", ["1700000000050000000.png"])
    with pytest.raises(FileFormatError, match="within 5 ms"):
        read_rig_sequence(tmp_path, 2)
