"""Point clouds as LAZ files, read back by laspy."""

import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import pytest

from epipole.errors import (
    ConfigError,
    FileFormatError,
    MissingDependencyError,
    ShapeError,
    WorkspaceError,
)
from epipole.io.survey.point_clouds import LazChunk, read_laz, write_laz, write_laz_chunks

UTM = np.array([500_000.0, 5_300_000.0, 400.0])
HALF_STEP_M = 0.5e-3


def cloud(n: int, extent: float = 800.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(n)
    return UTM + rng.uniform(0.0, extent, (n, 3)), rng.integers(0, 256, (n, 3), np.uint8)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    points, rgb = cloud(1000)
    sigma = np.linspace(0.001, 0.5, 1000, dtype=np.float32)
    sigma[7] = np.nan
    classes = np.arange(1000).astype(np.uint8)
    write_laz(tmp_path / "a.laz", points, rgb, crs="EPSG:32632", sigma=sigma, classification=classes)
    found = read_laz(tmp_path / "a.laz")
    np.testing.assert_allclose(found.points, points, rtol=0, atol=1.01 * HALF_STEP_M)
    np.testing.assert_array_equal(found.rgb, rgb)
    np.testing.assert_array_equal(found.sigma, sigma)
    np.testing.assert_array_equal(found.classification, classes)
    assert found.crs == "EPSG:32632" and len(found) == 1000
    assert [path.name for path in tmp_path.iterdir()] == ["a.laz"]


def test_a_file_for_other_programs(tmp_path: Path) -> None:
    points, rgb = cloud(600)
    sigma = np.linspace(0.5, 0.001, 600, dtype=np.float32)
    write_laz(tmp_path / "a.laz", points, rgb, crs="EPSG:32632", sigma=sigma)
    with laspy.open(tmp_path / "a.laz") as reader:
        header, found = reader.header, reader.read()
    assert str(header.version) == "1.4" and header.point_format.id == 7 and header.are_points_compressed
    assert header.parse_crs().to_epsg() == 32632 and header.global_encoding.wkt
    assert header.vlrs.get("WktCoordinateSystemVlr")[0].string.startswith("PROJCS[")  # WKT 1
    np.testing.assert_array_equal(header.scales, np.full(3, 0.001))
    np.testing.assert_array_equal(header.offsets, np.floor((points.min(axis=0) + points.max(axis=0)) / 2))
    np.testing.assert_allclose(found.xyz, points, rtol=0, atol=1.01 * HALF_STEP_M)
    np.testing.assert_allclose(header.maxs, points.max(axis=0), rtol=0, atol=1.01 * HALF_STEP_M)
    np.testing.assert_array_equal(found.red, rgb[:, 0] * np.uint16(257))
    np.testing.assert_array_equal(found["sigma"], sigma)
    assert header.number_of_points_by_return[0] == 600 and (np.asarray(found.number_of_returns) == 1).all()


@pytest.mark.parametrize("extent", [1e-9, 1e-6, 3e-3, 1.0, 77.0, 499.0, 5e3, 3.9e6, 1e12, 1e25])
@pytest.mark.parametrize("middle", [0.0, 0.4, -3.7, 5e6])
def test_coordinates_are_rounded_by_at_most_a_millionth_of_the_extent(
    tmp_path: Path, extent: float, middle: float
) -> None:
    points = middle + extent * np.random.default_rng(3).uniform(-0.5, 0.5, (200, 3))
    write_laz(tmp_path / "a.laz", points, np.zeros((200, 3), np.uint8))
    error = np.abs(read_laz(tmp_path / "a.laz").points - points).max()
    assert error <= 1e-6 * extent + 2 * np.spacing(abs(middle))
    assert extent > 4e6 or error <= 1.01 * HALF_STEP_M


def test_a_single_point_is_exact(tmp_path: Path) -> None:
    points = UTM[None] + 0.123456789
    write_laz(tmp_path / "a.laz", points, np.zeros((1, 3), np.uint8))
    np.testing.assert_array_equal(read_laz(tmp_path / "a.laz").points, points)


@pytest.mark.parametrize("with_sigma", [False, True])
def test_no_points_and_no_coordinate_system(tmp_path: Path, with_sigma: bool) -> None:
    sigma = np.zeros(0, np.float32) if with_sigma else None
    write_laz(tmp_path / "a.laz", np.zeros((0, 3)), np.zeros((0, 3), np.uint8), sigma=sigma)
    found = read_laz(tmp_path / "a.laz")
    assert len(found) == 0 and found.crs is None and (found.sigma is not None) == with_sigma
    assert laspy.read(tmp_path / "a.laz").header.point_count == 0
    write_laz_chunks(tmp_path / "b.laz", [])
    assert len(read_laz(tmp_path / "b.laz")) == 0


def parts(points: np.ndarray, rgb: np.ndarray, size: int, seen: list[int]) -> Iterator[LazChunk]:
    for start in range(0, len(points), size):
        seen.append(start)
        yield LazChunk(points[start : start + size], rgb[start : start + size])


def test_parts_are_written_one_at_a_time(tmp_path: Path) -> None:
    points, rgb = cloud(300_000)
    order = np.argsort(points[:, 0])
    points, rgb, seen = points[order], rgb[order], []
    bounds = np.stack([points.min(axis=0), points.max(axis=0)])
    write_laz_chunks(tmp_path / "a.laz", parts(points, rgb, 70_001, seen), bounds=bounds, crs="EPSG:32632")
    assert len(seen) == 5
    write_laz(tmp_path / "b.laz", points, rgb, crs="EPSG:32632")
    assert (tmp_path / "a.laz").read_bytes() == (tmp_path / "b.laz").read_bytes()
    write_laz_chunks(tmp_path / "c.laz", parts(points, rgb, 70_001, seen))
    found = read_laz(tmp_path / "c.laz")
    np.testing.assert_allclose(found.points, points, rtol=0, atol=1.01 * HALF_STEP_M)
    np.testing.assert_array_equal(found.rgb, rgb)


def test_parts_with_sigma_and_empty_parts(tmp_path: Path) -> None:
    points, rgb = cloud(10)
    sigma = np.full(10, 0.25, np.float32)
    nothing = (np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32))
    write_laz_chunks(tmp_path / "a.laz", iter([nothing, (points, rgb, sigma), nothing]))
    np.testing.assert_array_equal(read_laz(tmp_path / "a.laz").sigma, sigma)
    with pytest.raises(ShapeError, match=r"chunks\[1\]: give sigma for all parts, or for none"):
        write_laz_chunks(tmp_path / "b.laz", [(points, rgb, sigma), (points, rgb)])
    with pytest.raises(ShapeError, match="near the bounds"):
        write_laz_chunks(tmp_path / "b.laz", [(points, rgb), (points + 1e9, rgb)])
    assert [path.name for path in tmp_path.iterdir()] == ["a.laz"]


@pytest.mark.usefixtures("unchecked")
def test_chunks_that_are_none(tmp_path: Path) -> None:
    points, _ = cloud(10)
    with pytest.raises(ConfigError, match=r"chunks\[0\] must be"):
        write_laz_chunks(tmp_path / "a.laz", [points[0]])
    with pytest.raises(ConfigError, match="chunks must be parts"):
        write_laz_chunks(tmp_path / "a.laz", 3)
    assert not list(tmp_path.iterdir())


def test_an_error_of_the_caller_is_not_converted_and_leaves_no_file(tmp_path: Path) -> None:
    points, rgb = cloud(10)

    def failing() -> Iterator[LazChunk]:
        yield LazChunk(points, rgb)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_laz_chunks(tmp_path / "a.laz", failing())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e31])
def test_coordinates_must_be_finite(tmp_path: Path, bad: float) -> None:
    points, rgb = cloud(10)
    points[4, 1] = bad
    with pytest.raises(ShapeError, match="finite"):
        write_laz(tmp_path / "a.laz", points, rgb)
    with pytest.raises(ShapeError, match="finite"):
        write_laz_chunks(tmp_path / "a.laz", [(points, rgb)])


def test_wrong_arguments(tmp_path: Path) -> None:
    points, rgb = cloud(10)
    with pytest.raises(ShapeError):
        write_laz(tmp_path / "a.laz", points, rgb[:-1])
    for crs in ("EPSG:1", "", "nonsense"):
        with pytest.raises(ConfigError, match="use a code such as EPSG:32632"):
            write_laz(tmp_path / "a.laz", points, rgb, crs=crs)
    with pytest.raises(WorkspaceError, match="it is a folder"):
        write_laz(tmp_path, points, rgb)
    assert not list(tmp_path.iterdir())


def test_other_coordinate_systems(tmp_path: Path) -> None:
    points, rgb = cloud(10)
    for crs, name in (
        ("EPSG:25832+5783", "EPSG:5555"),
        ("EPSG:4979", "EPSG:4979"),
        ("EPSG:2056", "EPSG:2056"),
    ):
        write_laz(tmp_path / "a.laz", points, rgb, crs=crs)
        assert read_laz(tmp_path / "a.laz").crs == name
    write_laz(tmp_path / "a.laz", points, rgb, crs="+proj=utm +zone=32 +ellps=bessel +units=m +type=crs")
    found = read_laz(tmp_path / "a.laz").crs
    assert found is not None and "Bessel" in found


@pytest.mark.parametrize("point_format", range(11))
@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_files_of_other_programs(tmp_path: Path, point_format: int, suffix: str) -> None:
    header = laspy.LasHeader(point_format=point_format)
    header.scales, header.offsets = np.full(3, 0.01), UTM
    las = laspy.LasData(header)
    las.xyz = UTM + np.arange(15.0).reshape(5, 3)
    las.classification = np.arange(5, dtype=np.uint8)
    has_colors = "red" in set(header.point_format.dimension_names)
    if has_colors:
        las.red = np.array([0, 10, 20, 100, 255], np.uint16)  # 8-bit values
    las.write(tmp_path / f"a{suffix}")
    found = read_laz(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(found.points, UTM + np.arange(15.0).reshape(5, 3), rtol=0, atol=1e-8)
    np.testing.assert_array_equal(found.classification, np.arange(5))
    assert (found.rgb is not None) == has_colors and found.sigma is None and found.crs is None
    if has_colors:
        np.testing.assert_array_equal(found.rgb[:, 0], [0, 10, 20, 100, 255])


def test_broken_files(tmp_path: Path) -> None:
    path = tmp_path / "a.laz"
    write_laz(path, *cloud(1000), crs="EPSG:32632")
    data = path.read_bytes()
    for broken in (
        b"",
        b"LASF",
        b"nonsense" * 60,
        data[:300],
        data[:1200],
        data[: len(data) // 2],
        data[:-9],
    ):
        path.write_bytes(broken)
        with pytest.raises(FileFormatError, match=r"a\.laz"):
            read_laz(path)
    with pytest.raises(FileFormatError, match="does not exist"):
        read_laz(tmp_path / "none.laz")


@pytest.mark.parametrize(
    ("offset", "layout", "value", "words"),
    [
        (25, "<B", 9, "version 1.9"),
        (96, "<I", 2**32 - 1, "points start at"),
        (96, "<I", 3, "points start at"),
        (100, "<I", 2**32 - 1, "do not fit between the header"),
        (247, "<Q", 2**40, "do not fit into a file"),
        (105, "<H", 7, "point size"),
        (104, "<B", 0x8C, "not a readable"),
        (131, "<d", float("nan"), "not finite"),
    ],
)
def test_impossible_headers(tmp_path: Path, offset: int, layout: str, value: float, words: str) -> None:
    path = tmp_path / "a.laz"
    write_laz(path, *cloud(100))
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, offset, value)
    path.write_bytes(data)
    with pytest.raises(FileFormatError, match=words):
        read_laz(path)


def test_chunks_and_layers_that_exceed_the_file(tmp_path: Path) -> None:
    """lazrs would allocate as many bytes as they claim."""
    path = tmp_path / "a.laz"
    write_laz(path, *cloud(100))
    data = path.read_bytes()
    (first,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, first)
    for at, value, words in (
        (table + 4, 2**32 - 1, "4294967295 chunks for 100 points"),
        (table + 4, 0, "its 0 chunks have less than 100 points"),
        (first + 8 + 36 + 4, 2**32 - 1, "its layers"),
    ):
        broken = bytearray(data)
        struct.pack_into("<I", broken, at, value)
        path.write_bytes(broken)
        with pytest.raises(FileFormatError, match=words):
            read_laz(path)


@pytest.mark.parametrize("name", ["laspy", "lazrs", "pyproj"])
def test_without_a_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    path = tmp_path / "a.laz"
    write_laz(path, *cloud(5), crs="EPSG:32632")
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'epipole\[survey\]'"):
        write_laz(path, *cloud(5), crs="EPSG:32632")
    with pytest.raises(MissingDependencyError, match=r"pip install 'epipole\[survey\]'"):
        read_laz(path)
