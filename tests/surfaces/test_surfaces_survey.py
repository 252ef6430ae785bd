"""Survey products: height model, orthophoto and LAZ of a georeferenced model, read back by other libraries."""

import shutil
from dataclasses import replace

import laspy
import numpy as np
import pyogrio
import pytest
import rasterio
from benchmarks.tasks.surfaces import prepare_scene

from epipole import surface
from epipole.dense.orthophoto import top_view
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.io.colmap.model import read_colmap_model, write_colmap_model
from epipole.io.meshes.ply import read_points_ply
from epipole.io.survey.coordinate_systems import is_in_area_of_use, lat_lon_alt_of, utm_zone
from epipole.pipelines.surfaces.survey_stage import notes_on_cells
from epipole.scene import Georeference
from epipole.scene.textured_mesh import TexturedMesh
from whole import in_whole_run

ORIGIN = Georeference(48.2, 11.6, 520.0)
UTM = "EPSG:32632"
OPTIONS = {"until": "survey", "texture_px": 1024, "max_size_px": 256}


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    scene = prepare_scene("courtyard", tmp_path_factory.mktemp("survey"), (384, 256), 8)
    folder = scene.folder / "sparse" / "0"
    write_colmap_model(replace(read_colmap_model(folder), georeference=ORIGIN), folder)
    return scene


@pytest.fixture(scope="module")
def done(source, tmp_path_factory):
    return surface(source.folder, tmp_path_factory.mktemp("out") / "out", **OPTIONS)


def enu(positions):
    """UTM coordinates as meters from the origin."""
    return ORIGIN.enu_of(lat_lon_alt_of("test", positions, UTM))


def test_heights_are_those_of_the_ground_and_the_boxes(done):
    with rasterio.open(done.out / "dsm.tif") as file:
        assert file.crs.to_epsg() == 32632 and np.isnan(file.nodata)
        heights, transform = file.read(1), file.transform
    assert done.summary["raster_size"] == [heights.shape[1], heights.shape[0]]
    row, column = np.nonzero(np.isfinite(heights))
    x, y = rasterio.transform.xy(transform, row, column)
    local = enu(np.stack([np.asarray(x), np.asarray(y), heights[row, column].astype(float)], axis=1))
    front = (np.abs(local[:, 0] - 0.6) < 0.3) & (np.abs(local[:, 1] + 1.4) < 0.3)
    assert front.sum() > 20 and np.median(np.abs(local[front, 2])) < 0.12  # wavy ground, 10 cm
    top = np.hypot(local[:, 0] - 0.2, local[:, 1] + 0.5) < 0.15
    assert top.sum() > 5 and np.median(local[top, 2]) == pytest.approx(0.5, abs=0.06)


def test_the_orthophoto_has_the_same_grid_and_is_transparent_in_holes(done):
    with rasterio.open(done.out / "orthophoto.tif") as file, rasterio.open(done.out / "dsm.tif") as other:
        assert file.transform == other.transform and file.crs == other.crs
        colors, heights = file.read(), other.read(1)
    assert ((colors[3] == 255) == np.isfinite(heights)).all()
    assert colors[:3][:, colors[3] == 255].std() > 15


def test_the_points_are_the_cloud_in_utm_to_a_millimeter(done):
    with laspy.open(done.out / "cloud.laz") as file:
        assert file.header.parse_crs().to_epsg() == 32632
        read = file.read()
    assert len(read.points) == done.summary["num_points"]
    positions = enu(np.stack([read.x, read.y, read.z], axis=1))
    cloud = read_points_ply(done.out / "cloud.ply").xyz
    np.testing.assert_allclose(positions, cloud, atol=1.2e-3)


def test_the_terrain_lies_below_the_boxes_on_the_same_grid(done):
    with rasterio.open(done.out / "dtm.tif") as file, rasterio.open(done.out / "dsm.tif") as other:
        assert file.transform == other.transform and file.crs.to_epsg() == 32632
        terrain, heights = file.read(1), other.read(1)
    assert (np.isfinite(terrain) == np.isfinite(heights)).all()
    known = np.isfinite(heights)
    assert np.quantile((heights - terrain)[known], 0.02) > -0.35 and (heights - terrain)[known].max() > 0.2


def test_contour_lines_are_at_the_heights_that_they_state(done):
    info = pyogrio.read_info(done.out / "contours.gpkg")
    _, _, _, (elevation,) = pyogrio.raw.read(done.out / "contours.gpkg")
    interval = done.summary["contour_m"]
    assert info["crs"] == "EPSG:32632" and info["features"] == len(elevation) > 5
    np.testing.assert_allclose(elevation / interval, np.rint(elevation / interval), atol=1e-6)


def test_the_report_shows_the_products_and_their_figures(done):
    page = (done.out / "report.html").read_text()
    for words in ("orthophoto.tif", "dsm.tif", "dtm.tif", "ground sampling distance", "EPSG:32632"):
        assert words in page
    assert 0 < done.summary["area_m2"] < 500 and 0 < done.summary["gsd_m"] < 0.1


def test_products_can_be_cropped(done, source, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(done.out, out)
    with rasterio.open(out / "dsm.tif") as file:
        x, y = file.xy(file.height // 2, file.width // 2)
    crop = (x - 1.0, y - 0.75, x + 1.0, y + 0.75)
    cropped = surface(source.folder, out, **OPTIONS, crop=crop, contour_m=0.25)
    resolution = cropped.summary["resolution_m"]
    for name in ("dsm.tif", "dtm.tif", "orthophoto.tif"):
        with rasterio.open(out / name) as file:
            np.testing.assert_allclose(tuple(file.bounds), crop, atol=resolution)
    points = laspy.read(out / "cloud.laz")
    assert 0 < len(points.points) < cropped.summary["num_points"]
    assert points.x.min() >= crop[0] - 1e-3 and points.y.max() <= crop[3] + 1e-3
    with rasterio.open(done.out / "dsm.tif") as file:
        west, _, _, north = file.bounds
    beyond = (
        west - 0.2,
        north - 1.0,
        west - 0.1,
        north,
    )  # some image could show it, but the surface is elsewhere
    with pytest.raises(ConfigError, match="nothing is inside the crop: the surface is from"):
        surface(source.folder, out, **OPTIONS, crop=beyond)


def test_a_crop_elsewhere_and_too_many_contour_lines_are_refused_before_the_work(done, source, tmp_path):
    with rasterio.open(done.out / "dsm.tif") as file:
        (west, south, east, north), size = file.bounds, 1000.0
    for crop in (
        (0.0, 0.0, 1.0, 1.0),
        (west - 2 * size, south, west - size, north),
        (west, north + size, east, north + 2 * size),
    ):
        with pytest.raises(
            ConfigError, match=r"no image shows the crop .*: the points of the model are from"
        ):
            surface(source.folder, tmp_path / "out", until="survey", crop=crop)
    with pytest.raises(ConfigError, match=r"levels between .* use an interval of at least"):
        surface(source.folder, tmp_path / "out", until="survey", contour_m=1e-5)
    assert not (tmp_path / "out" / "units" / "depth").exists()


def test_a_model_without_a_position_is_refused_before_the_work(source, tmp_path):
    folder = tmp_path / "plain"
    (folder / "sparse" / "0").mkdir(parents=True)
    model = read_colmap_model(source.folder / "sparse" / "0")
    write_colmap_model(replace(model, georeference=None), folder / "sparse" / "0")
    with pytest.raises(ConfigError, match="position on Earth"):
        surface(folder, tmp_path / "out", images=source.folder / "images", until="survey")
    assert not (tmp_path / "out" / "units" / "depth").exists()


@in_whole_run
def test_the_ground_sampling_distance_is_that_of_the_images(done, source, tmp_path):
    found = surface(source.folder, tmp_path / "out", **{**OPTIONS, "max_size_px": 384})
    assert found.summary["gsd_m"] == pytest.approx(done.summary["gsd_m"], rel=0.1)
    assert found.summary["resolution_m"] < done.summary["resolution_m"]


@pytest.mark.parametrize("crs", ["EPSG:3857", "EPSG:2193"])
def test_a_projection_that_stretches_lengths_is_refused(source, tmp_path, crs):
    """Web Mercator, and New Zealand's projection, in Munich."""
    with pytest.raises(ConfigError, match="shows lengths"):
        surface(source.folder, tmp_path / "out", until="survey", crs=crs)
    assert not (tmp_path / "out" / "units" / "depth").exists()


def test_a_resolution_with_too_many_cells_is_refused_before_the_work(source, tmp_path):
    with pytest.raises(ConfigError, match="coarser --resolution-m, or parts"):
        surface(source.folder, tmp_path / "out", until="survey", resolution_m=1e-5)
    assert not (tmp_path / "out" / "units" / "depth").exists()


def test_cells_that_are_too_fine_are_reported():
    facts = {"resolution_m": 0.02, "voxel": 0.04, "gsd_m": 0.016}
    assert not notes_on_cells(facts)
    assert "much finer than the mesh" in notes_on_cells(facts | {"voxel": 0.2})[0]
    assert "finer than the pixels" in notes_on_cells(facts | {"gsd_m": 0.05})[0]


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg", "zone"),
    [
        (48.2, 11.6, 32),
        (60.4, 5.3, 32),
        (55.9, 5.3, 31),
        (78.2, 15.6, 33),
        (78.2, 8.9, 31),
        (75.0, 41.9, 37),
        (71.9, 15.6, 33),
        (-33.9, 18.4, 34),
        (0.0, 180.0, 1),
        (0.0, 179.9, 60),
        (0.0, 359.0, 30),
    ],
)
def test_utm_zones(lat_deg, lon_deg, zone):
    """Bergen and Svalbard have zones of their own."""
    assert utm_zone(lat_deg, lon_deg) == zone


def test_the_area_for_which_a_projection_is_made():
    assert is_in_area_of_use("EPSG:32632", 48.2, 11.6) and not is_in_area_of_use("EPSG:32660", 48.2, 11.6)
    assert is_in_area_of_use("EPSG:3832", 0.0, 190.0) and is_in_area_of_use("+proj=utm +zone=32", 48.2, 100.0)


def test_degrees_are_refused(source, tmp_path):
    with pytest.raises(ConfigError, match="degrees"):
        surface(source.folder, tmp_path / "out", until="survey", crs="EPSG:4326")


def slab():
    """Two triangles at height 5 over one at height 2."""
    vertices = np.array([[0, 0, 2], [4, 0, 2], [4, 4, 2], [0, 4, 2], [0, 0, 5], [2, 0, 5], [0, 2, 5]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]])
    uv = np.zeros((3, 3, 2))
    uv[2] = 0.99
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[0, 0], texture[1, 1] = (200, 0, 0), (0, 0, 200)
    return TexturedMesh(vertices, faces, uv, np.zeros(3, np.int64), (texture,))


def test_the_highest_surface_is_seen_from_above():
    mesh = slab()
    seen = top_view(mesh, mesh.vertices_in_world, 0.5)
    assert seen.height.shape == (8, 8) and (seen.x_min, seen.y_max) == (0.0, 4.0)
    assert seen.height[7, 0] == 5.0 and seen.height[0, 7] == 2.0 and seen.is_known.all()
    assert tuple(seen.rgb[7, 0]) == (0, 0, 200) and tuple(seen.rgb[0, 7]) == (200, 0, 0)


def test_a_cell_has_the_mean_of_its_samples():
    mesh = slab()
    whole = top_view(mesh, mesh.vertices_in_world, 2.0, samples=8)
    fine = top_view(mesh, mesh.vertices_in_world, 0.25)
    means = fine.height.reshape(2, 8, 2, 8).mean(axis=(1, 3))
    np.testing.assert_allclose(whole.height, means, atol=1e-5)
    colors = fine.rgb.reshape(2, 8, 2, 8, 3).mean(axis=(1, 3))
    assert np.abs(whole.rgb.astype(float) - colors).max() <= 0.5
    assert whole.height[1, 0] == pytest.approx(3.5, abs=0.3)  # half at 5, half at 2


def test_a_crop_is_the_same_part_of_the_whole():
    mesh = slab()
    whole = top_view(mesh, mesh.vertices_in_world, 0.5)
    part = top_view(mesh, mesh.vertices_in_world, 0.5, (0.9, 0.6, 3.2, 9.0))
    assert (part.x_min, part.y_max) == (1.0, 4.0) and part.height.shape == (7, 4)
    np.testing.assert_array_equal(part.height, whole.height[:7, 2:6])
    np.testing.assert_array_equal(part.rgb, whole.rgb[:7, 2:6])
    with pytest.raises(DegenerateGeometryError):
        top_view(mesh, mesh.vertices_in_world, 0.5, (8.0, 8.0, 9.0, 9.0))


def test_wrong_resolutions_are_refused():
    mesh = slab()
    for resolution in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ConfigError, match="resolution"):
            top_view(mesh, mesh.vertices_in_world, resolution)
    with pytest.raises(ConfigError):
        top_view(mesh, mesh.vertices_in_world, 1e-7)
    empty = TexturedMesh(
        np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3, 2)), np.zeros(0, np.int64), ()
    )
    with pytest.raises(DegenerateGeometryError, match="no face"):
        top_view(empty, np.zeros((0, 3)), 1.0)
