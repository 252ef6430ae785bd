"""Decoding of image files to upright 8-bit pixels; `photographs` documents the rules."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import IO

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, features
from PIL.BmpImagePlugin import BmpImageFile
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.PpmImagePlugin import PpmImageFile
from PIL.TiffImagePlugin import TiffImageFile
from PIL.WebPImagePlugin import WebPImageFile

from epipole.errors import EpipoleError, FileFormatError, MissingDependencyError
from epipole.io._spherical import refuse_panorama
from epipole.io.files import file_bytes
from epipole.io.images._rotated_pixels import as_stored as as_stored
from epipole.io.images._rotated_pixels import rotation as rotation
from epipole.io.images.deep_pixels import (
    GrayRange,
    check_range,
    color_16,
    has_16_bits,
    range_of,
    sample_of,
    stretched,
)
from epipole.io.images.exif import EXIF_ERRORS, orientation_of
from epipole.io.images.formats import AVIF_SUFFIXES, FORMAT_OF_SUFFIX, HEIF_SUFFIXES, format_of

MAX_LOSSLESS_PX = 150_000_000
"""Pixel limit of formats other than JPEG."""

MAX_JPEG_PX = 2**30
"""Pixel limit of JPEG."""

MOST_SAMPLED = 16
"""Number of images in a set that are sampled for its range of gray."""

_MOST_JPEG_PX_PER_BYTE = 1024
_MOST_PX_PER_BYTE, _MANY_PX = 8256, 1 << 24
_COMMENT, _LONGEST_PPM_HEADER = re.compile(rb"#[^\r\n]*"), 1 << 16
_MOST_SCANS, _MOST_SCANNED_PX = 16, 1 << 30

_PILLOW_READERS: dict[str, Callable[..., ImageFile]] = {
    "JPEG": JpegImageFile,
    "PNG": PngImageFile,
    "TIFF": TiffImageFile,
    "WEBP": WebPImageFile,
    "BMP": BmpImageFile,
    "PPM": PpmImageFile,
}
PILLOW_ERRORS = (*EXIF_ERRORS, MemoryError, AttributeError, RuntimeError, Image.DecompressionBombError)
"""Exceptions that Pillow raises on a damaged image."""
_SUBFILE_TYPE, _PHOTOMETRIC, _BITS_PER_SAMPLE, _DNG_VERSION = 254, 262, 258, 50706
_IS_PREVIEW, _IS_NO_PAGE = 1, 5
_WHITE_IS_ZERO = 0
_MOST_PAGES = 64
_JPEG_MARKER = re.compile(rb"\xff+[\x01-\xcf\xd8-\xfe]")
_REDUCED_FLAGS = {
    1: (cv2.IMREAD_GRAYSCALE, cv2.IMREAD_COLOR),
    2: (cv2.IMREAD_REDUCED_GRAYSCALE_2, cv2.IMREAD_REDUCED_COLOR_2),
    4: (cv2.IMREAD_REDUCED_GRAYSCALE_4, cv2.IMREAD_REDUCED_COLOR_4),
    8: (cv2.IMREAD_REDUCED_GRAYSCALE_8, cv2.IMREAD_REDUCED_COLOR_8),
}


def readable_suffixes() -> frozenset[str]:
    """Suffixes of the images that can be read with the installed packages."""
    missing = frozenset() if find_spec("pillow_heif") else HEIF_SUFFIXES
    return frozenset(FORMAT_OF_SUFFIX) - missing - (frozenset() if features.check("avif") else AVIF_SUFFIXES)


def open_with_pillow(path: Path, stream: io.BufferedIOBase, file_format: str) -> ImageFile:
    """Read a header. The reader is chosen explicitly since `Image.open` rejects every image above 180 megapixels."""
    stream.seek(0)
    # Pillow would search for the header's numbers byte by byte, past comments of unlimited length.
    if file_format == "PPM" and len(_COMMENT.sub(b" ", stream.read(_LONGEST_PPM_HEADER)).split()) < 3:
        raise FileFormatError(path, "the PPM header is damaged: it has no size")
    reader = _reader(path, file_format)
    try:
        stream.seek(0)
        image = reader(stream)
        problem = _problem_of_pages(image)
        if isinstance(image, TiffImageFile):  # it is at another page now
            stream.seek(0)
            image = reader(stream)
    except PILLOW_ERRORS as error:
        problem = f"the {file_format} header is damaged or not supported ({error})"
        raise FileFormatError(path, problem) from error
    if problem:
        raise FileFormatError(path, problem)
    return image


def _problem_of_pages(image: ImageFile) -> str:
    """Why an image is not a single photograph (an animation, a multi-page TIFF); empty if it is one."""
    if isinstance(image, TiffImageFile):
        return _problem_of_tiff(image)
    if image.format not in ("WEBP", "AVIF"):  # others start with the main image, even an animated PNG
        return ""
    count = int(getattr(image, "n_frames", 1))
    return f"it is an animation of {count} frames; extract those you need as PNG or JPEG" if count > 1 else ""


def _problem_of_tiff(image: TiffImageFile) -> str:
    """Why a TIFF is not a single photograph; previews, masks (TIFF 6.0, NewSubfileType) and other sizes are no pages."""
    if _DNG_VERSION in image.tag_v2:
        return "camera RAW (DNG) is not supported; develop it to JPEG or TIFF first"
    if int(image.tag_v2.get(_SUBFILE_TYPE, 0)) & _IS_PREVIEW:
        return "it starts with a preview instead of the image; save it again as a single-image TIFF"
    size, count = image.size, 1
    with suppress(EOFError):
        for page in range(1, _MOST_PAGES):
            image.seek(page)
            kind = int(image.tag_v2.get(_SUBFILE_TYPE, 0))
            count += image.size == size and not kind & _IS_NO_PAGE
    return f"it has {count} pages; save the pages you need as single-image files" if count > 1 else ""


def _reader(path: Path, file_format: str) -> Callable[..., ImageFile]:
    """The reader of a format; those for HEIC and AVIF may not be installed."""
    if file_format in _PILLOW_READERS:
        return _PILLOW_READERS[file_format]
    module, name, package = {
        "HEIF": ("pillow_heif", "HeifImageFile", "pillow-heif"),
        "AVIF": ("PIL.AvifImagePlugin", "AvifImageFile", "--upgrade Pillow"),
    }[file_format]
    try:
        reader: Callable[..., ImageFile] = getattr(import_module(module), name)
    except ImportError as error:
        problem = f"{path} is a {file_format} image: run `pip install {package}`, or convert it to JPEG"
        raise MissingDependencyError(problem) from error
    return reader


def exif_of(image: ImageFile) -> Image.Exif:
    """The EXIF block, empty if it is damaged."""
    if isinstance(image, PngImageFile) and image.fp is not None and not _has_exif_chunk(image.fp):
        return Image.Exif()  # Pillow would decode the whole image to search after its pixels
    try:
        return image.getexif()
    except EXIF_ERRORS:
        return Image.Exif()


def _has_exif_chunk(stream: IO[bytes]) -> bool:
    """Whether a PNG file has a chunk that can contain EXIF, before or after its pixels (PNG 1.5, section 4.7)."""
    before, index = stream.tell(), 8  # after the signature
    try:
        while True:
            stream.seek(index)
            head = stream.read(8)
            if len(head) < 8 or head[4:] == b"IEND":
                return False
            if head[4:] in (b"eXIf", b"tEXt", b"zTXt", b"iTXt"):
                return True
            index += 12 + int.from_bytes(head[:4], "big")
    finally:
        stream.seek(before)


def stored_size(image: ImageFile) -> tuple[int, int]:
    """Width and height as stored (Pillow returns those of a TIFF after rotation)."""
    if isinstance(image, TiffImageFile):
        return int(image.tag_v2[256]), int(image.tag_v2[257])
    return image.size


def refuse_huge(path: Path, image: ImageFile, data: bytes) -> None:
    """Reject an image that is too large or inconsistent, before memory or time is spent on it.

    Raises:
        FileFormatError: the image has more pixels than the format's limit or than its bytes can encode, or is a JPEG
            with too many scans.
    """
    (width, height), num_bytes = image.size, len(data)
    limit = MAX_JPEG_PX if isinstance(image, JpegImageFile) else MAX_LOSSLESS_PX
    if width * height > limit:
        sizes = f"{width} x {height} is more than {limit // 1_000_000} megapixels"
        raise FileFormatError(path, f"{sizes}, the limit for {image.format}; resize it or save it as JPEG")
    # Deflate compresses by a factor of at most 1032; a byte is up to 8 gray pixels, or one channel of a color pixel.
    channels = len(image.getbands()) if isinstance(image, PngImageFile) else 1
    px_per_byte = 1032 / channels if channels > 1 else _MOST_PX_PER_BYTE
    if width * height > max(_MANY_PX, px_per_byte * num_bytes):
        raise FileFormatError(path, f"{num_bytes} bytes cannot hold {width} x {height} pixels")
    # Each block of 8 x 8 takes at least one bit; a decoder would fill in missing data.
    if isinstance(image, JpegImageFile) and width * height > _MOST_JPEG_PX_PER_BYTE * num_bytes:
        problem = f"{num_bytes} bytes cannot hold {width} x {height} pixels"
        raise FileFormatError(path, f"the JPEG is truncated or damaged: {problem}")
    num_scans = data.count(b"\xff\xda") if isinstance(image, JpegImageFile) else 1
    if num_scans > _MOST_SCANS and num_scans * width * height > _MOST_SCANNED_PX:
        raise FileFormatError(path, f"the JPEG has {num_scans} scans, more than any image needs")


def decode(
    path: Path,
    gray: bool,
    max_size_px: int | None,
    limits: GrayRange | None = None,
    orientation: int | None = None,
) -> UInt8[np.ndarray, "h w *channels"]:
    """Decode to gray or RGB, shrink to `max_size_px`, rotate upright (or by `orientation` instead of the file's)."""
    return decode_bytes(path, file_bytes(path), gray, max_size_px, limits, orientation)


def decode_bytes(
    path: Path,
    data: bytes,
    gray: bool,
    max_size_px: int | None,
    limits: GrayRange | None = None,
    orientation: int | None = None,
) -> UInt8[np.ndarray, "h w *channels"]:
    """Decode the bytes of an image file, as `decode`.

    Raises:
        ConfigError: the range of limits is empty or infinite.
        FileFormatError: the image cannot be decoded.
    """
    check_range(limits)
    image = open_with_pillow(path, io.BytesIO(data), format_of(path, data[:64]))
    refuse_huge(path, image, data)
    refuse_panorama(path, image)
    if isinstance(image, JpegImageFile):
        own = orientation_of(exif_of(image))
        full_size = image.size
        reduction = _jpeg_reduction(full_size, max_size_px)
        pixels = _decode_jpeg(path, data, image, gray, reduction)
        return rotation(_shrink(pixels, full_size, reduction, max_size_px), orientation or own)
    stored = orientation_of(exif_of(image)) if isinstance(image, TiffImageFile) else None
    pixels, own = pillow_pixels(path, image, data)
    pixels = as_stored(pixels, stored, own, orientation)
    if pixels.dtype != np.uint8:
        pixels = stretched(pixels, limits)
    if gray and pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    elif not gray and pixels.ndim == 2:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB)
    size_now = (pixels.shape[1], pixels.shape[0])
    return rotation(_shrink(pixels, size_now, 1, max_size_px), orientation or own)


def _jpeg_reduction(size: tuple[int, int], max_size_px: int | None) -> int:
    """The largest of 8, 4, 2, 1 that leaves the longer side at least `max_size_px`."""
    if max_size_px is None:
        return 1
    return next((d for d in (8, 4, 2) if max(size) >= d * max_size_px), 1)


def _decode_jpeg(
    path: Path, data: bytes, image: JpegImageFile, gray: bool, reduction: int
) -> UInt8[np.ndarray, "h w *channels"]:
    """Decode at 1 / reduction; sizes are rounded up."""
    if not _jpeg_is_complete(data):
        raise FileFormatError(
            path, f"the JPEG is truncated: the file ends after {len(data)} bytes, before the image does"
        )
    if image.layers == 4:
        if reduction > 1:
            image.draft(None, (image.width // reduction, image.height // reduction))
        pixels, _ = pillow_pixels(path, image, data)
        return cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY) if gray else pixels
    flags = _REDUCED_FLAGS[reduction][0 if gray else 1] | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise FileFormatError(path, f"the JPEG cannot be decoded ({error.err})") from error
    if decoded is None:
        raise FileFormatError(path, "the JPEG cannot be decoded: it is damaged or of an unsupported kind")
    return decoded if gray else cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB, dst=decoded)


def _jpeg_is_complete(data: bytes) -> bool:
    """Whether the file ends with an end-of-image marker or, if data follow, has one after its pixels.

    Jumps from marker to marker, skipping thumbnails inside segments.
    """
    if data[-256:].rstrip(b"\0").endswith(b"\xff\xd9"):
        return True
    at = 2
    while (marker := _JPEG_MARKER.search(data, at)) is not None:
        code = data[marker.end() - 1]
        if code == 0xD9:
            return True
        has_length = code not in (0x01, 0xD8)
        at = marker.end() + (
            int.from_bytes(data[marker.end() : marker.end() + 2], "big") if has_length else 0
        )
    return False


def pillow_pixels(path: Path, image: ImageFile, data: bytes) -> tuple[np.ndarray, int]:
    """Pixels and the orientation still to be applied: 8-bit gray or RGB, or deep gray unchanged.

    Transparency is composited on black.
    """
    pixels, orientation = stored_pixels(path, image, data)
    if pixels.ndim == 2 or pixels.shape[2] == 3:
        return pixels, orientation
    rgba = Image.fromarray(pixels)
    black = Image.new("RGB", rgba.size)
    black.paste(rgba, mask=rgba.getchannel("A"))
    return np.array(black), orientation


def stored_pixels(path: Path, image: ImageFile, data: bytes) -> tuple[np.ndarray, int]:
    """As `pillow_pixels`, with alpha (RGBA) if there is transparency.

    Raises:
        FileFormatError: the image is damaged or cannot be converted.
    """
    try:
        is_deep_color = has_16_bits(image)
        image.load()
        orientation = orientation_of(exif_of(image))
        if image.mode.startswith(("I", "F")):
            return _black_is_zero(image, np.array(image)), orientation
        is_transparent = "transparency" in image.info or image.mode in ("LA", "La", "PA", "RGBA", "RGBa")
        if image.mode in ("1", "L") and not is_transparent:
            return np.array(image.convert("L")), orientation
        pixels = np.array(image.convert("RGBA" if is_transparent else "RGB"))
        if is_deep_color:
            pixels = color_16(type(image), io.BytesIO(data), pixels)
        return pixels, orientation
    except PILLOW_ERRORS as error:
        raise FileFormatError(path, f"the {image.format} data are damaged or truncated ({error})") from error


def _black_is_zero(image: ImageFile, deep: np.ndarray) -> np.ndarray:
    """Invert deep gray of a TIFF whose zero is white (Pillow does so for 8 bits only)."""
    if not isinstance(image, TiffImageFile) or image.tag_v2.get(_PHOTOMETRIC) != _WHITE_IS_ZERO:
        return deep
    if deep.dtype.kind == "f":
        return -deep
    bits = image.tag_v2.get(_BITS_PER_SAMPLE, 16)
    white = (1 << int(bits[0] if isinstance(bits, tuple) else bits)) - 1
    return (white - deep.astype(np.int64)).astype(deep.dtype)


def common_range(paths: Sequence[Path]) -> GrayRange | None:
    """The common range of deep gray images, sampled from a set so that all are mapped alike; None if the set has none.

    Unreadable images are ignored.
    """
    samples, dtype = [], np.dtype(np.uint8)
    chosen = np.unique(np.linspace(0, len(paths) - 1, min(len(paths), MOST_SAMPLED)).astype(int))
    for row in chosen.tolist():
        with suppress(EpipoleError):
            deep = deep_gray(paths[row], file_bytes(paths[row]))
            if deep is None:
                return None
            samples.append(sample_of(deep))
            dtype = deep.dtype
    return range_of(np.concatenate(samples), dtype) if samples else None


def deep_gray(path: Path, data: bytes) -> np.ndarray | None:
    """The values of a deep gray image; None for other images, which are not decoded."""
    image = open_with_pillow(path, io.BytesIO(data), format_of(path, data[:64]))
    refuse_huge(path, image, data)
    return pillow_pixels(path, image, data)[0] if image.mode.startswith(("I", "F")) else None


def _shrink(
    pixels: UInt8[np.ndarray, "h w *channels"],
    full_size: tuple[int, int],
    reduction: int,
    max_size_px: int | None,
) -> UInt8[np.ndarray, "new_h new_w *channels"]:
    """Average over areas on a grid that divides the full image evenly.

    If `reduction` does not divide the width, a JPEG reduced to ceil(width / reduction) pixels covers slightly more than
    the image; it is then sampled bilinearly, less than two pixels apart, at the positions of the grid.
    """
    width, height = full_size
    if max_size_px is None or max(width, height) <= max_size_px:
        return pixels
    scale = max_size_px / max(width, height)
    new_width, new_height = max(1, round(width * scale)), max(1, round(height * scale))
    if width % reduction == 0 and height % reduction == 0:
        return cv2.resize(pixels, (new_width, new_height), interpolation=cv2.INTER_AREA)
    step_x, step_y = width / new_width / reduction, height / new_height / reduction
    reduced_from_new = np.array([[step_x, 0.0, 0.5 * step_x - 0.5], [0.0, step_y, 0.5 * step_y - 0.5]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(
        pixels, reduced_from_new, (new_width, new_height), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
