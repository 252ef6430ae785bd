"""The header of LAZ files, its coordinate system, and the errors of laspy and lazrs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from epipole.errors import ConfigError, EpipoleError, FileFormatError, MissingDependencyError
from epipole.io.files import read_by_others

SIGMA = "sigma"
"""Name of the extra dimension with standard deviations."""
_POINT_FORMAT = 7
"""With 16-bit colors (LAS 1.4)."""


def laspy_module() -> Any:
    """The module laspy.

    Raises:
        MissingDependencyError: laspy or lazrs is not installed.
    """
    try:
        import laspy
        import laspy.point.record
        import lazrs  # noqa: F401 - laspy reports a missing backend only when it writes points
    except ImportError as error:
        problem = "LAZ files need the packages laspy and lazrs: pip install 'epipole[survey]'"
        raise MissingDependencyError(problem) from error
    return laspy


def _pyproj() -> Any:
    try:
        import pyproj
    except ImportError as error:
        problem = "coordinate systems of LAZ files need pyproj: pip install 'epipole[survey]'"
        raise MissingDependencyError(problem) from error
    return pyproj


def known_crs(crs: str | None) -> Any:
    """The coordinate system as a `pyproj.CRS`; None if it is unknown.

    Raises:
        ConfigError: pyproj does not know it.
        MissingDependencyError: pyproj is not installed.
    """
    if crs is None:
        return None
    pyproj = _pyproj()
    try:
        return pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.ProjError as error:
        raise ConfigError(f"crs is {crs[:80]!r}, which is unknown: use a code such as EPSG:32632") from error


def new_header(laspy: Any, step: float, offset: np.ndarray, system: Any, has_sigma: bool) -> Any:
    """The header of a new file.

    Args:
        laspy: the module.
        step: of the coordinates.
        offset: of the coordinates, (3,).
        system: the coordinate system as a `pyproj.CRS`, or None.
        has_sigma: whether points have standard deviations.
    """
    header = laspy.LasHeader(version="1.4", point_format=_POINT_FORMAT)
    header.scales, header.offsets = np.full(3, step), offset
    header.generating_software = "epipole"
    if has_sigma:
        words = "standard deviation in meters"
        header.add_extra_dim(laspy.ExtraBytesParams(SIGMA, "float32", description=words))
        described = header.vlrs.get("ExtraBytesVlr")[0].extra_bytes_structs[0]
        # laspy derives the optional minimum and maximum from the first point of each batch.
        described.options &= ~(described.MIN_BIT_MASK | described.MAX_BIT_MASK)
    if system is not None:
        header.add_crs(system)
        header.vlrs.get("WktCoordinateSystemVlr")[0].string = _wkt(system)
    return header


def _wkt(system: Any) -> str:
    """WKT 1, which LAS 1.4 specifies, or WKT 2 if the coordinate system cannot be written so."""
    try:
        return str(system.to_wkt("WKT1_GDAL") or system.to_wkt())
    except _pyproj().exceptions.ProjError:
        return str(system.to_wkt())


def crs_text(header: Any) -> str | None:
    """The coordinate system in a header: EPSG:number if it has one, else WKT; None if there is none.

    Raises:
        MissingDependencyError: pyproj is not installed.
    """
    if not header.vlrs.get_by_id("LASF_Projection"):
        return None
    _pyproj()
    crs = header.parse_crs()
    if crs is None:
        return None
    number = crs.to_epsg(min_confidence=100)
    return f"EPSG:{number}" if number is not None else str(crs.to_wkt())


@contextmanager
def written_by_lazrs() -> Iterator[None]:
    """Convert the exceptions of laspy and lazrs.

    Raises:
        OSError: the file cannot be written.
    """
    try:
        yield
    except (EpipoleError, OSError):
        raise
    except Exception as error:
        raise OSError(f"lazrs reports: {error}") from error


@contextmanager
def decoded_by_lazrs(path: Path) -> Iterator[None]:
    """Convert the exceptions of laspy and lazrs on damaged files, including panics of lazrs, which is written in Rust.

    Raises:
        FileFormatError: reading the file failed.
    """
    try:
        with read_by_others(path, "not a readable LAS or LAZ file"):
            yield
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise FileFormatError(path, "the compressed points are damaged") from error
