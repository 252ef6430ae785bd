"""Detection of image formats by content; suffixes are only a hint."""

from __future__ import annotations

import re
from pathlib import Path

from epipole.errors import FileFormatError

FORMAT_OF_SUFFIX = {
    **dict.fromkeys((".jpg", ".jpeg", ".jpe", ".jfif", ".jfi", ".jif"), "JPEG"),
    **{
        f".{kind}{mark}{size}": "JPEG"
        for kind in ("jpg", "jpeg")
        for mark in "_-"
        for size in ("large", "orig")
    },
    **dict.fromkeys((".png", ".png_large"), "PNG"),
    **dict.fromkeys((".tif", ".tiff"), "TIFF"),
    ".webp": "WEBP",
    **dict.fromkeys((".bmp", ".dib"), "BMP"),
    **dict.fromkeys((".ppm", ".pgm", ".pbm", ".pnm"), "PPM"),
    ".avif": "AVIF",
    **dict.fromkeys((".heic", ".heif", ".hif"), "HEIF"),
}
"""Format by suffix, for all readable formats."""

HEIF_SUFFIXES = frozenset(suffix for suffix, name in FORMAT_OF_SUFFIX.items() if name == "HEIF")
AVIF_SUFFIXES = frozenset(suffix for suffix, name in FORMAT_OF_SUFFIX.items() if name == "AVIF")
RAW_SUFFIXES = frozenset(
    f".{kind}"
    for kind in (
        "3fr",
        "arw",
        "cr2",
        "cr3",
        "crw",
        "dcr",
        "dng",
        "erf",
        "fff",
        "iiq",
        "k25",
        "kdc",
        "mef",
        "mos",
        "mrw",
        "nef",
        "nrw",
        "orf",
        "pef",
        "raf",
        "raw",
        "rw2",
        "rwl",
        "sr2",
        "srf",
        "srw",
        "x3f",
    )
)
OTHER_SUFFIXES = frozenset({".gif", ".jp2", ".j2k", ".jpf", ".jpx", ".jxl", ".psd", ".exr", ".tga"})
"""Suffixes of unsupported formats."""

_MAGIC = (
    ("JPEG", re.compile(rb"\xff\xd8\xff")),
    ("PNG", re.compile(rb"\x89PNG\r\n\x1a\n")),
    ("TIFF", re.compile(rb"II[*+]\x00|MM\x00[*+]")),
    ("WEBP", re.compile(rb"RIFF....WEBP", re.DOTALL)),
    ("BMP", re.compile(rb"BM")),
    ("PPM", re.compile(rb"P[1-6]\s")),
    ("AVIF", re.compile(rb"....ftyp(?:avi[fs]|(?:mif1|msf1|miaf).{4}(?:.{4})*?avi[fs])", re.DOTALL)),
    ("HEIF", re.compile(rb"....ftyp(?:he[ivx][cxms]|mif1|msf1)", re.DOTALL)),
)
_UNREAD_MAGIC = (
    ("GIF", re.compile(rb"GIF8[79]a")),
    ("JPEG 2000", re.compile(rb"\x00\x00\x00\x0cjP  |\xff\x4f\xff\x51")),
    ("JPEG XL", re.compile(rb"\xff\x0a|\x00\x00\x00\x0cJXL ")),
    ("Photoshop", re.compile(rb"8BPS")),
    ("OpenEXR", re.compile(rb"v/1\x01")),
    ("Radiance HDR", re.compile(rb"#\?(?:RADIANCE|RGBE)")),
    ("PFM", re.compile(rb"P[Ff]\s")),
    ("SVG", re.compile(rb"\s*(?:<\?xml[^>]*>\s*)?<svg")),
    ("PDF", re.compile(rb"%PDF")),
    ("MP4 video", re.compile(rb"....ftyp(?:isom|mp4[12]|qt  |M4V )", re.DOTALL)),
)


def format_of(path: Path, head: bytes) -> str:
    """Detect a format from the first 64 bytes; the suffix only identifies camera RAW files that look like TIFF.

    Raises:
        FileFormatError: the file is empty, or in an unsupported format.
    """
    if not head:
        raise FileFormatError(path, "the file is empty (0 bytes)")
    found = next((name for name, magic in _MAGIC if magic.match(head)), None)
    if path.suffix.lower() in RAW_SUFFIXES and found in (None, "TIFF"):
        raise FileFormatError(path, "camera RAW is not supported; develop it to JPEG or TIFF first")
    if found is not None:
        return found
    unread = next((name for name, magic in _UNREAD_MAGIC if magic.match(head)), None)
    if unread is not None:
        raise FileFormatError(path, f"{unread} files are not supported; convert it to PNG or JPEG first")
    is_text = all(32 <= byte < 127 or byte in b"\t\n\r\f" for byte in head.removeprefix(b"\xef\xbb\xbf")[:16])
    kind = "it looks like text" if is_text else f"it starts with the bytes {head[:8].hex(' ')}"
    raise FileFormatError(path, f"not an image in a known format: {kind}")
