"""Images of unusual kinds are read right or refused by name."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from epipole.cameras import Camera
from epipole.errors import FileFormatError
from epipole.io.images.photographs import (
    common_range,
    copy_or_rotate,
    list_photographs,
    read_gray,
    read_header,
    read_mask,
    read_rgb,
)
from epipole.io.images.rgba import read_rgba
from epipole.io.images.writing import write_photograph
from epipole.io.sequences.sequence import read_sequence
from epipole.pipelines.slam.sources.folder import open_sequence


def smooth_rgb(height: int = 40, width: int = 56) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    return np.rint(255 * np.stack([x, y, 1 - x], axis=2)).astype(np.uint8)


def encoded(rgb: np.ndarray, kind: str, **options: object) -> bytes:
    out = io.BytesIO()
    Image.fromarray(rgb).save(out, kind, **options)
    return out.getvalue()


def test_turned_avif_is_written_upright(tmp_path: Path) -> None:
    rgb = smooth_rgb()
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "M"
    stored = np.ascontiguousarray(np.rot90(rgb, 1))
    (tmp_path / "a.avif").write_bytes(encoded(stored, "AVIF", quality=98, exif=exif.tobytes()))
    copy_or_rotate(tmp_path / "a.avif", tmp_path / "b.avif")
    header = read_header(tmp_path / "b.avif")
    assert (header.orientation, header.width, header.height, header.make) == (1, 56, 40, "M")
    assert np.abs(read_rgb(tmp_path / "b.avif").astype(int) - rgb).mean() < 5


@pytest.mark.parametrize("suffix", [".avif", ".png", ".tif", ".webp", ".bmp", ".ppm", ".jfif", ".jpg_large"])
@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
def test_the_content_decides_and_copies_have_the_format_of_their_suffix(
    tmp_path: Path, suffix: str, kind: str
) -> None:
    rgb = smooth_rgb()
    (tmp_path / f"a{suffix}").write_bytes(encoded(rgb, kind))
    assert list_photographs(tmp_path).names == (f"a{suffix}",)
    assert np.abs(read_rgb(tmp_path / f"a{suffix}").astype(int) - rgb).mean() < 5
    copied = tmp_path / "out" / f"b{suffix}"
    copy_or_rotate(tmp_path / f"a{suffix}", copied)
    expected = {".jfif": "JPEG", ".jpg_large": "JPEG", ".tif": "TIFF"}.get(suffix, suffix[1:].upper())
    with Image.open(copied) as image:
        assert image.format == expected
    assert np.abs(read_rgb(copied).astype(int) - rgb).mean() < 6


@pytest.mark.parametrize("name", ["a.JPG", "a.jpe", "a.jfif", "a.JPG_LARGE", "a.jpg-large", "a.dib", "a.pnm"])
def test_usual_suffixes_are_listed_and_written(tmp_path: Path, name: str) -> None:
    write_photograph(tmp_path / name, smooth_rgb())
    assert list_photographs(tmp_path).names == (name,)
    assert np.abs(read_rgb(tmp_path / name).astype(int) - smooth_rgb()).mean() < 5


def test_formats_that_are_not_read_are_listed_as_such(tmp_path: Path) -> None:
    Image.fromarray(smooth_rgb()).save(tmp_path / "a.gif")
    found = list_photographs(tmp_path)
    assert found.names == () and found.unreadable == ("a.gif",) and "convert them" in found.advice


@pytest.mark.parametrize(
    ("head", "word"),
    [
        (b"GIF89a", "GIF"),
        (b"\x00\x00\x00\x0cjP  \r\n\x87\n", "JPEG 2000"),
        (b"\x00\x00\x00\x0cJXL \r\n\x87\n", "JPEG XL"),
        (b"8BPS\x00\x01", "Photoshop"),
        (b"v/1\x01", "OpenEXR"),
        (b"PF\n4 4\n", "PFM"),
    ],
)
def test_other_formats_are_refused_by_name(tmp_path: Path, head: bytes, word: str) -> None:
    (tmp_path / "a.jpg").write_bytes(head + bytes(200))
    for read in (read_gray, read_rgb, read_header):
        with pytest.raises(FileFormatError, match=f"{word} files are not supported"):
            read(tmp_path / "a.jpg")


@pytest.mark.parametrize("kind", ["WEBP", "TIFF", "AVIF"])
def test_animations_and_pages_are_refused(tmp_path: Path, kind: str) -> None:
    pages = [Image.fromarray(np.full((20, 30, 3), value, np.uint8)) for value in (10, 200, 90)]
    pages[0].save(tmp_path / "a.img", kind, save_all=True, append_images=pages[1:])
    for read in (read_gray, read_rgb, read_header):
        with pytest.raises(FileFormatError, match=r"3 (frames|pages)"):
            read(tmp_path / "a.img")


def test_the_still_image_of_an_animated_png_is_read(tmp_path: Path) -> None:
    pages = [Image.fromarray(np.full((20, 30, 3), value, np.uint8)) for value in (10, 200)]
    pages[0].save(tmp_path / "a.png", save_all=True, append_images=pages[1:])
    assert (read_rgb(tmp_path / "a.png") == 10).all()


def test_a_tiff_with_a_preview_behind_is_read(tmp_path: Path) -> None:
    rgb = smooth_rgb()
    preview = Image.fromarray(rgb[::4, ::4])
    Image.fromarray(rgb).save(tmp_path / "a.tif", save_all=True, append_images=[preview])
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.tif"), rgb)


def test_camera_raw_with_another_suffix_is_refused(tmp_path: Path) -> None:
    Image.fromarray(smooth_rgb()).save(tmp_path / "a.tif", tiffinfo={50706: b"\x01\x04\x00\x00"})
    with pytest.raises(FileFormatError, match="camera RAW"):
        read_rgb(tmp_path / "a.tif")


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize(
    ("suffix", "has_alpha"),
    [(".png", False), (".png", True), (".tif", False), (".tif", True), (".ppm", False)],
)
def test_deep_color_keeps_the_upper_bits_of_its_sensor(
    tmp_path: Path, bits: int, suffix: str, has_alpha: bool
) -> None:
    deep = np.random.default_rng(0).integers(0, 1 << bits, (30, 40, 4 if has_alpha else 3)).astype(np.uint16)
    if has_alpha:
        deep[..., 3] = 65535
    cv2.imwrite(str(tmp_path / f"a{suffix}"), deep)
    expected = deep[..., 2::-1] >> (bits - 8)
    np.testing.assert_array_equal(read_rgb(tmp_path / f"a{suffix}"), expected)
    if has_alpha:
        rgba = read_rgba(tmp_path / f"a{suffix}")
        np.testing.assert_array_equal(rgba[..., :3], expected)
        assert (rgba[..., 3] == 255).all()


def test_deep_gray_with_alpha(tmp_path: Path) -> None:
    """PNG of color type 4 and 16 bits, which Pillow cannot write."""
    gray = np.arange(12, dtype=">u2").reshape(3, 4) * 341
    rows = np.stack([gray, np.full((3, 4), 65535, ">u2")], axis=2).astype(">u2")

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 4, 3, 16, 4, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows)))
    path = tmp_path / "a.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + body + chunk(b"IEND", b""))
    np.testing.assert_array_equal(read_gray(path), (gray >> 4).astype(np.uint8))


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_zero_is_white(tmp_path: Path, kind: type) -> None:
    values = np.linspace(0, 1, 300).reshape(15, 20)
    full = 1.0 if kind is np.float32 else np.iinfo(kind).max
    stored = ((1.0 - values) * full).astype(kind)
    Image.fromarray(stored).save(tmp_path / "a.tif", tiffinfo={262: 0})
    gray = read_gray(tmp_path / "a.tif")
    assert np.abs(gray - 255 * values).max() <= 2


def test_a_set_of_deep_gray_is_mapped_alike(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    paths = []
    for k, gain in enumerate((1.0, 0.3)):
        deep = (gain * rng.integers(100, 4000, (40, 50))).astype(np.uint16)
        deep[0, 0] = 900
        cv2.imwrite(str(tmp_path / f"{k}.png"), deep)
        paths.append(tmp_path / f"{k}.png")
    limits = common_range(paths)
    first, second = (read_gray(path, limits=limits) for path in paths)
    assert first[0, 0] == second[0, 0]
    assert len(np.unique(first)) > 200
    cv2.imwrite(str(tmp_path / "c.png"), smooth_rgb())
    assert common_range([tmp_path / "c.png"]) is None


def test_transparency_of_palettes_and_turned_images(tmp_path: Path) -> None:
    rgba = np.dstack([smooth_rgb(), np.full((40, 56), 255, np.uint8)])
    rgba[:10, :, 3] = 0
    palette = Image.fromarray(rgba).quantize(64)
    palette.save(tmp_path / "p.png")
    found = read_rgba(tmp_path / "p.png")
    assert found is not None and (found[:10, :, 3] == 0).all() and (found[10:, :, 3] == 255).all()
    assert (read_rgb(tmp_path / "p.png")[:10] == 0).all()
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(np.ascontiguousarray(np.rot90(rgba, 1))).save(tmp_path / "t.png", exif=exif.tobytes())
    np.testing.assert_array_equal(read_rgba(tmp_path / "t.png"), rgba)


def test_inverted_masks(tmp_path: Path) -> None:
    stored = np.full((6, 8), 65535, np.uint16)
    stored[:, 4:] = 0
    Image.fromarray(stored).save(tmp_path / "m.tif", tiffinfo={262: 0})
    (tmp_path / "m.tif").rename(tmp_path / "a.jpg.png")
    keep = read_mask(tmp_path, "a.jpg")
    assert not keep[:, :4].any() and keep[:, 4:].all()


@pytest.mark.parametrize("mode", ["1", "LA", "CMYK", "YCbCr"])
def test_other_modes(tmp_path: Path, mode: str) -> None:
    kind = {"1": "PNG", "LA": "PNG", "CMYK": "JPEG", "YCbCr": "JPEG"}[mode]
    image = Image.fromarray(smooth_rgb()).convert(mode)
    image.save(tmp_path / "a.img", kind, quality=95)
    expected = np.asarray(image.convert("RGB")).astype(int)
    assert np.abs(read_rgb(tmp_path / "a.img") - expected).mean() < 4


def test_frames_of_slam_are_mapped_alike(tmp_path: Path) -> None:
    """A darker frame stays darker: each would be stretched to the full range by itself."""
    (tmp_path / "frames").mkdir()
    base = np.random.default_rng(0).integers(1000, 4000, (48, 64)).astype(np.uint16)
    for k, gain in enumerate((1.0, 0.6, 0.8)):
        cv2.imwrite(str(tmp_path / "frames" / f"{k:03d}.png"), (gain * base).astype(np.uint16))
    sequence = read_sequence(tmp_path / "frames", 10.0)
    camera = Camera("PINHOLE", 64, 48, [60.0, 60.0, 31.5, 23.5])
    frames = [queued.read() for queued in open_sequence(sequence, "mono", camera).frames()]
    means = [float(frame.gray.mean()) for frame in frames]
    assert means[1] < means[2] - 10 < means[0] - 20
