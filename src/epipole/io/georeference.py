"""georeference.json beside a model: the origin of its east-north-up coordinates on Earth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from epipole._checks import checked
from epipole.errors import ConfigError, FileFormatError
from epipole.io.atomic import atomic_write
from epipole.io.files import read_json
from epipole.io.json_files import json_text
from epipole.scene import Georeference

GEOREFERENCE = "georeference.json"
_NUMBERS = ("lat_deg", "lon_deg", "alt_m")
AXES = "east, north, up"
SIGMA = "sigma_m"
_LARGEST = 1e12
"""Larger numbers are none of a position on Earth; integers in JSON may be larger than any float."""


@checked
def georeference_fields(georeference: Georeference) -> dict[str, Any]:
    """The content of the file, which other formats can include, too."""
    fields: dict[str, Any] = {
        "lat_deg": georeference.lat_deg,
        "lon_deg": georeference.lon_deg,
        "alt_m": georeference.alt_m,
        "axes": AXES,
        "crs": georeference.crs,
    }
    return fields if georeference.sigma_m is None else fields | {SIGMA: list(georeference.sigma_m)}


@checked
def georeference_of_fields(path: str | Path, content: Any) -> Georeference:
    """The position on Earth from the content of a file.

    Args:
        path: the file, for error messages.
        content: as in `georeference_fields`.

    Raises:
        FileFormatError: a number is missing or out of range, or the axes are others.
    """
    if not isinstance(content, dict):
        raise FileFormatError(path, "the georeference must be an object with lat_deg, lon_deg and alt_m")
    for name in _NUMBERS:
        number = content.get(name)
        if not _is_number(number):
            raise FileFormatError(path, f"{name} of the georeference must be a number, got {number!r}")
    axes, crs = content.get("axes", AXES), content.get("crs", "")
    if axes != AXES:
        raise FileFormatError(path, f"unknown axes {axes!r} of the georeference: only {AXES!r} is supported")
    if not isinstance(crs, str):
        raise FileFormatError(path, f"crs of the georeference must be text, got {crs!r}")
    sigma_m = content.get(SIGMA)
    if sigma_m is not None and not (
        isinstance(sigma_m, list) and len(sigma_m) == 3 and all(map(_is_number, sigma_m))
    ):
        raise FileFormatError(path, f"{SIGMA} of the georeference must be three numbers, got {sigma_m!r}")
    try:
        return Georeference(
            float(content["lat_deg"]),
            float(content["lon_deg"]),
            float(content["alt_m"]),
            crs,
            None if sigma_m is None else (float(sigma_m[0]), float(sigma_m[1]), float(sigma_m[2])),
        )
    except ConfigError as error:
        raise FileFormatError(path, str(error)) from error


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= _LARGEST


@checked
def write_georeference(path: str | Path, georeference: Georeference) -> None:
    """Write the file.

    Raises:
        WorkspaceError: it cannot be written.
    """
    with atomic_write(Path(path)) as aside:
        aside.write_text(json_text(georeference_fields(georeference)), encoding="utf-8")


@checked
def read_georeference(path: str | Path) -> Georeference:
    """Read the file.

    Raises:
        FileFormatError: it is missing or damaged.
    """
    return georeference_of_fields(path, read_json(Path(path)))
