"""Files of lengths, places and odometry; and lines that are none."""

import numpy as np
import pytest

from epipole.errors import FileFormatError
from epipole.io.anchor_files import NamedPositions, read_anchor_positions, read_lengths, read_odometry
from epipole.io.trajectories.files import PositionLog

LENGTHS = """# name meters end image x y
shelf 1.5 a one.jpg 10 20.5
shelf 1.5 b one.jpg 30 20
shelf 1.5 a holiday pictures/two.jpg 11 21
shelf 1.5 b two.jpg -3 21
door, 2.02, a, one.jpg, 5, 6
door 2.02 b one.jpg 5 90
"""


def write(folder, text):
    (folder / "a.txt").write_text(text)
    return folder / "a.txt"


def test_lengths(tmp_path):
    shelf, door = read_lengths(write(tmp_path, LENGTHS))
    assert (shelf.name, shelf.length_m, door.length_m) == ("shelf", 1.5, 2.02)
    assert shelf.ends[0] == {"one.jpg": (10.0, 20.5), "holiday pictures/two.jpg": (11.0, 21.0)}
    assert shelf.ends[1]["two.jpg"] == (-3.0, 21.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "contains no lengths"),
        ("L 1 a p.jpg 3\n", "NAME METERS END"),
        ("L 1 c p.jpg 3 4\n", "a or b"),
        ("L 0 a p.jpg 3 4\n", "positive"),
        ("L x a p.jpg 3 4\n", "is not a number"),
        ("L 1 a p.jpg nan 4\n", "is not finite, or exceeds"),
        ("L 1 a p.jpg 3 4\n", "end b of L is seen in no image"),
        ("L 1 a p.jpg 3 4\nL 2 b p.jpg 3 4\n", "1 above"),
        ("L 1 a p.jpg 3 4\nL 1 a p.jpg 3 4\n", "is given twice"),
    ],
)
def test_lengths_that_are_none(tmp_path, text, words):
    with pytest.raises(FileFormatError, match=words):
        read_lengths(write(tmp_path, text))


def test_places_by_time_or_by_name(tmp_path):
    by_time = read_anchor_positions(write(tmp_path, "0.5 1 2 3\n0.6,1,2,4\n"))
    assert isinstance(by_time, PositionLog) and by_time.timestamp_s.tolist() == [0.5, 0.6]
    by_name = read_anchor_positions(write(tmp_path, "# place\nmy photo 1.jpg 1 2 3\nb.png 4 5 6\n"))
    assert isinstance(by_name, NamedPositions) and by_name.names == ("my photo 1.jpg", "b.png")
    np.testing.assert_array_equal(by_name.positions, [[1, 2, 3], [4, 5, 6]])
    for text, words in (
        ("", "contains no positions"),
        ("a.png 1 2\n", "X Y Z"),
        ("a 1 2 3\na 1 2 3\n", "twice"),
        ("a 1 2 z\n", "z"),
    ):
        with pytest.raises(FileFormatError, match=words):
            read_anchor_positions(write(tmp_path, text))


def test_odometry_as_distances_or_places(tmp_path):
    wheels = read_odometry(write(tmp_path, "# s m\n1700000000.5 10\n1700000001 10\n1700000002 11.5\n"))
    assert wheels.positions is None and wheels.traveled_m.tolist() == [10, 10, 11.5]
    positions = read_odometry(write(tmp_path, "0 1 2 3 0 0 0 1\n0 1 2 3 0 0 0 1\n1 2 2 3 0 0 0 1\n"))
    assert positions.traveled_m is None and positions.timestamp_s.tolist() == [0, 1]
    for text, words in (
        ("", "no odometry"),
        ("0 1\n1 0\n", "must not decrease"),
        ("0 1\n0 2\n", "must increase"),
        ("0 1\n1\n", "METERS"),
    ):
        with pytest.raises(FileFormatError, match=words):
            read_odometry(write(tmp_path, text))
