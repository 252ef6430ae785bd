"""Georeferencing of simulated flights against the truth, and surveys with errors."""

import re
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from epipole.errors import ConfigError
from epipole.geometry import Similarity3
from epipole.pipelines.georeferencing.config import GeoreferenceConfig
from epipole.pipelines.georeferencing.georeference import GeoreferencedModel, PointRole, georeference_model
from epipole.pipelines.georeferencing.start import find_start, fit_similarity, is_wide
from epipole.pipelines.georeferencing.survey import GpsFixes

sys.path.insert(0, str(Path(__file__).parent))
from surveyed_flights import MARK_SIGMA_PX, NUM_CONTROL, ORIGIN, Flight, flight, with_positions

from whole import IS_WHOLE

CONFIG = GeoreferenceConfig(gcp=Path("gcp_list.txt"), mark_sigma_px=MARK_SIGMA_PX)
SEEDS = 20 if IS_WHOLE else 4


@cache
def usual() -> Flight:
    return flight(0)


def adjusted(of: Flight, **changes) -> GeoreferencedModel:
    given = {"surveyed": of.surveyed, "gps": of.gps} | changes
    return georeference_model(of.model, given["surveyed"], given["gps"], CONFIG)


def ratios(found: GeoreferencedModel, truth: np.ndarray) -> np.ndarray:
    """Errors of the adjusted points, relative to their standard deviations."""
    sigma = np.sqrt(np.einsum("nii->ni", found.adjusted.covariances))
    return (found.adjusted.positions_m - truth) / sigma


def test_errors_are_as_large_as_stated():
    """Of check points, control points and cameras; and nothing is rejected."""
    checks, points, cameras = [], [], []
    for seed in range(SEEDS):
        one = flight(seed)
        found = adjusted(one)
        assert not found.warnings
        check = ~one.surveyed.is_control
        checks.append((found.residuals_m / found.sigmas_m)[check])
        points.append(ratios(found, one.truth))
        sigma = np.sqrt(np.einsum("nii->ni", found.adjusted.center_covariances))
        cameras.append((found.model.camera_centers_in_world() - one.centers) / sigma)
    for name, values in (("check", checks), ("point", points), ("camera", cameras)):
        stacked = np.concatenate(values)
        assert (np.abs(stacked) <= 2.0).mean() > 0.9, name
        assert 0.4 < np.sqrt((stacked**2).mean()) < 1.3, name


def test_the_adjustment_is_better_than_a_similarity():
    """The lens distortion of the simulated model is a bit off, which bends it; control points unbend it."""
    own, others = [], []
    for seed in range(SEEDS):
        one = flight(seed)
        found = adjusted(one)
        check = ~one.surveyed.is_control
        start = find_start(
            one.model, one.surveyed, _in_model(one, found), None, CONFIG.gps_sigma_m
        ).enu_from_world
        own.append((found.adjusted.positions_m - one.truth)[check])
        others.append((start.apply(_in_model(one, found)) - one.truth)[check])
    assert np.square(own).mean() < np.square(others).mean()


def _in_model(one: Flight, found: GeoreferencedModel) -> np.ndarray:
    """The surveyed points in the coordinates of the model before it was adjusted."""
    from epipole.pipelines.georeferencing.georeference import _triangulated

    return _triangulated(one.model, one.surveyed, found.used_mask, 12.0)[1]


def test_gps_alone():
    one = usual()
    none = replace(one.surveyed, is_control=np.zeros(len(one.surveyed), bool))
    found = adjusted(one, surveyed=none)
    off = found.adjusted.positions_m - one.truth
    # Tilt is determined by altitudes of 4 m alone, which displace the ground by meters; the standard deviations say so.
    assert 0.5 < np.abs(off[:, :2]).max() < 8.0 and found.gps_offset_m is None
    assert (np.abs(ratios(found, one.truth)) < 3.5).all()
    assert set(found.roles) == {PointRole.CHECK}


def test_control_points_without_gps():
    one = usual()
    found = adjusted(one, gps=None)
    assert (np.abs(ratios(found, one.truth)) < 4.0).all()
    assert np.isnan(found.gps_residuals_m).all()


def test_a_wrong_coordinate_is_found_and_named():
    one = usual()
    wrong = one.surveyed.position_m.copy()
    wrong[2, 0] += 1.0
    found = adjusted(one, surveyed=with_positions(one.surveyed, wrong))
    assert found.roles[2] is PointRole.REJECTED
    assert found.roles.count(PointRole.REJECTED) == 1
    (warning,) = found.warnings
    assert "P2 contradicts the others" in warning and "+1.0" in warning
    assert (np.abs(ratios(found, one.truth)) < 4.0).all()


@pytest.mark.parametrize("off_m", [0.2] + IS_WHOLE * [0.3, 0.5])
def test_small_errors_of_coordinates_are_found(off_m: float):
    """Ten standard deviations, which the correlated residuals of the images must not hide."""
    num_found = 0
    for seed in range(SEEDS):
        one = flight(seed)
        wrong = one.surveyed.position_m.copy()
        wrong[1, 1] += off_m
        found = adjusted(one, surveyed=with_positions(one.surveyed, wrong))
        num_found += found.roles[1] is PointRole.REJECTED
    assert num_found >= 0.8 * SEEDS


def test_many_wrong_points_are_all_rejected():
    one = flight(0)
    more = replace(one.surveyed, is_control=np.ones(len(one.surveyed), bool))
    wrong = more.position_m.copy()
    wrong[[1, 6, 9]] += [[0.5, 0, 0], [0, 0.7, 0], [0, -0.6, 0.5]]
    found = adjusted(one, surveyed=with_positions(more, wrong))
    assert {n for n, role in enumerate(found.roles) if role is PointRole.REJECTED} == {1, 6, 9}
    assert (np.abs(ratios(found, one.truth)) < 4.5).all()


def test_a_wrong_point_of_four_is_not_silent():
    one = usual()
    few = replace(one.surveyed, is_control=np.arange(len(one.surveyed)) < 4)
    wrong = few.position_m.copy()
    wrong[1, 0] += 1.0
    found = adjusted(one, surveyed=with_positions(few, wrong))
    assert PointRole.REJECTED not in found.roles
    assert any("P1" in warning and "wrong" in warning for warning in found.warnings)


@pytest.mark.parametrize("num_control", [1, 2])
def test_one_or_two_control_points_remove_the_offset_of_gps(num_control: int):
    """GPS 40 m too high: the images, and not only the control points, are at the heights of the control points."""
    one = usual()
    few = replace(one.surveyed, is_control=np.arange(len(one.surveyed)) < num_control)
    above = GpsFixes(one.gps.position_m + np.array([0.0, 0.0, 40.0]), one.gps.sigma_m)
    found = adjusted(one, surveyed=few, gps=above)
    assert np.abs((found.model.camera_centers_in_world() - one.centers)[:, 2]).max() < 6.0
    assert any("above the ellipsoid" in warning for warning in found.warnings)
    assert found.model.mean_reprojection_error_px() < 0.8


def test_gps_moves_a_model_that_was_georeferenced_elsewhere():
    one = usual()
    none = replace(one.surveyed, is_control=np.zeros(len(one.surveyed), bool))
    true = georeference_model(one.model, one.surveyed, None, CONFIG).model
    moved = true.transformed(Similarity3(np.asarray(1.0), np.eye(3), np.array([5.0, 20.0, -30.0])))
    moved = replace(moved, georeference=ORIGIN)
    found = georeference_model(moved, none, one.gps, CONFIG)
    off = found.model.camera_centers_in_world() - one.centers
    assert np.abs(off.mean(axis=0)).max() < 1.5


@pytest.mark.parametrize("off_px", [200.0, 9.0])
def test_a_wrong_mark_is_found_and_named(off_px: float):
    one = usual()
    k = int(np.flatnonzero(one.surveyed.point == 4)[0])
    pixels = one.surveyed.pixels.copy()
    pixels[k, 0] += off_px
    found = adjusted(one, surveyed=replace(one.surveyed, pixels=pixels))
    assert not found.used_mask[k] and found.used_mask.sum() == len(pixels) - 1
    assert len(found.warnings) == 1 and "P4" in found.warnings[0]
    assert PointRole.REJECTED not in found.roles


def test_a_point_in_one_image_is_not_used():
    one = usual()
    own = np.flatnonzero(one.surveyed.point == 1)
    keep = np.setdiff1d(np.arange(len(one.surveyed.point)), own[1:])
    part = {name: getattr(one.surveyed, name)[keep] for name in ("point", "image", "pixels")}
    found = adjusted(one, surveyed=replace(one.surveyed, **part))
    assert found.roles[1] is PointRole.UNSEEN
    assert found.warnings == (
        "the point P1 is not used: only one registered image shows it, and at least two are needed",
    )


def test_exchanged_axes_are_refused_with_and_without_gps():
    one = usual()
    given = one.surveyed
    exchanged = replace(given, position_m=given.position_m[:, [1, 0, 2]], exchanged_m=given.position_m)
    for gps in (None, one.gps):
        with pytest.raises(ConfigError, match=r"exchanged: easting .longitude. must come first"):
            adjusted(one, surveyed=exchanged, gps=gps)


def test_heights_above_the_geoid_are_noticed():
    one = usual()
    above = GpsFixes(one.gps.position_m + np.array([0.0, 0.0, 46.5]), one.gps.sigma_m)
    found = adjusted(one, gps=above)
    (warning,) = found.warnings
    assert "46." in warning and "above the ellipsoid" in warning
    assert found.gps_offset_m is not None and abs(found.gps_offset_m[2] - 46.5) < 3.0
    assert (np.abs(ratios(found, one.truth)) < 4.0).all()


def test_precise_gps_above_another_surface_is_noticed_by_its_standard_deviations():
    one = usual()
    sigma = np.full_like(one.gps.sigma_m, 0.03)
    noise = np.random.default_rng(1).normal(0.0, 0.03, one.centers.shape)
    for offset_m, number in ((0.3, 0), (8.0, 1)):
        precise = GpsFixes(one.centers + noise + [0.0, 0.0, offset_m], sigma)
        found = adjusted(one, gps=precise)
        assert len(found.warnings) == number and all(
            re.search(r"[78]\.\d m above", text) for text in found.warnings
        )


def test_check_points_above_another_surface_or_measured_wrongly_are_told():
    one, rows = usual(), np.flatnonzero(~usual().surveyed.is_control)
    higher = one.surveyed.position_m.copy()
    higher[rows, 2] += 46.5
    (warning,) = adjusted(one, surveyed=with_positions(one.surveyed, higher)).warnings
    assert f"{len(rows)} check points were measured 46." in warning and "sea level" in warning
    wrong = one.surveyed.position_m.copy()
    wrong[rows[0], 0] += 1.0
    (warning,) = adjusted(one, surveyed=with_positions(one.surveyed, wrong)).warnings
    assert re.search(rf"the check point {one.surveyed.name[rows[0]]} was measured \+(0\.9|1\.0)", warning)


def test_many_wrong_check_points_are_counted_and_the_farthest_named():
    one, rows = usual(), np.flatnonzero(~usual().surveyed.is_control)
    wrong = one.surveyed.position_m.copy()
    wrong[rows, 0] += np.where(np.arange(len(rows)) < 3, 4.0, 0.5)
    first, *named = adjusted(one, surveyed=with_positions(one.surveyed, wrong)).warnings
    assert f"{len(rows)} check points are more than 4 standard deviations" in first
    assert len(named) == 3 and all(f"{one.surveyed.name[row]} was" in " ".join(named) for row in rows[:3])


@pytest.mark.parametrize("higher", [(0, 1), (0, 2, 4)])
def test_control_points_above_two_surfaces_are_named(higher):
    """Two or three of five."""
    one = usual()
    position, is_control = one.surveyed.position_m.copy(), one.surveyed.is_control.copy()
    rows = np.flatnonzero(is_control)[:5]
    is_control[:] = False
    is_control[rows] = True
    position[rows[list(higher)], 2] += 46.5
    mixed = replace(with_positions(one.surveyed, position), is_control=is_control)
    with pytest.raises(ConfigError, match=r"fit the model horizontally, but .* 46\.\d m (higher|lower)"):
        adjusted(one, surveyed=mixed)


def test_a_constant_offset_of_gps_does_not_matter():
    one = usual()
    moved = GpsFixes(one.gps.position_m + np.array([4.0, -3.0, 1.0]), one.gps.sigma_m)
    before, after = adjusted(one), adjusted(one, gps=moved)
    assert not after.warnings
    np.testing.assert_allclose(
        after.adjusted.positions_m[:NUM_CONTROL], before.adjusted.positions_m[:NUM_CONTROL], atol=2e-3
    )


@pytest.mark.parametrize("num_control", [0, 1, 2])
def test_too_few_control_points_say_so(num_control: int):
    one = usual()
    few = replace(one.surveyed, is_control=np.arange(len(one.surveyed)) < num_control)
    with pytest.raises(ConfigError, match="at least 3 that are not on a line, or GPS"):
        adjusted(one, surveyed=few, gps=None)


def test_control_points_of_another_model_are_refused():
    one = usual()
    random = np.random.default_rng(3).uniform(0, 80, one.surveyed.position_m.shape)
    with pytest.raises(ConfigError, match="do not fit the model"):
        adjusted(one, surveyed=with_positions(one.surveyed, random), gps=None)


def test_a_height_that_is_not_known_does_not_constrain():
    one = usual()
    without = one.surveyed.position_m.copy()
    without[4, 2] = np.nan
    found = adjusted(one, surveyed=with_positions(one.surveyed, without))
    assert np.isnan(found.residuals_m[4, 2]) and np.isfinite(found.residuals_m[4, :2]).all()
    assert (np.abs(ratios(found, one.truth)) < 4.0).all()


def test_points_on_a_line_are_not_wide():
    line = np.arange(5.0)[:, None] * [1.0, 2.0, 0.5]
    assert not is_wide(line) and not is_wide(line[:2])
    assert is_wide(np.concatenate([line, [[0.0, 3.0, 0.0]]]))


def test_three_points_of_another_shape_have_no_similarity():
    source = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]])
    assert fit_similarity(source, source * [2.0, 1.0, 1.0]) is None
    found = fit_similarity(source, 3.0 * source + 1.0)
    assert isinstance(found, Similarity3) and abs(float(found.scale) - 3.0) < 1e-9
