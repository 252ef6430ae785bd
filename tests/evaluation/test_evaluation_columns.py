"""Trajectories are read by their content; where one file leaves it open, both decide together, or they are refused."""

import json

import numpy as np
import pytest

from epipole.cli.main import main
from epipole.errors import DegenerateGeometryError, FileFormatError
from epipole.geometry import Rigid3, Rotation3
from epipole.io import read_trajectory, write_trajectory
from epipole.io.trajectories.files import trajectory_format
from epipole.metrics import associate, score_trajectory
from epipole.pipelines.evaluation.trajectories import evaluate_trajectory, trajectories_of
from epipole.scene import Trajectory

FAULTS = ("truth_tum.txt", "euroc_wfirst.txt", "orbslam3_ns.txt", "tum_order_ns.csv")
START_S = 1403636579.75


@pytest.fixture
def path(rng) -> Trajectory:
    """From no rotation on, as most paths begin; 30 Hz, by a computer's clock."""
    steps = np.vstack([np.zeros(6), rng.normal(scale=0.15, size=(39, 6))])
    return Trajectory(START_S + np.arange(40) / 32, Rigid3.exp(np.cumsum(steps, axis=0)))


def rows_of(path, *, order="xyzw", unit=1.0, sep=" ", whole=False, offset_s=0.0):
    """Text of a trajectory, in any form."""
    wxyz = Rotation3(path.world_from_body.rotation).as_quat_wxyz()
    columns = {"wxyz": [0, 1, 2, 3], "xyzw": [1, 2, 3, 0]}[order]
    out = []
    for time, p, q in zip(path.timestamp_s - offset_s, path.world_from_body.translation, wxyz):
        stamp = str(round(time * unit)) if whole else f"{time * unit:.9f}"
        out.append(sep.join([stamp, *(f"{value:.9g}" for value in (*p, *q[columns]))]))
    return "\n".join(out) + "\n"


@pytest.mark.parametrize("estimate", FAULTS)
@pytest.mark.parametrize("truth", FAULTS)
def test_the_same_path_in_four_forms(data_dir, estimate, truth):
    found = evaluate_trajectory(data_dir / "faults" / estimate, data_dir / "faults" / truth)
    assert (found.num_compared, found.num_instants, found.num_truth) == (60, 60, 60)
    assert found.rigid.ate_rmse < 1e-8 and found.rigid.rotation_rmse_deg < 1e-4
    for name in {estimate, truth} - {"truth_tum.txt"}:
        assert any(words.startswith(f"{name}: quaternion with w ") for words in found.assumptions)


def test_the_suffix_decides_nothing(path, tmp_path):
    for suffix in ("txt", "csv", "tum", "log"):
        for order, unit, sep, whole, form in (
            ("xyzw", 1.0, " ", False, "tum"),
            ("wxyz", 1e9, ",", True, "euroc"),
            ("xyzw", 1e9, " ", True, "tum"),
            ("xyzw", 1e6, " ", True, "tum"),
            ("xyzw", 1e3, " ", True, "tum"),
            ("wxyz", 1.0, ",", False, None),
            ("xyzw", 1.0, ",", False, "tum"),
        ):
            file = tmp_path / f"path.{suffix}"
            file.write_text(rows_of(path, order=order, unit=unit, sep=sep, whole=whole))
            if form is None:
                with pytest.raises(FileFormatError, match="Unknown quaternion order"):
                    read_trajectory(file)
                continue
            found = read_trajectory(file)
            assert trajectory_format(file) == form
            np.testing.assert_allclose(found.timestamp_s, path.timestamp_s, atol=6e-4)
            np.testing.assert_allclose(
                found.world_from_body.rotation, path.world_from_body.rotation, atol=1e-7
            )


@pytest.mark.parametrize(
    "header",
    [
        "# timestamp tx ty tz {}",
        "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],{}",
        "#time(ns),px,py,pz,{}",
    ],
)
@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
def test_names_of_columns_decide(path, tmp_path, header, order):
    names = {"# ": " ".join(f"q{c}" for c in order), "#t": ",".join(f"q_RS_{c} []" for c in order)}[
        header[:2]
    ]
    for sep in (" ", ","):
        file = tmp_path / "path.txt"
        file.write_text(
            header.format(names) + "\n" + rows_of(path, order=order, unit=1e9, sep=sep, whole=True)
        )
        found = read_trajectory(file).world_from_body
        np.testing.assert_allclose(found.rotation, path.world_from_body.rotation, atol=1e-7)


@pytest.mark.parametrize("sep", [" ", ","])
@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
@pytest.mark.parametrize(("unit", "whole"), [(1.0, False), (1e9, True)])
def test_a_truth_decides_the_order_of_an_estimate(path, tmp_path, sep, order, unit, whole):
    write_trajectory(path, tmp_path / "truth.txt")
    (tmp_path / "path.txt").write_text(rows_of(path, order=order, unit=unit, sep=sep, whole=whole))
    for pair in (("path.txt", "truth.txt"), ("truth.txt", "path.txt")):
        found = evaluate_trajectory(*(tmp_path / name for name in pair))
        assert found.num_compared == 40 and found.rigid.rotation_rmse_deg < 1e-3
        is_plain = (order, sep, unit) == ("xyzw", " ", 1.0)
        assert bool(found.assumptions) or is_plain or (order, sep) == ("xyzw", ",")


def test_an_order_that_neither_file_decides_is_refused(path, tmp_path):
    """On a line positions leave the rotation about it open."""
    along = np.linspace(0, 5, 40)[:, None] * np.array([1.0, 0, 0])
    straight = Trajectory(path.timestamp_s, Rigid3(path.world_from_body.rotation, along))
    write_trajectory(straight, tmp_path / "truth.txt")
    (tmp_path / "path.csv").write_text(rows_of(straight, unit=1e9, sep=",", whole=True))
    with pytest.raises(FileFormatError, match="Unknown quaternion order"):
        evaluate_trajectory(tmp_path / "path.csv", tmp_path / "truth.txt")


@pytest.mark.parametrize(
    ("unit", "name"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")]
)
def test_both_files_decide_the_unit_of_times_from_zero(path, tmp_path, unit, name):
    truth = Trajectory(path.timestamp_s - START_S, path.world_from_body)
    write_trajectory(truth, tmp_path / "truth.txt")
    (tmp_path / "path.txt").write_text(rows_of(truth, unit=unit, whole=True))
    found = evaluate_trajectory(tmp_path / "path.txt", tmp_path / "truth.txt")
    assert found.num_compared == 40 and found.rigid.ate_rmse < 1e-6
    assert any(name in words for words in found.assumptions)


def test_clocks_that_do_not_meet_stay_apart(path, tmp_path):
    write_trajectory(path, tmp_path / "truth.txt")
    late = Trajectory(path.timestamp_s + 100.0, path.world_from_body)
    write_trajectory(late, tmp_path / "path.txt")
    with pytest.raises(DegenerateGeometryError, match="are the clocks"):
        evaluate_trajectory(tmp_path / "path.txt", tmp_path / "truth.txt")


def test_a_quaternion_before_the_position_is_named(path, tmp_path):
    wxyz = Rotation3(path.world_from_body.rotation).as_quat_wxyz()
    table = np.column_stack([path.timestamp_s, wxyz, path.world_from_body.translation])
    np.savetxt(tmp_path / "path.txt", table)
    with pytest.raises(FileFormatError, match="columns 2 to 5 are unit quaternions"):
        read_trajectory(tmp_path / "path.txt")


def test_rows_without_times_pair_in_their_order_from_python(path, tmp_path):
    write_trajectory(path, tmp_path / "kitti.txt", "kitti")
    small = Trajectory(np.arange(40) * 0.4, path.world_from_body)
    write_trajectory(small, tmp_path / "tum.txt")
    rows, timed = read_trajectory(tmp_path / "kitti.txt"), read_trajectory(tmp_path / "tum.txt")
    assert not rows.is_timed and timed.is_timed and not rows[np.arange(3)].is_timed
    for one, other in ((rows, timed), (timed, rows), (rows, rows)):
        found = score_trajectory(one, other)
        assert found.num_compared == 40 and found.rigid.ate_rmse < 1e-7
        given = [row.tolist() for row in associate(one, other)]
        assert given == [list(range(40)), list(range(40))]
    by_file = evaluate_trajectory(tmp_path / "kitti.txt", tmp_path / "tum.txt")
    assert by_file.num_compared == 40 and by_file.rigid.ate_rmse < 1e-7
    for one, other in (
        (rows, timed[np.arange(30)]),
        (rows[np.arange(30)], timed),
        (rows, rows[np.arange(30)]),
    ):
        with pytest.raises(DegenerateGeometryError, match="has no times"):
            score_trajectory(one, other)


def folder_with_truth(folder, kind, path):
    """A folder of frames that brings the truth in its own form."""
    folder.mkdir()
    if kind == "TUM RGB-D":
        write_trajectory(path, folder / "groundtruth.txt")
    elif kind == "KITTI":
        write_trajectory(path, folder / "poses.txt", "kitti")
    elif kind == "7-Scenes":
        for n, matrix in enumerate(path.world_from_body.as_matrix()):
            np.savetxt(folder / f"frame-{n:06d}.pose.txt", matrix)
    elif kind == "ScanNet":
        (folder / "pose").mkdir()
        for n, matrix in enumerate(path.world_from_body.as_matrix()):
            np.savetxt(folder / "pose" / f"{n}.txt", matrix)
        (folder / "pose" / "40.txt").write_text("-inf -inf -inf -inf\n" * 4)
    return folder


@pytest.mark.parametrize("kind", ["TUM RGB-D", "KITTI", "7-Scenes", "ScanNet"])
def test_evaluate_takes_folders_of_frames(path, tmp_path, kind, capsys):
    path = Trajectory(np.arange(40) / 30, path.world_from_body)
    folder = folder_with_truth(tmp_path / "frames", kind, path)
    write_trajectory(path, tmp_path / "path.txt")
    assert trajectories_of(tmp_path / "path.txt", folder) == [tmp_path / "path.txt"]
    main(["evaluate", str(tmp_path / "path.txt"), "--truth", str(folder), "--json"])
    found = json.loads(capsys.readouterr().out)["path.txt"]
    assert found["num_compared"] == 40 and found["rigid"]["ate_rmse"] < 1e-6
    left_out = [words for words in found["assumptions"] if "1 of 41 pose files" in words]
    assert len(left_out) == (kind == "ScanNet")


def test_a_folder_without_a_path_is_refused(path, tmp_path):
    write_trajectory(path, tmp_path / "path.txt")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileFormatError, match="no ground-truth trajectory"):
        main_or_raise(tmp_path)


def main_or_raise(folder):
    assert trajectories_of(folder / "path.txt", folder / "empty") == [folder / "path.txt"]
    evaluate_trajectory(folder / "path.txt", folder / "empty")


def test_a_nearly_straight_path_keeps_its_usual_order(path, tmp_path):
    """Its positions leave the rotation about it open, so that another order may agree better by chance."""
    rng = np.random.default_rng(8)
    for tilt in np.linspace(0.0, 3.0, 13):
        rotated = Rotation3.exp(np.array([tilt, 0.0, 0.0])).matrix
        rotation = rotated @ path.world_from_body.rotation
        along = np.linspace(0, 50, 40)[:, None] * np.array([1.0, 0, 0]) + rng.normal(scale=1e-3, size=(40, 3))
        noisy = along + rng.normal(scale=1e-3, size=(40, 3))
        for name, positions in (("truth.txt", along), ("path.txt", noisy)):
            (tmp_path / name).write_text(
                rows_of(Trajectory(path.timestamp_s, Rigid3(rotation, positions.copy())))
            )
        found = evaluate_trajectory(tmp_path / "path.txt", tmp_path / "truth.txt")
        assert found.assumptions == () and found.step_rotation_rmse_deg < 1e-4
