"""The georeferencing job: files in, files out."""

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import epipole
from epipole.errors import ConfigError, FileFormatError, WorkspaceError
from epipole.io.colmap.model import read_colmap_model, write_colmap_model
from epipole.io.meshes.ply import read_points_ply
from epipole.io.survey.coordinate_systems import lat_lon_alt_of

sys.path.insert(0, str(Path(__file__).parent))
from surveyed_flights import ORIGIN, Flight, flight, gcp_text


@pytest.fixture(scope="module")
def one() -> Flight:
    return flight(0)


@pytest.fixture
def workspace(one: Flight, tmp_path: Path) -> Path:
    write_colmap_model(one.model, tmp_path / "model" / "sparse" / "0")
    (tmp_path / "gcp_list.txt").write_text(gcp_text(one))
    return tmp_path / "model"


def enu(model: epipole.Reconstruction, points: np.ndarray) -> np.ndarray:
    """Points of a georeferenced model in the coordinates of the simulated truth."""
    assert model.georeference is not None
    return ORIGIN.enu_of(model.georeference.lat_lon_alt_of(points))


def test_a_model_gets_its_position_on_earth(one: Flight, workspace: Path):
    result = epipole.georeference(workspace, gcp=workspace.parent / "gcp_list.txt", mark_sigma_px=0.7)
    assert result.out == workspace / "georeferenced"
    stored = read_colmap_model(result.out / "sparse" / "0")
    assert stored.georeference == result.model.georeference
    off = enu(stored, stored.camera_centers_in_world()) - one.centers
    assert np.abs(off).max() < 0.5
    sigma_m = result.summary["median_image_sigma_m"]
    assert stored.georeference.sigma_m == tuple(sigma_m[axis] for axis in ("east_m", "north_m", "up_m"))
    with (result.out / "images.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["image"] for row in rows] == list(stored.images.name)
    table = np.array([[float(row[f"{axis}_m"]) for axis in ("east", "north", "up")] for row in rows])
    np.testing.assert_allclose(table, stored.camera_centers_in_world(), atol=1e-6)
    on_earth = np.array(
        [[float(row[n]) for n in ("latitude_deg", "longitude_deg", "altitude_m")] for row in rows]
    )
    np.testing.assert_allclose(stored.georeference.enu_of(on_earth), table, atol=1e-4)
    sigmas = np.array([[float(row[f"sigma_{axis}_m"]) for axis in ("east", "north", "up")] for row in rows])
    assert (np.abs(off) < 5.0 * sigmas).mean() > 0.9 and (sigmas > 0).all()
    points = json.loads((result.out / "control_points.json").read_text())
    assert points["P0"]["role"] == "control" and points["CHK-P7"]["role"] == "check"
    assert max(abs(v) for v in points["CHK-P7"]["residual_m"].values()) < 0.4
    assert result.summary["num_control"] == 5 and result.summary["num_check"] == 8
    assert "Control and check points" in (result.out / "report.html").read_text()


def test_the_result_can_be_viewed(workspace: Path, tmp_path: Path):
    result = epipole.georeference(workspace, gcp=workspace.parent / "gcp_list.txt")
    page = epipole.share(result.out, tmp_path / "page.html")
    assert "13 surveyed points" in page.read_text() and "Check points" in page.read_text()


def test_points_in_the_coordinate_system_of_the_control_points(one: Flight, workspace: Path):
    pyproj = pytest.importorskip("pyproj")
    to_utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    table = ORIGIN.lat_lon_alt_of(one.surveyed.position_m)
    east, north = to_utm.transform(table[:, 1], table[:, 0])
    lines = ["WGS84 UTM 32N"]
    for k, row in enumerate(one.surveyed.point.tolist()):
        u, v = one.surveyed.pixels[k]
        image = one.model.images.name[int(one.surveyed.image[k])]
        lines.append(f"{east[row]:.4f} {north[row]:.4f} {table[row, 2]:.4f} {u:.3f} {v:.3f} {image} P{row}")
    path = workspace.parent / "utm.txt"
    path.write_text("\n".join(lines))
    result = epipole.georeference(workspace, gcp=path, check=("P8", "P9"))
    assert result.points["P8"]["role"] == "check"
    assert result.model.georeference is not None and result.model.georeference.crs == "EPSG:32632"
    points = read_points_ply(result.out / "points_in_crs.ply").xyz
    back = lat_lon_alt_of("x", points, "EPSG:32632")
    expected = result.model.georeference.lat_lon_alt_of(result.model.points.xyz_in_world)
    np.testing.assert_allclose(ORIGIN.enu_of(back), ORIGIN.enu_of(expected), atol=1e-4)


def test_local_coordinates_have_no_position_on_earth(one: Flight, workspace: Path):
    path = workspace.parent / "local.txt"
    rows = [line.split("\t") for line in gcp_text(one).splitlines()[1:]]
    names = {
        f"{'' if c else 'CHK-'}{n}": p
        for n, p, c in zip(one.surveyed.name, one.surveyed.position_m, one.surveyed.is_control)
    }
    lines = ["LOCAL", *(" ".join([*(f"{v:.4f}" for v in names[row[6]]), *row[3:]]) for row in rows)]
    path.write_text("\n".join(lines))
    result = epipole.georeference(workspace, gcp=path)
    assert result.model.georeference is None and result.summary["is_metric"]
    assert np.abs(result.model.camera_centers_in_world() - one.centers).max() < 0.5


def test_control_points_elsewhere_are_refused(one: Flight, workspace: Path):
    """GPS from an earlier georeferencing is not needed: the database has none, and only the shape can be compared."""
    path = workspace.parent / "swapped.txt"
    path.write_text(gcp_text(one, columns=(0, 1, 2)))
    with pytest.raises(ConfigError, match="exchanged"):
        epipole.georeference(workspace, gcp=path)


@pytest.mark.parametrize("is_given", [True, False])
def test_given_intrinsics_stay(one: Flight, workspace: Path, is_given: bool):
    source = "given" if is_given else "EXIF, 35 mm equivalent, then refined with the model"
    (workspace / "config.json").write_text(json.dumps({"config": {"refine_known": False}}))
    (workspace / "summary.json").write_text(json.dumps({"focal_sources": [source]}))
    result = epipole.georeference(workspace, gcp=workspace.parent / "gcp_list.txt")
    before, after = one.model.cameras.params, result.model.cameras.params
    assert np.array_equal(before, after) == is_given


def test_what_is_missing_is_named(one: Flight, workspace: Path, tmp_path: Path):
    gcp = workspace.parent / "gcp_list.txt"
    with pytest.raises(ConfigError, match="no GPS positions"):
        epipole.georeference(workspace, tmp_path / "out")
    with pytest.raises(ConfigError, match="does not have: P99"):
        epipole.georeference(workspace, tmp_path / "out", gcp=gcp, check=("P99",))
    with pytest.raises(FileFormatError, match="does not exist"):
        epipole.georeference(workspace, tmp_path / "out", gcp=tmp_path / "none.txt")
    with pytest.raises(WorkspaceError, match="choose another output folder"):
        epipole.georeference(workspace, workspace, gcp=gcp)
    with pytest.raises(FileFormatError):
        epipole.georeference(tmp_path / "nothing", tmp_path / "out", gcp=gcp)


def test_images_that_the_model_does_not_have_are_named(workspace: Path):
    gcp = workspace.parent / "gcp_list.txt"
    gcp.write_text(gcp.read_text() + "11.6 48.2 500 10 10 other.jpg P0x\n")
    result = epipole.georeference(workspace, gcp=gcp)
    assert any("under several folders: other.jpg" in w for w in result.warnings)
    assert result.points["P0x"]["role"] == "unseen"
