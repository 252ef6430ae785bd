"""Errors of trajectories: laws, known answers, and the figures of evo and of KITTI's own tool."""

import copy

import numpy as np
import pytest

from epipole.errors import DegenerateGeometryError
from epipole.geometry import Rigid3, Rotation3, Similarity3
from epipole.io import read_trajectory
from epipole.metrics import absolute_error, associate, drift_per_length, relative_error, score_trajectory
from epipole.metrics.numbered_truth import at_image_numbers
from epipole.scene import Trajectory


@pytest.fixture
def positions(rng) -> Rigid3:
    return Rigid3.exp(rng.normal(size=(30, 6)))


def moved(positions: Rigid3, by: Similarity3) -> Rigid3:
    return Rigid3(by.rotation @ positions.rotation, by.apply(positions.translation))


def test_what_an_alignment_is_free_of_costs_nothing(positions):
    rotation = Rotation3.exp(np.array([0.3, -0.2, 0.9])).matrix
    for scale, alignment in ((1.0, "rigid"), (2.5, "similarity")):
        found = absolute_error(
            moved(positions, Similarity3(np.asarray(scale), rotation, np.ones(3))), positions, alignment
        )
        assert found.position.max < 1e-12 and found.rotation_deg.max < 1e-5
        assert float(found.truth_from_estimate.scale) == pytest.approx(1 / scale)
    shifted = moved(positions, Similarity3(np.asarray(1.0), np.eye(3), np.array([3.0, 4.0, 0.0])))
    assert absolute_error(shifted, positions, "none").position.rmse == pytest.approx(5.0)
    step, rotated = relative_error(shifted, positions)
    assert step.max < 1e-12 and rotated.max < 1e-5


def test_each_instant_finds_the_nearest_of_the_other(positions):
    truth = Trajectory(np.arange(30) * 0.1, positions)
    sparse = Trajectory(np.array([0.104, 0.52, 1.996, 7.0]), positions[np.arange(4)])
    rows, rows_of_truth = associate(sparse, truth)
    assert rows.tolist() == [0, 2] and rows_of_truth.tolist() == [1, 20]
    assert [list(r) for r in associate(truth, sparse)] == [[1, 20], [0, 2]]
    with pytest.raises(DegenerateGeometryError, match="are the clocks the same"):
        associate(Trajectory(sparse.timestamp_s + 1e5, sparse.world_from_body), truth)


def test_a_scale_error_of_one_per_cent_is_a_drift_of_one_per_cent():
    along = np.linspace(0, 900, 901)[:, None] * np.array([1.0, 0.0, 0.0])
    truth = Rigid3(np.tile(np.eye(3), (901, 1, 1)), along)
    found = drift_per_length(Rigid3(truth.rotation, 1.01 * along), truth)
    assert found.translation_percent == pytest.approx(1.0, rel=0.02) and found.rotation_deg_per_m == 0.0
    assert drift_per_length(truth[np.arange(50)], truth[np.arange(50)]).num_segments == 0


def test_kitti_as_its_own_tool_has_it(data_dir):
    """ORB-SLAM2 on sequence 00, as published: 0.70 % and 0.25 degrees per 100 m."""
    folder = data_dir / "trajectories"
    ours, truth = (read_trajectory(folder / f"KITTI_00_{name}.txt") for name in ("ORB", "gt"))
    found = drift_per_length(ours.world_from_body, truth.world_from_body)
    assert found.translation_percent == pytest.approx(0.70, abs=0.005)
    assert 100 * found.rotation_deg_per_m == pytest.approx(0.253, abs=0.001)


@pytest.mark.parametrize("alignment", ["none", "rigid", "similarity"])
def test_the_figures_are_those_of_evo(data_dir, alignment):
    metrics = pytest.importorskip("evo.core.metrics")
    from evo.core import sync
    from evo.tools import file_interface

    names = [str(data_dir / "trajectories" / f"fr2_desk_{name}.txt") for name in ("ORB", "groundtruth")]
    ours, truth = (read_trajectory(name) for name in names)
    rows, rows_of_truth = associate(ours, truth)
    ours, truth = ours.world_from_body[rows], truth.world_from_body[rows_of_truth]
    theirs, reference = (file_interface.read_tum_trajectory_file(name) for name in names)
    reference, theirs = sync.associate_trajectories(reference, theirs)
    if alignment == "none":
        for step in (1, 10):
            for found, relation in zip(
                relative_error(ours, truth, step),
                (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg),
            ):
                rpe = metrics.RPE(relation, step, metrics.Unit.frames)
                rpe.process_data((reference, theirs))
                assert_same(found, rpe.get_all_statistics())
    aligned = copy.deepcopy(theirs)
    if alignment != "none":
        aligned.align(reference, correct_scale=alignment == "similarity")
    error = absolute_error(ours, truth, alignment)
    for found, relation in (
        (error.position, metrics.PoseRelation.translation_part),
        (error.rotation_deg, metrics.PoseRelation.rotation_angle_deg),
    ):
        ape = metrics.APE(relation)
        ape.process_data((reference, aligned))
        assert_same(found, ape.get_all_statistics())


def assert_same(found, theirs):
    for name in ("rmse", "mean", "median", "max"):
        assert getattr(found, name) == pytest.approx(theirs[name], abs=1e-9)


def test_scores_of_another_scale_are_told_with_it(positions):
    """Steps and KITTI's drift of a path of unknown scale count after the scale is aligned."""
    along = np.linspace(0, 300, 301)[:, None] * np.array([1.0, 0.0, 0.0])
    along[:, 1] = 20 * np.sin(along[:, 0] / 40)
    truth = Trajectory(np.arange(301.0), Rigid3(np.tile(np.eye(3), (301, 1, 1)), along))
    half = Trajectory(truth.timestamp_s, Rigid3(truth.world_from_body.rotation, 0.5 * along))
    found = score_trajectory(half, truth)
    assert found.similarity.ate_rmse < 1e-9 and found.similarity.scale == pytest.approx(2.0)
    assert found.similarity.step_rmse < 1e-9 and found.similarity.kitti_percent < 1e-9
    steps = np.linalg.norm(np.diff(along, axis=0), axis=1)
    assert found.rigid.step_rmse == pytest.approx(0.5 * np.sqrt(np.mean(steps**2)))
    assert found.rigid.scale == 1.0 and 40 < found.rigid.kitti_percent < 55 and found.coverage == 1.0
    few = Trajectory(np.array([0.0, 1.0, 7.5]), positions[:3])
    with pytest.raises(DegenerateGeometryError, match="2 of 3 instants"):
        score_trajectory(few, truth)


def test_a_truth_of_picture_numbers_gets_the_pictures_times() -> None:
    poses = Rigid3(np.broadcast_to(np.eye(3), (50, 3, 3)).copy(), np.linspace(0, [1, 0, 0], 50))
    truth = Trajectory(np.arange(50.0), poses)
    names = [f"frame-{2 * n:06d}.color.jpg" for n in range(25)]
    times = 100.0 + np.arange(25) / 15
    times[3] = np.nan
    found = at_image_numbers(truth, [n.replace(".color", "") for n in names], times, 0.01)
    assert found is not None and len(found) == 24
    every_third = np.where(np.arange(25) % 3, np.nan, times)  # frames that were passed over have no times
    assert len(at_image_numbers(truth, names, every_third, 0.01)) == np.isfinite(every_third).sum()
    np.testing.assert_array_equal(found.timestamp_s, np.delete(times, 3))
    np.testing.assert_array_equal(
        found.world_from_body.translation, np.delete(poses.translation[::2], 3, axis=0)
    )
    # What are times indeed, or numbers of other images, stays as it is.
    timed = Trajectory(times[~np.isnan(times)], poses[np.arange(24)])
    assert at_image_numbers(timed, names, times, 0.01) is None
    assert at_image_numbers(truth, [f"{n + 1000}.png" for n in range(25)], times, 0.01) is None
    assert at_image_numbers(truth, [], np.zeros(0), 0.01) is None
