"""`times.txt` beside images: rows that do not belong to them are paired by the images' numbers, or refused."""

import cv2
import numpy as np
import pytest

from epipole.errors import FileFormatError
from epipole.io import read_sequence


def images(folder, names):
    folder.mkdir(exist_ok=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((48, 64), np.uint8))
    return folder


def times(folder, values):
    (folder / "times.txt").write_text("".join(f"{value}\n" for value in values))


def test_more_rows_than_images_are_paired_by_number(tmp_path):
    folder = images(tmp_path / "ride", [f"{n:06d}.png" for n in (3, 4, 5, 7)])
    times(folder, 0.5 + np.arange(12.0) * 0.1)
    found = read_sequence(folder)
    assert [round(frame.timestamp_s, 6) for frame in found.frames] == [0.8, 0.9, 1.0, 1.2]
    (words,) = found.warnings
    assert words.startswith("times.txt has 12 lines for 4 images: they are paired by the numbers")


@pytest.mark.parametrize(
    ("names", "count"),
    [
        (["a.png", "b.png"], 3),  # no numbers
        (["000001.png", "000002.png"], 3),  # from 0, or from 1
        (["000002.png", "000009.png"], 5),  # a number beyond the rows
        (["000000.png", "000001.png"], 1),
        (["0.png", "1.png"], 0),
    ],
)
def test_rows_that_cannot_be_paired_are_refused(tmp_path, names, count):
    folder = images(tmp_path / "ride", names)
    times(folder, np.arange(count) * 0.1)
    with pytest.raises(FileFormatError, match=f"has {count} times for 2 images"):
        read_sequence(folder)


@pytest.mark.parametrize(
    "text", ["0.1 0.2\n", "0 0.1\n1 0.2\n", "0.1\nx\n", "0.2\n0.1\n", "0.1\n0.1\n", "0.1\nnan\n"]
)
def test_lines_that_are_no_rising_times_are_refused(tmp_path, text):
    folder = images(tmp_path / "ride", ["a.png", "b.png"])
    (folder / "times.txt").write_text(text)
    with pytest.raises(FileFormatError, match=r"times\.txt"):
        read_sequence(folder)


def test_kitti_with_the_times_of_a_longer_ride(tmp_path):
    for name in ("image_0", "image_1"):
        images(tmp_path / name, [f"{n:06d}.png" for n in range(3)])
    times(tmp_path, np.arange(20) * 0.1037)
    found = read_sequence(tmp_path)
    np.testing.assert_allclose([frame.timestamp_s for frame in found.frames], np.arange(3) * 0.1037)
    assert "20 lines for 3 images" in found.warnings[0]


@pytest.mark.parametrize(
    ("unit", "name"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")]
)
def test_times_by_a_computers_clock(tmp_path, unit, name):
    seconds = 1.4e9 + np.arange(3) / 32
    folder = images(tmp_path / "ride", ["a.png", "b.png", "c.png"])
    times(folder, [str(round(second * unit)) for second in seconds])
    found = read_sequence(folder)
    np.testing.assert_allclose([frame.timestamp_s for frame in found.frames], seconds, atol=6e-4)
    assert found.warnings == (f"times.txt: its times are in {name}",)


def test_numbered_images_come_in_the_order_of_their_numbers(tmp_path):
    folder = images(tmp_path / "ride", [f"{n}.png" for n in range(12)])
    assert [frame.image.stem for frame in read_sequence(folder).frames] == [str(n) for n in range(12)]


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e6, 1e9])
def test_lists_of_tum_by_a_computers_clock(tmp_path, unit):
    images(tmp_path / "rgb", ["a.png", "b.png", "c.png"])
    stamps = [f"{round((1.4e9 + n) * unit)}" for n in range(3)]
    for name in ("rgb", "depth"):
        rows = (f"{stamp} rgb/{image}.png\n" for stamp, image in zip(stamps, "abc"))
        (tmp_path / f"{name}.txt").write_text("".join(rows))
    found = [frame.timestamp_s for frame in read_sequence(tmp_path).frames]
    np.testing.assert_allclose(found, 1.4e9 + np.arange(3), atol=1e-3)


def test_microseconds_in_the_layout_of_euroc_are_refused(tmp_path):
    images(tmp_path / "cam0", [])
    images(tmp_path / "cam0" / "data", ["a.png", "b.png", "c.png"])
    rows = (f"{1400000000000000 + 50000 * n},{name}.png\n" for n, name in enumerate("abc"))
    (tmp_path / "cam0" / "data.csv").write_text("".join(rows))
    with pytest.raises(FileFormatError, match="5e-05 s apart if its times were nanoseconds"):
        read_sequence(tmp_path)
