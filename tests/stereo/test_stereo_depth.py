"""Depth with its error, points with their covariances, and the command on files."""

import json

import numpy as np
import pytest
from PIL import Image

from epipole import api
from epipole.cameras import Camera, CameraModel
from epipole.disparity_search.search import match_stereo
from epipole.errors import ConfigError, FileFormatError, ShapeError, WorkspaceError
from epipole.geometry import Rigid3
from epipole.io.images.depth_maps import read_pfm, read_png16
from epipole.io.meshes.ply import read_points_ply
from epipole.pipelines.stereo.config import RigOptions, StereoConfig
from epipole.pipelines.stereo.depth import depth_of, point_covariances
from epipole.pipelines.stereo.pair import measure_pair
from epipole.pipelines.stereo.rigs import rectified_rig_of, rig_from_options
from epipole.pipelines.stereo.run import examine_stereo
from epipole.scene import DisparityMap, RectifiedRig, StereoReason, StereoRig
from epipole.synthetic.stereo_rooms import stereo_room
from whole import IS_WHOLE

RIG = RectifiedRig(800.0, 319.5, 239.5, 0.12)


def made_up(disparity, sigma):
    disparity = np.asarray(disparity, np.float32)
    reason = np.where(np.isfinite(disparity), StereoReason.OK, StereoReason.OCCLUDED).astype(np.uint8)
    return DisparityMap(
        disparity, np.where(np.isfinite(disparity), np.float32(sigma), np.float32(np.nan)), reason
    )


def test_depth_and_its_error_are_the_lessons():
    found = depth_of(made_up([[40.0, 4.0, np.nan, 0.0]], 1.0), RIG)
    np.testing.assert_allclose(found.depth, [[2.4, 24.0, np.nan, np.nan]], rtol=1e-6)
    np.testing.assert_allclose(found.sigma, [[0.06, 6.0, np.nan, np.nan]], rtol=1e-6)


def test_covariances_are_those_of_simulated_pixels(rng):
    disparities = made_up(np.full((480, 640), 20.0), 0.2)
    depths = depth_of(disparities, RIG)
    first_order = point_covariances(depths, RIG)[100, 500]
    d, x, y = (
        20 + 0.2 * rng.standard_normal(200_000),
        *(0.3 * rng.standard_normal((2, 200_000)) + [[500], [100]]),
    )
    z = RIG.focal_px * RIG.baseline / d
    points = np.stack([z * (x - RIG.cx) / RIG.focal_px, z * (y - RIG.cy) / RIG.focal_px, z], axis=1)
    np.testing.assert_allclose(first_order, np.cov(points.T), rtol=0.03, atol=2e-7)
    with pytest.raises(ConfigError, match="pixel_sigma_px"):
        point_covariances(depths, RIG, -1.0)


def test_depth_errors_lie_within_their_bars_near_and_far():
    """Z^2 / (f B) sigma_d against what is true, in fifths of rising depth."""
    ratios, depths = [], []
    for seed in range(20_001, 20_021 if IS_WHOLE else 20_011, 2):
        pair = stereo_room(seed, (320, 240))
        rig = RectifiedRig(pair.camera.K[0, 0], pair.camera.K[0, 2], pair.camera.K[1, 2], pair.baseline)
        config = StereoConfig(max_disparity_px=int(np.nanmax(pair.disparity_px)) + 8)
        found = depth_of(match_stereo(pair.left, pair.right, config), rig)
        truth = rig.focal_px * rig.baseline / pair.disparity_px
        known = np.isfinite(found.depth) & np.isfinite(truth)
        ratios.append((np.abs(found.depth - truth) / found.sigma)[known])
        depths.append(truth[known])
    ratio, depth = np.concatenate(ratios), np.concatenate(depths)
    assert 0.62 < (ratio <= 1).mean() < 0.75
    for part in np.array_split(np.argsort(depth), 5):
        assert 0.55 < (ratio[part] <= 1).mean() < 0.85


def test_rigs_that_cannot_be():
    with pytest.raises(ConfigError, match="swapped"):
        RectifiedRig(800.0, 0, 0, -0.1)
    for focal, baseline in ((0.0, 1.0), (800.0, 0.0), (np.nan, 1.0)):
        with pytest.raises(ConfigError, match=r"positive|must be a number, got NaN"):
            RectifiedRig(focal, 0, 0, baseline)
    with pytest.raises(ConfigError, match="only focal_px was given"):
        rig_from_options(RigOptions(focal_px=800.0), (640, 480))
    with pytest.raises(ConfigError, match="only baseline was given"):
        rig_from_options(RigOptions(baseline=0.1), (640, 480))
    with pytest.raises(ConfigError, match=r"focal_px must be 0, or from 1e-30 to 1e\+30"):
        rig_from_options(RigOptions(focal_px=1e308, baseline=0.1), (640, 480))
    assert rig_from_options(RigOptions(), (640, 480)) is None
    assert rig_from_options(RigOptions(focal_px=800.0, baseline=0.12), (640, 480)) == RIG


@pytest.fixture
def pair_files(tmp_path):
    pair = stereo_room(7, (200, 150))
    for side in ("left", "right"):
        Image.fromarray(getattr(pair, side)).save(tmp_path / f"{side}.png")
    return pair, tmp_path / "left.png", tmp_path / "right.png"


def test_a_pair_of_files_to_everything(pair_files, tmp_path):
    pair, left, right = pair_files
    out = tmp_path / "out"
    rig = RectifiedRig(pair.camera.K[0, 0], pair.camera.K[0, 2], pair.camera.K[1, 2], pair.baseline)
    found = api.stereo(left, right, out, StereoConfig(max_disparity_px=63), rig)
    disparity, known = read_pfm(out / "disparity.pfm"), found.disparities.reason == StereoReason.OK
    np.testing.assert_array_equal(disparity, found.disparities.disparity_px)
    np.testing.assert_array_equal(read_pfm(out / "sigma_disparity.pfm"), found.disparities.sigma_px)
    assert np.nanmax(np.abs(read_png16(out / "disparity.png") - disparity)) <= 0.5 / 256 + 1e-6
    np.testing.assert_allclose(read_pfm(out / "depth.pfm"), found.depths.depth, rtol=1e-6)
    np.testing.assert_allclose(read_pfm(out / "sigma_depth.pfm"), found.depths.sigma, rtol=1e-6)
    cloud = read_points_ply(out / "cloud.ply")
    assert len(cloud) == found.num_points == np.isfinite(found.depths.depth).sum()
    reasons = np.asarray(Image.open(out / "reasons.png"))
    assert (reasons[known] == 255).all() and (reasons[~known] != 255).any(axis=1).all()
    page = (out / "report.html").read_text()
    assert (
        "Error against range" in page
        and page.count("data:image/png") == 6
        and "http" not in page.split("</style>")[1]
    )
    assert json.loads((out / "config.json").read_text())["rig"]["baseline"] == pair.baseline
    assert "points" in repr(found)


def test_without_a_rig_there_is_no_depth(pair_files, tmp_path):
    _, left, right = pair_files
    found = api.stereo(left, right, tmp_path / "out")
    assert found.depths is None and not (tmp_path / "out" / "depth.pfm").exists()
    assert "Error against range" not in (tmp_path / "out" / "report.html").read_text()


def test_depth_of_an_earlier_run_does_not_stay_beside_other_disparities(pair_files, tmp_path):
    _, left, right = pair_files
    out = tmp_path / "out"
    api.stereo(left, right, out, rig=RIG)
    (out / "mine.txt").write_text("precious")
    assert (out / "depth.pfm").exists() and (out / "cloud.ply").exists()
    api.stereo(left, right, out)
    assert not any((out / name).exists() for name in ("depth.pfm", "sigma_depth.pfm", "cloud.ply"))
    assert (out / "disparity.pfm").exists() and (out / "mine.txt").read_text() == "precious"


def test_files_that_are_no_pair(pair_files, tmp_path):
    _, left, right = pair_files
    Image.new("L", (190, 150)).save(tmp_path / "small.png")
    with pytest.raises(ShapeError, match="190 x 150"):
        api.stereo(left, tmp_path / "small.png", tmp_path / "out")
    (tmp_path / "broken.png").write_bytes(left.read_bytes()[:300])
    with pytest.raises(FileFormatError, match=r"broken\.png"):
        api.stereo(tmp_path / "broken.png", right, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_page_of_nothing(tmp_path):
    Image.new("L", (60, 40), 128).save(tmp_path / "blank.png")
    found = api.stereo(tmp_path / "blank.png", tmp_path / "blank.png", tmp_path / "out", rig=RIG)
    assert found.disparities.density == 0 and found.num_points == 0
    assert "disparity of 0.0 % of the pixels" in (tmp_path / "out" / "report.html").read_text()


def flat_rig(pair, offset_px=3.0, rotation=0.0, k1=0.0, covariance=None):
    height, width = pair.left.shape[:2]
    focal, cx, cy = pair.camera.K[0, 0], pair.camera.K[0, 2], pair.camera.K[1, 2]
    left = Camera(CameraModel.OPENCV, width, height, np.array([focal, focal, cx, cy, k1, 0, 0, 0]))
    right = Camera(CameraModel.PINHOLE, width, height, np.array([focal, focal, cx + offset_px, cy]))
    return StereoRig(left, right, Rigid3.exp(np.array([-pair.baseline, 0, 0, 0, 0, rotation])), covariance)


def test_a_calibration_of_rectified_cameras_resamples_nothing(pair_files, tmp_path):
    pair, left, right = pair_files
    height, width = pair.left.shape[:2]
    found = api.stereo(left, right, tmp_path / "out", StereoConfig(max_disparity_px=40), flat_rig(pair))
    assert found.rectification is None and found.left_rgb.shape[:2] == (height, width)
    assert found.rig.principal_offset_px == pytest.approx(3.0)
    assert any("the calibration has no covariance" in words for words in found.warnings)
    for other in ({"rotation": 1e-4}, {"k1": 1e-3}, {"covariance": np.zeros((30, 30))}):
        assert rectified_rig_of(flat_rig(pair, **other)) is None


def test_a_calibration_of_another_size_is_refused(pair_files, tmp_path):
    pair, left, right = pair_files
    rig = flat_rig(pair)
    small = Camera(rig.left.model, rig.left.width // 2, rig.left.height, rig.left.params)
    wrong = StereoRig(small, rig.right, rig.right_from_left)
    with pytest.raises(ShapeError, match="its calibration is for"):
        api.stereo(left, right, tmp_path / "out", StereoConfig(max_disparity_px=40), wrong)
    with pytest.raises(ShapeError, match="its calibration is for"):
        examine_stereo(left, right, wrong)


def test_far_things_are_found_where_principal_points_differ(tmp_path):
    """Axes that meet at a point: what lies beyond it has negative disparities, and depth all the same."""
    pair = stereo_room(3, (320, 240))
    moved = np.roll(pair.right, 30, axis=1)
    found = [
        measure_pair(
            np.dstack([pair.left] * 3),
            np.dstack([right] * 3),
            StereoConfig(),
            flat_rig(pair, offset_px=offset),
        )
        for right, offset in ((pair.right, 0.0), (moved, 30.0))
    ]
    inside = np.s_[:, 60:-30]  # what both pairs show
    known = [np.isfinite(f.depths.depth[inside]) for f in found]
    assert (found[1].disparities.disparity_px[inside][known[1]] < 0).mean() > 0.2
    assert known[1].mean() > 0.95 * known[0].mean()
    both = known[0] & known[1]
    apart = np.abs(found[1].depths.depth / found[0].depths.depth - 1)[inside][both]
    assert np.quantile(apart, 0.95) < 0.02


def test_nothing_of_the_users_is_lost(pair_files, tmp_path):
    _, left, right = pair_files
    config = StereoConfig(max_disparity_px=40)
    with pytest.raises(WorkspaceError, match=r"is the folder of left\.png"):
        api.stereo(left, right, tmp_path, config)
    out = tmp_path / "own"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    with pytest.raises(WorkspaceError, match="not written by epipole"):
        api.stereo(left, right, out, config)
    assert [path.name for path in out.iterdir()] == ["notes.txt"] and left.is_file()
    (out / "notes.txt").rename(tmp_path / "notes.txt")
    api.stereo(left, right, out, config)
    (out / "notes.txt").write_text("mine")
    api.stereo(left, right, out, config)  # its own results may go
    assert (out / "notes.txt").read_text() == "mine"
