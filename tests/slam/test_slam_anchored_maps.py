"""Meters of maps that are gone on in: kept in the file and told, or found by what is known, or refused before any frame."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from slam_rides import CAMERA, RGBD, ride

from epipole import Slam
from epipole.config import AnchorOptions
from epipole.errors import ConfigError
from epipole.geometry import align_points
from epipole.pipelines.slam.frames import SlamCamera
from epipole.pipelines.slam.output.map_file import MAP_FILE, TABLE, VERSION, read_slam_map
from epipole.pipelines.slam.output.scale import anchor_map
from epipole.pipelines.slam.run import slam as run_slam
from epipole.runs.units import load, store
from whole import IS_WHOLE

OLD, NEW = slice(0, 18), slice(8, 30)
GIVEN = {"camera_params": "260,260,160,120", "fps": 10.0}
MONO = SlamCamera(CAMERA)
pytestmark = pytest.mark.usefixtures("unchecked")


def truth(part):
    return ride().truth().translation[part]


def write_places(path, part, sigma=0.01):
    """By the clock of a folder that holds these frames alone."""
    positions = truth(part) + sigma * np.random.default_rng(3).normal(size=truth(part).shape)
    rows = [f"{0.1 * n:.3f} {x} {y} {z}\n" for n, (x, y, z) in enumerate(positions)]
    path.write_text("".join(rows))
    return path


def write_named_places(path, part):
    """By the images' names, which are numbered from the first of these frames."""
    write_places(path, part)
    rows = [line.split(maxsplit=1)[1] for line in path.read_text().splitlines()]
    path.write_text("".join(f"{n:03d}.png {row}\n" for n, row in enumerate(rows)))
    return path


def write_wheels(path, part):
    steps = np.linalg.norm(np.diff(truth(part), axis=0), axis=1)
    rows = [f"{0.1 * n:.3f} {at}\n" for n, at in enumerate(np.concatenate([[0.0], np.cumsum(steps)]))]
    path.write_text("".join(rows))
    return path


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two folders of images with the same names and clock; a map in meters of the first, and one up to scale."""
    folder = tmp_path_factory.mktemp("maps")
    for name, part in (("old", OLD), ("new", NEW)):
        (folder / name).mkdir()
        for n, image in enumerate(ride().left[part]):
            cv2.imwrite(str(folder / name / f"{n:03d}.png"), image)
    positions = write_places(folder / "places.txt", OLD)
    run_slam(folder / "old", folder / "metric", positions=positions, positions_sigma_m=0.01, **GIVEN)
    run_slam(folder / "old", folder / "scaleless", **GIVEN)
    return folder


def scale_of(result, part):
    """Meters of the unit of the path."""
    rows = np.rint(10 * result.trajectory.timestamp_s).astype(int)
    return float(align_points(result.trajectory.world_from_body.translation, truth(part)[rows]).scale)


def test_the_file_says_where_its_meters_come_from(runs):
    known = read_slam_map(runs / "metric", MONO)
    assert known.is_metric and known.scale.startswith("meters, from 18 measured positions of 18: known to ")
    plain = read_slam_map(runs / "scaleless", MONO)
    assert not plain.is_metric and not plain.scale
    assert read_slam_map(runs / "metric", RGBD).is_metric  # meters are meters, whatever camera goes on
    with pytest.raises(ConfigError, match="is up to scale"):
        read_slam_map(runs / "scaleless", RGBD)


@pytest.mark.parametrize("localize", [False, True])
def test_the_meters_of_a_known_map_are_told(runs, tmp_path, localize):
    result = run_slam(runs / "new", tmp_path / "out", map=runs / "metric", localize=localize, **GIVEN)
    before, after = (read_slam_map(folder, MONO) for folder in (runs / "metric", tmp_path / "out"))
    words = before.scale.removeprefix("meters, ")
    assert result.summary["is_metric"] and result.summary["scale"] == f"meters, as in the known map ({words})"
    assert after.is_metric and after.scale == before.scale  # the next run says the same of it
    assert scale_of(result, NEW) == pytest.approx(1.0, abs=0.02)
    rows = np.rint(10 * result.trajectory.timestamp_s).astype(int)
    off = result.trajectory.world_from_body.translation - truth(NEW)[rows]
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.05  # in the world of the places
    assert "up to scale" not in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert np.array_equal(before.model.xyz, after.model.xyz, equal_nan=True) == localize


@pytest.mark.parametrize("is_map_fixed", [False, True])
def test_a_camera_that_tells_depth_goes_on_in_the_metric_map_of_one_that_does_not(runs, is_map_fixed):
    known = read_slam_map(runs / "metric", RGBD).model
    system = Slam(RGBD, known=known, is_map_fixed=is_map_fixed)
    answers = [system.track(frame) for frame in ride().frames("rgbd")[NEW]]
    system.finish()
    assert all(answer.world_from_body is not None for answer in answers)
    off = system.trajectory().world_from_body.translation - truth(NEW)
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.04


def test_a_map_without_meters_stays_so(runs, tmp_path):
    result = run_slam(runs / "new", tmp_path / "out", map=runs / "scaleless", **GIVEN)
    assert not result.summary["is_metric"] and result.summary["scale"].startswith("up to scale")
    assert not read_slam_map(tmp_path / "out", MONO).is_metric


@pytest.mark.parametrize(
    ("name", "write"),
    [("positions", write_places), ("positions", write_named_places), ("odometry", write_wheels)],
)
def test_what_is_known_makes_a_map_metric_that_is_gone_on_in(runs, tmp_path, name, write):
    options = {name: write(tmp_path / "known.txt", NEW), "positions_sigma_m": 0.01}
    result = run_slam(runs / "new", tmp_path / "out", map=runs / "scaleless", **options, **GIVEN)
    known, old = read_slam_map(tmp_path / "out", MONO), read_slam_map(runs / "scaleless", MONO)
    assert result.summary["is_metric"] and result.summary["scale"] == known.scale
    assert not result.warnings and not old.is_metric
    off = abs(np.log(scale_of(result, NEW)))
    assert off < 2 * result.summary["anchor"]["relative_sigma"] < 0.03
    keyframes = [k for k in known.model.keyframes if k.number < OLD.stop]
    assert len(keyframes) == len(old.names) and len(set(known.names)) == len(known.names)
    assert set(known.names) >= {f"earlier/{name}" for name in set(old.names) & set(known.names)}
    there = np.stack([k.cam_from_world.centers() for k in keyframes])
    of_old = align_points(there, truth(np.array([k.number for k in keyframes])))
    assert abs(np.log(float(of_old.scale))) < 0.03  # the old part of the map is in the same unit
    if name == "positions":
        assert np.abs(there - truth(np.array([k.number for k in keyframes]))).max() < 0.1


@pytest.mark.parametrize("write", [write_named_places] + IS_WHOLE * [write_places])
def test_pictures_of_the_map_are_not_taken_for_those_of_this_run(runs, tmp_path, write):
    """They have the same names and times as other ones."""
    system = Slam(MONO, known=read_slam_map(runs / "scaleless", MONO).model)
    for frame in ride().frames("mono")[NEW]:
        system.track(replace(frame, timestamp_s=round(frame.timestamp_s - 0.1 * NEW.start, 3)))
    frames = {float(t): f"{round(10 * t):03d}.png" for t in system.trajectory().timestamp_s}
    of_keyframes = [f"{k.number - OLD.stop * (k.number >= OLD.stop):03d}.png" for k in system.map.keyframes]
    options = AnchorOptions(positions=write(tmp_path / "places.txt", NEW), positions_sigma_m=0.01)
    positions = anchor_map(system, options, of_keyframes, frames).positions
    is_new = np.array([k.number >= system.first_number for k in system.map.keyframes])
    assert np.array_equal(np.isfinite(positions.positions[:, 0]), is_new) and 2 <= is_new.sum() < len(is_new)
    there = truth(NEW)[[k.number - system.first_number for k in system.map.keyframes if k.number >= OLD.stop]]
    np.testing.assert_allclose(positions.positions[is_new], there, atol=0.05)


@pytest.mark.parametrize(
    ("map_name", "localize", "words"),
    [
        (
            "metric",
            False,
            r"metric already \(meters, from 18 measured positions .*\): odometry and imu would",
        ),
        ("metric", True, "metric already"),
        (
            "scaleless",
            True,
            "localize does not change the known map, which is up to scale: odometry and imu would",
        ),
    ],
)
def test_what_would_change_the_unit_of_a_map_is_refused(runs, tmp_path, map_name, localize, words):
    (tmp_path / "imu.csv").write_text("".join(f"{0.1 * n},0,0,0,0,0,9.8\n" for n in range(30)))
    (tmp_path / "mounting.yaml").write_text(
        "T_cam_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    )
    known = {"odometry": write_wheels(tmp_path / "wheels.txt", NEW)}
    known |= {"imu": tmp_path / "imu.csv", "imu_mounting": tmp_path / "mounting.yaml"}
    with pytest.raises(ConfigError, match=words):
        run_slam(runs / "new", tmp_path / "out", map=runs / map_name, localize=localize, **known, **GIVEN)
    assert not (tmp_path / "out").exists()


def test_files_of_before_do_not_say_where_their_meters_come_from(runs, tmp_path):
    arrays = load(runs / "metric" / MAP_FILE, TABLE)
    del arrays["scale"]
    store(tmp_path / "map.npz", VERSION, arrays)
    known = read_slam_map(tmp_path / "map.npz", MONO)
    assert known.is_metric and not known.scale
    result = run_slam(runs / "new", tmp_path / "out", map=tmp_path / "map.npz", localize=True, **GIVEN)
    assert result.summary["scale"] == "meters, as in the known map" and result.summary["is_metric"]
    with pytest.raises(ConfigError, match="already: tag_size_m would"):
        run_slam(runs / "new", tmp_path / "out", map=tmp_path / "map.npz", tag_size_m=0.1, **GIVEN)
