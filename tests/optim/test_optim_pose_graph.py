"""Pose graphs: the truth from exact edges, the same minima as other programs, false loops named, hostile input."""

from dataclasses import replace

import numpy as np
import pytest

from epipole.errors import ConfigError, DegenerateGeometryError, FileFormatError, ShapeError
from epipole.geometry import Rigid2, Rigid3, Similarity3
from epipole.io import read_g2o, write_g2o
from epipole.optim import (
    PoseGraph,
    PoseGraphConfig,
    initialize_pose_graph,
    optimize_pose_graph,
    optimize_pose_graph_robustly,
    pose_graph_cost,
)
from whole import IS_WHOLE

KINDS = {Rigid2: 3, Rigid3: 6, Similarity3: 7}


def ring(kind, rng, count=60, noise=0.0, start=0.1):
    """Places around a ring with loops across it, and a start that is off."""
    d = KINDS[kind]
    step = np.zeros((count, d))
    step[:, 0] = 1.0
    step[:, 2 if d == 3 else 5] = 2 * np.pi / count
    if d > 3:
        step[:, 1:5] = 0.1 * rng.normal(size=(count, 4))
    positions = [kind.identity(1)]
    for k in range(count - 1):
        positions.append(positions[-1] @ kind.exp(step[k : k + 1]))
    fields = [np.concatenate([getattr(p, f) for p in positions]) for f in kind.__dataclass_fields__]
    truth = kind(*fields)
    first = np.concatenate([np.arange(count - 1), np.arange(0, count - 12, 3)])
    second = np.concatenate([np.arange(1, count), np.arange(12, count, 3)])
    exact = truth[first].inverse() @ truth[second]
    measured = exact @ kind.exp(noise * rng.normal(size=(len(first), d)))
    off = start * rng.normal(size=(count, d))
    off[0] = 0.0
    return truth, PoseGraph(
        truth @ kind.exp(off), first, second, measured, np.tile(np.eye(d), (len(first), 1, 1))
    )


def apart(a, b):
    return np.abs((a.inverse() @ b).log()).max()


@pytest.mark.parametrize("kind", list(KINDS))
def test_exact_edges_give_the_truth(rng, kind):
    truth, graph = ring(kind, rng)
    found = optimize_pose_graph(graph)
    assert found.converged and found.final_cost < 1e-12 < found.initial_cost
    assert apart(found.world_from_body, truth) < 1e-6


@pytest.mark.parametrize("kind", list(KINDS))
def test_noisy_edges_give_a_minimum(rng, kind):
    _, graph = ring(kind, rng, noise=0.05)
    found = optimize_pose_graph(graph, PoseGraphConfig(relative_tolerance=1e-14))
    best = found.final_cost
    assert abs(pose_graph_cost(replace(graph, world_from_body=found.world_from_body)) - best) < 1e-9
    for _ in range(20):
        shift = 1e-4 * rng.normal(size=(len(graph), KINDS[kind]))
        shift[0] = 0.0
        moved = found.world_from_body @ kind.exp(shift)
        assert pose_graph_cost(replace(graph, world_from_body=moved)) > best


@pytest.mark.parametrize("kind", [Rigid2, Rigid3])
def test_first_places_come_from_the_edges_alone(rng, kind):
    truth, graph = ring(kind, rng, start=2.0)
    assert apart(initialize_pose_graph(graph).world_from_body, truth) < 1e-6
    with pytest.raises(ShapeError):
        initialize_pose_graph(ring(Similarity3, rng)[1])
    huge = ring(Rigid3, rng)[1]
    with pytest.raises(ShapeError, match="rotation matrices"):
        replace(huge.first_from_second, rotation=np.full_like(huge.first_from_second.rotation, 1e308))


@pytest.mark.parametrize("kind", list(KINDS) if IS_WHOLE else [Rigid3])
def test_false_loops_are_named(rng, kind):
    truth, graph = ring(kind, rng, count=120, noise=0.01, start=0.02)
    d, wrong = KINDS[kind], 12
    first, second = rng.integers(0, 50, wrong), rng.integers(60, 120, wrong)
    false = kind.exp(2.0 * rng.normal(size=(wrong, d)))
    fields = [
        np.concatenate([getattr(graph.first_from_second, f), getattr(false, f)])
        for f in kind.__dataclass_fields__
    ]
    spoiled = PoseGraph(
        graph.world_from_body,
        np.concatenate([graph.first, first]),
        np.concatenate([graph.second, second]),
        kind(*fields),
        np.tile(1e4 * np.eye(d), (len(graph.first) + wrong, 1, 1)),
    )
    found = optimize_pose_graph_robustly(spoiled)
    assert not found.kept_mask[-wrong:].any()
    assert found.kept_mask[:-wrong].mean() > 0.97
    clean = optimize_pose_graph(graph)
    assert apart(found.world_from_body, truth) < 1.1 * apart(clean.world_from_body, truth) + 1e-3
    assert apart(optimize_pose_graph(spoiled).world_from_body, truth) > 2 * apart(
        found.world_from_body, truth
    )


def test_parts_that_nothing_joins_keep_a_place_each(rng):
    _, graph = ring(Rigid3, rng, count=30)
    keep = (graph.first < 15) == (graph.second < 15)
    split = PoseGraph(
        graph.world_from_body,
        graph.first[keep],
        graph.second[keep],
        graph.first_from_second[keep],
        graph.information[keep],
    )
    found = optimize_pose_graph(split)
    assert found.final_cost < 1e-12
    assert apart(found.world_from_body[[15]], graph.world_from_body[[15]]) == 0.0


def test_work_can_be_watched_and_ended(rng):
    _, graph = ring(Rigid3, rng, noise=0.05, start=0.3)
    seen = []

    def stop_after_two(iteration, cost):
        seen.append(cost)
        return iteration < 2

    found = optimize_pose_graph(graph, progress=stop_after_two)
    assert len(seen) == 2 and found.num_iterations == 2 and not found.converged
    assert seen[1] <= seen[0] <= found.initial_cost


def test_graphs_of_nothing_and_of_nonsense(rng):
    _, graph = ring(Rigid3, rng, count=20)
    none = PoseGraph(
        Rigid3.identity(3), *(np.zeros(0, np.int64),) * 2, Rigid3.identity(0), np.zeros((0, 6, 6))
    )
    assert optimize_pose_graph(none).final_cost == 0.0
    with pytest.raises(ShapeError):
        replace(graph, second=graph.second + 100)
    with pytest.raises(ShapeError):
        replace(graph, information=graph.information[:, :3, :3])
    with pytest.raises(ShapeError):
        replace(graph, first_from_second=Rigid2.identity(len(graph.first)))
    with pytest.raises(DegenerateGeometryError):
        optimize_pose_graph(replace(graph, information=-graph.information))
    with pytest.raises(ConfigError):
        PoseGraphConfig(confidence=1.0)
    with pytest.raises(ConfigError):
        PoseGraphConfig(max_iterations=0)


@pytest.mark.parametrize("kind", list(KINDS))
def test_g2o_files_come_back_as_they_were(rng, kind, tmp_path):
    _, graph = ring(kind, rng, noise=0.1)
    square = rng.normal(size=graph.information.shape)
    graph = replace(graph, information=square @ np.swapaxes(square, 1, 2))
    write_g2o(tmp_path / "ring.g2o", graph, ids=10 * np.arange(len(graph)))
    back = read_g2o(tmp_path / "ring.g2o")
    np.testing.assert_array_equal(back.ids, 10 * np.arange(len(graph)))
    np.testing.assert_array_equal(back.graph.first, graph.first)
    np.testing.assert_array_equal(back.graph.information, graph.information)
    assert apart(back.graph.world_from_body, graph.world_from_body) < 1e-12
    assert apart(back.graph.first_from_second, graph.first_from_second) < 1e-12


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no vertices"),
        ("VERTEX_SE2 0 1 2", "3 finite numbers"),
        ("VERTEX_SE2 0 1 2 nan", "3 finite numbers"),
        ("VERTEX_SE2 0 1 2 x", "line 1"),
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 0 0 0", "twice"),
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE3:QUAT 1 0 0 0 0 0 0 1", "in a graph of SE2"),
        ("VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 7 0 0 0 1 0 0 1 0 1", "vertex 7"),
        ("VERTEX_XY 0 0 0", "not a supported kind"),
        (f"VERTEX_SE2 {10**20} 0 0 0", "line 1: a vertex name must fit in 64 bits"),
        (f"VERTEX_SE2 {'9' * 5000} 0 0 0", "line 1"),
        (
            f"VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 -{10**20} 0 0 0 1 0 0 1 0 1",
            "line 2: a vertex name must fit in 64 bits",
        ),
    ],
)
def test_broken_g2o_files_say_where(text, says, tmp_path):
    (tmp_path / "broken.g2o").write_text(text)
    with pytest.raises(FileFormatError, match=says):
        read_g2o(tmp_path / "broken.g2o")


def _file_with(tmp_path, *weights):
    """A chain whose edges have these diagonals as information."""
    lines = [f"VERTEX_SE2 {i} {i} 0 0" for i in range(len(weights) + 1)]
    lines += [f"EDGE_SE2 {i} {i + 1} 1 0 0 {a} 0 0 {b} 0 {c}" for i, (a, b, c) in enumerate(weights)]
    path = tmp_path / "chain.g2o"
    path.write_text("\n".join(lines))
    return path


def test_edges_with_indefinite_information_are_named(tmp_path):
    path = _file_with(tmp_path, (1, 1, 1), (1, -1, 1), *[(2, 3, 0)] * 6)
    with pytest.raises(
        FileFormatError, match=r"7 of 8 edges are not positive definite: 1 2, 2 3, 3 4, 4 5, 5 6 and 2 more"
    ):
        read_g2o(path)
    with pytest.raises(ConfigError, match="indefinite must be one of refuse, nearest"):
        read_g2o(path, indefinite="ignore")


def test_nearest_definite_information_takes_the_place(tmp_path):
    path = _file_with(tmp_path, (1, 1, 1), (4, -1, 2), (2, 3, 0))
    found = read_g2o(path, indefinite="nearest")
    np.testing.assert_array_equal(found.mended_edges, [1, 2])
    np.testing.assert_array_equal(found.graph.information[0], np.eye(3))
    # The nearest semidefinite matrix in the Frobenius norm has no negative eigenvalues; of a diagonal one it is plain.
    np.testing.assert_allclose(found.graph.information[1], np.diag([4.0, 4e-9, 2.0]), atol=1e-12)
    np.testing.assert_allclose(found.graph.information[2], np.diag([2.0, 3.0, 3e-9]), atol=1e-12)
    assert optimize_pose_graph(found.graph).converged
    sound = _file_with(tmp_path, (1, 1, 1))
    assert len(read_g2o(sound).mended_edges) == 0
    with pytest.raises(FileFormatError, match="no positive eigenvalue"):
        read_g2o(_file_with(tmp_path, (0, 0, 0)), indefinite="nearest")


def test_indefinite_information_is_named_by_the_optimizer(rng):
    _, graph = ring(Rigid2, rng, noise=0.1)
    information = graph.information.copy()
    information[[2, 5]] = -np.eye(3)
    with pytest.raises(
        DegenerateGeometryError, match=rf"2 of {len(graph.first)} edges are not positive definite: 2, 5"
    ):
        optimize_pose_graph(replace(graph, information=information))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_measurements_that_are_no_numbers_are_refused(rng, bad):
    """They would spread over the graph, which then looked as if it had converged."""
    _, graph = ring(Rigid3, rng, noise=0.1)
    shifted = graph.first_from_second.translation.copy()
    shifted[1, 1] = bad
    with pytest.raises(ShapeError, match=r"first_from_second\.translation must be finite"):
        replace(graph, first_from_second=Rigid3(graph.first_from_second.rotation, shifted))
