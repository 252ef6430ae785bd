"""Small files that stand for gigabytes, for hours or for the end of the process, each with the reader that meets it."""

import bz2
import gzip
import io
import json
import os
import socket
import sqlite3
import struct
import zipfile
import zlib
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
from example_files import TEXT_PLY
from PIL import Image

from epipole.io import write_colmap_model, write_database
from io_models import small_model

LENS = """image_width: 640
image_height: 480
camera_matrix: {data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}
distortion_coefficients: {data: [0, 0, 0, 0]}
"""
TENFOLD = "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 10))
YAML = {
    "aliases within anchors": "a0: &a0 [1, 1]\n" + TENFOLD + LENS,
    "aliases beside each other": f"a: &a [{'1, ' * 9000}1]\n"
    + LENS.replace("[0, 0, 0, 0]", f"[{'*a, ' * 20000}*a]"),
    "a merge of merges": "a0: &a0 {x: 1}\n"
    + "".join(f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 10)}]}}\n" for k in range(1, 9))
    + LENS,
    "one mapping merged often": "a: &a {"
    + ", ".join(f"k{k}: 1" for k in range(9000))
    + "}\nb:\n  <<: ["
    + ", ".join(["*a"] * 20000)
    + "]\n"
    + LENS,
    "a list in itself": "distortion_model: &a [*a, *a]\n" + LENS,
    "a list in itself, deeper": "distortion_model: &a [[*a, 1], {b: *a}]\n" + LENS,
    "deep brackets": "a: " + "[" * 100_000 + "\n" + LENS,
    "deep dashes": "a:\n" + "- " * 50_000 + "1\n" + LENS,
    "deep indentation": "".join(" " * k + "a:\n" for k in range(1000)) + LENS,
    "deep questions": "? " * 50_000 + "1\n" + LENS,
    "a number of sixties": "a: 1" + ":1" * 400_000 + "\n" + LENS,
    "very many values": LENS + "a: [" + "1, " * 400_000 + "1]\n",
    "endless words": LENS + "distortion_model: " + "a" * 500_000 + "\n",
}


def opencv(
    rows: str, cols: str, kind: str = "d", data: str = "500., 0., 320., 0., 500., 240., 0., 0., 1."
) -> str:
    """OpenCV's YAML, with such a matrix."""
    matrix = f"!!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: {kind}\n   data: [ {data} ]\n"
    rest = "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 4\n   dt: d\n   data: [ 0., 0., 0., 0. ]\n"
    return f"%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: {matrix}{rest}"


MATRICES = {
    "cols -1": opencv("3", "-1"),
    "rows -1": opencv("-1", "3"),
    "a matrix of 2^31": opencv("2147483647", "2147483647"),
    "a matrix of 4 x 4 with nine values": opencv("4", "4"),
    "a matrix without values": opencv("3", "3", data=""),
    "a type of 2^31 channels": opencv("3", "3", "2147483647d"),
    "rows that are words": opencv("three", "[]"),
}
XML = '<?xml version="1.0"{}?>\n{}<opencv_storage>{}</opencv_storage>'
ENTITIES = '<!DOCTYPE a [<!ENTITY b "1 1 1 1 1 1 1 1 1 1"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;">]>'
XML_FILES = {
    "entities": XML.format("", ENTITIES, "<image_width>&c;</image_width>").encode(),
    "entities in UTF-16": XML.format(' encoding="utf-16"', ENTITIES, "<a>&c;</a>").encode("utf-16"),
    "entities in UTF-7": XML.format(' encoding="utf-7"', ENTITIES.replace("<", "+ADw-"), "").encode(),
    "a file from elsewhere": XML.format(
        "", '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>', "&b;"
    ).encode(),
    "deep marks": b"<opencv_storage>" + b"<a>" * 300_000,
    "a drawing": b"<?xml version='1.0'?><svg></svg>",
    "a file cut off": XML.format("", "", "<image_width>640</image_width>")[:60].encode(),
    "very many marks": b"<opencv_storage>" + b"<a/>" * 3_000_000 + b"</opencv_storage>",
}


def png_chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk with its sum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(
    width: int, height: int, depth: int = 8, color: int = 0, extra: bytes = b"", rows: bytes = bytes(100)
) -> bytes:
    """A PNG whose header promises an image of this size."""
    head = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0))
    rest = png_chunk(b"IDAT", zlib.compress(rows)) + png_chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + head + extra + rest


def text_chunks(kind: bytes, head: bytes, count: int) -> bytes:
    """A PNG with texts that unpack to 50 MB each."""
    return png(4, 4, extra=png_chunk(kind, head + zlib.compress(bytes(50 << 20), 9)) * count, rows=bytes(20))


def encoded(kind: str, size: tuple[int, int] = (32, 24), **options: object) -> bytes:
    """A valid image."""
    stream = io.BytesIO()
    Image.new("RGB", size, (200, 100, 50)).save(stream, kind, **options)
    return stream.getvalue()


def large_jpeg(mark: bytes, **options: object) -> bytes:
    """A small JPEG whose header promises a gigapixel."""
    data = encoded("JPEG", **options)
    start = data.index(mark) + 5
    return data[:start] + struct.pack(">HH", 32000, 32000) + data[start + 4 :]


def tiff(width: int, height: int, compression: int, channels: int = 3, bits: int = 8) -> bytes:
    """A TIFF of one strip of zeros, packed as it says."""
    strip = zlib.compress(bytes(1 << 20), 9)
    tags = [
        *(
            (256, 4, 1, width),
            (257, 4, 1, height),
            (258, 3, 1, bits),
            (259, 3, 1, compression),
            (262, 3, 1, 2),
        ),
        *(
            (273, 4, 1, 8),
            (277, 3, 1, channels),
            (278, 4, 1, height),
            (279, 4, 1, len(strip)),
            (284, 3, 1, 1),
        ),
    ]
    entries = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    return (
        b"II*\0"
        + struct.pack("<I", 8 + len(strip))
        + strip
        + struct.pack("<H", len(tags))
        + entries
        + bytes(4)
    )


def many_scans(count: int) -> bytes:
    """A progressive JPEG of 16 megapixels that goes over all of them again and again."""
    valid = encoded("JPEG", (4000, 4000), progressive=True)
    last = valid.rindex(b"\xff\xda")
    return valid[:last] + valid[last:-2] * count + b"\xff\xd9"


ANIMATION = png_chunk(b"acTL", struct.pack(">II", 2, 0)) + png_chunk(
    b"fcTL", struct.pack(">IIIIIHHBB", 0, 20000, 12000, 0, 0, 1, 1, 0, 0)
)
IMAGES: dict[str, Callable[[], bytes]] = {
    "PNG of 3.5 GB": lambda: png(30000, 30000, 16, 2),
    "PNG of 16-bit grays": lambda: png(30000, 30000, 16),
    "PNG of a million rows": lambda: png(32, 1_000_000, 8, 2, extra=png_chunk(b"teXt", bytes(5000))),
    "PNG of 144 megapixels in 143 bytes": lambda: png(12000, 12000, 16, 6),
    "PNG with a chunk of 640 MB": lambda: (
        (d := png(4, 3, 16, 0, rows=bytes(5)))[:33] + struct.pack(">I", 640 << 20) + d[37:]
    ),
    "PNG whose frames are huge": lambda: png(4, 3, 16, 0, extra=ANIMATION),
    "PNG of 1-bit pixels": lambda: png(12000, 12000, 1, 0),
    "zTXt": lambda: text_chunks(b"zTXt", b"key\0\0", 20),
    "iTXt": lambda: text_chunks(b"iTXt", b"key\0\1\0\0\0", 20),
    "iCCP": lambda: text_chunks(b"iCCP", b"key\0\0", 20),
    "TIFF of zeros": lambda: tiff(12000, 12000, 8),
    "TIFF of 2^31 channels": lambda: tiff(2000, 2000, 8, channels=65535),
    "TIFF of 4 gigapixels": lambda: tiff(65535, 65535, 5),
    "WebP of one color": lambda: encoded("WEBP", (16383, 9000), lossless=True, quality=0, method=0),
    "BMP": lambda: encoded("BMP")[:18] + struct.pack("<ii", 12000, 12000) + encoded("BMP")[26:],
    "BMP of negative size": lambda: (
        encoded("BMP")[:18] + struct.pack("<ii", -5, -(2**31)) + encoded("BMP")[26:]
    ),
    "PPM": lambda: b"P6\n12000 12000\n255\n" + bytes(100),
    "PPM of words": lambda: b"P3\n12000 12000\n255\n" + b"1 " * 100,
    "PPM with an endless header": lambda: b"P6\n" + b"9" * 5_000_000,
    "PPM with endless comments": lambda: b"P6\n" + b"#\n" * 500_000,
    "PFM": lambda: b"Pf\n16384 16384\n-1.0\n" + bytes(100),
    "JPEG of a gigapixel": lambda: large_jpeg(b"\xff\xc0"),
    "JPEG of a progressive gigapixel": lambda: large_jpeg(b"\xff\xc2", progressive=True),
    "JPEG of many scans": lambda: many_scans(3000),
}
BZ2 = {
    "bz2 of zeros": lambda: bz2.compress(bytes(100 << 20)),
    "bz2 of small numbers": lambda: bz2.compress(b"1 1 1 " + b"1 " * (2 << 20)),
    "bz2 of archives": lambda: bz2.compress(bz2.compress(bytes(30 << 20))) * 2,
}
EYE = np.eye(4).tolist()
FRAME = {"file_path": "a.png", "transform_matrix": EYE}
SIZE = {"w": 640, "h": 480, "fl_x": 500.0}


def transforms(change: dict | None = None, **frame: object) -> bytes:
    """A transforms.json with other values."""
    return json.dumps({**SIZE, **(change or {}), "frames": [FRAME | frame]}).encode()


TRANSFORMS = {
    "nested 10^5 deep": b'{"frames": ' + b"[" * 100_000,
    "objects nested 10^5 deep": b'{"a":' * 100_000,
    "very many lists": b'{"frames": [' + b"[]," * 12_000_000 + b"[]]}",
    "no angle": json.dumps({"w": 640, "h": 480, "camera_angle_x": 0, "frames": [FRAME]}).encode(),
    "a full turn": json.dumps({"w": 640, "h": 480, "camera_angle_x": 2 * np.pi, "frames": [FRAME]}).encode(),
    "an endless angle": json.dumps({"w": 640, "h": 480, "camera_angle_x": 1e308, "frames": [FRAME]}).encode(),
    "NaN": transforms({"fl_x": float("nan")}),
    "Infinity": transforms({"cx": float("inf")}),
    "an endless width": transforms({"w": float("inf")}),
    "NaN in a matrix": transforms(transform_matrix=[[float("nan")] * 4] * 4),
    "a number of 5000 digits": transforms().replace(b"640", b"9" * 5000),
    "a size of 10^12": transforms({"w": 10**12}),
    "a size of 10^400": transforms({"w": 10**400}),
    "half a pixel": transforms({"w": 0.5}),
    "a long name": transforms(file_path="a/" * 50_000),
    "a lone surrogate": transforms(file_path="\ud800.png"),
    "a zero": transforms(file_path="a\0.png"),
    "a line break": transforms(file_path="a\nb.png"),
    "no name": transforms(file_path=""),
    "a name of lists": transforms(file_path=[[["a"]]]),
    "a name that is a number": transforms(file_path=7),
    "no text": b'{"frames": "\xff\xfe"}',
    "points of a long name": transforms({"ply_file_path": "a" * 5000}),
    "points with a zero": transforms({"ply_file_path": "a\0.ply"}),
    "points with a surrogate": transforms({"ply_file_path": "\ud800.ply"}),
    "points in a device": transforms({"ply_file_path": "/dev/zero"}),
    "a size from a device": json.dumps({"fl_x": 5, "frames": [FRAME | {"file_path": "/dev/zero"}]}).encode(),
    "a size from a pipe": json.dumps({"fl_x": 5, "frames": [FRAME | {"file_path": "pipe"}]}).encode(),
    "a size from a folder": json.dumps({"fl_x": 5, "frames": [FRAME | {"file_path": "/"}]}).encode(),
}


def database(*statements: str) -> Callable[[Path], None]:
    """A database that these statements have changed."""

    def write(path: Path) -> None:
        from test_io_colmap_database import PAIRS, make_contents

        write_database(path, make_contents(small_model(), PAIRS))
        with closing(sqlite3.connect(path, isolation_level=None)) as connection:
            connection.execute("PRAGMA synchronous = OFF")
            connection.execute("PRAGMA ignore_check_constraints = ON")
            for statement in statements:
                connection.execute(statement)

    return write


COUNT = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
FREE = "CREATE TABLE other AS SELECT * FROM {0}; DROP TABLE {0}; ALTER TABLE other RENAME TO {0}".format
VIEW = ("ALTER TABLE images RENAME TO other", f"CREATE VIEW images AS {COUNT} SELECT other.* FROM other, n")
DATABASES = {
    "a view without end": database(*VIEW),
    "a plain view": database(VIEW[0], "CREATE VIEW images AS SELECT * FROM other"),
    "a view over matches": database(
        "DROP TABLE matches",
        f"CREATE VIEW matches AS {COUNT} SELECT i AS pair_id,"
        " 0 AS rows, 0 AS cols, zeroblob(1000000) AS data FROM n",
    ),
    "a view over priors": database(
        "DROP TABLE pose_priors",
        f"CREATE VIEW pose_priors AS {COUNT} SELECT i AS"
        " image_id, 0 AS coordinate_system, zeroblob(24) AS position FROM n",
    ),
    "a column made up": database(
        "CREATE TABLE other AS SELECT image_id, camera_id FROM images",
        "DROP TABLE images",
        "CREATE TABLE images (image_id INTEGER, camera_id INTEGER, name AS (hex(zeroblob(400000000))))",
        "INSERT INTO images SELECT * FROM other",
    ),
    "a table that is code": database(
        "DROP TABLE pose_priors",
        "CREATE VIRTUAL TABLE pose_priors USING fts4(image_id, coordinate_system, position)",
    ),
    "no column of names": database("ALTER TABLE images RENAME COLUMN name TO other"),
    "no column of rows": database("ALTER TABLE keypoints RENAME COLUMN rows TO other"),
    "a name of bytes": database("UPDATE images SET name = X'ff80' WHERE image_id = 1"),
    "a name that is no UTF-8": database("UPDATE images SET name = CAST(X'ff80' AS TEXT) WHERE image_id = 1"),
    "a name with a zero": database("UPDATE images SET name = CAST(X'610062' AS TEXT) WHERE image_id = 1"),
    "a name with a line break": database(
        "UPDATE images SET name = 'a' || char(10) || 'b' WHERE image_id = 1"
    ),
    "an empty name": database("UPDATE images SET name = '' WHERE image_id = 1"),
    "a name of a megabyte": database("UPDATE images SET name = printf('%01000000d', 1) WHERE image_id = 1"),
    "a width that is text": database("UPDATE cameras SET width = 'wide'"),
    "a width of 2^63 - 1": database("UPDATE cameras SET width = 9223372036854775807"),
    "camera model 99": database("UPDATE cameras SET model = 99"),
    "a camera that is text": database("UPDATE images SET camera_id = 'one' WHERE image_id = 1"),
    "rows of 2^62": database("UPDATE keypoints SET rows = 4611686018427387904, cols = 4"),
    "rows that are text": database("UPDATE keypoints SET rows = 'many'"),
    "keypoints as text": database("UPDATE keypoints SET data = 'many'"),
    "a pair of 2^63 - 1": database(
        "UPDATE matches SET pair_id = 9223372036854775807 WHERE rowid = (SELECT max(rowid) FROM matches)"
    ),
    "configuration 77": database("UPDATE two_view_geometries SET config = 77"),
    "configuration 'text'": database("UPDATE two_view_geometries SET config = 'text'"),
}


def looped_database(path: Path, levels: int = 7, fan: int = 60) -> None:
    """Pages of a tree that all name the same page below them: 60^7 rows out of some kilobytes."""
    database("PRAGMA page_size = 1024", "VACUUM")(path)
    data, size = bytearray(path.read_bytes()), 1024
    with closing(sqlite3.connect(path)) as connection:
        (root,) = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'images'").fetchone()
    first = len(data) // size + 1
    leaf, start = bytes(data[(root - 1) * size : root * size]), (root - 1) * size
    assert leaf[0] == 13, "the images fill one page"

    def inner(child: int) -> bytes:
        cells = struct.pack(">IB", child, 1) * fan
        begin = size - len(cells)
        head = struct.pack(">BHHHBI", 5, 0, fan, begin, 0, child)
        return (head + b"".join(struct.pack(">H", begin + 5 * k) for k in range(fan))).ljust(
            begin, b"\0"
        ) + cells

    data[start : start + size] = inner(first)
    for level in range(1, levels):
        data += inner(first + level)
    data += leaf
    struct.pack_into(">I", data, 28, len(data) // size)
    path.write_bytes(data)


DATABASES["a tree of loops"] = looped_database


def colmap_file(name: str, at: int, value: bytes) -> Callable[[Path], None]:
    """A binary model, one file of which has other bytes at a place."""

    def write(folder: Path) -> None:
        write_colmap_model(small_model(), folder)
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[:at] + value + data[at + len(value) :])

    return write


def colmap_text(name: str, old: str, new: str) -> Callable[[Path], None]:
    """A text model, one file of which has another text."""

    def write(folder: Path) -> None:
        write_colmap_model(small_model(), folder, text=True)
        text = (folder / name).read_text(encoding="utf-8")
        assert old in text
        (folder / name).write_bytes(text.replace(old, new).encode(errors="surrogateescape"))

    return write


ENDLESS = struct.pack("<Q", 1 << 63)
NAME_AT = 8 + 64
MODELS = {
    "camera model 99": colmap_file("cameras.bin", 12, struct.pack("<i", 99)),
    "camera model -1": colmap_file("cameras.bin", 12, struct.pack("<i", -1)),
    "2^63 cameras": colmap_file("cameras.bin", 0, ENDLESS),
    "2^63 images": colmap_file("images.bin", 0, ENDLESS),
    "2^63 points": colmap_file("points3D.bin", 0, ENDLESS),
    "a point seen 2^63 times": colmap_file("points3D.bin", 8 + 43, ENDLESS),
    "2^32 sensors": colmap_file("rigs.bin", 12, b"\xff\xff\xff\xff"),
    "a name that is no UTF-8": colmap_file("images.bin", NAME_AT, b"\xff"),
    "a name with a line break": colmap_file("images.bin", NAME_AT, b"\n"),
    "an unknown camera model": colmap_text("cameras.txt", "OPENCV", "UNKNOWN"),
    "a text name that is no UTF-8": colmap_text("images.txt", "a1.jpg", "\udcff.jpg"),
    "a text name with a zero": colmap_text("images.txt", "a1.jpg", "a\0.jpg"),
    "a text name of a megabyte": colmap_text("images.txt", "a1.jpg", "a" * 1_000_000),
    "a text name of a line break": colmap_text("images.txt", "a1.jpg", "a\rb.jpg"),
    "a rig of 2^62 sensors": colmap_text("rigs.txt", "1 2 CAMERA", "1 4611686018427387904 CAMERA"),
}


def make_pipe(path: Path) -> None:
    """A pipe into which nothing is ever written."""
    os.mkfifo(path)


def make_socket(path: Path) -> None:
    """A socket; its name must be short, so that it is made where it is."""
    before = Path.cwd()
    os.chdir(path.parent)
    try:
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(path.name)
    finally:
        os.chdir(before)


NO_FILES: dict[str, Callable[[Path], None]] = {
    "a pipe": make_pipe,
    "a socket": make_socket,
    "an endless device": lambda path: path.symlink_to("/dev/zero"),
    "an empty device": lambda path: path.symlink_to("/dev/null"),
    "a folder": lambda path: path.mkdir(),
    "nothing": lambda path: None,
    "a link to itself": lambda path: path.symlink_to(path.name),
}


def arrays(**of: np.ndarray) -> Callable[[Path], None]:
    """An archive of arrays, packed."""
    return lambda path: np.savez_compressed(path, **of)


def zeros(numbers: str, *shape: int) -> np.ndarray:
    return np.zeros(shape, numbers)


LAYERS = {
    f"layer{n}": zeros("f2", *size) for n, size in enumerate([(4, 8), (8, 16), (32, 8), (8, 8), (8, 3)])
}
GRID = {"shape": np.array([8, 8, 8], "i4"), "cells": zeros("u1", 64), "place": np.ones(5)}
HASH = GRID | LAYERS | {"place": np.ones(4), "levels": np.array([4], "i4")}


def promising(path: Path) -> None:
    """An array whose header says 2^40 rows."""
    arrays(**GRID, values=zeros("f2", 4, 13))(path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data.replace(b"(4, 13), }", b"(1099511627776, 13), }"))


def spz(
    count: int, frames: Callable[[int], bytes], degree: int = 3, given: int | None = None
) -> Callable[[Path], None]:
    """Version 4: the header, a table of streams, and these."""

    def write(path: Path) -> None:
        sizes = [size * count for size in (9, 1, 3, 3, 4, 45)[: 6 if degree else 5]]
        streams = [frames(size) for size in sizes]
        head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, degree, 12, 0, len(sizes), 32)
        table = b"".join(struct.pack("<QQ", len(one), given or size) for one, size in zip(streams, sizes))
        path.write_bytes(head + table + b"".join(streams))

    return write


def zstd(size: int) -> bytes:
    import zstandard

    return zstandard.ZstdCompressor().compress(bytes(size))


def boasting(size: int) -> bytes:
    """A frame of a few bytes that says it holds 2^40."""
    return b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 1 << 40) + b"\x01\0\0" + bytes(size & 0)


def mcap(compression: str, packed: Callable[[bytes], bytes], size: int = 1 << 31) -> Callable[[Path], None]:
    """A recording whose one chunk unpacks to zeros without end."""

    def record(kind: int, data: bytes) -> bytes:
        return bytes([kind]) + struct.pack("<Q", len(data)) + data

    def text(of: str) -> bytes:
        return struct.pack("<I", len(of)) + of.encode()

    def write(path: Path) -> None:
        chunk = packed(bytes(1 << 20)) * (size >> 20)
        data = struct.pack("<QQQI", 0, 1, size, 0) + text(compression) + struct.pack("<Q", len(chunk)) + chunk
        parts = (
            record(1, text("ros2") + text("")),
            record(6, data),
            record(15, bytes(4)),
            record(2, bytes(20)),
        )
        path.write_bytes(b"\x89MCAP0\r\n" + b"".join(parts) + b"\x89MCAP0\r\n")

    return write


def zstd_frame(data: bytes) -> bytes:
    """Without its size."""
    import zstandard

    return zstandard.ZstdCompressor(write_content_size=False).compress(data)


def ros1(compression: str, packed: Callable[[bytes], bytes], size: int = 1 << 31) -> Callable[[Path], None]:
    """A recording cut off after one chunk, which unpacks to zeros without end."""

    def fields(**of: bytes) -> bytes:
        parts = [name.encode() + b"=" + value for name, value in of.items()]
        whole = b"".join(struct.pack("<I", len(part)) + part for part in parts)
        return struct.pack("<I", len(whole)) + whole

    def write(path: Path) -> None:
        chunk = packed(bytes(1 << 20)) * (size >> 20)
        head = fields(op=b"\x05", compression=compression.encode(), size=struct.pack("<I", size - 1))
        path.write_bytes(b"#ROSBAG V2.0\n" + head + struct.pack("<I", len(chunk)) + chunk)

    return write


def lz4(data: bytes) -> bytes:
    import lz4.frame

    return lz4.frame.compress(data)


def holding(content: str | bytes) -> Callable[[Path], None]:
    """A file of that content."""
    return lambda path: path.write_bytes(content.encode() if isinstance(content, str) else content) and None


DIGITS = "9" * 4300
"""The longest number that Python reads; twice as much it does not print."""
PACKED = {
    "BAL of endless counts": ("bal", "a.txt", holding(f"{DIGITS} {DIGITS} {DIGITS}")),
    "BAL of a negative count": ("bal", "a.txt", holding("-1 1 1 0")),
    "BAL of 2^40 cameras": ("bal", "a.txt", holding("1099511627776 0 0")),
    "BAL of half an index": ("bal", "a.txt", holding("1 1 1 0.5 0 1 2" + 12 * " 1")),
    "BAL of an endless turn": ("bal", "a.txt", holding("1 1 1 0 0 1 2 1e160" + 11 * " 1")),
    "PFM of endless sides": ("pfm", "a.pfm", holding(f"Pf\n{DIGITS} {DIGITS}\n-1\n")),
    "PFM of negative sides": ("pfm", "a.pfm", holding("Pf\n-1 -1\n-1\n0000")),
    "PFM of no byte order": ("pfm", "a.pfm", holding("Pf\n1 1\nnan\n0000")),
    **{
        f"a whole number that is {value}": (
            *("ply", "a.ply"),
            holding(
                TEXT_PLY.replace(b"property float x", b"property int x").replace(b"0.5 1.5", value + b" 1.5")
            ),
        )
        for value in (b"inf", b"nan", b"1e300")
    },
    "a grid of 1024^3 empty cells": (
        *("grid", "grid.npz"),
        arrays(
            **GRID | {"shape": np.array([1024] * 3, "i4"), "cells": zeros("u1", 1 << 27)},
            values=zeros("f2", 0, 13),
        ),
    ),
    "a grid of 2^23 rows": ("grid", "grid.npz", arrays(**GRID, values=zeros("f2", 1 << 23, 13))),
    "a grid whose header lies": ("grid", "grid.npz", promising),
    "tables of 2^24 rows": ("hash", "hash.npz", arrays(**HASH, tables=zeros("f2", 1, 1 << 24, 4))),
    "tables of doubles": ("hash", "hash.npz", arrays(**HASH, tables=zeros("f8", 1, 1 << 16, 4))),
    "SPZ of 2^24 Gaussians": ("gaussians", "a.spz", spz(1 << 24, zstd)),
    "SPZ of frames that boast": ("gaussians", "a.spz", spz(4, boasting)),
    "SPZ that promises 2^40 bytes": ("gaussians", "a.spz", spz(4, boasting, given=1 << 40)),
    "SPZ of gzip": (
        *("gaussians", "a.spz"),
        lambda path: path.write_bytes(
            gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 1 << 24, 0, 12, 0, 0) + bytes(20 << 24), 1)
        ),
    ),
    "MCAP of zstd": ("bag", "ride.mcap", mcap("zstd", zstd_frame)),
    "MCAP of zstd that says its size": ("bag", "ride.mcap", mcap("zstd", lambda data: zstd(len(data)))),
    "MCAP of lz4": ("bag", "ride.mcap", mcap("lz4", lz4, 1 << 28)),
    "ROS 1 of bz2": ("bag", "ride.bag", ros1("bz2", bz2.compress)),
    "ROS 1 of lz4": ("bag", "ride.bag", ros1("lz4", lz4, 1 << 28)),
}
"""The reader, the file's name, and what writes it."""
