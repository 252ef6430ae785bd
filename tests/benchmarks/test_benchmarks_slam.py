"""The SLAM benchmark: frames come whole to the disk, and scores are what they say."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from benchmarks.measure import REPOSITORY, run_measured
from benchmarks.peers.pyorbslam3_slam import Pyorbslam3Slam, settings_of
from benchmarks.peers.slam_frames import Metronome, load_frames, save_answers
from benchmarks.slam_score import score_path, score_run
from benchmarks.tasks import slam as tasks

from benchmarks import slam as bench
from epipole.geometry import Rigid3
from epipole.io.trajectories.files import write_trajectory
from epipole.scene import Trajectory
from epipole.synthetic import rides


def a_path(count: int = 20) -> Trajectory:
    times = np.arange(count) / 10.0
    xi = np.stack(
        [0.3 * times, np.sin(times), np.cos(2 * times), 0.1 * times, 0 * times, 0.2 * times], axis=1
    )
    return Trajectory(times, Rigid3.exp(xi))


def test_scores_are_those_of_known_errors() -> None:
    truth = a_path()
    moved = Rigid3.exp(np.array([1.0, 2.0, 3.0, 0.4, 0.5, 0.6])) @ truth.world_from_body
    double = Trajectory(truth.timestamp_s, Rigid3(moved.rotation, 2.0 * moved.translation))
    score = score_path(double, truth)
    assert score["compared"] == 20
    assert score["sim3_m"] < 1e-9 < score["se3_m"]
    assert score["sim3_scale"] == pytest.approx(0.5)
    half = score_path(double[np.arange(10)], truth)
    assert half["compared"] == 10
    assert "error" in score_path(Trajectory(truth.timestamp_s + 50.0, moved), truth)


def test_what_a_turn_makes_up_is_told() -> None:
    positions = rides.rotate_only(40, (32, 24)).truth()
    assert score_path(positions, positions)["made_up_max"] == 0
    wrong = positions.world_from_body.translation.copy()
    wrong[7] += [0.0, 0.03, 0.04]
    rotated = positions.world_from_body.rotation.copy()
    rotated[9] = rotated[9] @ Rigid3.exp(np.array([0, 0, 0, 0, 0.02, 0])).rotation
    score = score_path(Trajectory(positions.timestamp_s, Rigid3(rotated, wrong)), positions)
    assert score["made_up_max"] == pytest.approx(0.05)
    assert score["turn_max_deg"] == pytest.approx(np.degrees(0.02))
    assert "se3_m" not in score


def test_a_run_without_any_place_is_scored(tmp_path: Path) -> None:
    frames = written(tmp_path)
    out = tmp_path / "out"
    out.mkdir()
    save_answers(out, [1.0, 2.0, 9.0, 2.0], [None] * 4, states={})
    score = score_run(out, frames, tasks.truths_of(frames))
    assert score["causal"] == score["final"] == {"coverage": 0.0}
    assert score["segments"] == 0
    assert score["ms_median"] == 2.0


def test_coverage_counts_from_the_first_frame(tmp_path: Path) -> None:
    frames = written(tmp_path)
    out = tmp_path / "out"
    out.mkdir()
    truth = rides.loop_room(4, (32, 24)).truth()
    positions = truth.world_from_body.as_matrix()
    save_answers(out, [1.0] * 4, [None, positions[1], None, positions[3]])
    write_trajectory(truth[np.array([1, 2, 3])], out / "final.txt")
    score = score_run(out, frames, tasks.truths_of(frames))
    assert score["causal"]["coverage"] == 0.5
    assert score["final"]["coverage"] == 0.75
    assert score["segments"] == 2
    assert score["final"]["exact"]["se3_m"] < 1e-6


def written(tmp_path: Path) -> Path:
    folder = tmp_path / "frames"
    folder.mkdir()
    tasks._write_ride(lambda: rides.loop_room(4, (32, 24)))(tmp_path, folder)
    return folder


def test_frames_come_whole_to_the_disk(tmp_path: Path) -> None:
    frames, ride = load_frames(written(tmp_path)), rides.loop_room(4, (32, 24))
    assert frames.right is not None and frames.depth is not None
    for n in (0, 3):
        np.testing.assert_array_equal(frames.left[n], ride.left(n).gray)
        np.testing.assert_array_equal(frames.right[n], ride.right(n).gray)
        np.testing.assert_allclose(frames.depth[n] / tasks.DEPTH_FACTOR, ride.left(n).depth, atol=1.01e-4)
    np.testing.assert_array_equal(frames.timestamp_s, ride.timestamp_s)
    assert frames.about["baseline_m"] == ride.baseline


def test_sequences_that_are_not_there_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="7scenes"):
        tasks.prepare("7scenes", tmp_path / "none", tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


def test_settings_tell_what_the_camera_is(tmp_path: Path) -> None:
    frames = load_frames(written(tmp_path))
    text = settings_of(frames, "stereo")
    assert 'Camera.type: "PinHole"' in text
    assert "Camera2.fx: 22.4" in text
    assert "Camera.fps: 30" in text
    assert "data: [1.0, 0.0, 0.0, 0.12," in text
    assert "RGBD.DepthMapFactor: 5000.0" in settings_of(frames, "rgbd")
    assert "Camera2" not in settings_of(frames, "mono")


def test_frames_are_given_at_their_time() -> None:
    metronome = Metronome(np.array([5.0, 5.0, 5.05]))
    start = os.times().elapsed
    for n in range(3):
        metronome.wait_for(n)
    assert os.times().elapsed - start >= 0.03
    assert metronome.most_late_s < 0.05
    slower = Metronome(np.array([5.0, 5.01]), slower=5.0)
    start = os.times().elapsed
    slower.wait_for(1)
    assert os.times().elapsed - start >= 0.03


def test_a_program_that_is_not_there_has_no_version(tmp_path: Path) -> None:
    assert Pyorbslam3Slam(tmp_path / "python", tmp_path / "words.txt").version() is None
    assert Pyorbslam3Slam(Path(sys.executable), tmp_path / "words.txt").version() is None
    assert Pyorbslam3Slam(tmp_path, tmp_path, 6.0).name == "pyorbslam3 6x slower"


def test_a_program_that_hangs_is_ended(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "import time; time.sleep(60)"]
    measure = run_measured(command, tmp_path / "log", 1, limit_s=0.3)
    assert measure.exit_code != 0
    assert measure.wall_s < 30


def test_results_of_other_sensors_stay(tmp_path: Path) -> None:
    report = {"set": "x", "runs": [], "summary": {}}
    file = tmp_path / "slam_x.json"
    for sensor, program, cover in (
        ("mono", "a", 0.5),
        ("mono", "a", 1.0),
        ("mono", "b", 0.1),
        ("stereo", "a", 1.0),
    ):
        score = {"causal": {"coverage": cover, "exact": {"se3_m": 0.01}}, "ms_median": 5.0}
        report["runs"].append(
            {"sensor": sensor, "program": program, "run": 0, "exit_code": 0, "score": score}
        )
    bench._write(file, report)
    kept = bench._kept(file, "x")
    bench._forget(kept, "mono", ["a"])
    assert [(run["sensor"], run["program"]) for run in kept["runs"]] == [("mono", "b"), ("stereo", "a")]
    summary = json.loads(file.read_text())["summary"]
    assert summary["mono a"]["causal coverage"] == {"median": 0.75, "min": 0.5, "max": 1.0, "runs": 2}
    assert bench._table("x", report).row_count == 3


def test_epipole_runs_in_a_process_of_its_own(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    tasks._write_ride(lambda: rides.loop_room(6, (160, 120)))(tmp_path, folder)
    out = tmp_path / "out"
    out.mkdir()
    command = [sys.executable, "-m", "benchmarks.peers.epipole_slam", str(folder), "rgbd", str(out)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    score = score_run(out, folder, tasks.truths_of(folder))
    assert score["final"]["coverage"] == 1.0
    assert score["final"]["exact"]["se3_m"] < 0.02
