"""Contour lines of height rasters: lines of surfaces that are known, and GeoPackage files read back."""

import resource
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyogrio
import pytest

from epipole.errors import ConfigError, MissingDependencyError, ShapeError, WorkspaceError
from epipole.io.survey.contours import (
    contour_lines,
    default_interval,
    require_contours,
    write_contours,
)
from epipole.io.survey.rasters import Raster
from whole import in_whole_run

UTM = {"x_min": 500_000.0, "y_max": 5_300_000.0, "resolution_m": 0.5, "crs": "EPSG:32632"}


def raster(height: int, width: int, surface: str = "cone", **changes: object) -> Raster:
    """Heights at the centers of pixels, by their x and y from the lower left corner of the raster."""
    size = UTM["resolution_m"]
    x = (np.arange(width) + 0.5) * size
    y = (height - 0.5 - np.arange(height)[:, None]) * size
    cone = 100.0 - np.hypot(x - width * size / 2, y - height * size / 2)
    plane = 20.0 + 0.5 * x + 0.25 * y
    values = (cone if surface == "cone" else plane).astype(np.float32)
    return Raster(values, **{**UTM, **changes})


def read(path: Path) -> tuple[dict, list[np.ndarray], np.ndarray]:
    """Metadata, points and elevations, from well-known binary."""
    meta, _, geometry, (elevations,) = pyogrio.raw.read(path)
    lines = []
    for data in geometry:
        assert data[:5] == b"\x01\x02\0\0\0"  # little-endian two-dimensional line string
        count = int.from_bytes(data[5:9], "little")
        assert len(data) == 9 + 16 * count
        lines.append(np.frombuffer(data, "<f8", offset=9).reshape(-1, 2))
    return meta, lines, elevations


def length(points: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def area(points: np.ndarray) -> float:
    """Positive if counterclockwise."""
    x, y = (points - points[0]).T
    return float(x[:-1] @ y[1:] - x[1:] @ y[:-1]) / 2


def test_contours_of_a_cone_are_circles(tmp_path: Path) -> None:
    write_contours(tmp_path / "a.gpkg", raster(200, 240), 10.0)
    meta, lines, elevations = read(tmp_path / "a.gpkg")
    middle = np.array([UTM["x_min"] + 60.0, UTM["y_max"] - 50.0])
    complete = {}
    for points, elevation in zip(lines, elevations, strict=True):
        distances = np.linalg.norm(points - middle, axis=1)
        np.testing.assert_allclose(distances, 100.0 - elevation, atol=0.02)
        if (points[0] == points[-1]).all():
            complete[elevation] = points
    assert sorted(complete) == [60.0, 70.0, 80.0, 90.0]  # the circle of 50 m leaves the raster
    for elevation, points in complete.items():
        radius = 100.0 - elevation
        assert length(points) == pytest.approx(2 * np.pi * radius, rel=1e-3)
        assert area(points) == pytest.approx(-np.pi * radius**2, rel=1e-3), "higher ground is on the right"
    assert set(elevations) == {30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0}
    assert meta["crs"] == "EPSG:32632" and list(meta["fields"]) == ["elevation"]
    assert meta["geometry_type"] == "LineString" and meta["dtypes"] == ["float64"]
    assert [path.name for path in tmp_path.iterdir()] == ["a.gpkg"]
    assert pyogrio.list_layers(tmp_path / "a.gpkg").tolist() == [["contours", "LineString"]]


def test_contours_of_a_plane_are_straight() -> None:
    plane = raster(61, 81, "plane")
    lines = contour_lines(plane, 2.5)
    assert [line.elevation for line in lines] == [22.5 + 2.5 * k for k in range(len(lines))]
    assert len(lines) == 11
    for line in lines:
        x, y = (line.points - [plane.x_min, plane.y_max - 61 * plane.resolution_m]).T
        np.testing.assert_allclose(20 + 0.5 * x + 0.25 * y, line.elevation, atol=1e-5)
        ends = line.points[[0, -1]] - [plane.x_min, plane.y_max]
        on_edge = np.isclose(ends, [0.25, -0.25]) | np.isclose(ends, [40.25, -30.25])
        assert on_edge.any(axis=1).all(), "lines end at the centers of the outermost pixels"
        assert length(line.points) == pytest.approx(np.linalg.norm(ends[1] - ends[0]), abs=1e-4)


def test_areas_without_data_have_no_lines() -> None:
    plane = raster(61, 81, "plane")
    values = plane.values.copy()
    values[20:40, 30:60] = np.nan
    values[5, 70] = np.nan
    found = contour_lines(Raster(values, **UTM), 0.5)
    assert len(found) > len(contour_lines(plane, 0.5))
    for line in found:
        column, row = ((line.points - [plane.x_min, plane.y_max]) / [0.5, -0.5] - 0.5).T
        assert not ((column > 29.001) & (column < 59.999) & (row > 19.001) & (row < 39.999)).any()
        assert not ((np.abs(column - 70) < 0.999) & (np.abs(row - 5) < 0.999)).any()
        middle = (line.points[1:] + line.points[:-1]) / 2
        column, row = ((middle - [plane.x_min, plane.y_max]) / [0.5, -0.5] - 0.5).T
        assert not ((column > 29) & (column < 60) & (row > 19) & (row < 40)).any()
    values[:] = np.nan
    values[::2, ::2] = plane.values[::2, ::2]  # no four neighbors are known
    assert contour_lines(Raster(values, **UTM), 0.5) == []


def test_heights_equal_to_a_level() -> None:
    values = np.full((9, 9), 5.0, np.float32)
    assert contour_lines(Raster(values, **UTM), 5.0) == []
    values[4, 4] = 10.0
    (line,) = contour_lines(Raster(values, **UTM), 5.0)  # around the peak; none at its top
    assert line.elevation == 5.0 and (line.points[0] == line.points[-1]).all()
    values[:] = 7.0
    values[4, 4] = 5.0
    assert contour_lines(Raster(values, **UTM), 5.0) == [], "a pit at a level is no line"
    for shape in ((1, 1), (1, 9), (9, 1)):
        values = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
        assert contour_lines(Raster(values, **UTM), 2.0) == []


def test_levels_are_multiples_without_rounding_errors() -> None:
    x = np.linspace(-0.55, 1.25, 50)
    values = np.tile(x, (3, 1)).astype(np.float32)
    found = [line.elevation for line in contour_lines(Raster(values, **UTM), 0.1)]
    assert found == [float(f"{k / 10:.1f}") for k in range(-5, 13)]


@pytest.mark.parametrize("crs", ["EPSG:2056", "EPSG:25832", None])
def test_coordinate_systems_are_read_back(tmp_path: Path, crs: str | None) -> None:
    write_contours(tmp_path / "a.gpkg", raster(20, 20, crs=crs), 1.0)
    meta, lines, _ = read(tmp_path / "a.gpkg")
    assert meta["crs"] == crs and lines


def test_coordinate_systems_without_a_number(tmp_path: Path) -> None:
    crs = "+proj=tmerc +lat_0=47 +lon_0=8.5 +k=1 +x_0=0 +y_0=0 +ellps=GRS80 +units=m +type=crs"
    write_contours(tmp_path / "a.gpkg", raster(20, 20, crs=crs), 1.0)
    assert "47" in read(tmp_path / "a.gpkg")[0]["crs"]
    write_contours(tmp_path / "b.gpkg", raster(20, 20, crs="EPSG:25832+5783"), 1.0)
    assert "25832" in read(tmp_path / "b.gpkg")[0]["crs"]


def test_files_are_geopackages_and_are_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.gpkg"
    path.write_text("old")
    write_contours(path, raster(20, 20), 1.0)
    with sqlite3.connect(path) as found:
        (application,) = found.execute("PRAGMA application_id").fetchone()
        rows = found.execute("SELECT table_name, data_type, srs_id FROM gpkg_contents").fetchall()
        bounds = found.execute("SELECT min_x, min_y, max_x, max_y FROM gpkg_contents").fetchone()
    found.close()
    assert application == 0x47504B47 and rows == [("contours", "features", 32632)]
    np.testing.assert_allclose(bounds, [500_000.3, 5_299_990.3, 500_009.7, 5_299_999.7], atol=0.5)


def test_no_level_between_the_heights_gives_an_empty_layer(tmp_path: Path) -> None:
    values = np.linspace(3.1, 3.9, 100, dtype=np.float32).reshape(10, 10)
    write_contours(tmp_path / "a.gpkg", Raster(values, **UTM), 5.0)
    meta, lines, _ = read(tmp_path / "a.gpkg")
    assert lines == [] and meta["crs"] == "EPSG:32632" and list(meta["fields"]) == ["elevation"]


@pytest.mark.parametrize(
    ("lowest", "highest", "interval"),
    [
        (0.0, 40.0, 1.0),
        (400.0, 440.0, 1.0),
        (0.0, 41.0, 2.0),
        (-3.0, 77.0, 2.0),
        (0.0, 81.0, 5.0),
        (100.0, 300.0, 5.0),
        (0.0, 201.0, 10.0),
        (0.0, 1.0, 0.05),
        (0.0, 4000.0, 100.0),
        (7.0, 7.0, 1.0),
    ],
)
def test_default_intervals(lowest: float, highest: float, interval: float) -> None:
    values = np.array([[lowest, np.nan], [np.nan, highest]], np.float32)
    assert default_interval(Raster(values, **UTM)) == interval


@pytest.mark.parametrize("spread", np.geomspace(1e-3, 9e3, 40))
def test_default_intervals_give_16_to_40_levels(spread: float) -> None:
    values = np.array([[0.0, spread]], np.float32)
    interval = default_interval(Raster(values, **UTM))
    assert 16 * 0.999 <= spread / interval <= 40 * 1.001
    assert f"{interval:e}"[0] in "125"


@pytest.mark.parametrize("interval", [0.0, -1.0, float("nan"), float("inf")])
def test_intervals_must_be_positive(tmp_path: Path, interval: float) -> None:
    with pytest.raises(ConfigError, match="interval must be"):
        write_contours(tmp_path / "a.gpkg", raster(9, 9), interval)
    assert not list(tmp_path.iterdir())


def test_wrong_rasters_and_too_many_levels(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"0\.0001 m gives .* at most 5000 .* at least 0\.00"):
        write_contours(tmp_path / "a.gpkg", raster(9, 9), 1e-4)
    nothing = Raster(np.full((9, 9), np.nan, np.float32), **UTM)
    colors = Raster(np.zeros((9, 9, 3), np.uint8), **UTM)
    for wrong, words in ((nothing, "no known height"), (colors, "got colors")):
        with pytest.raises(ShapeError, match=words):
            write_contours(tmp_path / "a.gpkg", wrong, 1.0)
        with pytest.raises(ShapeError, match=words):
            default_interval(wrong)
    for crs in ("EPSG:1", "nonsense"):
        with pytest.raises(ConfigError, match="use a code such as EPSG:32632"):
            write_contours(tmp_path / "a.gpkg", raster(9, 9, crs=crs), 1.0)
    assert not list(tmp_path.iterdir())
    with pytest.raises(WorkspaceError, match="it is a folder"):
        write_contours(tmp_path, raster(9, 9), 1.0)
    (tmp_path / "file").write_text("")
    with pytest.raises(WorkspaceError, match="cannot write"):
        write_contours(tmp_path / "file" / "a.gpkg", raster(9, 9), 1.0)


FULL = """
import resource, signal, sys
import numpy as np
from epipole.errors import WorkspaceError
from epipole.io.survey.contours import write_contours
from epipole.io.survey.rasters import Raster
values = np.random.default_rng(0).normal(size=(500, 500)).astype(np.float32)
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
try:
    write_contours(sys.argv[1], Raster(values, 0.0, 0.0, 1.0), 1.0)
except WorkspaceError as error:
    print("refused:", error)
"""


@in_whole_run
@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="no limit of file sizes")
def test_a_full_disk_leaves_no_file(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path / "a.gpkg")], capture_output=True, text=True
    )
    assert "refused: cannot write" in done.stdout, done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["contourpy", "pyogrio"])
def test_without_a_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    for call in (lambda: write_contours(tmp_path / "a.gpkg", raster(9, 9), 1.0), require_contours):
        with pytest.raises(MissingDependencyError, match=r"pip install 'epipole\[survey\]'"):
            call()
    assert not list(tmp_path.iterdir())
