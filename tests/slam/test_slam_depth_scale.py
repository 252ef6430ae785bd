"""The unit of depth images: the summary states it and its source, and --depth-scale gives it."""

import cv2
import numpy as np
import pytest
from slam_rides import CAMERA, ride

from bag_writing import Recorded
from epipole.cli.main import main
from epipole.errors import ConfigError
from epipole.pipelines.slam.config import CameraOptions
from epipole.pipelines.slam.run import slam as run_slam

PARAMS = ",".join(str(p + 0.5 * (n >= 2)) for n, p in enumerate(CAMERA.params))
COUNT = 8


def tum_folder(folder, values_per_m):
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
        (folder / f"{name}.txt").write_text("".join(f"{0.1 * n:.3f} {name}/{n}.png\n" for n in range(COUNT)))
    for n in range(COUNT):
        cv2.imwrite(str(folder / "rgb" / f"{n}.png"), ride().left[n])
        values = np.rint(values_per_m * ride().depth[n]).astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{n}.png"), values)
    return folder


@pytest.fixture
def true_length():
    path = ride().truth().translation[:COUNT]
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def test_millimeters_in_the_layout_of_tum(tmp_path, true_length, capsys):
    folder, known = tum_folder(tmp_path / "room", 1000.0), {"camera_params": PARAMS}
    result = run_slam(folder, tmp_path / "out", **known)
    (warning,) = (words for words in result.warnings if "--depth-scale" in words)
    assert "5000 values per meter" in warning and "1000 would also give plausible distances" in warning
    source = result.summary["source"]
    assert source["depth_scale"] == 5000.0 and "1000 is also possible" in source["depth_scale_source"]
    main(["slam", str(folder), str(tmp_path / "mm"), "--camera-params", PARAMS, "--depth-scale", "1000"])
    said = " ".join(capsys.readouterr().out.split())
    assert "1000 values per meter, from given" in said and "camera source given" in said
    result = run_slam(folder, tmp_path / "again", camera_params=PARAMS, depth_scale=1000.0)
    assert not result.warnings
    assert result.trajectory.path_length() == pytest.approx(true_length, rel=0.1)


def test_a_depth_scale_without_depth_is_refused(tmp_path):
    folder = tum_folder(tmp_path / "room", 5000.0)
    known = {"camera_params": PARAMS, "depth_scale": 5000.0}
    with pytest.raises(ConfigError, match="depth_scale is given"):
        run_slam(folder, tmp_path / "out", **known, sensor="mono")
    with pytest.raises(ConfigError, match="needs depth images"):
        run_slam(folder / "rgb", tmp_path / "out", **known)
    with pytest.raises(ConfigError, match="which videos and cameras do not have"):
        run_slam("0", tmp_path / "out", **known)
    with pytest.raises(ConfigError, match="depth_scale must be positive"):
        CameraOptions(depth_scale=0.0)


def test_the_depth_scale_of_a_recording(tmp_path):
    """ROS' 16 bits are millimeters; a sensor that counts otherwise needs the option."""
    recorded = Recorded("mcap")
    for n in range(COUNT):
        ns = 10**18 + 10**8 * n
        recorded.camera_info("/cam/rgb/camera_info", ns, (CAMERA.width, CAMERA.height), CAMERA.K)
        recorded.image("/cam/rgb/image_raw", ns, ride().left[n], "mono8")
        values = np.rint(800.0 * ride().depth[n]).astype(np.uint16)
        recorded.image("/cam/depth_registered/image_raw", ns, values, "16UC1")
    lengths = {}
    ride_file = recorded.write(tmp_path, "ride")
    for scale in (None, 800.0):
        result = run_slam(ride_file, tmp_path / f"out_{scale}", depth_scale=scale)
        lengths[scale] = result.trajectory.path_length()
        source = result.summary["source"]
        assert source["camera_source"] == "CameraInfo" and source["depth_scale"] == (scale or 1000.0)
    assert lengths[None] == pytest.approx(0.8 * lengths[800.0], rel=0.05)
    with pytest.raises(ConfigError, match="depth_scale is given"):
        run_slam(ride_file, tmp_path / "mono", sensor="mono", depth_scale=800.0)
