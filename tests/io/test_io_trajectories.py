"""Trajectories survive a trip through every format, and damaged ones name the line."""

import numpy as np
import pytest

from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3
from epipole.io import read_trajectory, write_trajectory
from epipole.scene import Trajectory

LINE = "0 1 2 3 0 0 0 1"


@pytest.fixture
def trajectory(rng) -> Trajectory:
    square = rng.normal(size=(20, 6, 6))
    times = 1_403_636_580.0 + np.arange(20) * 0.05
    return Trajectory(times, Rigid3.exp(rng.normal(size=(20, 6))), square @ np.swapaxes(square, -1, -2))


@pytest.mark.parametrize(("form", "suffix"), [("tum", "txt"), ("kitti", "txt"), ("euroc", "csv")])
def test_a_round_trip(trajectory, form, suffix, tmp_path):
    path = tmp_path / f"path.{suffix}"
    write_trajectory(trajectory, path, form)
    back = read_trajectory(path)
    np.testing.assert_allclose(
        back.world_from_body.as_matrix(), trajectory.world_from_body.as_matrix(), atol=1e-8
    )
    times = np.arange(20) if form == "kitti" else trajectory.timestamp_s
    np.testing.assert_allclose(back.timestamp_s, times, rtol=0, atol=1e-6)
    assert back.covariance is None


def test_covariances_in_29_columns(trajectory, tmp_path):
    write_trajectory(trajectory, tmp_path / "a.txt", with_covariance=True)
    lines = (tmp_path / "a.txt").read_text().splitlines()
    assert {len(line.split()) for line in lines[1:]} == {29}
    np.testing.assert_allclose(
        read_trajectory(tmp_path / "a.txt").covariance, trajectory.covariance, rtol=1e-7
    )
    for wrong in ({"format": "kitti"}, {"format": "euroc"}):
        with pytest.raises(ConfigError, match="needs the format 'tum'"):
            write_trajectory(trajectory, tmp_path / "b.txt", with_covariance=True, **wrong)
    assert not (tmp_path / "b.txt").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "contains no poses"),
        ("# only a comment\n", "contains no poses"),
        (f"{LINE}\n1 2 3\n", "line 2: got 3 columns, expected 8"),
        ("1 2 3\n", "3 columns do not match a trajectory"),
        (f"{LINE}\n0.5 1 2 x 0 0 0 1\n", "line 2: could not convert"),
        (f"{LINE}\n0.5 1 2 nan 0 0 0 1\n", "line 2: a number is not finite"),
        (f"{LINE}\n0.5 1 2 3 0 0 0 2\n", "line 2: not a unit quaternion"),
        (f"{LINE}\n# no\n-1 1 2 3 0 0 0 1\n", "line 3: its time is earlier"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "line 1: not a rotation matrix"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(text, words, tmp_path):
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(FileFormatError, match=words):
        read_trajectory(tmp_path / "a.txt")
    with pytest.raises(FileFormatError, match="it does not exist"):
        read_trajectory(tmp_path / "b.txt")


def test_real_files_are_read(data_dir):
    folder = data_dir / "trajectories"
    assert len(read_trajectory(folder / "KITTI_00_gt.txt")) == 4541
    assert len(read_trajectory(folder / "fr2_desk_groundtruth.txt")) > 20_000  # some of its times come twice
    euroc = read_trajectory(data_dir / "slam" / "euroc_static" / "V1_01_easy.csv")
    assert 140 < euroc.timestamp_s[-1] - euroc.timestamp_s[0] < 150
