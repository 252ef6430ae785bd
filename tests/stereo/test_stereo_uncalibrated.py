"""Pairs of which nothing is known: rows match afterwards, there is no depth, and impossible pairs say why."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image

from epipole import api
from epipole.errors import ConfigError, DegenerateGeometryError, FileFormatError, ShapeError
from epipole.io.images.photographs import read_rgb
from epipole.pipelines.stereo.config import StereoConfig
from epipole.pipelines.stereo.uncalibrated import rectify_uncalibrated
from epipole.scene import RectifiedRig
from epipole.synthetic.stereo_rooms import stereo_room


def test_rows_of_real_pictures_match_afterwards(data_dir):
    folder = data_dir / "calibration" / "opencv_stereo"
    left, right = (read_rgb(folder / f"{side}01.jpg") for side in ("left", "right"))
    found = rectify_uncalibrated(left, right)
    assert np.median(np.abs(found.vertical_px)) < 0.5 and len(found.vertical_px) > 100
    a, b = found.apply(left, right)
    assert a.shape == b.shape == left.shape
    assert found.left_valid.mean() > 0.8 and not found.left_valid.all()
    assert "matches" in repr(found)


def test_pictures_that_are_no_pair(rng):
    blank = np.zeros((120, 160), np.uint8)
    with pytest.raises(DegenerateGeometryError):
        rectify_uncalibrated(blank, blank)
    with pytest.raises(ShapeError, match="the same size"):
        rectify_uncalibrated(blank, blank[:100])
    with pytest.raises(ShapeError, match="8-bit image"):
        rectify_uncalibrated(blank.astype(np.float64), blank)
    one, two = (rng.integers(0, 256, (200, 300)).astype(np.uint8) for _ in range(2))
    with pytest.raises(DegenerateGeometryError):
        rectify_uncalibrated(one, two)


def test_a_turned_pair_to_disparities(tmp_path):
    """The right image turned by two degrees: rows match again, and order what lies in them by depth."""
    pair = stereo_room(3, (480, 360))
    height, width = pair.right.shape[:2]
    rotation = cv2.getRotationMatrix2D((width / 2, height / 2), 2.0, 1.0)
    right = cv2.warpAffine(pair.right, rotation, (width, height), flags=cv2.INTER_CUBIC)
    for side, image in (("left", pair.left), ("right", right)):
        Image.fromarray(image).save(tmp_path / f"{side}.png")
    files, out = (tmp_path / "left.png", tmp_path / "right.png"), tmp_path / "out"
    found = api.stereo(*files, out, StereoConfig(uncalibrated=True))
    given = json.loads((out / "homographies.json").read_text())
    assert given["vertical_median_px"] < 0.3 and given["num_matches"] > 100
    assert found.depths is None and found.disparities.density > 0.5
    assert (out / "left.png").is_file() and not (out / "depth.pfm").exists()
    assert any("projective" in words for words in found.warnings)
    rig = RectifiedRig(500.0, 240.0, 180.0, 0.1)
    with pytest.raises(ConfigError, match="cannot be combined with a calibration"):
        api.stereo(*files, out, StereoConfig(uncalibrated=True), rig)
    found = api.stereo(*files, out, StereoConfig(max_disparity_px=60))
    assert not (out / "homographies.json").exists() and not (out / "left.png").exists()
    with pytest.raises(FileFormatError, match="no depth"):
        api.view(out, block=False)
