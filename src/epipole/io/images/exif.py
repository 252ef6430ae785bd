"""Camera, focal length, position and time from a photograph's EXIF block.

Focal length in pixels, from the first of these sources that is present and plausible (0.2 to 20 times the longer side):

1. "35 mm equivalent": focal_px = f35 / 36 * max(width, height). The equivalent refers to the longer image
   side; the variant that refers to the diagonal (43.27 mm) is not used.
2. "sensor width": focal_px = f_mm / sensor_width_mm * max(width, height), with `sensor_widths`.
3. "focal-plane resolution": focal_px = f_mm * pixels per mm on the sensor, scaled if the image is smaller
   than EXIF states.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping
from datetime import datetime
from typing import Any, Literal, NamedTuple

from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from epipole._checks import checked
from epipole.errors import ConfigError
from epipole.io.images.sensor_widths import sensor_width_mm

FocalSource = Literal["35 mm equivalent", "sensor width", "focal-plane resolution"]

_MOST_SHORT, _MOST_ALTITUDE_M = 65535, 1e6
_MAKE, _MODEL, _ORIENTATION, _DATE_TIME = 0x010F, 0x0110, 0x0112, 0x0132
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_DATE_TIME_ORIGINAL, _SUBSECOND_ORIGINAL, _FOCAL_LENGTH = 0x9003, 0x9291, 0x920A
_PIXEL_WIDTH, _PIXEL_HEIGHT, _FOCAL_35MM = 0xA002, 0xA003, 0xA405
_FOCAL_PLANE_X_RESOLUTION, _FOCAL_PLANE_UNIT = 0xA20E, 0xA210
_LAT_REF, _LAT, _LON_REF, _LON, _ALT_REF, _ALT, _GPS_STATUS = 1, 2, 3, 4, 5, 6, 9
_GPS_HORIZONTAL_ERROR = 31

_GIMBAL_ANGLE = re.compile(r"Gimbal(Pitch|Roll)Degree\s*(?:=\s*[\"']|>)\s*([+-]?\d{1,3}(?:\.\d{1,9})?)\b")
_RTK_VALUE = re.compile(r"Rtk(Flag|StdLon|StdLat|StdHgt)\s*(?:=\s*[\"']|>)\s*\+?(\d{1,3}(?:\.\d{1,9})?)\b")
_RTK_FIXED = 50
"""`RtkFlag` of DJI for a fixed solution, of centimeters; others (float, single point) have no useful deviations."""
_MAX_XMP_CHARACTERS = 100_000

_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_FILM_WIDTH_MM = 36.0
_MIN_FOCAL_IN_SIZES, _MAX_FOCAL_IN_SIZES = 0.2, 20.0

EXIF_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    EOFError,
    struct.error,
    OverflowError,
)
"""Exceptions that Pillow raises on a damaged EXIF block."""


class Focal(NamedTuple):
    """A focal length in pixels and its source."""

    focal_px: float
    source: FocalSource


class GpsPosition(NamedTuple):
    """WGS84 position; the altitude is None if it was not recorded."""

    lat_deg: float
    lon_deg: float
    alt_m: float | None


@checked
def orientation_of(exif: Image.Exif) -> int:
    """EXIF orientation 1 to 8; 1 (as stored) if missing or invalid."""
    value = _number(exif.get(_ORIENTATION))
    return int(value) if value is not None and value in range(1, 9) else 1


@checked
def camera_of(exif: Image.Exif) -> tuple[str, str]:
    """Make and model, empty if not recorded."""
    return _text(exif.get(_MAKE)), _text(exif.get(_MODEL))


@checked
def focal_of(exif: Image.Exif, width: int, height: int) -> Focal | None:
    """Focal length in pixels for an image of the given size; None if EXIF has no plausible one."""
    size_px = max(width, height)
    details = _block(exif, _EXIF_IFD)
    candidates: tuple[tuple[FocalSource, float | None], ...] = (
        ("35 mm equivalent", _focal_in_sizes_from_35mm(details)),
        ("sensor width", _focal_in_sizes_from_sensor(details, *camera_of(exif))),
        ("focal-plane resolution", _focal_in_sizes_from_plane(details, size_px)),
    )
    for source, sizes in candidates:
        if sizes is not None and _MIN_FOCAL_IN_SIZES <= sizes <= _MAX_FOCAL_IN_SIZES:
            return Focal(sizes * size_px, source)
    return None


@checked
def gps_of(exif: Image.Exif) -> GpsPosition | None:
    """GPS position; None if it is missing, void, invalid or exactly (0, 0)."""
    block = _block(exif, _GPS_IFD)
    if _text(block.get(_GPS_STATUS)).upper() == "V":
        return None
    lat_deg = _signed_degrees(block.get(_LAT), block.get(_LAT_REF), "S", 90.0)
    lon_deg = _signed_degrees(block.get(_LON), block.get(_LON_REF), "W", 180.0)
    if lat_deg is None or lon_deg is None or (lat_deg == 0.0 and lon_deg == 0.0):
        return None
    alt_m = _number(block.get(_ALT))
    if alt_m is not None and block.get(_ALT_REF) in (1, b"\x01", "\x01"):
        alt_m = -abs(alt_m)
    return GpsPosition(lat_deg, lon_deg, alt_m)


@checked
def gps_sigma_of(exif: Image.Exif, xmp: object) -> tuple[float, float, float] | None:
    """Standard deviations of the GPS position in meters, east, north and up; None if not recorded.

    From the XMP block of a drone with a fixed RTK solution (`RtkStdLon`, `RtkStdLat`, `RtkStdHgt`, as written by DJI), or else
    from EXIF's GPSHPositioningError, with twice that for the altitude.
    """
    text = xmp.decode("utf-8", "replace") if isinstance(xmp, bytes) else xmp
    if isinstance(text, str):
        found = {name: float(value) for name, value in _RTK_VALUE.findall(text[:_MAX_XMP_CHARACTERS])}
        east, north, up = (found.get(name, 0.0) for name in ("StdLon", "StdLat", "StdHgt"))
        if found.get("Flag") == _RTK_FIXED and min(east, north, up) > 0:
            return (east, north, up)
    error_m = _number(_block(exif, _GPS_IFD).get(_GPS_HORIZONTAL_ERROR))
    if error_m is None or not 0 < error_m < _MOST_ALTITUDE_M:
        return None
    return (error_m, error_m, 2.0 * error_m)


@checked
def gimbal_up_of(xmp: object) -> tuple[float, float, float] | None:
    """Direction of up in camera coordinates (x right, y down, z forward) from a drone's XMP block; None if absent.

    With pitch p (-90 degrees looks straight down) and roll r of the gimbal, up is
    (-sin r cos p, -cos r cos p, sin p). Reads `GimbalPitchDegree` and `GimbalRollDegree` as written by DJI.
    """
    text = xmp.decode("utf-8", "replace") if isinstance(xmp, bytes) else xmp
    if not isinstance(text, str):
        return None
    found = {name: float(value) for name, value in _GIMBAL_ANGLE.findall(text[:_MAX_XMP_CHARACTERS])}
    pitch_deg, roll_deg = found.get("Pitch"), found.get("Roll", 0.0)
    if pitch_deg is None or abs(pitch_deg) > 180.0 or abs(roll_deg) > 360.0:
        return None
    p, r = math.radians(pitch_deg), math.radians(roll_deg)
    return (-math.sin(r) * math.cos(p), -math.cos(r) * math.cos(p), math.sin(p))


@checked
def capture_time_of(exif: Image.Exif) -> datetime | None:
    """Local time on the camera's clock (without zone), with fractions of a second where recorded."""
    details = _block(exif, _EXIF_IFD)
    for value, fraction in (
        (details.get(_DATE_TIME_ORIGINAL), _text(details.get(_SUBSECOND_ORIGINAL))),
        (exif.get(_DATE_TIME), ""),
    ):
        try:
            taken = datetime.strptime(_text(value)[:19], "%Y:%m:%d %H:%M:%S")
        except ValueError:
            continue
        return taken.replace(microsecond=int(fraction[:6].ljust(6, "0"))) if fraction.isdecimal() else taken
    return None


@checked
def upright_exif(exif: Image.Exif) -> Image.Exif:
    """A new block with the tags that this module reads, without orientation, thumbnail and maker notes."""
    out = Image.Exif()
    for tag in (_MAKE, _MODEL, _DATE_TIME):
        if tag in exif:
            out[tag] = exif[tag]
    details = _block(exif, _EXIF_IFD)
    kept = [_DATE_TIME_ORIGINAL, _SUBSECOND_ORIGINAL, _FOCAL_LENGTH, _FOCAL_35MM]
    kept += [_PIXEL_WIDTH, _PIXEL_HEIGHT, _FOCAL_PLANE_X_RESOLUTION, _FOCAL_PLANE_UNIT]
    out.get_ifd(_EXIF_IFD).update({tag: details[tag] for tag in kept if tag in details})
    out.get_ifd(_GPS_IFD).update(_block(exif, _GPS_IFD))
    return out


@checked
def new_exif(
    make: str,
    model: str,
    focal_35mm: float | None = None,
    gps: GpsPosition | tuple[float, float, float | None] | None = None,
) -> Image.Exif:
    """EXIF block for a rendered photograph (the 35 mm equivalent is rounded to whole mm, as EXIF requires).

    Raises:
        ConfigError: a number is outside the range of EXIF.
    """
    if focal_35mm is not None and not 0 <= focal_35mm < _MOST_SHORT:
        raise ConfigError(f"focal_35mm must be from 0 to {_MOST_SHORT}, got {focal_35mm:g}")
    if gps is not None:
        lat_deg, lon_deg, alt_m = gps
        if not (
            abs(lat_deg) <= 90 and abs(lon_deg) <= 360 and (alt_m is None or abs(alt_m) < _MOST_ALTITUDE_M)
        ):
            raise ConfigError(
                f"gps must be a latitude and a longitude in degrees and an altitude in meters, got {tuple(gps)}"
            )
    out = Image.Exif()
    out[_MAKE], out[_MODEL] = make, model
    if focal_35mm is not None:
        out.get_ifd(_EXIF_IFD)[_FOCAL_35MM] = round(focal_35mm)
    if gps is not None:
        lat_deg, lon_deg, alt_m = gps
        block = out.get_ifd(_GPS_IFD)
        block[_LAT_REF], block[_LAT] = "S" if lat_deg < 0 else "N", _degrees_minutes_seconds(lat_deg)
        block[_LON_REF], block[_LON] = "W" if lon_deg < 0 else "E", _degrees_minutes_seconds(lon_deg)
        if alt_m is not None:
            block[_ALT_REF] = b"\x01" if alt_m < 0 else b"\x00"
            block[_ALT] = IFDRational(round(abs(alt_m) * 1000), 1000)
    return out


def _focal_in_sizes_from_35mm(details: Mapping[int, Any]) -> float | None:
    focal_35mm = _number(details.get(_FOCAL_35MM))
    return None if focal_35mm is None else focal_35mm / _FILM_WIDTH_MM


def _focal_in_sizes_from_sensor(details: Mapping[int, Any], make: str, model: str) -> float | None:
    focal_mm, width_mm = _number(details.get(_FOCAL_LENGTH)), sensor_width_mm(make, model)
    return None if focal_mm is None or width_mm is None else focal_mm / width_mm


def _focal_in_sizes_from_plane(details: Mapping[int, Any], size_px: int) -> float | None:
    """Focal length divided by the longer side, from pixels per unit on the sensor."""
    focal_mm, resolution = (
        _number(details.get(_FOCAL_LENGTH)),
        _number(details.get(_FOCAL_PLANE_X_RESOLUTION)),
    )
    if focal_mm is None or resolution is None:
        return None
    unit_mm = _UNIT_MM.get(int(_number(details.get(_FOCAL_PLANE_UNIT)) or 2), 25.4)
    described_px = max(_number(details.get(_PIXEL_WIDTH)) or 0.0, _number(details.get(_PIXEL_HEIGHT)) or 0.0)
    return focal_mm * resolution / unit_mm / (described_px if described_px > 0 else size_px)


def _block(exif: Image.Exif, tag: int) -> Mapping[int, Any]:
    try:
        return exif.get_ifd(tag)
    except EXIF_ERRORS:
        return {}


def _number(value: Any) -> float | None:
    if isinstance(value, tuple) and len(value) == 1:
        value = value[0]
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _text(value: Any) -> str:
    if isinstance(value, bytes):
        value = value.decode("latin-1")
    return value.split("\x00")[0].strip() if isinstance(value, str) else ""


def _signed_degrees(value: Any, reference: Any, negative: str, limit_deg: float) -> float | None:
    """Decimal degrees from (degrees, minutes, seconds); the reference letter gives the sign."""
    parts = [_number(part) for part in value] if isinstance(value, tuple) else [_number(value)]
    numbers = [part for part in parts if part is not None]
    if not 1 <= len(numbers) <= 3 or len(numbers) < len(parts):
        return None
    degrees = sum(part / 60.0**power for power, part in enumerate(numbers))
    degrees = -degrees if _text(reference).upper().startswith(negative) else degrees
    return degrees if abs(degrees) <= limit_deg else None


def _degrees_minutes_seconds(degrees: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    microseconds = round(abs(degrees) * 3600.0 * 1e6)
    minutes, rest = divmod(microseconds, 60_000_000)
    return IFDRational(minutes // 60, 1), IFDRational(minutes % 60, 1), IFDRational(rest, 1_000_000)
