"""GPS gives a model its scale, heading and place; fixes that are wrong or too few do not."""

from itertools import cycle, product

import numpy as np
import pytest
from photographs import CAMERA, FOCAL_35MM, neighboring_views

from epipole import reconstruct
from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.io.images.photographs import read_header, read_rgb, write_jpeg_with_exif
from epipole.pipelines.sfm.config import MapperConfig, ReconstructConfig
from epipole.pipelines.sfm.gps.alignment import align_to_gps
from epipole.pipelines.sfm.gps.evidence import gps_evidence
from epipole.pipelines.sfm.orientation import upright_from_world
from epipole.pipelines.sfm.up_direction import UpDirection, up_directions
from epipole.scene.georeference import gps_to_enu
from epipole.synthetic import courtyard, courtyard_views, render
from whole import IS_WHOLE

SIGMA_M, REACH_M = 3.0, 15.0
TILT = Similarity3(np.array(1.0), Rotation3.exp([0.4, -0.7, 0.2]).matrix, np.array([1.0, 2.0, 3.0]))
"""Rotates the models below upright: as they come, they lie on their side."""
UP = UpDirection(TILT.rotation.T @ [0.0, 0.0, 1.0], np.deg2rad(4.0))
ENU_FROM_UPRIGHT = Similarity3(
    np.array(12.5), Rotation3.exp([0.0, 0.0, 2.1]).matrix, np.array([120.0, -45.0, 7.0])
)


def walk(kind: str, count: int = 12) -> np.ndarray:
    """Upright camera centers: along a line, around a block, or up a hill and around."""
    t = np.linspace(0, 1, count)
    x, y = 4 * np.cos(5 * t), 4 * np.sin(5 * t)
    return {
        "line": np.stack([6 * t, 2 * t, 0 * t], axis=1),
        "block": np.stack([x, y, 0 * t], axis=1),
        "hill": np.stack([x, y, 2 * np.sin(7 * t)], axis=1),
    }[kind]


def aligned(upright_centers: np.ndarray, fixes: np.ndarray):
    return align_to_gps(TILT.inverse().apply(upright_centers), [UP], fixes, SIGMA_M, REACH_M)


@pytest.mark.parametrize("kind", ["line", "block", "hill"])
def test_exact_fixes_give_the_similarity_that_made_them(kind: str) -> None:
    centers = walk(kind)
    found = aligned(centers, ENU_FROM_UPRIGHT.apply(centers))
    assert found is not None and found.residuals_m.max() < 1e-8 and found.median_m < 1e-8
    expected = ENU_FROM_UPRIGHT @ TILT
    np.testing.assert_allclose(found.enu_from_world.scale, 12.5, rtol=1e-9)
    np.testing.assert_allclose(found.enu_from_world.rotation, expected.rotation, atol=1e-8)
    np.testing.assert_allclose(found.enu_from_world.translation, expected.translation, atol=1e-7)


@pytest.mark.parametrize("kind", ["line", "block", "hill"])
def test_wrong_fixes_have_no_say(kind: str) -> None:
    """Four of twelve are hundreds of meters off; the rest decide alone."""
    centers = walk(kind)
    fixes = ENU_FROM_UPRIGHT.apply(centers)
    wrong = np.array([0, 3, 7, 11])
    fixes[wrong] += np.array([[400.0, 0, 0], [0, -300, 0], [250, 250, 0], [0, 0, 500]])
    found = aligned(centers, fixes)
    right = np.setdiff1d(np.arange(12), wrong)
    assert found.residuals_m[right].max() < 1e-8
    np.testing.assert_allclose(found.residuals_m[wrong], [400, 300, 250 * np.sqrt(2), 500], rtol=1e-8)


def test_noise_of_the_fixes_is_averaged(rng: np.random.Generator) -> None:
    """40 fixes of 2 m: the scale to 2 m / (50 m sqrt 40) or so, and residuals as large as the noise."""
    centers = walk("block", 40)
    fixes = ENU_FROM_UPRIGHT.apply(centers) + rng.normal(0, 2.0, (40, 3))
    found = aligned(centers, fixes)
    assert found.enu_from_world.scale == pytest.approx(12.5, rel=0.03)
    assert 2.0 < found.median_m < 4.0
    error = found.enu_from_world.apply(TILT.inverse().apply(centers)) - ENU_FROM_UPRIGHT.apply(centers)
    assert np.linalg.norm(error, axis=1).max() < 2.5


def test_pictures_without_fix_or_place_stand_aside() -> None:
    centers = walk("hill")
    fixes = ENU_FROM_UPRIGHT.apply(centers)
    fixes[2], centers[5] = np.nan, np.nan
    found = aligned(centers, fixes)
    assert np.flatnonzero(np.isnan(found.residuals_m)).tolist() == [2, 5]
    assert np.nanmax(found.residuals_m) < 1e-8


@pytest.mark.parametrize("case", ["none", "two", "one place", "one camera"])
def test_fixes_that_cannot_tell_give_nothing(case: str) -> None:
    """Fewer than three, all within their own error, or a model without extent: no scale is better than a wrong one."""
    centers = walk("block")
    fixes = ENU_FROM_UPRIGHT.apply(centers)
    if case == "one place":
        fixes = 0.1 * (fixes - fixes.mean(axis=0))  # ten meters across
    if case == "one camera":
        centers = np.zeros_like(centers)
    if case in ("none", "two"):
        fixes[{"none": 0, "two": 2}[case] :] = np.nan
    assert aligned(centers, fixes) is None


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("count", [3, 4, 5, 8, 40, 200] if IS_WHOLE else [4, 40])
def test_random_fixes_are_not_believed(count: int) -> None:
    """Places within 111 m that have nothing to do with the images: one set in twenty deceives, at most."""
    believed, trials = 0, (20 if count > 6 else 60) // (1 if IS_WHOLE else 2)
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        centers = walk("hill", count) + rng.normal(0, 0.3, (count, 3))
        fixes = rng.uniform(0, 111, (count, 3)) * [1, 1, 0.1]
        believed += aligned(centers, fixes) is not None
    assert believed <= trials // 20


BELIEVED = [(5, 20, 17), (40, 8, 8), (3, 20, 12), (8, 12, 12)] if IS_WHOLE else [(40, 4, 4)]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("count", "trials", "least"), BELIEVED)
def test_noisy_fixes_are_believed(count: int, trials: int, least: int) -> None:
    """Fixes of 3 m along a path of a hundred; one of eight is far off."""
    believed = 0
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        centers = walk("hill", count)
        fixes = ENU_FROM_UPRIGHT.apply(centers) + rng.normal(0, 3.0, (count, 3))
        fixes[: count // 8] += [500.0, -200.0, 0.0]
        believed += aligned(centers, fixes) is not None
    assert believed >= least


def test_what_speaks_against_the_fixes_is_said() -> None:
    rng = np.random.default_rng(0)
    centers = walk("hill")
    up = [np.array([0.0, 0.0, 1.0])]
    found = gps_evidence(centers, rng.uniform(0, 111, (12, 3)), up)
    assert not found.is_convincing and found.num_positions == 12
    assert "half of the 12 images are" in found.in_words() and "shuffled among the images" in found.in_words()
    same_position = gps_evidence(0 * centers, rng.uniform(0, 111, (12, 3)), up)
    assert not same_position.is_convincing
    few = gps_evidence(centers[:2], centers[:2], up)
    assert not few.is_convincing and few.num_positions == 2


def test_upright_is_the_direction_that_the_cameras_call_up() -> None:
    """Level cameras around a corner, which look down: up comes out of their x axes, whichever way the model lay."""
    views = courtyard_views(24)
    tilted = TILT.move_cam_from_source(views)
    points = TILT.apply(np.random.default_rng(0).normal(size=(200, 3)))
    upright = upright_from_world(tilted, points, up_directions(tilted)[0])
    up = (upright @ TILT).rotation @ np.array([0.0, 0.0, 1.0])
    assert np.rad2deg(np.arccos(up[2])) < 1.0
    moved = upright.apply(points)
    assert np.median(np.linalg.norm(moved, axis=1)) == pytest.approx(1.0, rel=0.05)
    np.testing.assert_allclose(np.median(moved, axis=0), 0.0, atol=0.2)


def flight(kind: str, rng: np.random.Generator, count: int = 24) -> tuple[np.ndarray, Rigid3]:
    """Positions in meters and poses in an upright world: four lines back and forth, 80 m above the ground."""
    row, column = np.divmod(np.arange(count), count // 4)
    forward = np.where(row % 2 == 0, 1.0, -1.0)
    column = np.where(row % 2 == 0, column, count // 4 - 1 - column)
    position = np.stack([20.0 * column, 25.0 * row, np.full(count, 80.0)], axis=1) + rng.normal(
        0, 1.0, (count, 3)
    )
    if kind == "hillside":
        position[:, 2] += 0.4 * position[:, 0]
    looks_down = {"oblique": np.zeros(count, bool), "mixed": row % 2 == 0}.get(kind, np.ones(count, bool))
    pitch = np.deg2rad(np.where(looks_down, -90.0, -50.0))
    heading = np.where(looks_down, np.arctan2(0.0, forward), rng.uniform(0, 2 * np.pi, count))
    ahead = np.stack([np.cos(heading), np.sin(heading), np.zeros(count)], axis=1)
    z_axis = np.cos(pitch)[:, None] * ahead + np.sin(pitch)[:, None] * [0.0, 0.0, 1.0]
    x_axis = np.cross(ahead, [0.0, 0.0, 1.0])
    rotation = np.stack([x_axis, np.cross(z_axis, x_axis), z_axis], axis=1)
    rotation = rotation @ Rotation3.exp(rng.normal(0, np.deg2rad(2.0), (count, 3))).matrix
    return position, Rigid3(rotation, -np.einsum("nij,nj->ni", rotation, position))


KINDS, CASES = ("nadir", "oblique", "mixed", "hillside"), ("", "outlier", "no altitude")
FLIGHTS = list(product(KINDS, CASES) if IS_WHOLE else zip(KINDS, cycle(CASES)))


def align_flight(kind: str, seed: int, case: str = ""):
    """What GPS makes of a flight whose model has a random world: the alignment, and its error of up in degrees."""
    rng = np.random.default_rng(seed)
    position, cams_from_enu = flight(kind, rng)
    model_from_enu = Similarity3(
        np.array(0.02), Rotation3.exp(2 * rng.normal(size=3)).matrix, rng.normal(size=3)
    )
    gps = position + rng.normal(0, [1.0, 1.0, 2.0], position.shape)
    if case == "outlier":
        gps[3, 0] += 500e3
    elif case == "no altitude":
        gps[:, 2] = np.nan
    elif case == "random":
        gps = rng.uniform(0, 100, position.shape) * [1, 1, 0.2]
    ups = up_directions(model_from_enu.move_cam_from_source(cams_from_enu))
    found = align_to_gps(model_from_enu.apply(position), ups, gps, SIGMA_M, REACH_M, seed)
    if found is None:
        return None, np.nan
    up = found.enu_from_world.rotation @ model_from_enu.rotation @ [0.0, 0.0, 1.0]
    return found, np.rad2deg(np.arccos(min(up[2], 1.0)))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("kind", "case"), FLIGHTS)
def test_flights_are_aligned_whichever_way_they_look(kind: str, case: str) -> None:
    """GPS of 1 m (2 m in altitude) over 100 m by 75 m fixes up to a degree or so, the scale to 2 %."""
    trials = [align_flight(kind, seed, case) for seed in range(8 if IS_WHOLE else 4)]
    assert all(found is not None for found, _ in trials)
    assert max(tilt_deg for _, tilt_deg in trials) < 7.0
    assert np.median([tilt_deg for _, tilt_deg in trials]) < 1.5
    for found, _ in trials:
        assert found.enu_from_world.scale == pytest.approx(50.0, rel=0.03)
        assert found.up_sigma_rad < np.deg2rad(4.5)
        if case == "outlier":
            assert found.residuals_m[3] == pytest.approx(500e3, rel=1e-3)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", ["nadir", "oblique"] if IS_WHOLE else ["oblique"])
def test_random_positions_of_a_flight_are_refused(kind: str) -> None:
    assert all(align_flight(kind, seed, "random")[0] is None for seed in range(10))


def test_positions_along_a_line_leave_up_to_the_cameras() -> None:
    centers = walk("line")
    fixes = ENU_FROM_UPRIGHT.apply(centers) + np.random.default_rng(0).normal(0, 1.0, centers.shape)
    found = aligned(centers, fixes)
    assert np.deg2rad(2.0) < found.up_sigma_rad < np.deg2rad(4.5)  # the cameras' 4 degrees
    up = (found.enu_from_world @ TILT.inverse()).rotation @ [0.0, 0.0, 1.0]
    assert np.rad2deg(np.arccos(up[2])) < 3.0


def test_measured_gravity_outweighs_habits() -> None:
    """A straight flight that looks down may as well be a walk along a wall; the gimbal tells them apart."""
    rng = np.random.default_rng(0)
    rotation = np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (8, 3, 3))  # x east, y south, z down
    cams = Rigid3(rotation.copy(), rng.normal(size=(8, 3)))
    assert len(up_directions(cams)) == 2
    gimbal = np.tile([0.0, 0.0, -1.0], (8, 1)) + rng.normal(0, 0.01, (8, 3))
    gimbal[2], gimbal[5] = np.nan, [1.0, 0.0, 0.0]  # one image without, one that is wrong
    (found,) = up_directions(cams, gimbal)
    assert found.is_measured
    np.testing.assert_allclose(found.direction, [0.0, 0.0, 1.0], atol=0.02)


METERS_PER_UNIT = 20.0


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Seven images whose EXIF holds where they were taken, in a courtyard a hundred meters across; one is 2 km off."""
    folder = tmp_path_factory.mktemp("gps") / "photographs"
    folder.mkdir()
    views = neighboring_views(7)
    enu = METERS_PER_UNIT * views.centers()
    for n in range(7):
        east, north, up = enu[n] + ([2000.0, 0, 0] if n == 4 else [0.0, 0, 0])
        lat_deg = 46.5 + np.rad2deg(north / 6_368_000.0)
        lon_deg = 7.25 + np.rad2deg(east / (6_388_000.0 * np.cos(np.deg2rad(46.5))))
        image = render(courtyard(), CAMERA, views[n], noise_sigma=1.5, seed=n)
        path = folder / f"view_{n:02d}.jpg"
        write_jpeg_with_exif(path, image.rgb, focal_35mm=FOCAL_35MM, gps=(lat_deg, lon_deg, 500.0 + up))
    return folder


def test_a_model_of_photographs_with_gps_stands_in_meters(photographs, tmp_path) -> None:
    result = reconstruct(photographs, tmp_path / "out")
    assert result.model.is_registered().all() and result.summary["is_metric"]
    headers = [read_header(photographs / name) for name in result.model.images.name]
    fixes = gps_to_enu(np.array([(h.gps.lat_deg, h.gps.lon_deg, h.gps.alt_m) for h in headers]))
    off = np.linalg.norm(result.model.cams_from_world().centers() - fixes, axis=1)
    assert np.delete(off, 4).max() < 1.0  # of views that stand ten meters apart
    assert abs(off[4] - 2000.0) < 20.0
    assert result.summary["median_gps_residual_m"] < 1.0
    (said,) = [w for w in result.warnings if "GPS positions that contradict the model are not used" in w]
    assert "view_04.jpg by" in said and "view_03" not in said
    truth = METERS_PER_UNIT * neighboring_views(7).centers()
    length = np.linalg.norm(np.diff(result.model.cams_from_world().centers(), axis=0), axis=1)
    np.testing.assert_allclose(length, np.linalg.norm(np.diff(truth, axis=0), axis=1), rtol=0.03)


def test_without_enough_fixes_the_scale_is_unknown_and_said_to_be(photographs, tmp_path) -> None:
    three, folder = tmp_path / "three", tmp_path / "photographs"
    for copy, count in ((three, 3), (folder, 4)):
        copy.mkdir()
        for path in sorted(photographs.iterdir())[:count]:
            (copy / path.name).write_bytes(path.read_bytes())
    for path in sorted(folder.iterdir())[2:]:
        write_jpeg_with_exif(path, read_rgb(path), focal_35mm=FOCAL_35MM)
    result = reconstruct(folder, tmp_path / "out")
    assert not result.summary["is_metric"]
    assert result.summary["median_gps_residual_m"] is None
    assert any("2 of the model's images carry GPS, but at least 3 are needed" in w for w in result.warnings)
    # Fixes within their own error of each other: as many as it takes, but of a courtyard.
    vague = ReconstructConfig(mapper=MapperConfig(gps_sigma_m=1000.0))
    again = reconstruct(three, tmp_path / "vague", vague)
    assert not again.summary["is_metric"]
    assert any("may be off by 5000 m" in w for w in again.warnings)
    # Random fixes.
    rng, random = np.random.default_rng(3), tmp_path / "random"
    random.mkdir()
    for path in sorted(photographs.iterdir())[:4]:
        gps = (46.5 + rng.uniform(0, 1e-3), 7.25 + rng.uniform(0, 1.5e-3), 500.0)
        write_jpeg_with_exif(random / path.name, read_rgb(path), focal_35mm=FOCAL_35MM, gps=gps)
    lost = reconstruct(random, tmp_path / "lost")
    assert not lost.summary["is_metric"] and lost.summary["median_gps_residual_m"] is None
    assert any("GPS positions do not fit the model: after the best fit" in w for w in lost.warnings)
    # Who asks for no GPS is not told of it.
    without = ReconstructConfig(mapper=MapperConfig(use_gps=False))
    assert result.model.is_registered().all()
    assert reconstruct(folder, tmp_path / "out", without).warnings == ()
