"""Listing, headers, pixels and masks of photographs."""

import io
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from epipole.errors import FileFormatError, MissingDependencyError
from epipole.io.images import pixels as _photograph_pixels
from epipole.io.images.exif import GpsPosition
from epipole.io.images.photographs import (
    copy_or_rotate,
    list_photographs,
    mask_of,
    read_gray,
    read_header,
    read_mask,
    read_rgb,
    write_jpeg_with_exif,
)
from epipole.scene.georeference import gps_to_enu

DATA = Path(os.environ.get("EPIPOLE_DATA", Path(__file__).resolve().parents[2].parent / "shared" / "data"))

STORED_FROM_UPRIGHT = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, 1),
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: np.rot90(a, -1),
}


def color_blocks(height=64, width=96):
    """An image of flat 16-pixel blocks in different colors, which JPEG keeps almost exactly."""
    rng = np.random.default_rng(7)
    blocks = rng.integers(0, 256, (height // 16, width // 16, 3), dtype=np.uint8)
    return np.ascontiguousarray(blocks.repeat(16, 0).repeat(16, 1))


def jpeg_bytes(rgb, **options):
    out = io.BytesIO()
    Image.fromarray(rgb).save(out, "JPEG", **{"quality": 95, "subsampling": 0, **options})
    return out.getvalue()


def touch(path, data=b"x"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def test_list_sorts_enters_folders_and_ignores_the_rest(tmp_path):
    for name in ("b.JPG", "a.png", "sub/c.tif", "sub/deep/d.webp", "e.pgm", "notes.txt", ".hidden.jpg"):
        touch(tmp_path / name)
    for name in (
        ".cache/x.jpg",
        "out/database.db",
        "out/images/y.jpg",
        "run/config.json",
        "run/z.jpg",
        "masks/m.png",
    ):
        touch(tmp_path / name)
    touch(tmp_path / "config.json")
    found = list_photographs(tmp_path, ignore=[tmp_path / "masks"])
    assert found.names == ("a.png", "b.JPG", "e.pgm", "sub/c.tif", "sub/deep/d.webp")
    assert found.unreadable == ()
    assert found.advice == ""
    assert len(found) == 5
    assert "5 in" in repr(found)


def test_list_names_what_cannot_be_read_and_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setattr(_photograph_pixels, "find_spec", lambda name: None)
    for name in ("IMG_1.HEIC", "IMG_2.heif", "p.NEF", "q.CR3", "q.jpg"):
        touch(tmp_path / name)
    found = list_photographs(tmp_path)
    assert found.names == ("q.jpg",)
    assert found.unreadable == ("IMG_1.HEIC", "IMG_2.heif", "p.NEF")
    assert "2 HEIC files are skipped (such as IMG_1.HEIC): run `pip install pillow-heif`" in found.advice
    assert "1 RAW file is skipped" in found.advice
    monkeypatch.setattr(_photograph_pixels, "find_spec", lambda name: object())
    assert list_photographs(tmp_path).names == ("IMG_1.HEIC", "IMG_2.heif", "q.jpg")


def test_list_survives_circular_links_and_missing_folders(tmp_path):
    touch(tmp_path / "sub" / "a.jpg")
    try:
        (tmp_path / "sub" / "again").symlink_to(tmp_path, target_is_directory=True)
    except OSError:
        pytest.skip("this system makes no symbolic links")
    assert list_photographs(tmp_path).names == ("sub/a.jpg",)
    with pytest.raises(FileFormatError, match="it does not exist"):
        list_photographs(tmp_path / "nowhere")
    with pytest.raises(FileFormatError, match="is a file"):
        list_photographs(tmp_path / "sub" / "a.jpg")


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
def test_orientation_is_applied_once(tmp_path, suffix, orientation):
    upright = color_blocks()
    stored = np.ascontiguousarray(STORED_FROM_UPRIGHT[orientation](upright))
    exif = Image.Exif()
    exif[0x0112] = orientation
    options = {"jpg": {"quality": 98, "subsampling": 0}, "webp": {"lossless": True}}.get(suffix, {})
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(stored).save(path, exif=exif, **options)
    header = read_header(path)
    assert (header.width, header.height, header.orientation) == (96, 64, orientation)
    tolerance = 6 if suffix == "jpg" else 0
    rgb, gray = read_rgb(path), read_gray(path)
    assert np.abs(rgb.astype(int) - upright).max() <= tolerance
    assert np.abs(gray - upright @ [0.299, 0.587, 0.114]).max() <= tolerance + 1
    assert rgb.flags.c_contiguous
    assert gray.flags.c_contiguous
    assert rgb.flags.writeable
    assert gray.flags.writeable
    half = upright.reshape(32, 2, 48, 2, 3).mean((1, 3))
    assert np.abs(read_rgb(path, 48) - half).max() <= tolerance + 1

    copy_or_rotate(path, tmp_path / "out" / f"b.{suffix}")
    copied = tmp_path / "out" / f"b.{suffix}"
    assert read_header(copied).orientation == 1
    again = np.asarray(Image.open(copied).convert("RGB")).astype(int)
    assert np.abs(again - upright).max() <= 2 * tolerance


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_deep_grayscale_is_stretched_and_deep_color_keeps_its_range(tmp_path, suffix):
    rng = np.random.default_rng(1)
    deep = rng.integers(300, 3000, (120, 90)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / f"g.{suffix}"), deep)
    low, high = np.percentile(deep, [0.1, 99.9])
    expected = np.clip((deep - low) * 255.0 / (high - low), 0, 255)
    gray = read_gray(tmp_path / f"g.{suffix}")
    assert np.abs(gray - expected).max() <= 0.51
    np.testing.assert_array_equal(read_rgb(tmp_path / f"g.{suffix}"), np.dstack([gray] * 3))

    color = rng.integers(0, 65536, (20, 30, 3)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / f"c.{suffix}"), color)
    np.testing.assert_array_equal(read_rgb(tmp_path / f"c.{suffix}"), color[..., ::-1] >> 8)

    cv2.imwrite(str(tmp_path / f"k.{suffix}"), np.full((5, 5), 32896, np.uint16))
    np.testing.assert_array_equal(read_gray(tmp_path / f"k.{suffix}"), 128)


def test_float_tiff_with_nan(tmp_path):
    values = np.linspace(0.0, 1.0, 400, dtype=np.float32).reshape(20, 20)
    values[0, 0] = np.nan
    Image.fromarray(values).save(tmp_path / "f.tif")
    gray = read_gray(tmp_path / "f.tif")
    assert gray[0, 0] == 0
    np.testing.assert_allclose(gray.ravel()[1:], values.ravel()[1:] * 255.0, atol=1.5)


def test_palette_transparency_and_one_bit(tmp_path):
    rgb = color_blocks(32, 32)
    Image.fromarray(rgb).quantize(16).save(tmp_path / "p.png")
    np.testing.assert_array_equal(read_rgb(tmp_path / "p.png"), rgb)

    alpha = np.zeros((32, 32), np.uint8)
    alpha[:, 8:16], alpha[:, 16:] = 128, 255
    Image.fromarray(np.dstack([rgb, alpha])).save(tmp_path / "a.png")
    expected = rgb * (alpha[..., None] / 255.0)
    assert np.abs(read_rgb(tmp_path / "a.png") - expected).max() <= 1
    assert np.abs(read_gray(tmp_path / "a.png") - expected @ [0.299, 0.587, 0.114]).max() <= 2

    Image.fromarray(alpha).convert("LA").save(tmp_path / "la.png")
    np.testing.assert_array_equal(read_gray(tmp_path / "la.png"), alpha)
    Image.fromarray(alpha > 200).save(tmp_path / "one.png")
    np.testing.assert_array_equal(read_gray(tmp_path / "one.png"), np.where(alpha > 200, 255, 0))


@pytest.mark.parametrize("suffix", ["bmp", "ppm"])
def test_plain_formats(tmp_path, suffix):
    rgb = color_blocks()
    Image.fromarray(rgb).save(tmp_path / f"a.{suffix}")
    np.testing.assert_array_equal(read_rgb(tmp_path / f"a.{suffix}"), rgb)
    assert read_header(tmp_path / f"a.{suffix}").width == 96


def test_cmyk_and_gray_jpeg(tmp_path):
    rgb = color_blocks(320, 480)
    Image.fromarray(rgb).convert("CMYK").save(tmp_path / "cmyk.jpg", quality=98)
    assert np.abs(read_rgb(tmp_path / "cmyk.jpg").astype(int) - rgb).max() <= 8
    small = read_rgb(tmp_path / "cmyk.jpg", 60)
    assert np.abs(small - rgb.reshape(40, 8, 60, 8, 3).mean((1, 3))).max() <= 8
    gray = rgb[..., 0]
    Image.fromarray(gray).save(tmp_path / "gray.jpg", quality=98)
    assert np.abs(read_gray(tmp_path / "gray.jpg").astype(int) - gray).max() <= 4
    assert np.abs(read_rgb(tmp_path / "gray.jpg").astype(int) - gray[..., None]).max() <= 4


@pytest.mark.parametrize("max_size", [1000, 501, 400, 251, 200, 125, 60])
@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_shrinking_keeps_the_pixel_grid(tmp_path, kind, max_size):
    width, height = 1003, 705
    ramps = np.zeros((height, width, 3))
    ramps[..., 0] = 255.0 * np.arange(width) / (width - 1)
    ramps[..., 1] = 255.0 * np.arange(height)[:, None] / (height - 1)
    path = tmp_path / f"a.{kind}"
    Image.fromarray(np.rint(ramps).astype(np.uint8)).save(path, quality=100, subsampling=0)
    small = read_rgb(path, max_size)
    assert small.shape == (round(height * max_size / width), max_size, 3)
    x = (np.arange(small.shape[1]) + 0.5) * width / small.shape[1] - 0.5
    y = (np.arange(small.shape[0]) + 0.5) * height / small.shape[0] - 0.5
    assert abs(np.median(small[:, -5:, 0] - 255.0 * x[-5:] / (width - 1))) < 0.6
    assert abs(np.median(small[-5:, :, 1] - 255.0 * y[-5:, None] / (height - 1))) < 0.6
    assert np.abs(small[..., 0] - 255.0 * x / (width - 1)).max() < 5.0


def test_a_small_picture_is_not_enlarged(tmp_path):
    Image.fromarray(np.full((3, 3, 3), 90, np.uint8)).save(tmp_path / "a.jpg")
    assert read_gray(tmp_path / "a.jpg").shape == (3, 3)
    assert read_rgb(tmp_path / "a.jpg", 100).shape == (3, 3, 3)
    assert read_header(tmp_path / "a.jpg").width == 3


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads the peak memory from /proc")
def test_a_200_megapixel_jpeg_stays_in_bounded_memory(tmp_path):
    path = tmp_path / "huge.jpg"
    Image.new("L", (16384, 12288), 77).save(path, quality=80)
    script = (
        "import sys\n"
        "from pathlib import Path\n"
        "from epipole.io.images.photographs import read_gray, read_header, read_rgb\n"
        "def peak_mb():\n"
        "    lines = Path('/proc/self/status').read_text().splitlines()\n"
        "    return int(next(l for l in lines if l.startswith('VmHWM')).split()[1]) / 1024\n"
        "before = peak_mb()\n"
        "rgb, gray = read_rgb(sys.argv[1], 2000), read_gray(sys.argv[1], 3000)\n"
        "header = read_header(sys.argv[1])\n"
        "print(peak_mb() - before, rgb.shape, gray.shape, header.width, rgb.min(), rgb.max(), sep='|')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=True
    )
    growth_mb, *rest = done.stdout.strip().split("|")
    assert rest == ["(1500, 2000, 3)", "(2250, 3000)", "16384", "77", "77"]
    assert float(growth_mb) < 120.0, "the full image has 201 MB in gray and 604 MB in color"


def test_a_lossless_picture_over_the_limit_is_refused(tmp_path):
    def chunk(kind, content):
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = struct.pack(">IIBBBBB", 20000, 20000, 8, 2, 0, 0, 0)
    png = (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b""))
        + chunk(b"IEND", b"")
    )
    touch(tmp_path / "a.png", png)
    assert read_header(tmp_path / "a.png").width == 20000
    with pytest.raises(FileFormatError, match="20000 x 20000 is more than 150 megapixels, the limit for PNG"):
        read_gray(tmp_path / "a.png")


@pytest.mark.parametrize("progressive", [False, True])
@pytest.mark.parametrize("kept", [0.1, 0.5, 0.95, 0.999])
def test_a_truncated_jpeg_is_detected(tmp_path, progressive, kept):
    noise = np.random.default_rng(0).integers(0, 256, (512, 512, 3), dtype=np.uint8)
    thumbnail = Image.Exif()
    thumbnail.get_ifd(0x8769)[0x927C] = jpeg_bytes(noise[:40, :40])
    whole = jpeg_bytes(noise, progressive=progressive, exif=thumbnail, quality=75, subsampling=2)
    path = tmp_path / "a.jpg"
    touch(path, whole[: int(len(whole) * kept)])
    for read in (read_gray, read_rgb):
        with pytest.raises(FileFormatError, match=r"a\.jpg.*(truncated|header is damaged)"):
            read(path)
    touch(path, whole[: int(len(whole) * kept)] + bytes(5000))
    with pytest.raises(FileFormatError, match=r"truncated|header is damaged"):
        read_gray(path)


def test_data_behind_the_picture_are_allowed(tmp_path):
    rgb = color_blocks()
    for tail in (b"", b"\x00" * 40, b"trailer of a telephone" * 50, jpeg_bytes(rgb[:16])[:-9]):
        touch(tmp_path / "a.jpg", jpeg_bytes(rgb) + tail)
        assert np.abs(read_rgb(tmp_path / "a.jpg").astype(int) - rgb).max() <= 6


@pytest.mark.parametrize("suffix", ["png", "tif", "webp", "bmp", "ppm"])
def test_other_truncated_pictures_are_detected(tmp_path, suffix):
    noise = np.random.default_rng(0).integers(0, 256, (100, 120, 3), dtype=np.uint8)
    whole = tmp_path / f"whole.{suffix}"
    Image.fromarray(noise).save(whole)
    data = whole.read_bytes()
    for kept in (0.02, 0.6, 0.97):
        touch(tmp_path / f"a.{suffix}", data[: int(len(data) * kept)])
        with pytest.raises(FileFormatError, match=rf"a\.{suffix}"):
            read_gray(tmp_path / f"a.{suffix}")


def test_files_that_are_no_pictures(tmp_path):
    touch(tmp_path / "empty.jpg", b"")
    touch(tmp_path / "text.jpg", b"Dear photographer,\nthis is a letter.\n")
    touch(tmp_path / "junk.jpg", bytes(range(128, 228)))
    touch(tmp_path / "head.jpg", b"\xff\xd8\xff\xe0\x00\x10JFIF")
    touch(tmp_path / "raw.NEF", b"II*\x00" + bytes(100))
    problems = {
        "empty.jpg": "0 bytes",
        "text.jpg": "looks like text",
        "junk.jpg": "80 81 82",
        "head.jpg": "damaged",
    }
    problems |= {"missing.jpg": "it does not exist", "raw.NEF": "develop it"}
    for name, problem in problems.items():
        for read in (read_gray, read_rgb, read_header):
            with pytest.raises(FileFormatError, match=rf"{name}.*{problem}"):
                read(tmp_path / name)
    with pytest.raises(FileFormatError, match="cannot be opened"):
        read_gray(tmp_path)


def test_a_picture_with_the_wrong_suffix_is_read(tmp_path):
    rgb = color_blocks()
    Image.fromarray(rgb).save(tmp_path / "a.png")
    (tmp_path / "a.png").rename(tmp_path / "a.jpg")
    np.testing.assert_array_equal(read_rgb(tmp_path / "a.jpg"), rgb)
    copy_or_rotate(tmp_path / "a.jpg", tmp_path / "b.jpg")
    assert (tmp_path / "b.jpg").read_bytes()[:2] == b"\xff\xd8"


def test_heic_without_its_reader_names_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    touch(tmp_path / "a.jpg", b"\x00\x00\x00\x1cftypheic\x00\x00\x00\x00mif1heic" + bytes(50))
    for read in (read_gray, read_header):
        with pytest.raises(MissingDependencyError, match="pip install pillow-heif"):
            read(tmp_path / "a.jpg")


def test_heic_with_its_reader(tmp_path):
    heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed")
    upright = color_blocks()
    exif = Image.Exif()
    exif[0x0112], exif[0x010F] = 6, "Apple"
    stored = np.ascontiguousarray(STORED_FROM_UPRIGHT[6](upright))
    heif.from_pillow(Image.fromarray(stored)).save(tmp_path / "a.heic", quality=98, exif=exif.tobytes())
    header = read_header(tmp_path / "a.heic")
    assert (header.width, header.height, header.make) == (96, 64, "Apple")
    assert np.abs(read_rgb(tmp_path / "a.heic").astype(int) - upright).mean() < 6
    copy_or_rotate(tmp_path / "a.heic", tmp_path / "a.jpg")
    assert np.abs(read_rgb(tmp_path / "a.jpg").astype(int) - upright).mean() < 6


def test_copy_links_an_upright_file_and_replaces_the_target(tmp_path):
    source, target = tmp_path / "a.jpg", tmp_path / "new" / "folder" / "a.jpg"
    touch(source, jpeg_bytes(color_blocks()))
    touch(target, b"old")
    for _ in range(2):
        copy_or_rotate(source, target)
        assert target.read_bytes() == source.read_bytes()
        assert list(target.parent.iterdir()) == [target]
    with pytest.raises(FileFormatError, match="cannot write this format"):
        copy_or_rotate(source, tmp_path / "a.xyz")


def test_copy_falls_back_to_copying(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError("cross-device link")

    monkeypatch.setattr(os, "link", refuse)
    touch(tmp_path / "a.jpg", jpeg_bytes(color_blocks()))
    copy_or_rotate(tmp_path / "a.jpg", tmp_path / "b.jpg")
    assert (tmp_path / "b.jpg").read_bytes() == (tmp_path / "a.jpg").read_bytes()
    assert not (tmp_path / "b.jpg").samefile(tmp_path / "a.jpg")


def test_rotating_keeps_camera_place_and_leaves_the_source(tmp_path):
    write_jpeg_with_exif(tmp_path / "w.jpg", color_blocks(), focal_35mm=28.0, gps=(47.5, -8.25, None))
    with Image.open(tmp_path / "w.jpg") as image:
        exif = image.getexif()
        exif[0x0112] = 8
        image.save(tmp_path / "a.jpg", exif=exif, quality=95)
    before = (tmp_path / "a.jpg").read_bytes()
    copy_or_rotate(tmp_path / "a.jpg", tmp_path / "b.jpg")
    assert (tmp_path / "a.jpg").read_bytes() == before
    rotated, straight = read_header(tmp_path / "a.jpg"), read_header(tmp_path / "b.jpg")
    assert (rotated.orientation, straight.orientation) == (8, 1)
    assert (straight.width, straight.height) == (64, 96) == (rotated.width, rotated.height)
    for field in ("make", "model", "focal_px", "focal_source", "gps"):
        assert getattr(straight, field) == getattr(rotated, field)


def test_written_jpeg_is_read_back(tmp_path):
    rgb = color_blocks()
    position = GpsPosition(-12.25, 130.125, 31.5)
    write_jpeg_with_exif(
        tmp_path / "a.jpg", rgb, focal_35mm=24.0, make="M", model="N", gps=position, quality=98
    )
    header = read_header(tmp_path / "a.jpg")
    assert (header.width, header.height, header.make, header.model) == (96, 64, "M", "N")
    assert header.focal_px == pytest.approx(24 / 36 * 96)
    assert header.gps == pytest.approx(position)
    assert header.capture_time is None
    assert np.abs(read_rgb(tmp_path / "a.jpg").astype(int) - rgb).mean() < 6


@pytest.mark.filterwarnings("ignore:Corrupt EXIF")
def test_a_damaged_exif_block_does_not_hide_the_picture(tmp_path):
    rgb = color_blocks()
    garbage = b"Exif\x00\x00II*\x00\x08\x00\x00\x00\xff\xff" + bytes(range(60))
    touch(tmp_path / "a.jpg", jpeg_bytes(rgb, exif=garbage))
    header = read_header(tmp_path / "a.jpg")
    assert (header.width, header.height, header.orientation, header.focal_px, header.gps) == (
        96,
        64,
        1,
        None,
        None,
    )
    assert read_rgb(tmp_path / "a.jpg").shape == rgb.shape


def test_masks(tmp_path):
    keep = np.zeros((20, 30), bool)
    keep[5:, 3:20] = True
    (tmp_path / "sub").mkdir()
    Image.fromarray(keep.astype(np.uint8)).save(tmp_path / "a.jpg.png")
    Image.fromarray(np.where(keep, 255, 0).astype(np.uint8)).convert("RGBA").save(tmp_path / "sub" / "b.png")
    cv2.imwrite(str(tmp_path / "c.jpg.png"), keep.astype(np.uint16))
    blue = np.zeros((20, 30, 3), np.uint8)
    blue[..., 2] = keep
    Image.fromarray(blue).save(tmp_path / "d.png")
    Image.fromarray(keep).save(tmp_path / "e.png")
    Image.fromarray(blue).quantize(4).save(tmp_path / "f.png")
    for name in ("a.jpg", "sub/b.JPG", "c.jpg", "d.jpg", "e.tif", "f.png"):
        mask = read_mask(tmp_path, name, size=(30, 20))
        assert mask is not None
        assert mask.dtype == bool
        np.testing.assert_array_equal(mask, keep, err_msg=name)
    assert read_mask(tmp_path, "g.jpg") is None
    with pytest.raises(FileFormatError, match=r"30 x 20 but its image a\.jpg is 20 x 30"):
        read_mask(tmp_path, "a.jpg", size=(20, 30))
    touch(tmp_path / "h.jpg.png", b"\x89PNG\r\n\x1a\n")
    with pytest.raises(FileFormatError, match="damaged"):
        read_mask(tmp_path, "h.jpg")


@pytest.mark.skipif(
    not (DATA / "sfm" / "lund_gps").is_dir(), reason="the photographs of lund_gps are not here"
)
def test_real_photographs_with_gps():
    found = list_photographs(DATA / "sfm" / "lund_gps" / "images")
    headers = [read_header(found.folder / name) for name in found.names]
    assert len(headers) == 29
    assert {(h.width, h.height, h.focal_source) for h in headers} == {(1024, 768, "35 mm equivalent")}
    enu = gps_to_enu(np.array([h.gps for h in headers], float))
    assert np.isfinite(enu).all()
    assert 100.0 < np.ptp(enu[:, 1]) < 250.0, "the walk is about 170 m from south to north"
    assert read_gray(found.folder / found.names[0]).shape == (768, 1024)


@pytest.mark.skipif(
    not (DATA / "sfm" / "sceaux_castle").is_dir(), reason="the photographs of sceaux_castle are not here"
)
def test_real_focal_length_is_near_the_calibrated_one():
    found = list_photographs(DATA / "sfm" / "sceaux_castle" / "images")
    header = read_header(found.folder / found.names[0])
    assert header.focal_px == pytest.approx(2905.88 / 2, rel=0.07)
    assert header.capture_time is not None
    assert header.capture_time.year == 2010


def test_pipes_and_names_that_no_list_can_hold_are_named_and_not_listed(tmp_path):
    touch(tmp_path / "a.jpg")
    os.mkfifo(tmp_path / "pipe.jpg")
    odd = [
        "line\nbreak.jpg",
        "bell\x07.png",
        "next\x85line.jpg",
        "para\u2029graph.jpg",
        os.fsdecode(b"caf\xe9.jpg"),
    ]
    for name in odd:
        touch(tmp_path / name)
    touch(tmp_path / "notes\n.txt")
    longest = "n" * 251 + ".jpg"
    touch(tmp_path / longest)
    found = list_photographs(tmp_path)
    assert found.names == ("a.jpg", longest)
    assert "a pipe, a socket or a device" in found.unusable["pipe.jpg"]
    assert set(found.unusable) == {
        "pipe.jpg",
        r"line\nbreak.jpg",
        r"bell\x07.png",
        r"next\x85line.jpg",
        r"para\u2029graph.jpg",
        r"caf\udce9.jpg",
    }
    assert "not UTF-8" in found.unusable[r"caf\udce9.jpg"]
    assert "control character" in found.unusable[r"bell\x07.png"]
    assert mask_of(tmp_path, longest) is None


def test_a_header_tells_deep_gray(tmp_path):
    cv2.imwrite(str(tmp_path / "depth.png"), np.full((40, 50), 1000, np.uint16))
    cv2.imwrite(str(tmp_path / "gray.png"), np.full((40, 50), 100, np.uint8))
    cv2.imwrite(str(tmp_path / "deep.png"), np.full((40, 50, 3), 1000, np.uint16))
    deep = [
        name for name in ("depth", "gray", "deep") if read_header(tmp_path / f"{name}.png").is_deep_gray_png
    ]
    assert deep == ["depth"]


def test_a_folder_that_cannot_be_listed_is_not_passed_over(tmp_path, monkeypatch):
    (tmp_path / "closed").mkdir()
    real = os.scandir

    def scandir(path):
        if str(path).endswith("closed"):
            raise PermissionError(13, "Permission denied", str(path))
        return real(path)

    monkeypatch.setattr(os, "scandir", scandir)
    with pytest.raises(FileFormatError, match="closed: the folder cannot be listed: Permission denied"):
        list_photographs(tmp_path)
