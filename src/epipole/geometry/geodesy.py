"""Positions on the WGS84 ellipsoid: geodetic, Earth-centered, and local east-north-up coordinates.

x = (N + h) cos(lat) cos(lon),  y = (N + h) cos(lat) sin(lon),  z = (N (1 - e^2) + h) sin(lat),
N = a / sqrt(1 - e^2 sin(lat)^2)                                (Torge, Geodesy, 2001, section 4.1)
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from epipole._checks import checked

SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
_E2 = FLATTENING * (2.0 - FLATTENING)
_ROUNDS = 5
"""Iterations for the latitude: each divides its error by about 1 / e^2 = 150, and it starts 0.003 rad off at most."""


@checked
def ecef_from_lat_lon_alt(lat_lon_alt: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Earth-centered coordinates in meters.

    Args:
        lat_lon_alt: latitude and longitude in degrees, height above the ellipsoid in meters; NaN rows stay NaN.
    """
    lat, lon, alt = np.deg2rad(lat_lon_alt[:, 0]), np.deg2rad(lat_lon_alt[:, 1]), lat_lon_alt[:, 2]
    n = SEMI_MAJOR_M / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    x, y = (n + alt) * np.cos(lat) * np.cos(lon), (n + alt) * np.cos(lat) * np.sin(lon)
    return np.stack([x, y, (n * (1.0 - _E2) + alt) * np.sin(lat)], axis=1)


@checked
def lat_lon_alt_from_ecef(ecef_m: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Latitude and longitude in degrees, and height above the ellipsoid in meters.

    The fixed point tan(lat) = (z + e^2 N sin(lat)) / p with p = |(x, y)| (Torge 2001, equation 4.31).

    Args:
        ecef_m: Earth-centered coordinates, less than thousands of kilometers from the ellipsoid.
    """
    x, y, z = ecef_m.T
    p = np.hypot(x, y)
    lat = np.arctan2(z, p * (1.0 - _E2))
    for _ in range(_ROUNDS):
        n = SEMI_MAJOR_M / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
        lat = np.arctan2(z + _E2 * n * np.sin(lat), p)
    # Along the normal of the ellipsoid, which is well defined at the poles, too.
    alt = p * np.cos(lat) + z * np.sin(lat) - SEMI_MAJOR_M * np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    return np.stack([np.rad2deg(lat), np.rad2deg(np.arctan2(y, x)), alt], axis=1)


@checked
def enu_from_ecef_rotation(lat_deg: float, lon_deg: float) -> Float64[np.ndarray, "3 3"]:
    """Rotation from Earth-centered axes to east, north and up at a latitude and longitude."""
    lat, lon = np.deg2rad(lat_deg), np.deg2rad(lon_deg)
    return np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )
