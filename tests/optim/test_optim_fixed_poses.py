"""Pose graphs with fixed poses: g2o's FIX lines are honored, and lines of other kinds are refused."""

from pathlib import Path

import numpy as np
import pytest

from epipole.errors import FileFormatError, ShapeError
from epipole.geometry import Rigid2, Rigid3, Similarity3
from epipole.io import read_g2o, write_g2o
from epipole.optim import (
    PoseGraph,
    initialize_pose_graph,
    optimize_pose_graph,
    optimize_pose_graph_robustly,
)

FAULT = Path(__file__).parents[2].parent / "shared" / "data" / "faults" / "two_fixes.g2o"
CHAIN = (
    "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nVERTEX_SE2 2 2 0 0\nVERTEX_SE2 3 3.3 0 0\n{}"
    "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 1 2 1 0 0 1 0 0 1 0 1\nEDGE_SE2 2 3 1 0 0 1 0 0 1 0 1\n"
)


def x_of(graph: PoseGraph) -> list[float]:
    return optimize_pose_graph(graph).world_from_body.translation[:, 0].tolist()


@pytest.mark.parametrize("fixes", ["FIX 0\nFIX 3\n", "FIX 3 0\n", "FIX 0\nFIX 0 3\n"])
def test_fixed_vertices_stay(tmp_path, fixes) -> None:
    path = tmp_path / "chain.g2o"
    path.write_text(CHAIN.format(fixes))
    for file in (path, *([FAULT] if FAULT.is_file() else [])):
        graph = read_g2o(file).graph
        assert graph.fixed.tolist() == [0, 3]
        np.testing.assert_allclose(x_of(graph), [0.0, 1.1, 2.2, 3.3], atol=1e-9)
        write_g2o(tmp_path / "again.g2o", graph, ids=[4, 5, 6, 9])
        again = read_g2o(tmp_path / "again.g2o")
        assert again.ids[again.graph.fixed].tolist() == [4, 9]


def test_without_fixed_vertices_the_first_stays(tmp_path) -> None:
    path = tmp_path / "chain.g2o"
    path.write_text(CHAIN.format(""))
    np.testing.assert_allclose(x_of(read_g2o(path).graph), [0.0, 1.0, 2.0, 3.0], atol=1e-9)
    path.write_text(CHAIN.format("FIX 3\n"))
    np.testing.assert_allclose(x_of(read_g2o(path).graph), [0.3, 1.3, 2.3, 3.3], atol=1e-9)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("FIX 9", "line 5: FIX names vertex 9, which is not defined"),
        ("FIX", "line 5: FIX names no vertex"),
        ("FIX a", "line 5"),
        (f"FIX {10**20}", "line 5: a vertex name must fit in 64 bits"),
        ("FIXED 0", "line 5: FIXED is not a supported kind"),
        ("VERTEX_TRACKXYZ 9 0 0 0", "not a supported kind"),
        ("EDGE_SE2_XY 0 1 1 0 1 0 1", "not a supported kind"),
        ("ROBOTLASER1 0 -1.5 3.1", "not a supported kind"),
        ("EQUIV 0 1", "not a supported kind"),
    ],
)
def test_lines_that_are_not_understood_are_refused(tmp_path, line, says) -> None:
    path = tmp_path / "chain.g2o"
    path.write_text(CHAIN.format(f"{line}\n"))
    with pytest.raises(FileFormatError, match=says):
        read_g2o(path)
    path.write_text(CHAIN.format("# FIX 3\nPARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n"))
    assert len(read_g2o(path).graph.fixed) == 0


@pytest.mark.parametrize(("kind", "size"), [(Rigid2, 3), (Rigid3, 6), (Similarity3, 7)])
def test_two_fixed_ends_bend_a_chain_of_any_kind(kind, size) -> None:
    """The residual is spread over all edges; a component without a fixed pose keeps its first."""
    rng = np.random.default_rng(3)
    steps = kind.exp(0.2 * rng.normal(size=(4, size)))
    poses = kind.exp(0.5 * rng.normal(size=(6, size)))
    first, second = np.array([0, 1, 2, 4]), np.array([1, 2, 3, 5])
    graph = PoseGraph(poses, first, second, steps, np.tile(np.eye(size), (4, 1, 1)), np.array([1, 3]))
    for found in (optimize_pose_graph(graph), optimize_pose_graph_robustly(graph)):
        kept = found.world_from_body
        for row in (1, 3, 4):
            np.testing.assert_array_equal(kept.translation[row], poses.translation[row])
        assert not np.allclose(kept.translation[0], poses.translation[0])
    squared = optimize_pose_graph(graph).squared_residuals
    np.testing.assert_allclose(squared[[0, 3]], 0.0, atol=1e-12)  # free ends fit
    assert squared[1] > 1e-3 and squared[2] > 1e-3


@pytest.mark.parametrize("kind", [Rigid2, Rigid3])
def test_the_start_keeps_fixed_poses(kind) -> None:
    size = {Rigid2: 3, Rigid3: 6}[kind]
    rng = np.random.default_rng(4)
    truth = kind.exp(0.5 * rng.normal(size=(5, size)))
    first, second = np.arange(4), np.arange(1, 5)
    steps = truth[first].inverse() @ truth[second]
    rough = kind.exp(0.5 * rng.normal(size=(5, size)))
    rough.translation[[0, 4]] = truth.translation[[0, 4]]
    (rough.angle_rad if kind is Rigid2 else rough.rotation)[[0, 4]] = (
        truth.angle_rad if kind is Rigid2 else truth.rotation
    )[[0, 4]]
    graph = PoseGraph(rough, first, second, steps, np.tile(np.eye(size), (4, 1, 1)), np.array([0, 4]))
    found = initialize_pose_graph(graph).world_from_body
    np.testing.assert_allclose(found.translation, truth.translation, atol=1e-9)
    np.testing.assert_array_equal(found.translation[[0, 4]], truth.translation[[0, 4]])


@pytest.mark.parametrize("fixed", [[5], [-1], [0, 9]])
def test_fixed_poses_exist(fixed) -> None:
    one = Rigid2.exp(np.zeros((5, 3)))
    none = np.empty(0, np.int64)
    with pytest.raises(ShapeError, match="fixed refers to a pose that does not exist"):
        PoseGraph(one, none, none, one[:0], np.empty((0, 3, 3)), np.array(fixed))
