"""Positions on Earth against radii of curvature, distances, pyproj and known places."""

import math

import numpy as np
import pytest

from epipole.errors import ConfigError
from epipole.geometry.geodesy import ecef_from_lat_lon_alt, lat_lon_alt_from_ecef
from epipole.scene import Georeference
from epipole.scene.georeference import gps_to_enu

SEMI_MAJOR_M, E2 = 6378137.0, 0.00669437999014


def radii_m(lat_deg):
    """Radii of curvature of the meridian and of the prime vertical."""
    w = math.sqrt(1.0 - E2 * math.sin(math.radians(lat_deg)) ** 2)
    return SEMI_MAJOR_M * (1.0 - E2) / w**3, SEMI_MAJOR_M / w


@pytest.mark.parametrize(
    ("lat", "lon"), [(0.0, 0.0), (55.7, 13.2), (-33.9, 151.2), (10.0, 180.0), (80.0, -179.9999)]
)
def test_enu_agrees_with_the_radii_of_curvature(lat, lon):
    step_deg, alt_m = 1e-3, 120.0
    meridian_m, vertical_m = radii_m(lat)
    east_m = math.radians(step_deg) * (vertical_m + alt_m) * math.cos(math.radians(lat))
    north_m = math.radians(step_deg) * (meridian_m + alt_m)
    steps = np.array([[0, 0, 0], [0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 5], [0, 0, -5]], float)
    table = np.array([lat, lon, alt_m]) + steps * [step_deg, step_deg, 1.0]
    table[:, 1] = (table[:, 1] + 180.0) % 360.0 - 180.0
    enu = gps_to_enu(table)
    expected = np.array(
        [[0, 0, 0], [east_m, 0, 0], [-east_m, 0, 0], [0, north_m, 0], [0, -north_m, 0], [0, 0, 5], [0, 0, -5]]
    )
    np.testing.assert_allclose(enu, expected, atol=0.01)


def test_enu_keeps_distances():
    rng = np.random.default_rng(3)
    table = np.column_stack([rng.uniform(47, 48, 20), rng.uniform(8, 9, 20), rng.uniform(0, 2000, 20)])
    lat, lon = np.radians(table[:, :2].T)
    n = SEMI_MAJOR_M / np.sqrt(1 - E2 * np.sin(lat) ** 2)
    ecef = np.column_stack(
        [
            (n + table[:, 2]) * np.cos(lat) * np.cos(lon),
            (n + table[:, 2]) * np.cos(lat) * np.sin(lon),
            (n * (1 - E2) + table[:, 2]) * np.sin(lat),
        ]
    )
    enu = gps_to_enu(table)
    distances = [np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (enu, ecef)]
    np.testing.assert_allclose(distances[0], distances[1], atol=1e-5)


def test_enu_with_missing_values():
    table = np.array([[50.0, 8.0, 100.0], [np.nan, 8.0, 100.0], [50.001, 8.0, np.nan], [50.0, 8.0, 100.0]])
    before = table.copy()
    enu = gps_to_enu(table)
    np.testing.assert_array_equal(table, before)
    assert np.isnan(enu[1]).all()
    assert enu[2, 1] == pytest.approx(math.radians(1e-3) * (radii_m(50.0)[0] + 100), abs=0.01)
    assert np.isnan(enu[2, 2])
    np.testing.assert_allclose(enu[[0, 3]], 0.0, atol=1e-9)
    assert gps_to_enu(np.zeros((0, 3))).shape == (0, 3)
    assert np.isnan(gps_to_enu(np.full((2, 3), np.nan))).all()
    without_altitude = gps_to_enu(np.array([[50.0, 8.0, np.nan], [50.001, 8.0, np.nan]]))
    assert np.isfinite(without_altitude[:, :2]).all()
    assert np.isnan(without_altitude[:, 2]).all()


@pytest.mark.parametrize("lat_deg", [-90.0, -60.0, 0.0, 1e-9, 45.0, 89.999999, 90.0])
def test_geodetic_coordinates_there_and_back(lat_deg):
    table = np.array([[lat_deg, lon, alt] for lon in (-179.5, 0.0, 11.6) for alt in (-400.0, 0.0, 9000.0)])
    back = lat_lon_alt_from_ecef(ecef_from_lat_lon_alt(table))
    np.testing.assert_allclose(back[:, [0, 2]], table[:, [0, 2]], atol=2e-8)
    if abs(lat_deg) < 90:
        np.testing.assert_allclose(back[:, 1], table[:, 1], atol=1e-7)


def test_points_there_and_back_within_a_micrometer():
    origin = Georeference(48.2, 11.6, 520.0)
    points = np.random.default_rng(0).uniform(-5000.0, 5000.0, (50, 3))
    np.testing.assert_allclose(origin.enu_of(origin.lat_lon_alt_of(points)), points, atol=1e-6)


def test_earth_centered_coordinates_agree_with_pyproj():
    pyproj = pytest.importorskip("pyproj")
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")
    table = np.array([[48.2, 11.6, 520.0], [-33.9, 151.2, 3.0], [78.0, -15.0, -20.0]])
    np.testing.assert_allclose(ecef_from_lat_lon_alt(table).T, to_ecef.transform(*table.T), atol=1e-6)


@pytest.mark.parametrize("wrong", [(91.0, 0.0, 0.0), (0.0, 400.0, 0.0), (0.0, 0.0, 2e6), (np.nan, 0.0, 0.0)])
def test_an_origin_must_be_on_earth(wrong):
    with pytest.raises(ConfigError, match=r"not a latitude|must be a number"):
        Georeference(*wrong)


def test_no_position_gives_no_origin():
    assert Georeference.about(np.full((3, 3), np.nan)) is None
