"""Position of a model on Earth: the origin of its east-north-up coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from epipole._checks import as_points, check_fields, checked
from epipole.errors import ConfigError
from epipole.geometry.geodesy import (
    ecef_from_lat_lon_alt,
    enu_from_ecef_rotation,
    lat_lon_alt_from_ecef,
)


@dataclass(frozen=True, slots=True)
class Georeference:
    """World coordinates are meters east, north and up of an origin, with the axes at that origin (WGS84)."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    """Height of the origin, in the same vertical datum as the measurements that determined it."""
    crs: str = ""
    """Coordinate system of the control points, such as EPSG:32632; empty: WGS84 longitude and latitude."""
    sigma_m: tuple[float, float, float] | None = None
    """Standard deviations of a position in the model, east, north and up (the median over its images); None if unknown."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            ConfigError: not a position on Earth.
        """
        check_fields(self)
        if self.sigma_m is not None and not all(0 <= sigma < math.inf for sigma in self.sigma_m):
            raise ConfigError(f"sigma_m must not be negative, and finite, got {self.sigma_m}")
        if not (abs(self.lat_deg) <= 90.0 and abs(self.lon_deg) <= 360.0 and abs(self.alt_m) <= 1e6):
            raise ConfigError(
                f"not a latitude, longitude and altitude: {self.lat_deg}, {self.lon_deg}, {self.alt_m}"
            )

    @staticmethod
    @checked
    def about(lat_lon_alt: Float64[np.ndarray, "n 3"], crs: str = "") -> Georeference | None:
        """With the median of positions as the origin; None if no position is known.

        Args:
            lat_lon_alt: degrees, degrees, meters; NaN rows for unknown positions, NaN altitude if it is unknown.
            crs: coordinate system of the control points.
        """
        table = as_points(lat_lon_alt, "lat_lon_alt", 3)
        known = table[np.isfinite(table[:, :2]).all(axis=1)]
        if not len(known):
            return None
        lon_deg = known[0, 1] + np.median((known[:, 1] - known[0, 1] + 180.0) % 360.0 - 180.0)
        alt_m = known[np.isfinite(known[:, 2]), 2]
        origin_alt_m = float(np.median(alt_m)) if len(alt_m) else 0.0
        return Georeference(float(np.median(known[:, 0])), float(lon_deg), origin_alt_m, crs)

    @checked
    def enu_of(self, lat_lon_alt: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Meters east, north and up of the origin: R (p_ecef - o_ecef).

        Args:
            lat_lon_alt: degrees, degrees, meters. A row without position (NaN) stays NaN; a row without altitude is
                at the altitude of the origin, and its "up" is NaN.
        """
        table = as_points(lat_lon_alt, "lat_lon_alt", 3).copy()
        has_alt = np.isfinite(table[:, 2])
        table[~has_alt, 2] = self.alt_m
        enu = (ecef_from_lat_lon_alt(table) - self._origin_in_ecef()) @ self._enu_from_ecef().T
        enu[~np.isfinite(table[:, :2]).all(axis=1)] = np.nan
        enu[~has_alt, 2] = np.nan
        return enu

    @checked
    def lat_lon_alt_of(self, points_enu: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Latitude and longitude in degrees and altitude in meters, of points in meters east, north and up."""
        return lat_lon_alt_from_ecef(points_enu @ self._enu_from_ecef() + self._origin_in_ecef())

    def _origin_in_ecef(self) -> np.ndarray:
        return ecef_from_lat_lon_alt(np.array([[self.lat_deg, self.lon_deg, self.alt_m]]))[0]

    def _enu_from_ecef(self) -> np.ndarray:
        return enu_from_ecef_rotation(self.lat_deg, self.lon_deg)


@checked
def gps_to_enu(lat_lon_alt: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Meters east, north and up of the median position.

    Args:
        lat_lon_alt: degrees, degrees, meters; NaN as in `Georeference.enu_of`. Without any altitude, the origin is at 0 m.
    """
    origin = Georeference.about(lat_lon_alt)
    return np.full(np.shape(lat_lon_alt), np.nan) if origin is None else origin.enu_of(lat_lon_alt)
