"""Control points in the formats of OpenSfM and OpenDroneMap, and coordinate systems."""

import sys

import numpy as np
import pytest

from epipole.errors import FileFormatError, MissingDependencyError
from epipole.io.georeference import read_georeference, write_georeference
from epipole.io.survey.control_points import read_control_points
from epipole.io.survey.coordinate_systems import coordinate_system_of, coordinates_of, lat_lon_alt_of
from epipole.scene import Georeference

LIST = """WGS84
# a comment
13.4007407457 52.519134104 12.0792090446 2639.18 938.06 02.jpg
13.4007407457 52.519134104 12.0792090446 2335.03 1416.73 01.jpg
13.400502446 52.5192511585 NaN 711.23 616.36 02.jpg
"""
NAMED = """+proj=utm +zone=35 +ellps=WGS84 +datum=WGS84 +units=m +no_defs
518876.902\t4453173.463\t262.223\t2451\t542\t100_0030_0001.JPG\tYKN6
518876.902\t4453173.463\t262.223\t2598\t1307\t100_0030_0002.JPG\tYKN6\textra
518838.142\t4453136.888\t258.616\t2485\t458\t100_0030_0003.JPG\tCHK-YKN4
"""
JSON = """{"points": [
 {"id": "7", "position": {"latitude": 52.519, "longitude": 13.4, "altitude": 14.9},
  "observations": [{"shot_id": "01.jpg", "projection": [-0.004, -0.035]}]},
 {"id": "8", "observations": [{"shot_id": "01.jpg", "projection": [0.1, 0.2]}]},
 {"id": "9", "position": {"latitude": 52.52, "longitude": 13.41}, "observations": []}]}"""


def read(tmp_path, text: str):
    path = tmp_path / "gcp_list.txt"
    path.write_text(text)
    return read_control_points(path)


def test_a_list_without_names(tmp_path):
    found = read(tmp_path, LIST)
    assert found.name == ("point 1", "point 2") and found.crs == "" and not found.is_check.any()
    np.testing.assert_array_equal(found.point, [0, 0, 1])
    assert found.image == ("02.jpg", "01.jpg", "02.jpg") and not found.is_normalized
    np.testing.assert_array_equal(found.coordinates[1], [13.400502446, 52.5192511585, np.nan])
    np.testing.assert_array_equal(found.pixels[0], [2639.18, 938.06])


def test_a_list_with_names_and_check_points(tmp_path):
    found = read(tmp_path, NAMED)
    assert found.name == ("YKN6", "CHK-YKN4") and found.is_check.tolist() == [False, True]
    assert found.crs.startswith("+proj=utm")


def test_points_of_opensfm(tmp_path):
    found = read(tmp_path, JSON)
    assert found.name == ("7", "9") and found.is_normalized
    np.testing.assert_array_equal(found.coordinates[0], [13.4, 52.519, 14.9])
    assert np.isnan(found.coordinates[1, 2]) and found.image == ("01.jpg",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it is empty"),
        ("13.4 52.5 12 1 2 a.jpg\n", "line 1 must name the coordinate system"),
        ("WGS84\n", "no control points"),
        ("WGS84\n13.4 52.5 12 1 a.jpg\n", "line 2: expected x y z pixel_x pixel_y image"),
        ("WGS84\n13.4 x 12 1 2 a.jpg\n", "line 2: 'x' is not a finite number"),
        ("WGS84\n13.4 52.5 12 nan 2 a.jpg\n", "line 2: 'nan' is not a finite number"),
        (
            "WGS84\n13.4 52.5 12 1 2 a.jpg P\n13.5 52.5 12 1 2 b.jpg P\n",
            "line 3: the point P has the coordinates 13.5",
        ),
        ("WGS84\n13.4 52.5 12 1 2 a.jpg P\n13.4 52.5 12 1 2 b.jpg Q\n", "P and Q have the same coordinates"),
        (
            "WGS84\n13.4 52.5 12 1 2 a.jpg P\n13.4 52.5 12 3 4 a.jpg P\n",
            "line 3: the point P in a.jpg is given twice",
        ),
        ("NAD27\n13.4 52.5 12 1 2 a.jpg\n", "got 'NAD27'"),
        ("WGS84 UTM 61N\n13.4 52.5 12 1 2 a.jpg\n", "must name the coordinate system"),
        ('{"points": 3}', "expected"),
        ('{"points": [{"id": "a", "position": {"latitude": 1}}]}', "'None' is not a finite number"),
        ('{"points": [{"id": "a", "position": 3}]}', "latitude and longitude"),
    ],
)
def test_malformed_files_are_named(tmp_path, text, message):
    with pytest.raises(FileFormatError, match=message):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("words", "crs"),
    [
        ("WGS84", ""),
        (" wgs 84 ", ""),
        ("EPSG:4326", ""),
        ("WGS84 UTM 32N", "EPSG:32632"),
        ("WGS 84 / UTM zone 5S", "EPSG:32705"),
        ("epsg:25832", "EPSG:25832"),
        ("LOCAL", "LOCAL"),
    ],
)
def test_coordinate_systems(words, crs):
    assert coordinate_system_of("x", words) == crs


def test_projections_there_and_back():
    pytest.importorskip("pyproj")
    table = np.array([[48.2, 11.6, 520.0], [48.3, 11.7, np.nan]])
    for crs in ("", "EPSG:32632", "EPSG:25832", "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs"):
        np.testing.assert_allclose(lat_lon_alt_of("x", coordinates_of(table, crs), crs), table, atol=1e-9)
    np.testing.assert_allclose(
        coordinates_of(table, "EPSG:32632")[0, :2], [693190.164, 5341798.526], atol=0.01
    )


def test_coordinates_that_cannot_be_are_refused():
    with pytest.raises(FileFormatError, match="longitude comes before latitude"):
        lat_lon_alt_of("x", np.array([[52.5, 113.4, 10.0]]), "")
    pytest.importorskip("pyproj")
    with pytest.raises(FileFormatError, match="pyproj does not know"):
        lat_lon_alt_of("x", np.zeros((1, 3)), "EPSG:999999")
    for crs in ("+proj=utm +zone=33 +vunits=us-ft", "EPSG:4978"):
        with pytest.raises(FileFormatError, match=r"not in meters|geocentric"):
            lat_lon_alt_of("x", np.zeros((1, 3)), crs)
    with pytest.raises(FileFormatError, match="US survey foot: convert"):
        lat_lon_alt_of("x", np.zeros((1, 3)), "EPSG:2263")


def test_without_pyproj_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(MissingDependencyError, match=r"epipole\[survey\]"):
        lat_lon_alt_of("x", np.zeros((1, 3)), "EPSG:32632")


def test_a_georeference_there_and_back(tmp_path):
    origin = Georeference(48.2, 11.6, 520.5, "EPSG:32632")
    write_georeference(tmp_path / "georeference.json", origin)
    assert read_georeference(tmp_path / "georeference.json") == origin


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "must be an object"),
        ('{"lat_deg": 1, "lon_deg": 2}', "alt_m of the georeference must be a number"),
        (
            '{"lat_deg": 1, "lon_deg": 2, "alt_m": 3, "sigma_m": [1, 2]}',
            "sigma_m of the georeference must be three",
        ),
        ('{"lat_deg": 1, "lon_deg": 2, "alt_m": 3, "sigma_m": [1, 2, -1]}', "sigma_m must not be negative"),
        ('{"lat_deg": 100, "lon_deg": 2, "alt_m": 3}', "not a latitude"),
        ('{"lat_deg": 1, "lon_deg": 2, "alt_m": 3, "axes": "north, east, down"}', "unknown axes"),
        ('{"lat_deg": 1, "lon_deg": 2, "alt_m": 3, "crs": 5}', "crs of the georeference"),
        ('{"lat_deg": true, "lon_deg": 2, "alt_m": 3}', "lat_deg of the georeference"),
    ],
)
def test_damaged_georeferences_are_named(tmp_path, text, message):
    path = tmp_path / "georeference.json"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_georeference(path)
