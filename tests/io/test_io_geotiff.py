"""Orthophotos and height models as cloud-optimized GeoTIFF files, read back by rasterio."""

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import Affine, from_origin

from epipole.errors import (
    ConfigError,
    FileFormatError,
    MissingDependencyError,
    ShapeError,
    WorkspaceError,
)
from epipole.io.survey.rasters import Raster, read_geotiff, write_geotiff
from whole import in_whole_run

UTM = {"x_min": 500_000.125, "y_max": 5_300_000.375, "resolution_m": 0.05, "crs": "EPSG:32632"}


def heights(height: int, width: int) -> np.ndarray:
    values = np.random.default_rng(0).normal(400.0, 20.0, (height, width)).astype(np.float32)
    values[: height // 4, width // 2 :] = np.nan
    return values


def colors(height: int, width: int, channels: int) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (height, width, channels), np.uint8)


def assert_same(found: Raster, raster: Raster) -> None:
    np.testing.assert_array_equal(found.values, raster.values)
    assert found.values.dtype == raster.values.dtype and found.crs == raster.crs
    np.testing.assert_allclose(
        [found.x_min, found.y_max, found.resolution_m],
        [raster.x_min, raster.y_max, raster.resolution_m],
        rtol=1e-15,
    )


@pytest.mark.parametrize("values", [heights(70, 90), colors(70, 90, 3), colors(70, 90, 4)])
def test_what_is_written_is_read(tmp_path: Path, values: np.ndarray) -> None:
    raster = Raster(values, **UTM)
    write_geotiff(tmp_path / "a.tif", raster)
    assert_same(read_geotiff(tmp_path / "a.tif"), raster)
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]


def test_heights_of_other_programs_have_the_coordinate_system_and_no_data(tmp_path: Path) -> None:
    raster = Raster(heights(40, 50), **UTM)
    write_geotiff(tmp_path / "dsm.tif", raster)
    with rasterio.open(tmp_path / "dsm.tif") as found:
        assert found.crs.to_epsg() == 32632 and found.dtypes == ("float32",) and np.isnan(found.nodata)
        x, y = found.xy(0, 0)  # center of the top-left pixel
        assert abs(x - 500_000.150) < 1e-6 and abs(y - 5_300_000.350) < 1e-6
        assert found.bounds.right == pytest.approx(500_000.125 + 50 * 0.05, abs=1e-6)
        np.testing.assert_array_equal(found.read_masks(1) == 0, np.isnan(raster.values))


def test_colors_have_an_alpha_band(tmp_path: Path) -> None:
    values = colors(40, 50, 4)
    values[:20, :, 3] = 0
    write_geotiff(tmp_path / "ortho.tif", Raster(values, **UTM))
    with rasterio.open(tmp_path / "ortho.tif") as found:
        kinds = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
        assert found.colorinterp == kinds and found.nodata is None
        np.testing.assert_array_equal(found.dataset_mask(), values[:, :, 3])


@pytest.mark.parametrize(("values", "predictor"), [(heights(1500, 1300), "3"), (colors(1500, 1300, 4), "2")])
def test_a_large_raster_has_tiles_and_overviews(tmp_path: Path, values: np.ndarray, predictor: str) -> None:
    write_geotiff(tmp_path / "a.tif", Raster(values, **UTM))
    with rasterio.open(tmp_path / "a.tif") as found:
        assert found.profile["tiled"] and set(found.block_shapes) == {(512, 512)}
        assert found.overviews(1) == [2, 4]
        structure = found.tags(ns="IMAGE_STRUCTURE")
        assert structure["LAYOUT"] == "COG" and structure["COMPRESSION"] == "DEFLATE"
        assert structure["PREDICTOR"] == predictor
    with rasterio.open(tmp_path / "a.tif", overview_level=0) as half:
        assert half.shape == (750, 650)
        if values.ndim == 2:
            mean = values[1000:1002, :2].mean()
            assert half.read(1)[500, 0] == pytest.approx(mean, abs=1e-3)


def test_a_raster_without_a_coordinate_system(tmp_path: Path) -> None:
    raster = Raster(heights(4, 5), 0.0, 0.0, 1.0)
    write_geotiff(tmp_path / "a.tif", raster)
    assert_same(read_geotiff(tmp_path / "a.tif"), raster)


def test_a_compound_coordinate_system_and_a_proj_string(tmp_path: Path) -> None:
    write_geotiff(tmp_path / "a.tif", Raster(heights(4, 5), 5e5, 5.3e6, 1.0, "EPSG:25832+5783"))
    found = read_geotiff(tmp_path / "a.tif").crs
    assert found is not None and ("5555" in found or "DHHN92" in found)
    text = "+proj=utm +zone=32 +ellps=bessel +units=m"
    write_geotiff(tmp_path / "b.tif", Raster(heights(4, 5), 5e5, 5.3e6, 1.0, text))
    found = read_geotiff(tmp_path / "b.tif").crs
    assert found is not None and "Bessel" in found
    write_geotiff(tmp_path / "c.tif", Raster(heights(4, 5), 5e5, 5.3e6, 1.0, found))
    with rasterio.open(tmp_path / "c.tif") as source:
        assert source.crs.is_projected and "bessel" in source.crs.to_proj4()


def test_an_existing_file_is_replaced_and_a_folder_is_created(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.tif"
    for size in (4, 6):
        write_geotiff(path, Raster(heights(size, 5), **UTM))
        assert read_geotiff(path).values.shape == (size, 5)


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"values": np.zeros((0, 4), np.float32)}, ShapeError, "at least one pixel"),
        ({"values": np.zeros((4, 0, 3), np.uint8)}, ShapeError, "at least one pixel"),
        ({"values": np.zeros((4, 4, 2), np.uint8)}, ShapeError, "must be heights"),
        ({"values": np.full((2, 2), np.inf, np.float32)}, ShapeError, "NaN where there is no data"),
        ({"resolution_m": 0.0}, ConfigError, "resolution_m must be positive"),
        ({"resolution_m": np.inf}, ConfigError, "resolution_m must be positive"),
        ({"y_max": np.inf}, ConfigError, "must be finite"),
    ],
)
def test_wrong_rasters(changes: dict, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        Raster(**{"values": heights(4, 4), **UTM, **changes})


@pytest.mark.parametrize("crs", ["EPSG:1", "", "nonsense"])
def test_an_unknown_coordinate_system(tmp_path: Path, crs: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match="use a code such as EPSG:32632"):
        write_geotiff(tmp_path / "a.tif", Raster(heights(4, 4), 0.0, 0.0, 1.0, crs))
    assert not list(tmp_path.iterdir()) and not capfd.readouterr().err


def test_broken_files(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    write_geotiff(path, Raster(colors(600, 600, 3), **UTM))
    data = path.read_bytes()
    for broken in (b"", b"II*\0", b"nonsense" * 20, data[:300], data[: len(data) // 2]):
        path.write_bytes(broken)
        with pytest.raises(FileFormatError, match=r"a\.tif"):
            read_geotiff(path)
    with pytest.raises(FileFormatError, match="does not exist"):
        read_geotiff(tmp_path / "none.tif")
    with pytest.raises(FileFormatError, match="a folder"):
        read_geotiff(tmp_path)


def written_by_rasterio(path: Path, bands: np.ndarray, **options: object) -> Path:
    count, height, width = bands.shape
    profile = {"driver": "GTiff", "height": height, "width": width, "count": count, "dtype": bands.dtype.name}
    with rasterio.open(path, "w", **{**profile, **options}) as out:
        out.write(bands)
        if "photometric" in options and count == 4:
            out.colorinterp = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.undefined]
    return path


def test_heights_of_other_types(tmp_path: Path) -> None:
    bands = np.array([[[100, 200], [-32768, 400]]], np.int16)
    path = written_by_rasterio(
        tmp_path / "a.tif", bands, nodata=-32768, transform=from_origin(10, 20, 2, 2), crs="EPSG:25832"
    )
    found = read_geotiff(path)
    np.testing.assert_array_equal(found.values, np.array([[100, 200], [np.nan, 400]], np.float32))
    assert (found.x_min, found.y_max, found.resolution_m, found.crs) == (10.0, 20.0, 2.0, "EPSG:25832")
    with rasterio.open(path, "r+") as out:
        out.scales, out.offsets = (0.1,), (50.0,)
    np.testing.assert_allclose(read_geotiff(path).values[0], [60.0, 70.0])


def test_other_bands_are_no_alpha(tmp_path: Path) -> None:
    bands = np.arange(16, dtype=np.uint8).reshape(4, 2, 2)
    path = written_by_rasterio(
        tmp_path / "a.tif", bands, photometric="RGB", transform=from_origin(0, 9, 1, 1)
    )
    np.testing.assert_array_equal(read_geotiff(path).values, np.moveaxis(bands[:3], 0, -1))
    found = written_by_rasterio(
        tmp_path / "b.tif", bands[:3], nodata=0, photometric="RGB", transform=from_origin(0, 9, 1, 1)
    )
    assert read_geotiff(found).values.shape == (2, 2, 4)


@pytest.mark.parametrize(
    ("bands", "grid", "words"),
    [
        (np.zeros((1, 2, 2), np.float32), None, "no georeference"),
        (np.zeros((1, 2, 2), np.float32), Affine(1, 0.1, 0, 0.1, -1, 0), "no georeference"),
        (np.zeros((1, 2, 2), np.float32), Affine(1, 0, 0, 0, -2, 0), "square pixels"),
        (np.zeros((1, 2, 2), np.complex64), Affine(1, 0, 3, 0, -1, 0), "expected one band"),
        (np.zeros((2, 2, 2), np.float32), Affine(1, 0, 3, 0, -1, 0), "expected one band"),
        (np.zeros((3, 2, 2), np.uint16), Affine(1, 0, 3, 0, -1, 0), "expected one band"),
    ],
)
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_rasters_that_are_not_read(tmp_path: Path, bands: np.ndarray, grid: Affine, words: str) -> None:
    options = {} if grid is None else {"transform": grid}
    path = written_by_rasterio(tmp_path / "a.tif", bands, **options)
    with pytest.raises(FileFormatError, match=words):
        read_geotiff(path)


def test_a_small_file_does_not_declare_a_large_raster(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    profile = {"driver": "GTiff", "height": 60_000, "width": 60_000, "count": 1, "dtype": "float32"}
    options = {"transform": from_origin(0, 9, 1, 1), "sparse_ok": True, "tiled": True, "compress": "DEFLATE"}
    with rasterio.open(path, "w", blockxsize=4096, blockysize=4096, **profile, **options):
        pass
    with pytest.raises(FileFormatError, match="do not fit into a file"):
        read_geotiff(path)


def test_constant_rasters_are_read(tmp_path: Path) -> None:
    raster = Raster(np.full((6000, 6000), np.nan, np.float32), **UTM)
    write_geotiff(tmp_path / "a.tif", raster)
    assert np.isnan(read_geotiff(tmp_path / "a.tif").values).all()


FULL = """
import resource, signal, sys
import numpy as np
from epipole.errors import WorkspaceError
from epipole.io.survey.rasters import Raster, write_geotiff
values = np.random.default_rng(0).normal(size=(1500, 1500)).astype(np.float32)
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
try:
    write_geotiff(sys.argv[1], Raster(values, 0.0, 0.0, 1.0))
except WorkspaceError as error:
    print("refused:", error)
"""


@in_whole_run
@pytest.mark.skipif(not hasattr(resource, "RLIMIT_FSIZE"), reason="no limit of file sizes")
def test_a_full_disk_leaves_no_file(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(tmp_path / "a.tif")], capture_output=True, text=True
    )
    assert "refused: cannot write" in done.stdout, done.stderr
    assert not list(tmp_path.iterdir())


def test_a_folder_is_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="it is a folder"):
        write_geotiff(tmp_path, Raster(heights(4, 4), **UTM))


def test_without_rasterio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'epipole\[survey\]'"):
        write_geotiff(tmp_path / "a.tif", Raster(heights(4, 4), **UTM))
    with pytest.raises(MissingDependencyError, match=r"pip install 'epipole\[survey\]'"):
        read_geotiff(tmp_path / "a.tif")
