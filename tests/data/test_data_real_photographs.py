"""The main job on real photographs with known cameras."""

import pytest

from epipole.api import evaluate, reconstruct
from epipole.pipelines.sfm.config import ReconstructConfig
from whole import IS_WHOLE

K_HALF_SIZE = "1379.74,1382.08,760.345,503.405"


SETS = [("Herz-Jesus-P8", 8, 0.0045), ("fountain-P11", 11, 0.0032)]


@pytest.mark.parametrize(("name", "count", "limit_m"), SETS if IS_WHOLE else SETS[:1])
def test_strecha_sets_with_known_intrinsics(data_dir, tmp_path, name, count, limit_m):
    config = ReconstructConfig(camera_model="PINHOLE", camera_params=K_HALF_SIZE)
    result = reconstruct(data_dir / "sfm" / name / "images", tmp_path / "out", config)
    assert result.summary["num_registered"] == count
    errors = evaluate(tmp_path / "out", data_dir / "sfm" / name / "gt_dense_cameras")
    assert errors.num_registered == count
    assert errors.position_mean < limit_m
    assert errors.auc[1] > 0.9
