"""Maps, photographs and videos out of damaged files: a clear error or an image, in the memory that it takes."""

import io
import json
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from epipole.errors import FileFormatError
from epipole.io.images.depth_maps import read_pfm, read_png16, write_pfm, write_png16
from epipole.io.images.exif import new_exif
from epipole.io.images.photographs import copy_or_rotate, read_grey, read_header, read_mask, read_rgb
from epipole.io.images.video import extract_frames, frame_size
from epipole.io.sequences.stereo_video import extract_pairs
from hostile_bytes import read_or_refuse, spoilt

RGB = np.random.default_rng(0).integers(0, 255, (24, 32, 3)).astype(np.uint8)
GPS = (46.5, 7.25, 512.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pictures")


@given(data=st.data())
def test_pfm(folder: Path, data: st.DataObject) -> None:
    path = folder / "map.pfm"
    write_pfm(path, np.arange(12.0).reshape(3, 4))
    path.write_bytes(data.draw(spoilt(path.read_bytes(), is_text=data.draw(st.booleans()))))
    found = read_or_refuse(read_pfm, path, names=path.name)
    assert found is None or found.size * 4 <= path.stat().st_size


@given(data=st.data())
def test_png16(folder: Path, data: st.DataObject) -> None:
    path = folder / "map.png"
    write_png16(path, np.arange(1.0, 13.0).reshape(3, 4))
    path.write_bytes(data.draw(spoilt(path.read_bytes(), is_text=False)))
    found = read_or_refuse(read_png16, path, names=path.name)
    assert found is None or np.isfinite(found[~np.isnan(found)]).all()


def encoded(kind: str) -> bytes:
    stream = io.BytesIO()
    exif = {} if kind in ("BMP", "PPM") else {"exif": new_exif("Canon", "Canon EOS 5D", 35.0, GPS)}
    Image.fromarray(RGB).save(stream, kind, **exif)
    return stream.getvalue()


KINDS = ["JPEG", "PNG", "TIFF", "WEBP", "BMP", "PPM"]


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
def test_photographs(folder: Path, kind: str, data: st.DataObject) -> None:
    path = folder / f"photograph.{kind.lower()}"
    path.write_bytes(data.draw(spoilt(encoded(kind), is_text=False)))
    header = read_or_refuse(read_header, path, names=path.name)
    if header is not None:
        assert header.width > 0 and header.height > 0 and 1 <= header.orientation <= 8
        assert header.focal_px is None or 0 < header.focal_px < np.inf
        assert header.gps is None or (abs(header.gps.lat_deg) <= 90 and abs(header.gps.lon_deg) <= 180)
    for read, axes in ((read_grey, 2), (read_rgb, 3)):
        found = read_or_refuse(read, path, 16, names=path.name)
        assert found is None or (found.ndim == axes and max(found.shape) <= 16 and found.dtype == np.uint8)


def spoilt_exif(valid: bytes, exif: bytes) -> bytes:
    """A JPEG with this EXIF block (in its APP1 segment) in the place of its own."""
    start = valid.index(b"Exif\0\0")
    length = int.from_bytes(valid[start - 2 : start], "big")
    segment = (len(exif) + 8).to_bytes(2, "big") + b"Exif\0\0" + exif
    return valid[: start - 2] + segment + valid[start - 2 + length :]


@given(data=st.data())
def test_exif(folder: Path, data: st.DataObject) -> None:
    """A damaged block tells less, or nothing: the image itself is sound and stays readable."""
    path = folder / "exif.jpg"
    block = new_exif("Canon", "Canon EOS 5D", 35.0, GPS).tobytes().removeprefix(b"Exif\0\0")
    path.write_bytes(spoilt_exif(encoded("JPEG"), data.draw(spoilt(block, is_text=False))[:60000]))
    header = read_header(path)
    assert {header.width, header.height} == {24, 32} and 1 <= header.orientation <= 8
    assert header.focal_px is None or 0.2 * 32 <= header.focal_px <= 20 * 32
    assert header.gps is None or (abs(header.gps.lat_deg) <= 90 and abs(header.gps.lon_deg) <= 180)
    assert header.gps is None or header.gps.alt_m is None or np.isfinite(header.gps.alt_m)
    assert read_rgb(path).size == RGB.size


def test_an_exif_block_that_is_put_back_is_read(folder: Path) -> None:
    block = new_exif("Canon", "Canon EOS 5D", 35.0, GPS).tobytes().removeprefix(b"Exif\0\0")
    (folder / "again.jpg").write_bytes(spoilt_exif(encoded("JPEG"), block))
    header = read_header(folder / "again.jpg")
    assert header.make == "Canon" and header.gps.alt_m == 512.0


def test_a_picture_is_turned_where_its_exif_cannot_be_written_again(folder: Path) -> None:
    """Its north or south is two numbers: Pillow reads them, and fails to write them."""
    entries = struct.pack(">HHIHHHHII", 0x0112, 3, 1, 6, 0, 0x8825, 4, 1, 38)
    position = struct.pack(">HHHIHHI", 1, 1, 3, 2, 1, 2, 0)
    block = b"MM\0*" + struct.pack(">IH", 8, 2) + entries + bytes(4) + position
    (folder / "two.jpg").write_bytes(spoilt_exif(encoded("JPEG"), block))
    assert read_header(folder / "two.jpg").orientation == 6
    copy_or_rotate(folder / "two.jpg", folder / "turned.jpg")
    assert read_header(folder / "turned.jpg").orientation == 1
    assert read_rgb(folder / "turned.jpg").shape == read_rgb(folder / "two.jpg").shape


@pytest.fixture(scope="module")
def video(folder: Path) -> bytes:
    path = folder / "valid.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    for n in range(6):
        writer.write(np.roll(np.kron(RGB[:12, :16], np.ones((4, 4, 1), np.uint8)), n, axis=1))
    writer.release()
    return path.read_bytes()


@given(data=st.data())
def test_videos(folder: Path, video: bytes, data: st.DataObject) -> None:
    path, out = folder / "spoilt.avi", folder / "frames"
    path.write_bytes(data.draw(spoilt(video, is_text=False)))

    def read() -> object:
        size = frame_size(path)
        assert size is None or min(size) > 0
        return extract_frames(path, out, max_frames=3)

    found = read_or_refuse(read, names=path.name)
    if found is not None:
        assert 1 <= len(found) <= 3 and all((out / name).is_file() for name in found.name)


@given(data=st.data())
def test_stereo_videos(folder: Path, video: bytes, data: st.DataObject) -> None:
    path, out = folder / "spoilt_pair.avi", folder / "pairs"
    path.write_bytes(data.draw(spoilt(video, is_text=False)))
    found = read_or_refuse(extract_pairs, path, path, out, 3, names=path.name)
    assert found is None or 1 <= len(found) <= 3


@pytest.fixture(scope="module")
def manifest(folder: Path, video: bytes) -> bytes:
    extract_frames(folder / "valid.avi", folder / "listed", max_frames=2)
    return (folder / "listed" / "frames.json").read_bytes()


@given(data=st.data())
def test_the_list_of_frames_of_an_earlier_call(folder: Path, manifest: bytes, data: st.DataObject) -> None:
    """A damaged list is read anew from the video, or its frames are there; never a file outside of the folder."""
    path, out = folder / "valid.avi", folder / "listed"
    (out / "frames.json").write_bytes(data.draw(spoilt(manifest, is_text=True)))
    found = extract_frames(path, out, max_frames=2)
    assert all((out / name).is_file() and Path(name).name == name for name in found.name)


@pytest.mark.parametrize("name", ["own.jpg", "frames.json", ".", "../own.jpg", "frame_" + "9" * 300 + ".jpg"])
def test_a_list_of_frames_that_names_other_files_removes_none(folder: Path, video: bytes, name: str) -> None:
    path, out = folder / "valid.avi", folder / "kept"
    extract_frames(path, out, max_frames=2)
    (out / "own.jpg").write_bytes(b"mine")
    (folder / "own.jpg").write_bytes(b"mine")
    content = json.loads((out / "frames.json").read_text())
    content["frames"][0]["name"] = name
    (out / "frames.json").write_text(json.dumps(content))
    assert len(extract_frames(path, out, max_frames=3)) == 3
    assert (out / "own.jpg").read_bytes() == (folder / "own.jpg").read_bytes() == b"mine"


@pytest.mark.parametrize("change", [lambda rows: [], lambda rows: rows * 2, lambda rows: 3 * rows[:1]])
def test_a_list_of_no_frames_or_of_one_twice_is_made_anew(folder: Path, video: bytes, change: object) -> None:
    path, out = folder / "valid.avi", folder / "again"
    names = extract_frames(path, out, max_frames=2).name
    content = json.loads((out / "frames.json").read_text())
    (out / "frames.json").write_text(json.dumps(content | {"frames": change(content["frames"])}))
    assert extract_frames(path, out, max_frames=2).name == names


@pytest.mark.parametrize(
    "text", ["#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1/a.ts\n", "ffconcat version 1.0\nfile a.avi\n"]
)
def test_a_list_of_videos_is_no_video(folder: Path, text: str) -> None:
    """FFmpeg would follow the addresses and names in it."""
    (folder / "list.mp4").write_text(text)
    with pytest.raises(FileFormatError, match="not a video: the file is text"):
        extract_frames(folder / "list.mp4", folder / "none", max_frames=2)


def lying_png(width: int, height: int, depth: int = 16, color_type: int = 0, num_bytes: int = 0) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, 0)
    pixels = chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"teXt", bytes(num_bytes))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + pixels + chunk(b"IEND", b"")


def lying_jpeg(width: int, height: int, **options: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(RGB).save(stream, "JPEG", **options)
    data = stream.getvalue()
    start = data.index(b"\xff\xc2" if options else b"\xff\xc0")
    return data[: start + 5] + struct.pack(">HH", height, width) + data[start + 9 :]


LIES = {
    "grey.png": lying_png(30000, 30000),
    "colour.png": lying_png(32, 1_000_000, 8, 2, num_bytes=5000),
    "frame.jpg": lying_jpeg(30000, 30000),
    "progressive.jpg": lying_jpeg(30000, 30000, progressive=True),
    "picture.ppm": b"P6\n12000 12000\n255\n" + bytes(100),
    "picture.bmp": encoded("BMP")[:18] + struct.pack("<ii", 12000, 12000) + encoded("BMP")[26:],
}
"""Headers that promise gigabytes, over a few bytes of pixels."""

PEAK = """
import json, sys
from pathlib import Path
from epipole.errors import EpipoleError
from epipole.io.images.depth_maps import read_png16
from epipole.io.images.photographs import read_grey, read_rgb

def kib(name):
    return int(Path("/proc/self/status").read_text().split(name + ":")[1].split()[0])

found = {}
for path in map(Path, sys.argv[1:]):
    for read in (read_png16, read_grey, read_rgb):
        Path("/proc/self/clear_refs").write_text("5")
        before = kib("VmRSS")
        try:
            read(path)
            said = ""
        except EpipoleError as error:
            said = str(error)
        found[path.name + " " + read.__name__] = kib("VmHWM") - before, said
print(json.dumps(found))
"""


@pytest.mark.skipif(
    not Path("/proc/self/clear_refs").exists(), reason="peaks of memory are read from Linux' /proc"
)
def test_headers_that_promise_gigabytes_take_none(folder: Path) -> None:
    """Decoders take their memory where Python does not see it: another process is measured."""
    for name, data in LIES.items():
        (folder / name).write_bytes(data)
    files = [str(folder / name) for name in LIES]
    done = subprocess.run([sys.executable, "-c", PEAK, *files], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert len(found) == 3 * len(LIES)
    for what, (peak_kib, said) in found.items():
        assert peak_kib < 64 << 10, f"{what} took {peak_kib >> 10} MB"
        assert said, f"{what} was read"


def test_a_mask_that_is_a_lying_jpeg_is_refused(folder: Path) -> None:
    (folder / "masked.jpg.png").write_bytes(LIES["frame.jpg"])
    with pytest.raises(FileFormatError, match="cannot hold 30000 x 30000 pixels"):
        read_mask(folder, "masked.jpg")


def test_a_blank_picture_is_not_taken_for_a_lie(folder: Path) -> None:
    """Nothing is packed more tightly: one colour, optimised tables, a progressive JPEG without detail."""
    for options in ({"optimize": True}, {"progressive": True, "optimize": True}):
        Image.new("L", (4000, 3000), 255).save(folder / "blank.jpg", "JPEG", quality=10, **options)
        assert read_grey(folder / "blank.jpg", 100).shape == (75, 100)
    write_png16(folder / "flat.png", np.full((2000, 3000), 7.0))
    assert np.nanmax(read_png16(folder / "flat.png")) == 7.0
