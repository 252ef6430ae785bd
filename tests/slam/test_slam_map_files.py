"""Maps on disk: the same map comes back, what is damaged or another camera's is refused, the camera is found in it."""

from dataclasses import replace

import numpy as np
import pytest
from slam_rides import CAMERA, MONO, RGBD, STEREO, ride, tracked

from epipole import Slam
from epipole.cameras import Camera
from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3
from epipole.pipelines.slam.config import CameraOptions
from epipole.pipelines.slam.frames import DepthCamera, SlamCamera, TrackingState
from epipole.pipelines.slam.output.map_file import MAP_FILE, distinct_names, read_slam_map, write_slam_map
from epipole.pipelines.slam.run import slam as run_slam
from whole import IS_WHOLE


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A map of the ride's first half, with the file that it was written to."""
    system, _ = tracked(ride().frames("rgbd")[:18], RGBD)
    system.finish()
    path = tmp_path_factory.mktemp("run") / MAP_FILE
    write_slam_map(path, system.map, [f"{k.number}.png" for k in system.map.keyframes], RGBD)
    return system.map, path


def test_the_same_map_comes_back(made):
    model, path = made
    known = read_slam_map(path, RGBD)
    assert known.is_metric and known.names[0] == "0.png" and len(known.names) == len(model.keyframes)
    np.testing.assert_array_equal(known.model.xyz, model.xyz)
    np.testing.assert_array_equal(known.model.anchor, model.anchor)
    np.testing.assert_array_equal(known.model.num_agreed, model.num_agreed)
    for one, other in zip(known.model.keyframes, model.keyframes, strict=True):
        np.testing.assert_array_equal(one.gray, other.gray)
        np.testing.assert_array_equal(one.pixels, other.pixels)
        np.testing.assert_array_equal(one.point, other.point)
        np.testing.assert_array_equal(one.cam_from_world.rotation, other.cam_from_world.rotation)
        assert one.number == other.number and one.timestamp_s == other.timestamp_s


def test_the_folder_of_a_run_is_its_map(made):
    _, path = made
    for position in (path.parent, path.parent.parent, str(path)):
        assert len(read_slam_map(position, RGBD).names)


@pytest.mark.parametrize("kind", ["rgbd", "stereo", "mono"])
@pytest.mark.parametrize("gain", [0.7] + IS_WHOLE * [1.0])
def test_a_second_pass_is_localized(made, kind, gain):
    _, path = made
    sensor = {"rgbd": RGBD, "stereo": STEREO, "mono": MONO}[kind]
    known = read_slam_map(path, sensor).model
    before = known.xyz.copy(), len(known.keyframes)
    system = Slam(sensor, known=known, is_map_fixed=True)
    frames = [
        replace(f, gray=np.rint(gain * f.gray).astype(np.uint8), timestamp_s=100.0 + n)
        for n, f in enumerate(ride().frames(kind)[3:18])
    ]
    answers = [system.track(frame) for frame in frames]
    system.finish()
    assert all(a.state is TrackingState.TRACKING for a in answers)
    truth = ride().truth()[3:18]
    off = [
        np.linalg.norm(a.world_from_body.translation - truth.translation[n]) for n, a in enumerate(answers)
    ]
    assert max(off) < 0.02
    np.testing.assert_array_equal(known.xyz, before[0])  # the map stays as it was
    assert len(known.keyframes) == before[1] and len(system.maps) == 1


def test_the_map_grows_where_it_is_gone_on_in(made):
    _, path = made
    known = read_slam_map(path, RGBD).model
    count = len(known.keyframes)
    system = Slam(RGBD, known=known)
    answers = [system.track(frame) for frame in ride().frames("rgbd")[10:]]
    assert answers[0].state is TrackingState.TRACKING and len(system.map.keyframes) > count
    off = answers[-1].world_from_body.translation - ride().truth().translation[-1]
    assert np.linalg.norm(off) < 0.03
    numbers = [k.number for k in system.map.keyframes]
    assert numbers == sorted(numbers) and len(set(numbers)) == len(numbers)


def test_pictures_from_elsewhere_are_not_localized(made):
    _, path = made
    system = Slam(RGBD, known=read_slam_map(path, RGBD).model, is_map_fixed=True)
    noise = np.random.default_rng(0).integers(0, 255, (6, 240, 320), np.uint8)
    frames = [replace(f, gray=noise[n]) for n, f in enumerate(ride().frames("rgbd")[:6])]
    answers = [system.track(frame) for frame in frames]
    assert all(a.state is TrackingState.LOST and a.world_from_body is None for a in answers)


def test_maps_of_other_cameras_are_refused(made, tmp_path):
    _, path = made
    other = Camera("PINHOLE", 320, 240, [300.0, 300.0, 159.5, 119.5])
    with pytest.raises(ConfigError, match="another camera"):
        read_slam_map(path, SlamCamera(other, None, DepthCamera(other, Rigid3.identity())))
    with pytest.raises(ConfigError, match="320x240"):
        read_slam_map(path, SlamCamera(Camera("PINHOLE", 640, 480, [260.0, 260.0, 159.5, 119.5])))
    system, _ = tracked(ride().frames("mono")[:12], MONO)
    write_slam_map(tmp_path / "map.npz", system.map, ["x"] * len(system.map.keyframes), MONO)
    assert not read_slam_map(tmp_path, MONO).is_metric
    with pytest.raises(ConfigError, match="is up to scale"):
        read_slam_map(tmp_path, RGBD)
    with pytest.raises(ConfigError, match="is_map_fixed=True needs a map"):
        Slam(RGBD, is_map_fixed=True)


def test_damaged_maps_are_refused(made, tmp_path):
    _, path = made
    whole = path.read_bytes()
    bent = bytearray(whole)
    bent[len(bent) // 2] ^= 0xFF
    for name, content in {
        "cut": whole[: len(whole) // 2],
        "bent": bytes(bent),
        "empty": b"",
        "text": b"hello",
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileFormatError, match="not a map, or damaged"):
            read_slam_map(tmp_path / name, RGBD)
    with pytest.raises(FileFormatError, match="it does not exist"):
        read_slam_map(tmp_path / "none", RGBD)


def test_the_job_writes_goes_on_and_localizes(tmp_path):
    import cv2

    for folder, part in (("first", slice(0, 18)), ("second", slice(6, 16))):
        (tmp_path / folder).mkdir()
        for n, image in enumerate(ride().left[part]):
            cv2.imwrite(str(tmp_path / folder / f"{n:03d}.png"), image)

    camera = {"camera_params": ",".join(str(p) for p in (260.0, 260.0, 160.0, 120.0))}
    assert np.allclose(CameraOptions(**camera).camera((320, 240)).params, CAMERA.params)
    first = run_slam(tmp_path / "first", tmp_path / "out", **camera)
    fixed = run_slam(tmp_path / "second", tmp_path / "fixed", **camera, map=tmp_path / "out", localize=True)
    grown = run_slam(tmp_path / "second", tmp_path / "grown", **camera, map=tmp_path / "out")
    assert fixed.summary["num_localized"] == grown.summary["num_localized"] == 10
    assert fixed.summary["num_keyframes"] == first.summary["num_keyframes"]
    gap = fixed.trajectory.world_from_body.translation - first.trajectory.world_from_body.translation[6:16]
    assert np.linalg.norm(gap, axis=1).max() < 0.01  # in the first run's world and unit
    assert len(read_slam_map(tmp_path / "grown", SlamCamera(CAMERA)).names) == grown.summary["num_keyframes"]
    with pytest.raises(ConfigError, match="localize"):
        run_slam(tmp_path / "second", tmp_path / "none", **camera, localize=True)


def test_names_that_two_runs_have_used_are_made_distinct():
    names = ("0.png", "1.png", "earlier/1.png")
    assert distinct_names(names, {"1.png", "2.png"}, "earlier") == (
        "0.png",
        "earlier/earlier/1.png",
        "earlier/1.png",
    )
    assert distinct_names(names, set(), "earlier") == names
    assert distinct_names(("1.png", "1.png"), set(), "earlier") == ("1.png", "earlier/1.png")
