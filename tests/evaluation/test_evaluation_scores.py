"""The scores of `evaluate`: rmse, scale, and the areas of COLMAP's benchmarks."""

import numpy as np
import pytest

import epipole
from epipole.geometry import Similarity3
from epipole.io import write_colmap_model
from epipole.synthetic.problems import bundle_problem


def test_a_scaled_copy_has_its_scale_and_no_error(tmp_path):
    truth = bundle_problem(8, 200, 4).truth
    write_colmap_model(truth, tmp_path / "truth")
    moved = truth.transformed(Similarity3(np.asarray(0.98), np.eye(3), np.array([1.0, 2.0, 3.0])))
    write_colmap_model(moved, tmp_path / "scaled")
    found = epipole.evaluate(tmp_path / "scaled", tmp_path / "truth")
    assert found.scale == pytest.approx(1.0 / 0.98)
    centers = truth.camera_centers_in_world()
    spread = np.sqrt(np.mean(np.sum((centers - centers.mean(axis=0)) ** 2, axis=1)))
    assert found.position_rmse_same_scale == pytest.approx(0.02 * spread)
    assert found.position_rmse < 1e-9 and list(found.auc) == [0.5, 1, 3, 5, 10]
    assert min(found.auc.values()) > 0.999


def test_one_wrong_camera_raises_the_rmse_above_the_mean(tmp_path):
    truth = bundle_problem(8, 200, 4).truth
    write_colmap_model(truth, tmp_path / "truth")
    wrong = truth.frames.rig_from_world.translation.copy()
    wrong[0] += [0.3, 0.0, 0.0]
    frames = type(truth.frames)(
        truth.frames.rig,
        type(truth.frames.rig_from_world)(truth.frames.rig_from_world.rotation, wrong),
        truth.frames.timestamp_s,
    )
    model = type(truth)(truth.cameras, truth.rigs, frames, truth.images, truth.points, truth.tracks)
    write_colmap_model(model, tmp_path / "wrong")
    found = epipole.evaluate(tmp_path / "wrong", tmp_path / "truth")
    assert found.position_mean < found.position_rmse < found.position_max
    assert found.auc[0.5] < found.auc[10] < 1.0
