"""Before the first frame, every kernel is used once: tracking, mapping, and finding a lost camera again."""

import numpy as np
import pytest

from epipole.cameras import Camera, CameraModel
from epipole.geometry import Rigid3
from epipole.pipelines.slam import warm_up
from epipole.pipelines.slam.frames import DepthCamera, SlamCamera, TrackingState
from epipole.pipelines.slam.slam import Slam
from epipole.scene import CameraRig
from whole import IS_WHOLE

PINHOLE = Camera(CameraModel.PINHOLE, 640, 480, np.array([500.0, 500.0, 319.5, 239.5]))
FISHEYE = Camera(
    CameraModel.OPENCV_FISHEYE, 640, 480, np.array([250.0, 250.0, 319.5, 239.5, 0.01, 0.0, 0.0, 0.0])
)
SIDE_BY_SIDE = Rigid3.exp([[0.0] * 6, [-0.2, 0.0, 0.0, 0.0, 0.1, 0.0]])
CAMERAS = {
    "one camera": SlamCamera(PINHOLE),
    "depth": SlamCamera(PINHOLE, depth=DepthCamera(PINHOLE, Rigid3.identity())),
    "rig of different lenses": SlamCamera.of_cameras(CameraRig((FISHEYE, PINHOLE), SIDE_BY_SIDE)),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", CAMERAS if IS_WHOLE else ["rig of different lenses"])
def test_the_room_is_tracked_lost_and_found_again(name, monkeypatch):
    monkeypatch.setattr(warm_up, "_warm", set())
    states, made = [], []

    class Recorded(Slam):
        def track(self, frame):
            answer = super().track(frame)
            states.append(answer.state)
            return answer

    def make(camera):
        made.append(camera)
        return Recorded(camera)

    warm_up.warm_up(CAMERAS[name], make)
    before, black, after = states[:14], states[14:16], states[16:]
    assert before.count(TrackingState.TRACKING) >= 13
    assert black == [TrackingState.LOST] * 2
    assert after[-1] == TrackingState.TRACKING
    assert made[0].camera.width == 320
    warm_up.warm_up(CAMERAS[name], make)
    assert len(made) == 1


def test_slam_itself_is_unchanged(monkeypatch):
    monkeypatch.setattr(warm_up, "_warm", set())
    monkeypatch.setattr(warm_up, "NUM_FRAMES", 3)
    system = Slam(CAMERAS["depth"])
    system.warm_up()
    assert not system.map.keyframes and system.state == Slam(CAMERAS["depth"]).state


def test_the_imu_moves_as_the_camera_does(monkeypatch):
    """Kernels of alignment and factors are reached, and the motion observes what they estimate."""
    found = []
    aligned = warm_up.align_path_to_imu
    monkeypatch.setattr(
        warm_up, "align_path_to_imu", lambda *a, **k: found.append(aligned(*a, **k)) or found[-1]
    )
    warm_up.warm_up_imu.__wrapped__()
    np.testing.assert_allclose(found[0].gravity_in_world, [0.0, 0.0, -9.81], atol=0.05)
    assert abs(found[0].scale - 1.0) < 0.01
