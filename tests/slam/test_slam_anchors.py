"""Measured places make one camera's path metric, and its result says what fixed the scale and how well."""

import copy
import json

import cv2
import numpy as np
import pytest
from slam_rides import CAMERA, MONO, RGBD, ride, tracked

from epipole.config import AnchorOptions
from epipole.errors import ConfigError, DegenerateGeometryError, FileFormatError
from epipole.io import read_positions, read_trajectory
from epipole.io.trajectories.files import PositionLog
from epipole.metrics import absolute_error
from epipole.pipelines.slam.config import CameraOptions
from epipole.pipelines.slam.output.scale import anchor_map
from epipole.pipelines.slam.run import slam as run_slam
from whole import IS_WHOLE

SIGMA = 0.01


@pytest.fixture(scope="module")
def finished():
    system, _ = tracked(ride().frames("mono"), MONO)
    system.finish()
    return system


def anchored(system, log, sigma, folder):
    """The map with measured places that stand in a file; the fit of the places."""
    rows = np.column_stack([log.timestamp_s, log.positions])
    np.savetxt(folder / "places.txt", rows, "%.12g")
    options = AnchorOptions(positions=folder / "places.txt", positions_sigma_m=sigma)
    names = [f"{k.number:03d}.png" for k in system.maps[0].keyframes]
    found = anchor_map(system, options, names, {})
    return found.positions.fit


def log_of(rng, every=2, shift_s=0.0):
    """The true places of some frames, with noise, by the frames' clock."""
    positions = ride().truth().translation[::every]
    times = 0.1 * np.arange(30)[::every] + shift_s
    return PositionLog(times, positions + SIGMA * rng.standard_normal(positions.shape))


def test_the_true_scale_lies_within_what_is_stated(finished, rng, tmp_path):
    within, worst = 0, 0.0
    for _ in range(12):
        system = copy.deepcopy(finished)
        fit = anchored(system, log_of(rng), SIGMA, tmp_path)
        found = absolute_error(system.trajectory().world_from_body, ride().truth(), "similarity")
        off = abs(np.log(float(found.truth_from_estimate.scale)))
        within += off < 2.0 * fit.sigma / float(fit.world_from_model.scale)
        worst = max(worst, off)
    assert within >= 10 and worst < 0.05


def test_places_between_frames_are_compared_with_the_path_between_them(finished, rng, tmp_path):
    system = copy.deepcopy(finished)
    with_shift = log_of(rng, shift_s=0.05)
    there = ride().truth().translation
    exact = PositionLog(with_shift.timestamp_s[:-1], 0.5 * (there[:-1:2] + there[1::2])[:14])
    fit = anchored(system, exact, SIGMA, tmp_path)
    assert fit.kept_mask.all() and fit.residual_m < 0.02


def test_what_tells_no_scale_is_refused(finished, rng, tmp_path):
    still = PositionLog(0.1 * np.arange(30), 1.0 * rng.standard_normal((30, 3)))
    with pytest.raises(DegenerateGeometryError):
        anchored(copy.deepcopy(finished), still, 1.0, tmp_path)
    later = log_of(rng, shift_s=100.0)
    with pytest.raises(DegenerateGeometryError, match="0 positions"):
        anchored(copy.deepcopy(finished), later, SIGMA, tmp_path)
    metric, _ = tracked(ride().frames("rgbd")[:6], RGBD)
    with pytest.raises(ConfigError, match="one camera"):
        anchored(metric, log_of(rng), SIGMA, tmp_path)


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("anchored") / "pictures"
    folder.mkdir()
    for n, image in enumerate(ride().left):
        cv2.imwrite(str(folder / f"{n:03d}.png"), image)
    return folder


LENS = {"camera_params": ",".join(str(p) for p in (260.0, 260.0, 160.0, 120.0))}


def test_the_job_states_what_fixed_the_scale(images, tmp_path, rng):
    assert np.allclose(CameraOptions(**LENS).camera((320, 240)).params, CAMERA.params)
    log = log_of(rng)
    times = np.arange(30)[::2] / 30.0  # a folder of images is of 30 Hz
    lines = [f"{t:.6f}, {x}, {y}, {z}, 99" for t, (x, y, z) in zip(times, log.positions, strict=True)]
    (tmp_path / "log.csv").write_text("# seconds, x, y, z, satellites\n" + "\n".join(lines))
    out = tmp_path / "out"
    options = {**LENS, "positions": tmp_path / "log.csv", "positions_sigma_m": SIGMA}
    result = run_slam(images, out, **options)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["is_metric"] and "measured positions" in summary["scale"] and "1 sigma" in summary["scale"]
    assert 0 < summary["anchor"]["relative_sigma"] < 0.03
    for name in ("trajectory.txt", "trajectory_causal.txt"):  # both in meters, in the log's world
        path = read_trajectory(out / name)
        frames = np.rint(30 * path.timestamp_s).astype(int)
        off = path.world_from_body.translation - ride().truth().translation[frames]
        assert np.sqrt((off**2).sum(axis=1).mean()) < 0.05
    assert result.summary["scale"] == summary["scale"]


def test_places_that_tell_nothing_leave_the_path_up_to_scale(images, tmp_path):
    (tmp_path / "log.txt").write_text("".join(f"{n / 30} 1 2 3\n" for n in range(30)))
    result = run_slam(images, tmp_path / "out", **LENS, positions=tmp_path / "log.txt")
    assert not result.summary["is_metric"] and "up to scale" in result.summary["scale"]
    assert any("remains up to scale" in w for w in result.warnings)


@pytest.mark.parametrize("kind", ["places"] + IS_WHOLE * ["distances"])
def test_wheels_half_a_meter_behind_the_camera(images, tmp_path, kind):
    """The camera looks inward on its arc: the wheels go a tenth further, which the mounting tells."""
    true = ride().truth()
    wheels = true.translation + true.rotation @ np.array([0.0, 0.0, -0.5])
    trajectory = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(wheels, axis=0), axis=1))])
    rows = [f"{n / 30:.6f} {at}\n" for n, at in enumerate(trajectory)]
    if kind == "places":
        rows = [f"{n / 30:.6f} {x} {y} {z} 0 0 0 1\n" for n, (x, y, z) in enumerate(wheels)]
    (tmp_path / "wheels.txt").write_text("".join(rows))
    (tmp_path / "mounting.yaml").write_text(
        "T_cam_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -0.5], [0, 0, 0, 1]]\n"
    )
    found = []
    for mounting in (None, tmp_path / "mounting.yaml"):
        out = tmp_path / f"out_{mounting is None}"
        options = {"odometry": tmp_path / "wheels.txt", "odometry_mounting": mounting}
        result = run_slam(images, out, **LENS, **options)
        rows = np.rint(30 * result.trajectory.timestamp_s).astype(int)
        error = absolute_error(result.trajectory.world_from_body, true[rows], "similarity")
        off = abs(np.log(float(error.truth_from_estimate.scale)))
        assert result.summary["is_metric"] and "of odometry" in result.summary["scale"]
        found.append((off, 2 * result.summary["anchor"]["relative_sigma"]))
    assert found[0][0] > 0.08 and found[1][0] < found[1][1] < 0.04


def test_a_mounting_that_cannot_be_read_is_told_before_any_frame(images, tmp_path):
    (tmp_path / "wheels.txt").write_text("0 0\n1 1\n")
    (tmp_path / "mounting.yaml").write_text("T_cam_imu: [1, 2]\n")
    options = {"odometry": tmp_path / "wheels.txt", "odometry_mounting": tmp_path / "mounting.yaml"}
    with pytest.raises(FileFormatError, match=r"mounting\.yaml.*4 x 4"):
        run_slam(images, tmp_path / "out", **LENS, **options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["positions", "lengths", "odometry"])
def test_files_that_cannot_be_read_are_told_before_any_frame(images, tmp_path, name):
    (tmp_path / "damaged.txt").write_text("not a number\n")
    for path in (tmp_path / "damaged.txt", tmp_path / "missing.txt"):
        with pytest.raises(FileFormatError, match=path.name):
            run_slam(images, tmp_path / "out", **LENS, **{name: path})
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "it contains no poses"),
        ("0 1 2\n", "3 columns"),
        ("0 1 2 x\n", "x"),
        ("1 0 0 0\n1 0 0 0\n", "time"),
        ("0 1 2 nan\n", "finite"),
    ],
)
def test_logs_that_are_none(tmp_path, text, words):
    (tmp_path / "log.txt").write_text(text)
    with pytest.raises(FileFormatError, match=words):
        read_positions(tmp_path / "log.txt")
