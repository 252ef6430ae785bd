"""The path against a known one: with times and without, from files and from folders of frames."""

import json

import cv2
import numpy as np
import pytest
from slam_rides import CAMERA, ride, write_pairs

from epipole.errors import ConfigError, FileFormatError
from epipole.geometry import Rigid3, Similarity3
from epipole.io import read_trajectory, write_trajectory
from epipole.io.trajectories.files import read_pose_matrix
from epipole.io.trajectories.frame_tables import read_frame_table
from epipole.metrics import absolute_error
from epipole.pipelines.evaluation.trajectories import evaluate_trajectory
from epipole.pipelines.slam.frames import TrackedFrame, TrackingState
from epipole.pipelines.slam.output.record import FrameRecord, stretches, without_numbers, write_records
from epipole.pipelines.slam.output.truth import errors_of, true_path_at, truth_at_frames, truth_summary
from epipole.pipelines.slam.run import slam as run_slam
from epipole.scene import Trajectory

PARAMS = ",".join(str(p + 0.5 * (n >= 2)) for n, p in enumerate(CAMERA.params))


def records_of(times: list[float | None], names: list[str] | None = None) -> list[FrameRecord]:
    """Frames at these times; None for one that was left out."""
    out = []
    for n, time in enumerate(times):
        answer = None
        if time is not None:
            answer = TrackedFrame(time, TrackingState.LOST, "4 points", None, None, 0, is_keyframe=False)
        name = names[n] if names else f"{n}.png"
        out.append(FrameRecord(n, name, 0.01, answer, "" if answer else f"frame {n} is left out: no image"))
    return out


@pytest.fixture
def kitti_truth(tmp_path):
    truth = Trajectory(np.arange(4) * 1.0, Rigid3.exp(np.arange(24.0).reshape(4, 6) * 0.01))
    write_trajectory(truth, tmp_path / "poses.txt", "kitti")
    return truth, true_path_at(tmp_path / "poses.txt")


def test_rows_without_times_get_those_of_the_frames(kitti_truth):
    truth, found = kitti_truth
    assert not found.has_times
    known = truth_at_frames(found, records_of([0.0, None, 0.2, 0.3]))
    assert known.timestamp_s.tolist() == [0.0, 0.2, 0.3]
    positions = truth.world_from_body.translation[[0, 2, 3]]
    np.testing.assert_allclose(known.world_from_body.translation, positions, atol=1e-8)
    known = truth_at_frames(found, records_of([0.5, 0.7], ["000001.png", "000003.png"]))
    np.testing.assert_allclose(
        known.world_from_body.translation, truth.world_from_body.translation[[1, 3]], atol=1e-8
    )
    for names in (["a.png", "b.png"], ["000001.png", "000004.png"]):
        with pytest.raises(ConfigError, match="4 rows for 2 frames"):
            truth_at_frames(found, records_of([0.0, 0.1], names))


def test_a_first_column_of_picture_numbers_is_no_time(tmp_path):
    positions = Rigid3.exp(np.arange(60.0).reshape(10, 6) * 0.01)
    numbers = np.arange(100.0, 200.0, 10.0)
    write_trajectory(Trajectory(numbers, positions), tmp_path / "poses.txt")
    found = true_path_at(tmp_path / "poses.txt")
    times = [n / 30.0 for n in range(10)]
    known = truth_at_frames(
        found, records_of(times, [f"frame-{100 + 10 * n:06d}.color.jpg" for n in range(10)])
    )
    assert known.timestamp_s.tolist() == times
    np.testing.assert_allclose(known.world_from_body.translation, positions.translation, atol=1e-8)
    # Names without these numbers, or times that are seconds: they are times.
    assert truth_at_frames(found, records_of(times)) is found.trajectory
    names = [f"{number:.0f}.png" for number in numbers]
    for late_s in (0.0, 0.005, -0.005):
        assert truth_at_frames(found, records_of((numbers + late_s).tolist(), names)) is found.trajectory


def test_a_truth_that_meets_few_of_the_frames_gives_no_error(tmp_path):
    positions = Rigid3.exp(np.arange(240.0).reshape(40, 6) * 0.01)
    known = Trajectory(np.arange(40) * 1.0 + 0.2, positions)
    path = Trajectory(np.concatenate([np.arange(36) * 1.0, np.arange(36, 40) + 0.2]), positions)
    write_trajectory(known, tmp_path / "truth.txt")
    out, said = truth_summary(true_path_at(tmp_path / "truth.txt"), known, (path, path), 40)
    assert out["final"] is None and any("4 of 40 poses have a true pose" in words for words in said)


def test_errors_bring_the_truth_into_the_path_and_the_scale_is_asked_for(rng):
    truth = Trajectory(np.arange(9.0), Rigid3.exp(rng.normal(size=(9, 6))))
    world = Similarity3(np.asarray(0.4), Rigid3.exp(rng.normal(size=6)).rotation, rng.normal(size=3))
    path = Trajectory(
        truth.timestamp_s,
        Rigid3(
            world.rotation @ truth.world_from_body.rotation, world.apply(truth.world_from_body.translation)
        ),
    )
    found = errors_of(path, truth, with_scale=True)
    assert found.distance.max() < 1e-9 and errors_of(path, truth, with_scale=False).distance.max() > 0.1
    back = found.estimate_from_truth.apply(truth.world_from_body.translation)
    np.testing.assert_allclose(back, path.world_from_body.translation, atol=1e-9)
    later = Trajectory(truth.timestamp_s + 100, truth.world_from_body)
    assert errors_of(path, later, with_scale=True) is None


def test_the_summary_tells_scores_and_doubts(kitti_truth):
    truth, found = kitti_truth
    given, warnings = truth_summary(found, truth, (truth, truth), 8)
    assert not warnings and given["final"]["rigid"]["ate_rmse"] < 1e-9 and given["causal"]["coverage"] == 0.5
    later = Trajectory(truth.timestamp_s + 0.4, truth.world_from_body)
    given, warnings = truth_summary(found, truth, (later, truth), 8)
    assert given["final"] is None and "final trajectory is not compared" in warnings[0]


def test_runs_with_a_truth(tmp_path, capsys):
    folder = write_pairs(tmp_path / "ride")
    out = tmp_path / "out"
    result = run_slam(folder, out, truth=folder)
    score = json.loads((out / "summary.json").read_text())["truth"]
    assert score["source"].endswith("poses.txt") and score["final"]["coverage"] == 1.0
    found = absolute_error(result.trajectory.world_from_body, ride().truth()[np.arange(12)])
    assert score["final"]["rigid"]["ate_rmse"] == pytest.approx(found.position.rmse, rel=1e-6)
    path = read_trajectory(out / "trajectory.txt")
    np.testing.assert_allclose(
        path.world_from_body.translation, result.trajectory.world_from_body.translation, atol=1e-7
    )
    table = read_frame_table(out / "frames.csv")
    assert table.image[3] == "000003.png" and table.timestamp_s[3] == pytest.approx(0.3)
    with pytest.raises(FileFormatError, match="it does not exist"):
        run_slam(folder, out, truth=tmp_path / "nothing.txt")
    with pytest.raises(FileFormatError, match="no ground-truth trajectory"):
        run_slam(folder, out, truth=folder / "image_0")


def test_a_path_of_one_camera_is_compared_by_the_table_of_its_frames(tmp_path):
    """The causal path lacks the frames before the begin: KITTI's rows are told by the numbers of the frames."""
    folder = write_pairs(tmp_path / "ride")
    out = tmp_path / "out"
    result = run_slam(folder / "image_0", out, camera_params=PARAMS, truth=folder / "poses.txt")
    causal = out / "trajectory_causal.txt"
    assert len(result.causal) < 12
    found = evaluate_trajectory(causal, folder / "poses.txt")
    given = result.summary["truth"]["causal"]
    assert found.num_compared == len(result.causal) == given["num_compared"]
    assert found.similarity.ate_rmse == pytest.approx(given["similarity"]["ate_rmse"], rel=1e-4)
    (out / "frames.csv").unlink()
    with pytest.raises(FileFormatError, match="have no timestamps"):
        evaluate_trajectory(causal, folder / "poses.txt")


def test_the_truth_of_seven_scenes_lies_beside_its_pictures(tmp_path):
    for n in (0, 2):
        cv2.imwrite(str(tmp_path / f"frame-{n:06d}.color.png"), np.zeros((8, 8, 3), np.uint8))
        np.savetxt(
            tmp_path / f"frame-{n:06d}.pose.txt", [[0, -1, 0, n], [1, 0, 0, 5], [0, 0, 1, 6], [0, 0, 0, 1]]
        )
    found = true_path_at(tmp_path)
    assert found.has_times and found.trajectory.timestamp_s.tolist() == [0.0, 2 / 30]
    assert found.trajectory.world_from_body.translation.tolist() == [[0, 5, 6], [2, 5, 6]]
    (tmp_path / "frame-000002.pose.txt").write_text("1 0 0 0\n0 2 0 0\n0 0 1 0\n")
    with pytest.raises(FileFormatError, match="not a rotation matrix"):
        read_pose_matrix(tmp_path / "frame-000002.pose.txt")


def test_records_become_a_table_and_stretches(tmp_path):
    records = records_of([0.0, 0.1, None, 0.3])
    write_records(records, tmp_path / "frames.csv")
    table = read_frame_table(tmp_path / "frames.csv")
    assert table.image == ("0.png", "1.png", "2.png", "3.png")
    np.testing.assert_array_equal(table.timestamp_s, [0.0, 0.1, np.nan, 0.3])
    assert "left out: no image" in (tmp_path / "frames.csv").read_text().splitlines()[3]
    parts = stretches(records)
    assert [(p.first, p.last, p.state) for p in parts] == [(0, 1, "lost"), (2, 2, "left out"), (3, 3, "lost")]
    assert without_numbers("12.5 px of 3") == without_numbers("7 px of 41.0")
    # Frames that were dropped to keep up are not in the table, and count all the same.
    (tmp_path / "frames.csv").write_text("frame,timestamp_s,image\n1,0.0,a.png\n3,0.2,b.png\n")
    table = read_frame_table(tmp_path / "frames.csv")
    assert table.image == ("", "a.png", "", "b.png")
    np.testing.assert_array_equal(table.timestamp_s, [np.nan, 0.0, np.nan, 0.2])
    for row in ("1,0.0,a.png\n1,0.1,b.png", "1,0.0,a.png\n0,0.1,b.png", "99999999,0,a", "-1,0,a", "x,0,a"):
        (tmp_path / "frames.csv").write_text(f"frame,timestamp_s,image\n{row}\n")
        with pytest.raises(FileFormatError, match="expected columns frame, timestamp_s and image"):
            read_frame_table(tmp_path / "frames.csv")
