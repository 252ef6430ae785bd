"""Mounting, clock and noise of an IMU, as other programs state them."""

import json

import numpy as np
import pytest

from epipole.errors import FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.inertial import ImuNoise
from epipole.io.sequences.imu_logs import read_camera_from_imu, read_mounted_imu

IMU_FROM_CAMERA = Rigid3(Rotation3.exp(np.array([0.4, -1.1, 0.7])).matrix, np.array([-0.02, -0.06, 0.01]))
ROWS = IMU_FROM_CAMERA.as_matrix().tolist()
NUMBERS = ", ".join(repr(v) for row in ROWS for v in row)
ORB_SLAM = f"""%YAML:1.0
Camera.fx: 458.0
{{key}}: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [{NUMBERS}]
IMU.NoiseGyro: 1.0e-3
IMU.NoiseAcc: 2.0e-2
"""
OKVIS = f"""cameras:
   - {{T_SC: [{NUMBERS}], image_dimension: [752, 480]}}
   - {{T_SC: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], image_dimension: [752, 480]}}
imu_params: {{a_max: 176.0, sigma_g_c: 1.0e-3, sigma_a_c: 2.0e-2}}
"""
KALIBR = {
    "cam0": {"T_cam_imu": IMU_FROM_CAMERA.inverse().as_matrix().tolist(), "timeshift_cam_imu": 0.042},
    "gyroscope_noise_density": 1e-3,
    "accelerometer_noise_density": 2e-2,
}


@pytest.fixture
def log(tmp_path):
    rows = [f"{0.005 * n:.3f} 0.1 0.0 {0.01 * n} 0.0 0.0 9.81" for n in range(40)]
    (tmp_path / "imu.txt").write_text("\n".join(rows))
    return tmp_path / "imu.txt"


@pytest.mark.parametrize(
    "text",
    [ORB_SLAM.format(key="IMU.T_b_c1"), ORB_SLAM.format(key="Tbc"), OKVIS, json.dumps(KALIBR)],
    ids=["orb-slam3", "orb-slam3, before 1.0", "okvis", "kalibr"],
)
def test_mounting_and_noise_of_other_programs(log, tmp_path, text):
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    expected = IMU_FROM_CAMERA.inverse().as_matrix()
    np.testing.assert_allclose(read_camera_from_imu(path).as_matrix(), expected, atol=1e-6)
    found = read_mounted_imu(log, path)
    np.testing.assert_allclose(found.camera_from_imu.as_matrix(), expected, atol=1e-6)
    assert (found.noise.gyro_density, found.noise.accel_density) == (1e-3, 2e-2)
    assert found.noise.gyro_walk == ImuNoise().gyro_walk


def test_a_stated_offset_of_the_clock_is_corrected(log, tmp_path):
    (tmp_path / "camchain.yaml").write_text(json.dumps(KALIBR))
    found = read_mounted_imu(log, tmp_path / "camchain.yaml").log
    np.testing.assert_allclose(found.timestamp_s, 0.005 * np.arange(40) - 0.042, atol=1e-12)
    assert "42 ms ahead of the camera's" in found.notes[-1]
    (tmp_path / "camchain.yaml").write_text(json.dumps({"cam0": KALIBR["cam0"] | {"timeshift_cam_imu": 1e9}}))
    with pytest.raises(FileFormatError, match="timeshift_cam_imu"):
        read_mounted_imu(log, tmp_path / "camchain.yaml")


def test_noise_beside_the_log_counts_first(tmp_path):
    (tmp_path / "camchain.yaml").write_text(json.dumps(KALIBR))
    (tmp_path / "imu0").mkdir()
    (tmp_path / "imu0" / "data.csv").write_text("0.0,0,0,0,0,0,9.81\n0.005,0,0,0,0,0,9.81\n")
    (tmp_path / "imu0" / "sensor.yaml").write_text("gyroscope_noise_density: 5.0e-4\n")
    found = read_mounted_imu(tmp_path / "imu0", tmp_path / "camchain.yaml")
    assert found.noise == ImuNoise(gyro_density=5e-4)


def test_a_file_without_a_mounting_is_refused(log, tmp_path):
    (tmp_path / "a.yaml").write_text("cam0: {intrinsics: [1, 1, 1, 1]}\n")
    with pytest.raises(FileFormatError, match="T_BS"):
        read_mounted_imu(log, tmp_path / "a.yaml")
