"""Bundle adjustment in the large: the minima that Ceres reaches, or lower ones, by every way to solve."""

from itertools import product

import pytest

from epipole.io import read_bal, write_bal
from epipole.optim import BundleConfig, LinearSolver, Loss, adjust_bundle, bundle_covariance, with_fixed_gauge
from whole import IS_WHOLE

CERES_COST = {"problem-16-22106-pre": 18033.90351, "problem-21-11315-pre": 30378.63604}
"""Of version 2.2, function tolerance 1e-6 (the lower of a free gauge and a fixed one)."""

SOLVERS = (LinearSolver.DIRECT, LinearSolver.ITERATIVE)
PROBLEMS = list(product(CERES_COST, SOLVERS) if IS_WHOLE else zip(reversed(CERES_COST), SOLVERS))


@pytest.mark.parametrize(("name", "solver"), PROBLEMS)
def test_minima_are_those_of_ceres_or_lower(data_dir, name, solver):
    problem = read_bal(data_dir / "bundle" / f"{name}.txt.bz2")
    for single in (False, True):
        result = adjust_bundle(problem, BundleConfig(solver=solver, single_precision=single))
        assert result.converged and result.used_mask.all()
        slack = 1e-5 if solver is LinearSolver.ITERATIVE else 1e-7
        assert result.final_cost <= CERES_COST[name] * (1 + slack)


def test_a_robust_loss_leaves_most_observations_better(data_dir):
    problem = read_bal(data_dir / "bundle" / "problem-21-11315-pre.txt.bz2")
    plain = adjust_bundle(problem)
    for loss in [Loss.CAUCHY] + IS_WHOLE * [Loss.HUBER, Loss.TUKEY]:
        result = adjust_bundle(problem, BundleConfig(loss=loss, loss_scale_px=1.0, max_iterations=100))
        assert result.final_cost < 0.7 * plain.final_cost


def test_an_adjusted_problem_is_written_and_known(data_dir, tmp_path):
    problem = with_fixed_gauge(read_bal(data_dir / "bundle" / "problem-21-11315-pre.txt.bz2"))
    result = adjust_bundle(problem)
    found = bundle_covariance(problem, result)
    assert 1.2 < found.noise_px < 1.3
    focal = result.camera_params[:, 0]
    assert (found.camera_params[:, 0, 0] > 0).all() and (
        found.camera_params[:, 0, 0] < (0.2 * focal) ** 2
    ).all()
    write_bal(tmp_path / "same.txt", problem)
    assert adjust_bundle(read_bal(tmp_path / "same.txt")).final_cost == pytest.approx(
        result.final_cost, rel=1e-6
    )
