"""Which images belong to which camera, and what is said of those that cannot be used."""

import numpy as np
import pytest
from PIL import Image

from epipole.config import BoardConfig
from epipole.errors import DegenerateGeometryError, FileFormatError, WorkspaceError
from epipole.io.sequences.stereo_folders import pair_folders
from epipole.pipelines.calibration.config import CalibrationConfig
from epipole.pipelines.calibration.run import calibrate, images_of_cameras


def saved(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.zeros((80, 100), np.uint8)).save(path)


@pytest.mark.parametrize("names", [("left{}.png", "right{}.png"), ("cam0_{}.png", "cam1_{}.png")])
def test_pairs_in_one_folder_are_told_by_their_names(tmp_path, names):
    for number in (1, 2, 3):
        for name in names:
            saved(tmp_path / name.format(number))
    saved(tmp_path / names[0].format(9))  # without a partner
    saved(tmp_path / "bright_7.png")  # no side's word
    sides = images_of_cameras(tmp_path)
    assert [[p.name for p in side] for side in sides] == [[n.format(k) for k in (1, 2, 3, 9)] for n in names]
    assert not sides[1][3].exists()


def test_folders_of_sides_and_single_cameras(tmp_path):
    for side in ("cam0", "cam1"):
        for number in (1, 2):
            saved(tmp_path / "two" / side / f"{number}.png")
    assert [len(side) for side in images_of_cameras(tmp_path / "two")] == [2, 2]
    saved(tmp_path / "one" / "a.png")
    assert [len(side) for side in images_of_cameras(tmp_path / "one")] == [1]
    saved(tmp_path / "two" / "cam1" / "3.png")
    sides = images_of_cameras(tmp_path / "two")  # seen by one camera alone
    assert [[p.name for p in side] for side in sides] == [["1.png", "2.png", "3.png"]] * 2
    assert not sides[0][2].exists() and sides[1][2].exists()
    for name in ("cam0/a.png", "cam0/b.png", "cam1/c.png"):
        saved(tmp_path / "three" / name)
    with pytest.raises(FileFormatError, match="do not match the 2 in"):
        images_of_cameras(tmp_path / "three")


def paired(folder, left, right):
    for side, names in (("left", left), ("right", right)):
        for name in names:
            saved(folder / side / name)
    return [(a.name, b.name) for _, (a, b) in pair_folders(folder / "left", folder / "right")]


def test_folders_are_paired_by_names_but_for_the_sides_words_or_by_order(tmp_path):
    found = paired(tmp_path / "a", ("left1.png", "left3.png"), ("right1.png", "right2.png", "right3.png"))
    assert found == [("left1.png", "right1.png"), ("left2.png", "right2.png"), ("left3.png", "right3.png")]
    # One name in common is chance; two are not, however many others there are.
    found = paired(tmp_path / "b", ("10.png", "20.png", "30.png"), ("11.png", "20.png", "31.png"))
    assert found == [("10.png", "11.png"), ("20.png", "20.png"), ("30.png", "31.png")]
    late = [[f"{k:03d}.png" for k in range(start, start + 9)] for start in (0, 7)]
    assert paired(tmp_path / "c", *late) == [(name, name) for name in sorted({*late[0], *late[1]})]
    # Digits and letters beside a word are no part of it.
    names = [f"image_{k:02d}.png" for k in range(20)]
    assert paired(tmp_path / "d", names[:5] + names[6:], names) == [(name, name) for name in names]


def test_what_cannot_be_used_is_said(tmp_path):
    saved(tmp_path / "blank" / "a.png")
    for kind, words in (
        ("chessboard", "7 x 5 inner corners"),
        ("charuco", "ChArUco"),
        ("apriltag", "AprilTags"),
    ):
        config = CalibrationConfig(board=BoardConfig(kind=kind, columns=7, rows=5))
        with pytest.raises(DegenerateGeometryError, match=words):
            calibrate(tmp_path / "blank", tmp_path / "out", config)
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkspaceError, match="is a file"):
        calibrate(tmp_path / "blank", tmp_path / "file", CalibrationConfig())
    with pytest.raises(WorkspaceError, match="is the folder of the images"):
        calibrate(tmp_path / "blank", tmp_path / "blank", CalibrationConfig())
    with pytest.raises(FileFormatError, match="the left and the right folder are the same"):
        calibrate(tmp_path / "blank", tmp_path / "out", CalibrationConfig(), tmp_path / "blank")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileFormatError, match="no image"):
        calibrate(tmp_path / "empty", tmp_path / "out", CalibrationConfig())
    assert not (tmp_path / "out").exists()
