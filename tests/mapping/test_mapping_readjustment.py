"""Whole models adjusted: to the noise floor, into a new model, with the old one as it was."""

import numpy as np
import pytest

from epipole.mapping import Freedom, adjust_reconstruction, bundle_problem_of
from epipole.optim import BundleConfig, BundlePriors
from epipole.synthetic.problems import bundle_problem


def test_a_start_becomes_a_model():
    problem = bundle_problem(8, 200, 5, noise_px=0.5)
    before = problem.start.points.xyz_in_world.copy()
    adjusted, result = adjust_reconstruction(problem.start, BundleConfig(function_tolerance=1e-9))
    assert result.converged and result.final_cost < 0.2 * result.initial_cost
    assert adjusted.mean_reprojection_error_px() < problem.truth.mean_reprojection_error_px() * 1.01
    assert adjusted.points.error_px.mean() == pytest.approx(adjusted.mean_reprojection_error_px(), rel=0.05)
    np.testing.assert_array_equal(problem.start.points.xyz_in_world, before)


def test_constant_cameras_and_freedoms_are_kept():
    problem = bundle_problem(6, 100, 4)
    fixed, _ = adjust_reconstruction(problem.start, freedom=Freedom(focal=False, distortion=False))
    np.testing.assert_array_equal(fixed.cameras.params, problem.start.cameras.params)
    assert not bundle_problem_of(problem.start, Freedom(focal=False, distortion=False)).params_free.any()


def test_positions_say_where_the_model_is():
    problem = bundle_problem(8, 200, 5)
    wanted = 3.0 * problem.truth.frames.rig_from_world.centers() + [10.0, -5.0, 2.0]
    priors = BundlePriors(position_in_world=wanted, position_sigma=0.01)
    adjusted, _ = adjust_reconstruction(problem.truth, BundleConfig(max_iterations=200), priors=priors)
    assert np.abs(adjusted.frames.rig_from_world.centers() - wanted).max() < 0.05
