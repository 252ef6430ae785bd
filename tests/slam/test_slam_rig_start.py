"""The scale of cameras without a common view: exact without noise, within its deviation, refused where the motion hides it."""

from types import SimpleNamespace

import numpy as np
import pytest

from epipole.cameras import Camera
from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.pipelines.slam.frames import Frame
from epipole.pipelines.slam.map.slam_map import Keyframe, Observations, SlamMap
from epipole.pipelines.slam.start.rig_scale import fit_rig_scales
from epipole.pipelines.slam.start.rig_start import RigStart
from epipole.scene import CameraRig, Trajectory

NUM = 40


def mounting(rng, count=3):
    """cam_from_rig: any directions, up to 0.3 m apart."""
    rotations = np.stack([Rotation3.exp(v).matrix for v in rng.uniform(-2, 2, (count, 3))])
    return Rigid3(rotations, rng.uniform(-0.2, 0.2, (count, 3)))


def walk(rng, rotation=0.8):
    """rig_from_world on a bent way, rotating by about this angle (radians)."""
    steps = np.linspace(0, 1, NUM)[:, None]
    rotations = [Rotation3.exp(v).matrix for v in rotation * np.sin(steps * rng.uniform(1, 4, 3))]
    return Rigid3(np.stack(rotations), steps * rng.uniform(-1, 1, 3) + 0.2 * np.sin(4 * steps))


def alone(rng, cam_from_rig, rig_from_world, scales, noise_m=0.0):
    """What each camera estimates: in another world and unit."""
    out = []
    for k, scale in enumerate(scales):
        world = Rigid3.exp(rng.normal(size=6))
        path = cam_from_rig[k] @ rig_from_world @ world
        path = Rigid3(path.rotation, path.translation + noise_m * rng.normal(size=(NUM, 3)))
        out.append(Similarity3(np.array(1 / scale), np.eye(3), np.zeros(3)).move_cam_from_source(path))
    return out


def test_scales_are_exact_without_noise(rng):
    for _ in range(10):
        rig, scales = mounting(rng), rng.uniform(0.2, 5, 3)
        found = fit_rig_scales(rig, alone(rng, rig, walk(rng), scales))
        np.testing.assert_allclose(found.scale, scales, rtol=1e-6)
        assert found.rotation_deg < 1e-4 and found.residual < 1e-6


def test_the_deviation_covers_the_error(rng):
    off = []
    for _ in range(100):
        rig, scales = mounting(rng, 2), rng.uniform(0.2, 5, 2)
        found = fit_rig_scales(rig, alone(rng, rig, walk(rng), scales, noise_m=0.003))
        off.append((found.scale - scales) / found.sigma)
    # Smaller than one, since the deviation allows for drift, whose errors are not independent.
    assert 0.05 < np.sqrt(np.mean(np.square(off))) < 1.0 and np.abs(off).max() < 3.0


def relative_sigma(rng, rig, path):
    found = fit_rig_scales(rig, alone(rng, rig, path, (1.0, 1.0), noise_m=0.002))
    return float((found.sigma / np.abs(found.scale)).max())


def test_motion_without_rotation_does_not_determine_the_scale(rng):
    rig, path = mounting(rng, 2), walk(rng)
    straight = Rigid3(np.tile(path.rotation[:1], (NUM, 1, 1)), path.translation)
    assert relative_sigma(rng, rig, straight) > 0.2 or np.isinf(relative_sigma(rng, rig, straight))
    assert relative_sigma(rng, rig, path) < 0.1


def test_a_circle_on_whose_radius_the_cameras_lie_does_not_determine_the_scale(rng):
    """Both cameras move on circles around one axis, whatever the unit (a critical motion)."""
    angle = np.linspace(0, 3, NUM)
    rotations = np.stack([Rotation3.exp(np.array([0.0, a, 0.0])).matrix for a in angle])
    circle = Rigid3(rotations, np.tile([0.0, 0.0, 1.2], (NUM, 1)))
    ahead = Rigid3(np.stack([np.eye(3), np.diag([-1.0, 1.0, -1.0])]), np.array([[0, 0, 0], [0, 0, 0.3]]))
    beside = Rigid3(ahead.rotation, np.array([[0, 0, 0], [0.3, 0, 0]]))
    assert relative_sigma(rng, ahead, circle) > 0.1
    assert relative_sigma(rng, beside, circle) < 0.1


def test_cameras_that_do_not_move_together_are_seen(rng):
    rig = mounting(rng, 2)
    first, other = walk(rng), walk(rng)
    paths = [alone(rng, rig, first, (1.0, 1.0))[0], alone(rng, rig, other, (1.0, 1.0))[1]]
    found = fit_rig_scales(rig, paths)
    assert found.rotation_deg > 3.0


def test_cameras_at_rest_have_no_scale(rng):
    rig = mounting(rng, 2)
    rest = Rigid3.identity(NUM)
    found = fit_rig_scales(rig, alone(rng, rig, rest, (1.0, 1.0)))
    assert np.isinf(found.sigma).all()


class Alone:
    """Stands for the SLAM of one camera: it is right, except for frames in which it sees nothing."""

    def __init__(self, path, first, blind):
        self.path, self.first, self.blind = path, first, blind
        self.maps, self.seen, self.count = [SlamMap()], [], 0
        seen = Observations(np.array([[5.0, 5.0]]), np.array([np.nan]), np.array([0]))
        self.maps[0].add_points(np.array([[0.0, 0.0, 1.0]]), seen.pixels, 0)
        self.maps[0].keyframes.append(Keyframe(0, 0.0, np.zeros((24, 32), np.uint8), path[first], seen))

    def track(self, frame):
        number = self.first + self.count
        self.count += 1
        is_seen = number not in self.blind
        if is_seen:
            self.seen.append((frame.timestamp_s, number))
        return SimpleNamespace(world_from_body=self.path[number] if is_seen else None)

    def trajectory(self):
        times, numbers = (np.array(column) for column in zip(*self.seen)) if self.seen else (np.zeros(0),) * 2
        return Trajectory(times, self.path[numbers.astype(int)].inverse())


def started(rng, path, blind=()):
    """The frame in which a rig of four cameras starts, and the words before."""
    pinhole = Camera("PINHOLE", 32, 24, [30.0, 30.0, 15.5, 11.5])
    rig = CameraRig((pinhole,) * 4, mounting(rng, 4))
    paths = alone(rng, rig.cam_from_rig, path, (1.0, 2.0, 0.5, 1.5), noise_m=0.001)
    made, frames = [], 0

    def make(_):
        k = len(made) % 4 if len(made) < 4 else 3
        made.append(k)
        return Alone(paths[k], frames, blind if k == 3 else ())

    start, words = RigStart(rig, make), ""
    for frames in range(NUM):
        frame = Frame.from_rig(0.1 * frames, [np.zeros((24, 32), np.uint8)] * 4, rig)
        found = start.add(frame, frames)
        if not isinstance(found, str):
            return frames, words
        words = found
    return None, words


def test_a_camera_that_is_covered_does_not_keep_the_others_from_starting(rng):
    path = walk(rng)
    first, _ = started(rng, path)
    again, _ = started(rng, path, blind=range(10, NUM))
    assert first is not None and again is not None and again <= first + 5


def test_a_straight_ride_is_not_called_a_wrong_calibration(rng):
    path = walk(rng)
    noise = np.stack([Rotation3.exp(v).matrix for v in 1e-4 * rng.normal(size=(NUM, 3))])
    straight = Rigid3(noise @ path.rotation[0], path.translation)
    number, words = started(rng, straight)
    assert number is None and "scale is unknown" in words


@pytest.fixture
def rng():
    return np.random.default_rng(5)
