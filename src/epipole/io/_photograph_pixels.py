"""Decoding of picture files to 8 bits, upright; the rules are stated in `photographs`."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
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

from epipole.cameras.image_fit import inverse_orientation
from epipole.errors import FileFormatError, MissingDependencyError
from epipole.io.exif import EXIF_ERRORS, orientation_of
from epipole.io.files import file_bytes

MAX_LOSSLESS_PX = 150_000_000
"""Largest picture, in pixels, that is read from a format other than JPEG."""

MAX_JPEG_PX = 2**30
"""Largest JPEG, in pixels."""

_MOST_JPEG_PX_PER_BYTE = 1024
_MOST_PX_PER_BYTE, _MANY_PX = 8256, 1 << 24
_COMMENT, _LONGEST_PPM_HEADER = re.compile(rb"#[^\r\n]*"), 1 << 16
_MOST_SCANS, _MOST_SCANNED_PX = 16, 1 << 30

_PICTURE_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".pgm", ".ppm"})
HEIF_SUFFIXES = frozenset({".heic", ".heif", ".hif"})
AVIF_SUFFIXES = frozenset({".avif"})
RAW_SUFFIXES = frozenset(
    f".{kind}"
    for kind in (
        *("3fr", "arw", "cr2", "cr3", "crw", "dcr", "dng", "erf", "fff", "iiq", "k25", "kdc", "mef", "mos"),
        *("mrw", "nef", "nrw", "orf", "pef", "raf", "raw", "rw2", "rwl", "sr2", "srf", "srw", "x3f"),
    )
)
_MAGIC = (
    ("JPEG", re.compile(rb"\xff\xd8\xff")),
    ("PNG", re.compile(rb"\x89PNG\r\n\x1a\n")),
    ("TIFF", re.compile(rb"II[*+]\x00|MM\x00[*+]")),
    ("WEBP", re.compile(rb"RIFF....WEBP", re.DOTALL)),
    ("BMP", re.compile(rb"BM")),
    ("PPM", re.compile(rb"P[1-6]\s")),
    ("AVIF", re.compile(rb"....ftypavi[fs]", re.DOTALL)),
    ("HEIF", re.compile(rb"....ftyp(?:he[ivx][cxms]|mif1|msf1)", re.DOTALL)),
)
_PILLOW_READERS: dict[str, Callable[..., ImageFile]] = {
    "JPEG": JpegImageFile,
    "PNG": PngImageFile,
    "TIFF": TiffImageFile,
    "WEBP": WebPImageFile,
    "BMP": BmpImageFile,
    "PPM": PpmImageFile,
}
PILLOW_ERRORS = (*EXIF_ERRORS, MemoryError, AttributeError, RuntimeError, Image.DecompressionBombError)
"""What Pillow may raise on a damaged picture."""
_JPEG_MARKER = re.compile(rb"\xff+[\x01-\xcf\xd8-\xfe]")
_REDUCED_FLAGS = {
    1: (cv2.IMREAD_GRAYSCALE, cv2.IMREAD_COLOR),
    2: (cv2.IMREAD_REDUCED_GRAYSCALE_2, cv2.IMREAD_REDUCED_COLOR_2),
    4: (cv2.IMREAD_REDUCED_GRAYSCALE_4, cv2.IMREAD_REDUCED_COLOR_4),
    8: (cv2.IMREAD_REDUCED_GRAYSCALE_8, cv2.IMREAD_REDUCED_COLOR_8),
}


def readable_suffixes() -> frozenset[str]:
    """Suffixes of the pictures that can be read with what is installed."""
    heif = HEIF_SUFFIXES if find_spec("pillow_heif") else frozenset()
    return _PICTURE_SUFFIXES | heif | (AVIF_SUFFIXES if features.check("avif") else frozenset())


def format_of(path: Path, head: bytes) -> str:
    """Format by the first bytes, whatever the name says."""
    if not head:
        raise FileFormatError(path, "the file is empty (0 bytes)")
    if path.suffix.lower() in RAW_SUFFIXES:
        raise FileFormatError(path, "camera RAW is not read; develop it to JPEG or TIFF first")
    found = next((name for name, magic in _MAGIC if magic.match(head)), None)
    if found is None:
        is_text = all(
            32 <= byte < 127 or byte in b"\t\n\r\f" for byte in head.removeprefix(b"\xef\xbb\xbf")[:16]
        )
        kind = "it looks like text" if is_text else f"it starts with the bytes {head[:8].hex(' ')}"
        raise FileFormatError(path, f"is not a picture in a known format: {kind}")
    return found


def open_with_pillow(path: Path, stream: io.BufferedIOBase, file_format: str) -> ImageFile:
    """Read a header. The reader is called by name: `Image.open` refuses every picture of 180 megapixels."""
    stream.seek(0)
    # Pillow would look for the numbers of the header byte by byte, behind comments without end.
    if file_format == "PPM" and len(_COMMENT.sub(b" ", stream.read(_LONGEST_PPM_HEADER)).split()) < 3:
        raise FileFormatError(path, "the PPM header is damaged: it has no size")
    stream.seek(0)
    reader = _PILLOW_READERS.get(file_format) or _optional_reader(path, file_format)
    try:
        return reader(stream)
    except PILLOW_ERRORS as error:
        raise FileFormatError(path, f"the {file_format} header is damaged ({error})") from error


def _optional_reader(path: Path, file_format: str) -> Callable[..., ImageFile]:
    """Reader of HEIC or AVIF, which not every installation has."""
    module, name, package = {
        "HEIF": ("pillow_heif", "HeifImageFile", "pillow-heif"),
        "AVIF": ("PIL.AvifImagePlugin", "AvifImageFile", "--upgrade Pillow"),
    }[file_format]
    try:
        reader: Callable[..., ImageFile] = getattr(import_module(module), name)
    except ImportError as error:
        problem = f"{path} is a {file_format} picture: run `pip install {package}`, or convert it to JPEG"
        raise MissingDependencyError(problem) from error
    return reader


def exif_of(image: ImageFile) -> Image.Exif:
    """The EXIF block, empty when it is damaged."""
    if isinstance(image, PngImageFile) and image.fp is not None and not _has_exif_chunk(image.fp):
        return Image.Exif()  # Pillow would decode the whole picture to look behind its pixels
    try:
        return image.getexif()
    except EXIF_ERRORS:
        return Image.Exif()


def _has_exif_chunk(stream: IO[bytes]) -> bool:
    """Whether a PNG file has a chunk that may hold EXIF, before or after its pixels (PNG 1.5, section 4.7)."""
    before, place = stream.tell(), 8  # behind the signature
    try:
        while True:
            stream.seek(place)
            head = stream.read(8)
            if len(head) < 8 or head[4:] == b"IEND":
                return False
            if head[4:] in (b"eXIf", b"tEXt", b"zTXt", b"iTXt"):
                return True
            place += 12 + int.from_bytes(head[:4], "big")
    finally:
        stream.seek(before)


def stored_size(image: ImageFile) -> tuple[int, int]:
    """Width and height as stored (Pillow gives those of a TIFF already turned)."""
    if isinstance(image, TiffImageFile):
        return int(image.tag_v2[256]), int(image.tag_v2[257])
    return image.size


def refuse_huge(path: Path, image: ImageFile, data: bytes) -> None:
    """Refuse a picture that is too large, before memory or time is used.

    Raises:
        FileFormatError: more pixels than the format's limit, or than so many bytes can hold; a JPEG that goes over its
            pixels again and again.
    """
    (width, height), num_bytes = image.size, len(data)
    limit = MAX_JPEG_PX if isinstance(image, JpegImageFile) else MAX_LOSSLESS_PX
    if width * height > limit:
        sizes = f"{width} x {height} is more than {limit // 1_000_000} megapixels"
        raise FileFormatError(path, f"{sizes}, the limit for {image.format}; save it smaller or as JPEG")
    # Deflate packs at most 1032 bytes into one, each of up to 8 pixels; no photograph comes near in any format.
    if width * height > max(_MANY_PX, _MOST_PX_PER_BYTE * num_bytes):
        raise FileFormatError(path, f"{num_bytes} bytes cannot hold {width} x {height} pixels")
    # Each block of 8 x 8 takes at least one bit; a decoder would invent what is missing.
    if isinstance(image, JpegImageFile) and width * height > _MOST_JPEG_PX_PER_BYTE * num_bytes:
        problem = f"{num_bytes} bytes cannot hold {width} x {height} pixels"
        raise FileFormatError(path, f"the JPEG is truncated or damaged: {problem}")
    num_scans = data.count(b"\xff\xda") if isinstance(image, JpegImageFile) else 1
    if num_scans > _MOST_SCANS and num_scans * width * height > _MOST_SCANNED_PX:
        raise FileFormatError(path, f"the JPEG goes over its pixels {num_scans} times: no picture needs that")


def decode(
    path: Path, grey: bool, max_size_px: int | None, orientation: int | None = None
) -> UInt8[np.ndarray, "h w *channels"]:
    """Decode to grey or RGB, shrink to `max_size_px`, turn upright (or by another orientation than the file's)."""
    return decode_bytes(path, file_bytes(path), grey, max_size_px, orientation)


def decode_bytes(
    path: Path, data: bytes, grey: bool, max_size_px: int | None, orientation: int | None = None
) -> UInt8[np.ndarray, "h w *channels"]:
    """As `decode`, of bytes that stand in some file."""
    image = open_with_pillow(path, io.BytesIO(data), format_of(path, data[:64]))
    refuse_huge(path, image, data)
    if isinstance(image, JpegImageFile):
        own = orientation_of(exif_of(image))
        full_size = image.size
        reduction = _jpeg_reduction(full_size, max_size_px)
        pixels = _decode_jpeg(path, data, image, grey, reduction)
        return turn(_shrink(pixels, full_size, reduction, max_size_px), orientation or own)
    stored = orientation_of(exif_of(image)) if isinstance(image, TiffImageFile) else None
    pixels, own = pillow_pixels(path, image, stretch=True)
    pixels = as_stored(pixels, stored, own, orientation)
    if grey and pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    elif not grey and pixels.ndim == 2:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB)
    size_now = (pixels.shape[1], pixels.shape[0])
    return turn(_shrink(pixels, size_now, 1, max_size_px), orientation or own)


def _jpeg_reduction(size: tuple[int, int], max_size_px: int | None) -> int:
    """Largest of 8, 4, 2, 1 that leaves the longer side at least as long as asked for."""
    if max_size_px is None:
        return 1
    return next((d for d in (8, 4, 2) if max(size) >= d * max_size_px), 1)


def _decode_jpeg(
    path: Path, data: bytes, image: JpegImageFile, grey: bool, reduction: int
) -> UInt8[np.ndarray, "h w *channels"]:
    """Decode at 1 / reduction; a size that it does not divide is rounded up."""
    if not _jpeg_is_complete(data):
        raise FileFormatError(
            path, f"the JPEG is truncated: the file ends ({len(data)} bytes) before the picture"
        )
    if image.layers == 4:
        if reduction > 1:
            image.draft(None, (image.width // reduction, image.height // reduction))
        pixels, _ = pillow_pixels(path, image, stretch=False)
        return cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY) if grey else pixels
    flags = _REDUCED_FLAGS[reduction][0 if grey else 1] | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise FileFormatError(path, f"the JPEG cannot be decoded ({error.err})") from error
    if decoded is None:
        raise FileFormatError(path, "the JPEG cannot be decoded: its data are damaged or of a rare kind")
    return decoded if grey else cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB, dst=decoded)


def _jpeg_is_complete(data: bytes) -> bool:
    """Whether the file ends with the end-of-image marker or, with data behind, has one after its pixels.

    The walk goes from marker to marker; thumbnails inside segments are jumped over.
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


def pillow_pixels(path: Path, image: ImageFile, *, stretch: bool) -> tuple[np.ndarray, int]:
    """Grey or RGB pixels, and the orientation still to be applied; deep grey is stretched if asked."""
    try:
        image.load()
        orientation = orientation_of(exif_of(image))
        if image.mode.startswith(("I", "F")):
            deep = np.array(image)
            return (_stretched(deep) if stretch else deep), orientation
        if image.mode in ("1", "L"):
            return np.array(image.convert("L")), orientation
        if image.mode in ("LA", "La", "PA", "RGBA", "RGBa") or "transparency" in image.info:
            rgba = image.convert("RGBA")
            black = Image.new("RGB", image.size)
            black.paste(rgba, mask=rgba.getchannel("A"))
            return np.array(black), orientation
        return np.array(image.convert("RGB")), orientation
    except PILLOW_ERRORS as error:
        raise FileFormatError(path, f"the {image.format} data are damaged or truncated ({error})") from error


def _stretched(deep: np.ndarray) -> UInt8[np.ndarray, "h w"]:
    """Map the 0.1 and 99.9 percentiles to 0 and 255 (of every k-th pixel where there are very many)."""
    values = deep.astype(np.float32)
    sample = values.ravel()[:: max(1, values.size // 1_000_000)]
    sample = sample[np.isfinite(sample)]
    low, high = np.percentile(sample, [0.1, 99.9]) if len(sample) else (0.0, 0.0)
    if high <= low:
        low, high = 0.0, float(np.iinfo(deep.dtype).max) if deep.dtype.kind in "iu" else 1.0
    scaled = np.nan_to_num((values - np.float32(low)) * np.float32(255.0 / (high - low)), nan=0.0)
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


def _shrink(
    pixels: UInt8[np.ndarray, "h w *channels"],
    full_size: tuple[int, int],
    reduction: int,
    max_size_px: int | None,
) -> UInt8[np.ndarray, "new_h new_w *channels"]:
    """Area averages on the grid that divides the full picture evenly.

    A JPEG reduced to ceil(width / reduction) pixels covers a little more than the picture where the division
    leaves a remainder; it is then sampled (bilinearly, less than two pixels apart) at the places of the grid.
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


def as_stored(
    pixels: np.ndarray, stored: int | None, left: int, orientation: int | None
) -> UInt8[np.ndarray, "h w *channels"]:
    """The pixels to which another orientation than the file's is to be applied.

    Pillow turns a TIFF as it loads it: what is `left` of its `stored` orientation then is 1. Where another one is asked
    for, that is taken back.
    """
    if orientation is None or stored is None or stored == left:
        return pixels
    return turn(pixels, inverse_orientation(stored))


def turn(
    pixels: UInt8[np.ndarray, "h w *channels"], orientation: int
) -> UInt8[np.ndarray, "new_h new_w *channels"]:
    """Apply an EXIF orientation."""
    if orientation in (5, 6, 7, 8):
        pixels = cv2.transpose(pixels)
    flip = {2: 1, 3: -1, 4: 0, 6: 1, 7: -1, 8: 0}.get(orientation)
    return np.ascontiguousarray(pixels if flip is None else cv2.flip(pixels, flip))
