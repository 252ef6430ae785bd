"""An inertial unit beside one camera: its measurements join the adjustments, and tell meters."""

import copy
import json

import cv2
import numpy as np
import pytest
from slam_rides import errors, rendered

from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.inertial import ImuFactors, ImuLog, ImuNoise, MountedImu
from epipole.metrics import absolute_error
from epipole.pipelines.slam import run
from epipole.pipelines.slam.map.imu import InertialConstraints
from epipole.pipelines.slam.map.imu_clock import CameraImu
from epipole.pipelines.slam.slam import Slam
from epipole.synthetic.inertial import imu_along, inertial_path
from whole import IS_WHOLE, in_whole_run

pytestmark = pytest.mark.usefixtures("unchecked_module")

COUNT, STEP = 108 if IS_WHOLE else 80, 2
MOUNTING = Rigid3(Rotation3.exp(np.array([0.4, -1.1, 0.7])).matrix, np.array([0.03, -0.02, 0.05]))
NOISE = ImuNoise(accel_gain_sigma=1e-6)


@pytest.fixture(scope="module")
def ride():
    return rendered("loop_room", COUNT, STEP)


@pytest.fixture(scope="module")
def unit(ride):
    times = 0.1 * np.arange(len(ride.images))
    return MountedImu(imu_along(times, ride.truth(), MOUNTING, 0, NOISE), MOUNTING, NOISE)


def tracked(ride, imu):
    system = Slam(ride.sensor("mono"), imu=imu)
    for frame in ride.frames("mono"):
        system.track(frame)
    system.finish()
    return system


@pytest.fixture(scope="module")
def job(ride, unit, tmp_path_factory, unchecked_module):
    """The job on images and a log: its result, its system before the scale is applied, and what gave the scale."""
    folder, kept = tmp_path_factory.mktemp("inertial"), []
    params = ride.sensor("mono").camera.params
    (folder / "images").mkdir()
    for n, (gray, _, _) in enumerate(ride.images.values()):
        cv2.imwrite(str(folder / "images" / f"{n:03d}.png"), gray)
    log, there = unit.log, unit.camera_from_imu
    np.savetxt(folder / "imu.txt", np.column_stack([log.timestamp_s, log.gyro_rad_s, log.accel_m_s2]), "%.9g")
    rows = np.column_stack([there.rotation, there.translation]).tolist()
    (folder / "mounting.yaml").write_text(f"T_cam_imu: {json.dumps([*rows, [0, 0, 0, 1]])}\n")

    def recorded(system, *rest, anchor_map=run.anchor_map):
        kept.append(copy.deepcopy(system))
        kept.append(anchor_map(system, *rest))
        return kept[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "anchor_map", recorded)
        result = run.slam(
            *(folder / "images", folder / "out"),
            camera_params=",".join(str(p + 0.5 * (n >= 2)) for n, p in enumerate(params)),
            imu=folder / "imu.txt",
            imu_mounting=folder / "mounting.yaml",
            fps=10.0,
        )
    return result, *kept


@pytest.fixture(scope="module")
def with_unit(job):
    return job[1]


@pytest.fixture(scope="module")
def alone(ride):
    return tracked(ride, None)


@in_whole_run
def test_the_path_is_no_worse_and_the_images_move_with_the_unit(ride, with_unit, alone):
    truth = ride.truth()
    error = errors(with_unit, truth, "similarity").position.rmse
    assert error < 1.1 * errors(alone, truth, "similarity").position.rmse
    moved = (
        with_unit.trajectory().world_from_body.translation - alone.trajectory().world_from_body.translation
    )
    assert np.abs(moved).max() > 1e-6  # else the factors had no part


def test_a_run_uses_the_unit_and_states_the_scale_with_its_deviation(ride, job):
    result, before, found = job
    assert result.summary["is_metric"] and "the IMU" in result.summary["scale"]
    (estimate,) = found.scale.estimates
    assert estimate.kind == "imu" and "adjusted with the images" in estimate.note
    truth, path = ride.truth(), result.trajectory
    rows = np.rint(10 * path.timestamp_s).astype(int)
    error = absolute_error(path.world_from_body, truth[rows], "similarity")
    off = float(error.truth_from_estimate.scale) - 1.0
    assert abs(off) < 3 * estimate.sigma / estimate.scale < 0.03
    assert errors(before, truth, "similarity").position.rmse < 2e-3


def test_gravity_in_a_camera_is_right_and_stays_when_the_map_moves(ride, job):
    system = job[1]
    model = system.maps[0].copied()
    keyframe = next(k for k in model.keyframes if len(k.point))
    true = ride.truth()[round(10 * keyframe.timestamp_s)].rotation.T @ [0.0, 0.0, -9.81]
    found = keyframe.cam_from_world.rotation @ model.by_imu.gravity_in_world
    cosine = found @ true / np.linalg.norm(found) / 9.81
    assert np.degrees(np.arccos(cosine)) < 0.9  # three standard deviations after four seconds
    model.move(Similarity3(np.array(3.0), Rotation3.exp(np.array([0.3, 1.0, -0.2])).matrix, np.ones(3)))
    np.testing.assert_allclose(
        keyframe.cam_from_world.rotation @ model.by_imu.gravity_in_world, found, atol=1e-12
    )
    assert model.copied().by_imu.meters_per_unit == pytest.approx(system.maps[0].by_imu.meters_per_unit / 3.0)
    model.clear()
    assert model.by_imu is None


def test_the_written_map_is_level(ride, job):
    result = job[0]
    truth, path = ride.truth(), result.trajectory
    true_up = truth[np.rint(10 * path.timestamp_s).astype(int)].rotation[:, 2]
    cosine = np.sum(path.world_from_body.rotation[:, 2] * true_up, axis=1)
    assert np.degrees(np.arccos(np.minimum(cosine, 1.0))).max() < 0.9


@in_whole_run
def test_another_paths_unit_changes_nothing(ride, alone):
    other = MountedImu(inertial_path(5, seconds=6.0).log, MOUNTING)
    beside = tracked(ride, other)
    there = [one.trajectory().world_from_body.translation for one in (alone, beside)]
    np.testing.assert_array_equal(*there)


def test_keyframes_are_in_a_row_where_the_log_covers_them(ride, with_unit, unit):
    log = unit.log
    keyframes = with_unit.maps[0].keyframes
    kept = (log.timestamp_s < 1.4) | (log.timestamp_s > 1.9)
    holed = ImuLog(log.timestamp_s[kept], log.gyro_rad_s[kept], log.accel_m_s2[kept])
    ties = InertialConstraints(CameraImu(MountedImu(holed, MOUNTING, NOISE)))
    rows = ties._in_a_row(keyframes, 2.0)
    times = np.array([k.timestamp_s for k in keyframes])
    assert len(rows) == 2 and times[rows[0]].max() < 1.4 and times[rows[1]].min() > 1.9
    assert ties.factors(keyframes, 0.01) == ()
    ties.learn(keyframes, is_last=True)
    assert ties.aligned is not None and len(ties.factors(keyframes[::-1], 0.01)) == 2
    nothing = InertialConstraints(
        CameraImu(MountedImu(ImuLog(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))), MOUNTING))
    )
    nothing.learn(keyframes, is_last=True)
    assert nothing.aligned is None and nothing.factors(keyframes, 0.01) == ()


def test_noise_grows_as_it_shows_and_never_below_what_is_stated(ride, unit, with_unit, monkeypatch):
    keyframes, ties = with_unit.maps[0].keyframes, InertialConstraints(CameraImu(unit))
    ties.learn(keyframes, is_last=True)
    factors, poses = ties.factors(keyframes, 0.01), Rigid3.identity(len(keyframes))
    given = [(4.0, 0.1), (1.0, 26.0), (np.nan, 1.0)]
    monkeypatch.setattr(ImuFactors, "variance_factors", lambda *_: given.pop(0))
    assert ties.agrees(factors, poses) and ties.aligned is not None
    assert ties.noise.gyro_density == 2 * NOISE.gyro_density
    assert ties.noise.accel_density == NOISE.accel_density
    assert not ties.agrees(factors, poses) and ties.aligned is None and ties.factors(keyframes, 0.01) == ()
    assert not ties.agrees(factors, poses)
