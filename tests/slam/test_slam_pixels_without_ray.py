"""Pixels for which a camera model has no ray give no features, and the run says how many there are."""

import cv2
import numpy as np
import pytest

from epipole import Frame, Slam, SlamCamera
from epipole.cameras import Camera
from epipole.image.pixels_without_ray import no_ray_warning, pixels_without_ray
from epipole.pipelines.slam.run import slam as run_slam

FOLDED = Camera("OPENCV", 320, 240, [260.0, 260.0, 159.5, 119.5, 0.2312, -0.9, -0.0033, -0.0001])
"""k3 of such a calibration was left out: the distortion folds back inside the image."""


def moving_frames(count=12):
    """Images of a texture that moves sideways."""
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (240, 700), dtype=np.uint8), (5, 5), 1.2)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    return [np.ascontiguousarray(texture[:, 4 * n : 4 * n + 320]) for n in range(count)]


def test_all_tracked_points_have_a_ray():
    rays = FOLDED.unproject(np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), -1).reshape(-1, 2))
    has_none = ~np.isfinite(rays).all(axis=1).reshape(240, 320)
    assert 0.01 < has_none.mean() < 0.3
    assert pixels_without_ray(FOLDED)[has_none].all()
    assert pixels_without_ray(FOLDED).mean() < has_none.mean() + 0.1
    slam = Slam(SlamCamera(FOLDED))
    for n, gray in enumerate(moving_frames()):
        slam.track(Frame(0.1 * n, gray))
        assert len(slam.snapshot().tracked_px) > 100
        assert np.isfinite(FOLDED.unproject(slam.snapshot().tracked_px)).all()
    for keyframe in slam.map.keyframes:
        assert np.isfinite(FOLDED.unproject(keyframe.pixels)).all()


def test_a_camera_with_a_ray_everywhere_masks_nothing():
    assert pixels_without_ray(Camera("PINHOLE", 320, 240, [260.0, 260.0, 159.5, 119.5])) is None
    mild = Camera("OPENCV", 320, 240, [260.0, 260.0, 159.5, 119.5, 0.1, -0.05, 0.0, 0.0])
    assert pixels_without_ray(mild) is None and no_ray_warning(mild) == []
    frame = Frame(0.0, np.zeros((240, 320), np.uint8))
    assert SlamCamera(mild).checked(frame) is frame


def test_a_given_mask_stays_beside_the_pixels_without_ray():
    mask = np.zeros((240, 320), bool)
    mask[100:120, 100:120] = True
    frame = SlamCamera(FOLDED).checked(Frame(0.0, np.zeros((240, 320), np.uint8), ignored_mask=mask))
    np.testing.assert_array_equal(frame.ignored_mask, mask | pixels_without_ray(FOLDED))
    assert mask.sum() == 400


def test_the_run_says_how_many_pixels_have_no_ray(tmp_path):
    (tmp_path / "images").mkdir()
    for n, gray in enumerate(moving_frames()):
        cv2.imwrite(str(tmp_path / "images" / f"{n:02d}.png"), gray)
    params = ",".join(str(p + 0.5 * (n in (2, 3))) for n, p in enumerate(FOLDED.params))
    camera = {"camera_model": "OPENCV", "camera_params": params}
    result = run_slam(tmp_path / "images", tmp_path / "out", **camera)
    (warning,) = (w for w in result.warnings if "has no ray" in w)
    assert "check the distortion coefficients" in warning
    assert result.summary["fraction_without_ray"] == pytest.approx(pixels_without_ray(FOLDED).mean())
