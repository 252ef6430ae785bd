"""Conversion of images with more than 8 bits per channel to 8 bits.

Files do not record which values are black and white. Sensors with 10, 12 and 14 bits use 16-bit files, most often the
lower bits:

- color, and gray in recordings: the largest value determines the sensor's bits (8, 10, 12, 14 or 16), of which the
  upper 8 are kept. All channels, and all images of such a sensor, are thus mapped alike;
- gray in files: the 0.1 and 99.9 percentiles of the image, or of a set of images (`common_range`), become 0 and 255.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL.ImageFile import ImageFile

from epipole.errors import ConfigError

SENSOR_BITS = (8, 10, 12, 14, 16)
"""Bit depths of sensors whose values are stored in 16 bits."""
FEWEST_LEVELS = 64
"""Gray that spans fewer of the 256 levels after a shift is stretched instead (thermal cameras)."""

_MOST_SAMPLES = 1_000_000
_PERCENTILES = (0.1, 99.9)
_SWAPPED = {"16B": "16L", "16L": "16B", "16N": "16B" if sys.byteorder == "little" else "16L"}
"""Raw modes that return the lower instead of the upper byte."""
_PPM_16 = "ppm", ("RGB", 65535)
_GRAY_ALPHA = "LA;16B"
"""Has no byte-swapped variant: decoded as RGBA, whose four bytes are those of gray and alpha, upper byte first."""


class GrayRange(NamedTuple):
    """The values that become 0 and 255."""

    low: float
    high: float


class GrayScale(NamedTuple):
    """Conversion of a recording's gray to 8 bits."""

    bits: int
    """Bit depth of the sensor."""
    limits: GrayRange | None
    """None: keep the upper 8 of the sensor's bits."""

    def apply(self, deep: np.ndarray) -> UInt8[np.ndarray, "h w *channels"]:
        """Convert to 8-bit gray; an image with values above the sensor's range keeps its own upper 8 bits."""
        if self.limits is not None:
            return stretched(deep, self.limits)
        return upper_bits(deep, max(self.bits, sensor_bits(int(deep.max(initial=0)))))

    @property
    def range(self) -> GrayRange:
        """The values that become 0 and 255."""
        return GrayRange(0.0, float((1 << self.bits) - 1)) if self.limits is None else self.limits


def scale_of(images: Sequence[np.ndarray]) -> GrayScale:
    """Determine the conversion of a recording from some of its images."""
    bits = sensor_bits(max((int(deep.max(initial=0)) for deep in images), default=0))
    sample = np.concatenate([sample_of(deep) for deep in images]) if images else np.empty(0)
    low, high = np.percentile(sample, _PERCENTILES).tolist() if len(sample) else (0.0, 0.0)
    is_narrow = bits > 8 and 0.0 < high - low < FEWEST_LEVELS << (bits - 8)
    return GrayScale(bits, GrayRange(low, high) if is_narrow else None)


def sample_of(deep: np.ndarray) -> np.ndarray:
    """The finite values of every k-th pixel, about a million at most."""
    values = deep.ravel()[:: max(1, deep.size // _MOST_SAMPLES)].astype(np.float32)
    return values[np.isfinite(values)]


def range_of(sample: np.ndarray, dtype: np.dtype) -> GrayRange:
    """The 0.1 and 99.9 percentiles; the full range of the type (0 to 1 for floats) if they are equal."""
    low, high = np.percentile(sample, _PERCENTILES) if len(sample) else (0.0, 0.0)
    if high <= low:
        return GrayRange(0.0, float(np.iinfo(dtype).max) if dtype.kind in "iu" else 1.0)
    return GrayRange(float(low), float(high))


def check_range(limits: GrayRange | None) -> None:
    """Check a range of gray values.

    Raises:
        ConfigError: the range is empty or infinite.
    """
    if limits is not None and not 0.0 < limits.high - limits.low < float("inf"):
        raise ConfigError(f"limits must be a finite range of gray, got {limits.low:g} to {limits.high:g}")


def stretched(deep: np.ndarray, limits: GrayRange | None = None) -> UInt8[np.ndarray, "h w *channels"]:
    """Gray with the given range (default: its own percentiles) mapped to 0 to 255."""
    low, high = range_of(sample_of(deep), deep.dtype) if limits is None else limits
    with np.errstate(over="ignore", invalid="ignore"):  # float images can contain any number
        scaled = (deep.astype(np.float32) - np.float32(low)) * np.float32(255.0 / (high - low))
    return np.clip(np.rint(np.nan_to_num(scaled, nan=0.0)), 0, 255).astype(np.uint8)


def sensor_bits(largest: int) -> int:
    """The smallest bit depth of a sensor that can produce the value `largest`."""
    return next(bits for bits in SENSOR_BITS if largest < 1 << bits or bits == SENSOR_BITS[-1])


def upper_bits(deep: np.ndarray, bits: int) -> UInt8[np.ndarray, "*shape"]:
    """The upper 8 bits of values with `bits` bits; larger values become 255."""
    return np.minimum(deep >> (bits - 8), 255).astype(np.uint8)


def color_16(
    reader: Callable[..., ImageFile], stream: Any, upper: UInt8[np.ndarray, "h w c"]
) -> UInt8[np.ndarray, "h w c"]:
    """Convert a color image with 16 bits per channel to its 8 significant bits.

    Pillow returns the upper byte of each channel. If the sensor had fewer bits, the image is decoded again for the
    lower bytes.

    Args:
        reader: Pillow's reader of the format.
        stream: the file.
        upper: the upper bytes of three color channels and alpha, if any.
    """
    stream.seek(0)
    image = reader(stream)
    if image.format == "PPM":
        values = _ppm_values(image, stream)
    elif upper[..., :3].max(initial=0) >= 64:  # 14 bits and more
        return upper
    else:
        values = upper.astype(np.uint16) << 8 | _lower(image)
    out = upper_bits(values, sensor_bits(int(values[..., :3].max(initial=0))))
    if upper.shape[2] == 4 and upper[..., 3].max(initial=0) >= 64:
        out[..., 3] = upper[..., 3]
    return out


def has_16_bits(image: ImageFile) -> bool:
    """Whether a color image that is not loaded yet has 16 bits per channel, of which Pillow returns 8."""
    if image.format == "PPM":
        return image.mode == "RGB" and [(tile.codec_name, tile.args) for tile in image.tile] == [_PPM_16]
    modes = [_raw_mode(tile.args) for tile in image.tile]
    return bool(modes) and all(mode[-3:] in _SWAPPED for mode in modes) and image.mode in ("RGB", "RGBA")


def _raw_mode(args: Any) -> str:
    mode = args[0] if isinstance(args, tuple) and args else args
    return mode if isinstance(mode, str) else ""


def _lower(image: ImageFile) -> UInt8[np.ndarray, "h w c"]:
    """The lower bytes, read with raw modes of the opposite byte order."""
    is_gray = any(_raw_mode(tile.args) == _GRAY_ALPHA for tile in image.tile)
    image.tile = [tile._replace(args=_swapped(tile.args)) for tile in image.tile]
    lower = np.asarray(image)
    return lower[..., [1, 1, 1, 3]] if is_gray else lower


def _swapped(args: Any) -> Any:
    mode = _raw_mode(args)
    swapped = "RGBA" if mode == _GRAY_ALPHA else mode[:-3] + _SWAPPED[mode[-3:]]
    return (swapped, *args[1:]) if isinstance(args, tuple) else swapped


def _ppm_values(image: ImageFile, stream: Any) -> np.ndarray:
    stream.seek(image.tile[0].offset)
    shape = image.height, image.width, 3
    return np.frombuffer(stream.read(2 * math.prod(shape)), ">u2").reshape(shape)
