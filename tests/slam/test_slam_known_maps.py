"""Several known maps: merged where they show a common area, joined by frames, or left out with the reason."""

from copy import deepcopy

import cv2
import numpy as np
import pytest
from slam_rides import errors, rendered

from epipole.errors import ConfigError, FileFormatError
from epipole.pipelines.slam.config import SlamConfig
from epipole.pipelines.slam.loops.merging import join_maps
from epipole.pipelines.slam.output.map_file import load_slam_map, write_slam_map
from epipole.pipelines.slam.run import slam as run_slam
from epipole.pipelines.slam.slam import Slam
from whole import in_whole_run

pytestmark = pytest.mark.usefixtures("unchecked_module")

FIRST, SECOND, NEW = range(0, 100, 4), range(64, 168, 4), range(80, 152, 4)


@pytest.fixture(scope="module")
def ride():
    return rendered("loop_room", 168, 4)


def map_of(seen, kind, numbers):
    """The map of a run through these frames."""
    system = Slam(seen.sensor(kind))
    for frame in seen.frames(kind, numbers):
        system.track(frame)
    system.finish()
    return system.maps[0]


@pytest.fixture(scope="module")
def two_maps(ride):
    """Maps of two runs with one camera, which no test changes."""
    return [map_of(ride, "mono", numbers) for numbers in (FIRST, SECOND)]


@pytest.fixture(scope="module")
def saved(ride, two_maps, tmp_path_factory):
    """Maps of three runs with one camera, of which the last was in another scene, and images of a fourth run."""
    folder = tmp_path_factory.mktemp("maps")
    corridor = rendered("corridor", 60, 4)
    elsewhere = map_of(corridor, "mono", range(0, 60, 4))
    for name, seen, model in zip(
        ("first", "second", "corridor"), (ride, ride, corridor), (*two_maps, elsewhere)
    ):
        names = [f"{name}/{k.number}" for k in model.keyframes]
        write_slam_map(folder / name / "map.npz", model, names, seen.sensor("mono"))
    (folder / "new").mkdir()
    for n in NEW:
        cv2.imwrite(str(folder / "new" / f"{n:03d}.png"), ride.images[n][0])
    return folder


def given(ride):
    f, _, cx, cy = ride.ride.camera.params
    return {"camera_params": f"{f},{f},{cx + 0.5},{cy + 0.5}"}


def test_maps_of_a_common_area_are_merged(ride, saved, tmp_path):
    result = run_slam(saved / "new", tmp_path / "out", map=(saved / "first", saved / "second"), **given(ride))
    assert any("was merged with" in words for words in result.warnings)
    assert result.summary["num_localized"] == len(NEW)
    model, parts = load_slam_map(tmp_path / "out"), [load_slam_map(saved / n) for n in ("first", "second")]
    assert len(model.keyframes) >= sum(len(part.keyframes) for part in parts)
    truth = ride.truth(NEW)
    assert errors_of(result.trajectory.world_from_body, truth) < 0.02


def errors_of(path, truth):
    from epipole.metrics import absolute_error

    return absolute_error(path, truth, "similarity").position.rmse


def test_a_map_of_another_scene_is_left_out(ride, saved, tmp_path):
    result = run_slam(
        saved / "new", tmp_path / "out", map=[saved / "first", saved / "corridor"], **given(ride)
    )
    notes = [words for words in result.warnings if "corridor" in words]
    assert any("is separate from" in words and "recognized" in words for words in notes)
    assert any(
        words.startswith("no frame of this run") and "not part of the new map" in words for words in notes
    )
    assert result.summary["submaps"] == [] and result.summary["num_localized"] >= len(NEW) - 6
    assert len(load_slam_map(tmp_path / "out").keyframes) >= len(load_slam_map(saved / "first").keyframes)


@in_whole_run
def test_frames_join_maps_that_have_nothing_in_common(ride):
    maps = [map_of(ride, "rgbd", numbers) for numbers in (range(0, 44, 4), range(124, 168, 4))]
    count = sum(len(model.keyframes) for model in maps)
    for keyframe in maps[1].keyframes:
        keyframe.number += 100
    system = Slam(ride.sensor("rgbd"), known=maps)
    assert [model.number for model in system.maps] == [0, 1]
    for frame in ride.frames("rgbd"):
        system.track(frame)
    system.finish()
    assert len(system.maps) == 1 and len(system.maps[0].keyframes) > count
    assert len(system.trajectory()) == len(ride.images)
    assert errors(system, ride.truth(), "rigid").position.rmse < 0.02


def test_what_cannot_be_merged_is_refused(ride, saved, tmp_path):
    with pytest.raises(ConfigError, match="given twice"):
        run_slam(saved / "new", tmp_path / "out", map=(saved / "first", saved / "first"), **given(ride))
    with pytest.raises(FileFormatError, match="no SLAM map"):
        run_slam(saved / "new", tmp_path / "out", map=(saved / "first", saved / "new"), **given(ride))
    model = load_slam_map(saved / "second")
    names = [str(k.number) for k in model.keyframes]
    write_slam_map(tmp_path / "metric.npz", model, names, ride.sensor("mono"), "meters, from a tag")
    with pytest.raises(ConfigError, match="pass the metric map first"):
        run_slam(
            saved / "new", tmp_path / "out", map=(saved / "first", tmp_path / "metric.npz"), **given(ride)
        )
    assert not (tmp_path / "out").exists()


@in_whole_run
def test_maps_that_are_still_separate_are_compared_at_the_end(ride):
    """Both runs have seen frames 64 to 96; the only frame between them closes no loop, which needs three keyframes."""
    maps = [map_of(ride, "rgbd", numbers) for numbers in (FIRST, SECOND)]
    for keyframe in maps[1].keyframes:
        keyframe.number += 100
    first, second = (list(model.keyframes) for model in maps)
    system = Slam(ride.sensor("rgbd"), known=maps)
    (frame,) = ride.frames("rgbd", [160])
    answer = system.track(frame)
    assert answer.has_pose and answer.world_from_body is None and len(system.maps) == 2
    system.finish()
    assert len(system.maps) == 1 and system.map is system.maps[0]
    assert all(a is b for a, b in zip(system.maps[0].keyframes, first + second, strict=True))
    truth, there = ride.truth([0, 160])[1], system.trajectory().world_from_body[0]
    assert np.linalg.norm(there.translation - truth.translation) < 0.02
    points = [set(part[-1].point.tolist()) for part in (first, second)]
    assert any(len(points[0] & set(keyframe.point.tolist())) > 20 for keyframe in second)


def test_maps_with_the_same_frame_numbers_get_others(ride, two_maps):
    system = Slam(ride.sensor("mono"), known=deepcopy(two_maps))
    numbers = [keyframe.number for model in system.maps for keyframe in model.keyframes]
    assert len(set(numbers)) == len(numbers) and system.first_number == 1 + max(numbers)


def test_a_map_by_another_path_is_the_same(ride, saved, tmp_path):
    same = (saved / "first", saved / "first" / "map.npz")
    with pytest.raises(ConfigError, match="given twice"):
        run_slam(saved / "new", tmp_path / "out", map=same, **given(ride))


def test_joined_keyframes_of_a_rolling_shutter_move_in_the_common_unit(ride, two_maps):
    maps = deepcopy(two_maps)
    for model, scale, further in zip(maps, (1.0, 0.5), (0, 100)):
        model.rescale(scale)
        for keyframe in model.keyframes:
            keyframe.motion = np.full(12, keyframe.unit)
            keyframe.number += further
    config = SlamConfig().odometry
    ledger = []
    assert not join_maps(*maps, ride.sensor("mono"), config, ledger)
    assert [entry.verdict for entry in ledger] == ["accepted"]
    for keyframe in maps[0].keyframes:
        np.testing.assert_allclose(keyframe.motion[:3], keyframe.unit, rtol=1e-9)
