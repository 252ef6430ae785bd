"""Arguments that once crashed the process, were read past their end, or passed for good."""

import subprocess
import sys
from dataclasses import fields, replace

import numpy as np
import pytest

from epipole.config import FeatureConfig, MatchConfig, RansacConfig
from epipole.disparity_search.config import DisparityConfig
from epipole.errors import ConfigError, EpipoleError, ShapeError
from epipole.features import Features, match_along_epipolar_lines, most_similar
from epipole.mapping import connect_matches
from epipole.optim import BundleConfig, BundleProblem, Loss, PoseGraph, PoseGraphConfig, evaluate_loss
from epipole.pipelines.sfm.config import MapperConfig
from epipole.robust import point_covariances, triangulate_points
from epipole.solvers import solve_homography_dlt, solve_p3p
from epipole.synthetic.problems import two_view_problem
from valid_calls import Call, valid_calls

pytestmark = pytest.mark.usefixtures("unchecked")

CONFIGS = (
    FeatureConfig,
    MatchConfig,
    RansacConfig,
    DisparityConfig,
    MapperConfig,
    BundleConfig,
    PoseGraphConfig,
)


def call_named(name: str) -> Call:
    """The valid call of this name."""
    return next(call for call in valid_calls() if call.name == name)


@pytest.mark.parametrize("kind", CONFIGS)
def test_no_option_is_nan_or_of_another_kind(kind):
    for field in fields(kind):
        for value in (float("nan"), object(), b"x", [1]):
            with pytest.raises(ConfigError, match=field.name):
                kind(**{field.name: value})


@pytest.mark.parametrize("kind", [RansacConfig, MapperConfig])
def test_seeds_are_not_negative(kind):
    with pytest.raises(ConfigError, match=r"seed must .*, got -1"):
        kind(seed=-1)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("pixels", np.zeros((60, 1)), r"pixels must be \(k, 2\)"),
        ("points_in_world", np.zeros((20, 1)), r"points_in_world must be \(p, 3\)"),
        ("frame", np.zeros(60), "frame must be an array of whole numbers, got float64"),
        ("camera", np.zeros((60, 1), np.int32), r"camera must be \(k\)"),
        ("sensor", np.full(60, 7, np.int32), "refers to a sensor that does not exist"),
        ("camera_params", np.ones((1, 4)), r"camera_params must be \(c, 12\)"),
        ("camera_model", np.array([99], np.int32), "unknown camera model 99: models are numbered 0 to 6"),
        ("point_free", np.full(20, np.nan), "point_free must be 0 or 1"),
        ("priors", "none", "priors must be a BundlePriors"),
    ],
)
def test_bundle_problems_that_do_not_fit(name, value, says):
    valid = call_named("BundleProblem").arguments
    with pytest.raises(EpipoleError, match=says):
        BundleProblem(**valid | {name: value})


def test_losses_that_are_none():
    with pytest.raises(ConfigError, match="loss must be one of"):
        BundleConfig(loss=99)
    with pytest.raises(ConfigError, match="loss must be one of"):
        evaluate_loss(99, np.ones(3), 1.0)
    assert BundleConfig(loss=3).loss is Loss.CAUCHY


@pytest.mark.parametrize(
    "index", [np.zeros(6), np.zeros(6, bool), np.zeros((6, 1), int), np.full(6, -1), np.full(6, 5)]
)
def test_edges_name_places_by_whole_numbers(index):
    valid = call_named("PoseGraph").arguments
    with pytest.raises(ShapeError):
        PoseGraph(**valid | {"first": index})


@pytest.mark.parametrize("keypoint", [10**6, -1])
def test_matches_join_keypoints_that_are_there(keypoint):
    valid = call_named("connect_matches").arguments
    wrong = valid["view_graph"].keypoint1.copy()
    wrong[3] = keypoint
    with pytest.raises(ShapeError, match="keypoint1 refers to a keypoint that does not exist"):
        connect_matches(replace(valid["view_graph"], keypoint1=wrong), valid["keypoint_offsets"])


def test_a_component_is_triangulated_once():
    """Twice in a list it left observations of points that were not there."""
    builder = call_named("ModelBuilder.triangulate").function.__self__
    rows = builder.row_point.copy()
    with pytest.raises(ShapeError, match="components must be distinct, got 1 twice"):
        builder.triangulate(np.array([1, 0, 1]), 4.0, 0.01)
    np.testing.assert_array_equal(builder.row_point, rows)


def test_every_keypoint_has_a_descriptor():
    many = np.zeros((5000, 2), np.float32)
    with pytest.raises(ShapeError, match="descriptors must be"):
        Features(many, many[:, 0].copy(), many[:, 0].copy(), np.zeros((1, 128), np.uint8))


def test_pixels_that_no_picture_has_cost_no_memory():
    one = call_named("match_along_epipolar_lines").arguments
    for far in (1e7, np.nan):
        pixels = one["features1"].pixels.copy()
        pixels[0] = far
        with pytest.raises(ShapeError, match="pixels"):
            match_along_epipolar_lines(**one | {"features2": replace(one["features1"], pixels=pixels)})


def test_masks_of_views_fit():
    valid = call_named("point_covariances").arguments
    for mask in (np.ones((4, 5), bool), np.ones((2, 6), bool), np.ones(6, bool), np.ones((4, 6))):
        with pytest.raises(ShapeError, match="seen_mask"):
            point_covariances(**valid | {"seen_mask": mask})
    pixels = call_named("triangulate_points of 2").arguments["pixels"]
    with pytest.raises(ShapeError, match="pixels must be"):
        triangulate_points(valid["cams_from_world"], valid["cameras"], pixels)


def test_minimal_solvers_take_one_sample():
    valid = call_named("solve_p3p").arguments
    with pytest.raises(ShapeError, match=r"rays_in_cam must be \(3, 3\), got \(2, 3, 3\)"):
        solve_p3p(valid["points_in_world"], np.stack([valid["rays_in_cam"]] * 2))
    with pytest.raises(ShapeError, match="rays_in_cam must be finite, nonzero directions"):
        solve_p3p(valid["points_in_world"], 0.0 * valid["rays_in_cam"])


def test_problems_that_no_pictures_pose_end():
    with pytest.raises(ConfigError, match="too few points in common"):
        two_view_problem(20, size=(640, 1))


_MEMORY = """
import resource
import numpy as np
from epipole.solvers import solve_fundamental_eight_point, solve_homography_dlt
pixels = np.random.default_rng(0).uniform(0, 1000, (8000, 2))
solve_homography_dlt(pixels[:8], pixels[:8] + 1)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
solve_homography_dlt(pixels, pixels + 1)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


def test_memory_of_linear_solvers_grows_with_the_matches_alone():
    """Left singular vectors of 8000 matches would take 2 GB."""
    ran = subprocess.run([sys.executable, "-c", _MEMORY], capture_output=True, text=True, check=True)
    assert int(ran.stdout) < 100_000  # kilobytes


@pytest.mark.parametrize("n", [4, 5, 8, 9, 30])
def test_linear_homographies_are_those_of_the_full_decomposition(n):
    """The economical form gives the same last digit."""
    rng = np.random.default_rng(n)
    system = rng.normal(size=(2 * n, 9))
    full = np.linalg.svd(system, full_matrices=True)[2][-1]
    assert np.array_equal(np.linalg.svd(system, full_matrices=2 * n < 9)[2][-1], full)
    pixels = rng.uniform(0, 100, (n, 2))
    expected = np.eye(3) / np.sqrt(3.0)
    assert np.abs(np.abs(solve_homography_dlt(pixels, pixels)) - expected).max() < 1e-9


def test_many_pictures_are_compared_in_blocks(monkeypatch):
    vectors = np.random.default_rng(1).normal(size=(50, 16)).astype(np.float32)
    whole = most_similar(vectors, 5)
    monkeypatch.setattr("epipole.features.retrieve._BLOCK_ROWS", 7)
    np.testing.assert_array_equal(most_similar(vectors, 5), whole)
