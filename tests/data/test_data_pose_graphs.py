"""Pose graphs of the field: the minima that GTSAM 4.3 reaches, or lower ones; false loops put among real ones."""

from dataclasses import replace

import numpy as np
import pytest

from epipole.geometry import Rigid2, align_points
from epipole.io import read_g2o
from epipole.optim import initialize_pose_graph, optimize_pose_graph, optimize_pose_graph_robustly
from whole import IS_WHOLE, in_whole_run

GTSAM_COST = {
    "sphere2500": 675.7009629,
    "parking-garage": 0.6341923996,
    "intel": 22.5021165,
    "sphere_noisy_init": 63789.078927,
}


@pytest.mark.parametrize("name", list(GTSAM_COST) if IS_WHOLE else ["parking-garage", "intel"])
def test_minima_are_those_of_gtsam_or_lower(data_dir, name):
    graph = read_g2o(data_dir / "posegraph" / f"{name}.g2o").graph
    for start in (graph, initialize_pose_graph(graph)):
        assert optimize_pose_graph(start).final_cost <= GTSAM_COST[name] * (1 + 1e-6)


@in_whole_run
def test_a_torus_from_its_edges_alone_is_lower_than_from_its_guess(data_dir):
    """From the guess in the file GTSAM's Levenberg-Marquardt ends at 29,954."""
    graph = read_g2o(data_dir / "posegraph" / "torus3D.g2o").graph
    assert optimize_pose_graph(initialize_pose_graph(graph)).final_cost < 12118.0


def truth_of(data_dir, name):
    """Positions of the places (n, 2)."""
    folder = data_dir / "posegraph" / name / "groundTruth"
    if name == "ringCity":
        return read_g2o(folder / "ringCity.g2o").graph.world_from_body.translation
    return np.loadtxt(folder / "manhattanOlson3500_nodes_groundTruth.dat")[:, :2]


CITIES = [
    ("ringCity", "originalDataset/ringCity.g2o"),
    ("manhattan", "originalDataset/Olson/manhattanOlson3500.g2o"),
]


@pytest.mark.parametrize(("name", "file"), CITIES if IS_WHOLE else CITIES[:1])
def test_false_loops_among_real_ones_are_all_named(data_dir, name, file):
    graph = read_g2o(data_dir / "posegraph" / name / file).graph
    rng = np.random.default_rng(0)
    n, wrong = len(graph), 60
    first, second = rng.integers(0, n // 2, wrong), rng.integers(n // 2 + 50, n, wrong)
    false = Rigid2(rng.uniform(-3, 3, wrong), 5.0 * rng.normal(size=(wrong, 2)))
    measured = graph.first_from_second
    assert isinstance(measured, Rigid2)
    spoiled = replace(
        graph,
        first=np.concatenate([graph.first, first]),
        second=np.concatenate([graph.second, second]),
        first_from_second=Rigid2(
            np.concatenate([measured.angle_rad, false.angle_rad]),
            np.concatenate([measured.translation, false.translation]),
        ),
        information=np.concatenate([graph.information, graph.information[:wrong]]),
    )
    found, clean = optimize_pose_graph_robustly(spoiled), optimize_pose_graph(graph)
    assert not found.kept_mask[-wrong:].any()
    assert found.kept_mask[:-wrong].mean() > 0.985
    truth = truth_of(data_dir, name)

    def error(positions):
        aligned = align_points(
            positions.as_rigid3().translation, np.pad(truth, ((0, 0), (0, 1))), with_scale=False
        )
        moved = aligned.apply(positions.as_rigid3().translation)[:, :2]
        return np.sqrt(((moved - truth) ** 2).sum(axis=1).mean())

    assert error(found.world_from_body) < 1.1 * error(clean.world_from_body)
