"""Compressed recordings: read as before, and within their budget."""

import bz2
import io
import shutil
from importlib import import_module

import numpy as np
import pytest

from bag_writing import Recorded
from epipole.errors import FileFormatError
from epipole.io.bags._unpacking import _ZSTD, bound_unpacking, unpacked
from epipole.io.bags.recording import bag_frames, read_bag
from epipole.io.files import SMALL_BYTES

SMALL = bytes(range(256)) * 40


def packers():
    zstd, lz4 = import_module(_ZSTD), import_module("lz4.frame")
    return {"bz2": bz2.compress, "lz4": lz4.compress, "zstd": zstd.compress, "": bytes}


@pytest.mark.parametrize("name", ["bz2", "lz4", "zstd", ""])
def test_what_is_packed_comes_back(name):
    pack = packers()[name]
    assert unpacked(name, pack(SMALL)) == SMALL
    assert unpacked(name, pack(SMALL) + pack(SMALL)) == 2 * SMALL
    assert unpacked(name, b"") == b""


@pytest.mark.parametrize("name", ["bz2", "lz4", "zstd"])
def test_more_than_the_budget_is_refused(name):
    piece = packers()[name](bytes(SMALL_BYTES // 4))
    assert len(unpacked(name, 4 * piece)) == SMALL_BYTES
    with pytest.raises(ValueError, match="more than 67108864 bytes"):
        unpacked(name, 5 * piece)
    with pytest.raises(ValueError, match="truncated"):
        unpacked(name, piece[:-9])


def test_the_readers_of_rosbags_unpack_so():
    bound_unpacking()
    pieces = {name: 5 * pack(bytes(SMALL_BYTES // 4)) for name, pack in packers().items() if name}
    ros1, ros2 = import_module("rosbags.rosbag1.reader"), import_module("rosbags.rosbag2.reader")
    mcap = import_module("rosbags.rosbag2.storage_mcap")
    for unpack in (
        lambda: ros1.decompressors["bz2"](pieces["bz2"]),
        lambda: ros1.decompressors["lz4"](pieces["lz4"]),
        lambda: mcap.decompress(pieces["lz4"], "lz4", 5 * SMALL_BYTES // 4, 0),
        lambda: mcap.decompress(pieces["zstd"], "zstd", 5 * SMALL_BYTES // 4, 0),
        lambda: ros2.zstd.decompress(pieces["zstd"]),
        lambda: shutil.copyfileobj(ros2.zstd.open(io.BytesIO(pieces["zstd"]), "rb"), io.BytesIO()),
    ):
        with pytest.raises(ValueError, match="more than"):
            unpack()


@pytest.mark.parametrize(
    ("kind", "mode"),
    [("ros1", "bz2"), ("ros1", "lz4"), ("sqlite", "message"), ("sqlite", "file"), ("mcap", "storage")],
)
def test_compressed_recordings_are_read(kind, mode, tmp_path):
    recorded = Recorded(kind)
    gray = np.arange(64, dtype=np.uint8).reshape(8, 8)
    recorded.camera_info("/camera/camera_info", 10**18, (8, 8), np.diag([5.0, 5.0, 1.0]))
    recorded.image("/camera/image_raw", 10**18, gray, "mono8")
    path = recorded.write(tmp_path, compression=mode)
    assert [(frame.gray() == gray).all() for frame in bag_frames(read_bag(path))] == [True]


def test_a_recording_that_is_a_bomb_is_refused(tmp_path):
    from bombs import mcap

    for name, pack in packers().items():
        if name in ("lz4", "zstd"):
            mcap(name, pack, SMALL_BYTES + (1 << 20))(tmp_path / f"{name}.mcap")
            with pytest.raises(FileFormatError, match="more than"):
                read_bag(tmp_path / f"{name}.mcap")
