"""`epipole.compare_fields`: both fields trained and drawn, and the work for each pixel counted."""

import json

import numpy as np
import pytest
from fields_scenes import views

from epipole.errors import ConfigError, FileFormatError
from epipole.io.images.photographs import read_rgb
from epipole.pipelines.fields.comparison import compare_fields
from whole import in_whole_run


def test_both_are_trained_and_drawn(source, tmp_path):
    result = compare_fields(source, tmp_path / "out", test_every=7, steps=40, kind="grid")
    given = json.loads((result.out / "compare.json").read_text())
    assert given["held_out"] and given["views"] == 2 and given["kind"] == "grid" and not result.is_interrupted
    for name in ("splat", "nerf"):
        assert given[name] == result.rows[name]
        assert given[name]["psnr"] > 18 and given[name]["frames_s"] > 0 and given[name]["train_s"] > 0
        own = json.loads((result.out / name / "metrics.json").read_text())
        assert given[name]["psnr"] == pytest.approx(own["psnr"], abs=1e-6)
    assert given["splat"]["evaluated"] > given["splat"]["useful"] > 0.5 and given["nerf"]["queries"] > 0.5
    beside = read_rgb(result.out / "images" / "images_00.png")
    truth = np.rint(255 * views()[0].over(np.ones(3, np.float32))).astype(int)
    height, width, _ = truth.shape
    assert beside.shape == (height, 3 * width, 3)
    assert np.abs(beside[:, :width].astype(int) - truth).max() <= 1
    np.testing.assert_array_equal(
        beside[:, width : 2 * width], read_rgb(result.out / "splat/test/images_00.png")
    )


@in_whole_run
@pytest.mark.usefixtures("small_hash")
def test_without_held_out_views_those_of_the_training_are_compared(source, tmp_path):
    result = compare_fields(source, tmp_path / "out", test_every=0, steps=2, kind="hash")
    given = json.loads((result.out / "compare.json").read_text())
    assert not given["held_out"] and given["views"] == len(views())


def test_what_cannot_be_compared(source, tmp_path):
    with pytest.raises(FileFormatError, match="it does not exist"):
        compare_fields(tmp_path / "none", tmp_path / "out")
    with pytest.raises(ConfigError, match="kind"):
        compare_fields(source, tmp_path / "out", kind="mlp")
