"""PFM and 16-bit PNG: what is written is read again, and what is no such file is told so."""

import cv2
import numpy as np
import pytest

from epipole.errors import ConfigError, FileFormatError, ShapeError, WorkspaceError
from epipole.io.images.depth_maps import read_pfm, read_png16, write_pfm, write_png16


@pytest.fixture
def values(rng):
    out = rng.uniform(0.1, 200.0, (7, 11))
    out[2, 3], out[0, 0] = np.nan, np.inf
    return out


def test_pfm_keeps_every_float(tmp_path, values):
    write_pfm(tmp_path / "a.pfm", values)
    np.testing.assert_array_equal(read_pfm(tmp_path / "a.pfm"), values.astype(np.float32))
    theirs = cv2.imread(str(tmp_path / "a.pfm"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(theirs, values.astype(np.float32))


def test_pfm_of_the_other_byte_order(tmp_path, values):
    data = b"Pf\n11 7\n1.0\n" + values[::-1].astype(">f4").tobytes()
    (tmp_path / "big.pfm").write_bytes(data)
    np.testing.assert_array_equal(read_pfm(tmp_path / "big.pfm"), values.astype(np.float32))


def test_png_holds_256ths_and_zero_for_unknown(tmp_path, values):
    write_png16(tmp_path / "a.png", values)
    back = read_png16(tmp_path / "a.png")
    known = np.isfinite(values)
    assert np.abs(back - values)[known].max() <= 0.5 / 256 and np.isnan(back[~known]).all()
    write_png16(tmp_path / "mm.png", [[1.5, 70.0, -3.0]], scale=1000.0)
    np.testing.assert_array_equal(
        read_png16(tmp_path / "mm.png", 1000.0), np.float32([[1.5, np.nan, np.nan]])
    )


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"PF\n2 2\n-1\n" + bytes(48),
        b"Pf\n2 2\n-1\nxy",
        b"Pf\n-2 -2\n-1\n" + bytes(16),
        b"Pf\na b\n-1\n",
        b"\x89PNG",
    ],
)
def test_what_is_no_map_is_told_so(tmp_path, data):
    (tmp_path / "bad").write_bytes(data)
    for read in (read_pfm, read_png16):
        with pytest.raises(FileFormatError, match="bad"):
            read(tmp_path / "bad")


def test_bad_maps_and_places(tmp_path):
    for write in (write_pfm, write_png16):
        for wrong in (np.ones(4), np.ones((0, 3)), np.ones((2, 2, 3))):
            with pytest.raises(ShapeError, match="map"):
                write(tmp_path / "x", wrong)
    with pytest.raises(ConfigError, match="scale"):
        write_png16(tmp_path / "x.png", np.ones((2, 2)), scale=0)
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkspaceError):
        write_pfm(tmp_path / "file" / "x.pfm", np.ones((2, 2)))
