"""Pairs from verified pairs: which are chosen, that rounds continue, and that results do not depend on interruptions."""

from pathlib import Path

import numpy as np
import pytest

from epipole import reconstruct
from epipole.io.colmap.database import read_matched_pairs
from epipole.pipelines.sfm.config import PairingConfig
from epipole.pipelines.sfm.matching.expansion import CONNECTED, STRONG, neighbors_of_neighbors, unconnected
from epipole.pipelines.sfm.matching.pairing import method_of
from mapping_graphs import graph_of_rotations
from whole import IS_WHOLE, in_whole_run


def graph(pairs: dict[tuple[int, int], int]):
    return graph_of_rotations(list(pairs), np.tile(np.eye(3), (len(pairs), 1, 1)), list(pairs.values()))


def test_images_with_a_common_neighbor_are_paired_best_first() -> None:
    """0 and 2 over 1 by 100 matches, 0 and 3 over 1 by 40; 4 is connected too weakly; 1 and 5 were tried."""
    view_graph = graph({(0, 1): 100, (1, 2): 120, (1, 3): 40, (3, 4): STRONG - 1, (0, 5): 90})
    tried = np.array([(0, 1), (1, 2), (1, 3), (3, 4), (0, 5), (1, 5)], np.int32)
    found = neighbors_of_neighbors(view_graph, tried, 6, 10)
    assert found.tolist() == [[0, 2], [0, 3], [2, 3]]
    best = neighbors_of_neighbors(view_graph, tried, 6, 1)
    assert best.tolist() == [[0, 2], [0, 3]]  # the only ones of image 3 are equally good
    assert neighbors_of_neighbors(view_graph, tried, 6, 0).shape == (0, 2)
    assert neighbors_of_neighbors(graph({(0, 1): 50}), tried[:1], 6, 10).shape == (0, 2)


def test_well_connected_images_need_no_further_pairs() -> None:
    """A fan: 0 has ten neighbors, which have only it; they get pairs among each other, 0 none with the image beyond."""
    view_graph = graph({(0, k): 50 for k in range(1, 11)} | {(1, k): 60 for k in range(2, 12)})
    tried = np.stack([view_graph.image1, view_graph.image2], axis=1)
    found = neighbors_of_neighbors(view_graph, tried, 12, 1)
    assert all((0 not in pair and 1 not in pair) or 11 in pair for pair in found.tolist())
    assert 11 in found  # it has one neighbor


def test_images_with_many_common_tracks_are_connected() -> None:
    """Tracks through image 1 connect 0 and 2; one track less does not."""
    candidates = np.array([(0, 2), (0, 3), (2, 3)], np.int32)
    enough = graph({(0, 1): CONNECTED, (1, 2): CONNECTED, (2, 3): CONNECTED - 1})
    assert unconnected(enough, candidates, [CONNECTED] * 4).tolist() == [[0, 3], [2, 3]]
    assert unconnected(enough, candidates[:0], [CONNECTED] * 4).shape == (0, 2)
    few = graph({(0, 1): CONNECTED, (1, 2): CONNECTED - 1})
    assert unconnected(few, candidates[:1], [CONNECTED] * 4).tolist() == [[0, 2]]


def test_distant_neighbors_are_matched_only_where_points_are_missing(rendered: Path, tmp_path: Path) -> None:
    """Neighbors of six photographs of one wall: the first ones connect all of them."""
    pairing = PairingConfig(method="retrieval", neighbors=5, first_neighbors=3, expansion=0)
    found = reconstruct(rendered, tmp_path / "out", pairing=pairing)
    every = reconstruct(
        rendered, tmp_path / "all", pairing=PairingConfig(method="retrieval", neighbors=5, expansion=0)
    )
    assert found.summary["num_registered"] == every.summary["num_registered"] == 6
    pairs = [len(read_matched_pairs(result.out / "database.db")) for result in (found, every)]
    assert pairs[0] < pairs[1] == 15
    assert len(found.model.points) > 0.9 * len(every.model.points)


def test_the_method_of_pairing_fits_the_images() -> None:
    config, gps = PairingConfig(exhaustive_limit=3), np.zeros((4, 3))
    gps[:, 0] = 46.0 + 1e-3 * np.arange(4)
    none = np.full((4, 3), np.nan)
    assert method_of(none[:3], config, is_video=False) == "exhaustive"
    assert method_of(none, config, is_video=True) == "sequential"
    assert method_of(gps, config, is_video=False) == "spatial"
    assert method_of(none, config, is_video=False) == "retrieval"
    assert method_of(gps[[0, 0, 0, 0]], config, is_video=False) == "retrieval"  # one fix for all of them
    assert method_of(gps, PairingConfig(method="retrieval"), is_video=True) == "retrieval"


@in_whole_run
def test_rounds_have_folders_that_continue_and_disappear(rendered: Path, tmp_path: Path) -> None:
    """With two neighbors each, the six images need further rounds until all pairs that overlap are verified."""
    pairing = PairingConfig(method="retrieval", neighbors=2)
    whole = reconstruct(rendered, tmp_path / "out", pairing=pairing)
    assert whole.summary["num_registered"] == 6 and "expand" in whole.timings_s
    work = whole.out / "work"
    assert sorted(path.name for path in work.glob("matches-*")) == ["matches-round-2", "matches-round-3"]
    assert sorted(path.name for path in work.glob("geometry-*")) == ["geometry-round-2", "geometry-round-3"]
    files = {path: path.stat().st_mtime_ns for path in work.rglob("*.npz")}
    reconstruct(rendered, whole.out, pairing=pairing)
    assert {path: path.stat().st_mtime_ns for path in work.rglob("*.npz")} == files
    reconstruct(rendered, whole.out, pairing=PairingConfig(method="retrieval", neighbors=2, expansion=0))
    assert not [*work.glob("matches-*"), *work.glob("geometry-*")]


@pytest.mark.parametrize("method", ["sequential"] + IS_WHOLE * ["exhaustive"])
def test_pairs_of_other_methods_are_not_expanded(few: Path, tmp_path: Path, method: str) -> None:
    found = reconstruct(few, tmp_path / "out", pairing=PairingConfig(method=method, overlap=1))
    assert "expand" not in found.timings_s
