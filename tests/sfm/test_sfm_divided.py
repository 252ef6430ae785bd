"""Mapping in parts: the parts, what they become together, and parts that do not fit."""

from dataclasses import replace

import numpy as np
import pytest
from sfm_rings import EXACT, errors_of, mapper_of, view_graph_of

from epipole import reconstruct
from epipole.errors import ConfigError, WorkspaceError
from epipole.geometry import Rigid3
from epipole.pipelines.sfm import part_stage
from epipole.pipelines.sfm.config import MapperConfig, ReconstructConfig
from epipole.pipelines.sfm.mappers import divided as module
from epipole.pipelines.sfm.mappers import growth
from epipole.pipelines.sfm.mappers.divided import MappedPart, divided, map_divided, map_part
from epipole.pipelines.sfm.part_stage import load_part
from epipole.runs import Progress
from epipole.synthetic.problems import bundle_problem
from whole import IS_WHOLE, in_whole_run

pytestmark = pytest.mark.usefixtures("two_threads")

IN_PARTS = replace(EXACT, part_images=10)


@pytest.fixture(scope="module")
def long_ring():
    """Thirty images around a ball of points, five of which see each point."""
    return bundle_problem(30, 2400, 5).truth


@pytest.fixture(scope="module")
def long_graph(long_ring):
    return view_graph_of(long_ring)


@pytest.fixture(autouse=True)
def small_overlap(monkeypatch):
    """Parts of ten images in the tests overlap by a few."""
    monkeypatch.setattr(module, "LEAST_OVERLAP", 4)


def test_parts_overlap_and_number_their_own_images(long_ring, long_graph):
    mapper = mapper_of(long_ring, long_graph, IN_PARTS)
    parts = list(divided(mapper, np.ones(30, bool)))
    assert len(parts) >= 3 and sum(len(part.images) for part in parts) == 30 + 4 * len(parts)
    for part in parts:
        graph = part.view_graph
        assert graph.image1.max() < len(part.images) and graph.image2.max() < len(part.images)
        pairs = {(a, b) for a, b in zip(part.images[graph.image1], part.images[graph.image2])}
        both = np.isin(long_graph.image1, part.images) & np.isin(long_graph.image2, part.images)
        assert pairs == {*zip(long_graph.image1[both].tolist(), long_graph.image2[both].tolist())}
        for own, row in zip(part.keypoints, part.images):
            assert own is mapper.model.keypoints[row]


def test_exact_parts_become_the_exact_model(long_ring, long_graph):
    mapper = mapper_of(long_ring, long_graph, IN_PARTS)
    assert map_divided(mapper, np.ones(30, bool))
    assert mapper.model.registered.all() and not mapper.notes
    off, turned = errors_of(mapper, long_ring)
    assert off.max() < 1e-6 and turned.max() < 1e-6


@in_whole_run
def test_images_that_are_not_usable_are_in_no_part(long_ring, long_graph):
    mapper = mapper_of(long_ring, long_graph, IN_PARTS)
    usable = np.arange(30) != 7
    assert not any(7 in part.images for part in divided(mapper, usable))
    assert map_divided(mapper, usable)
    assert mapper.model.registered.sum() == 29 and not mapper.model.registered[7]


def test_images_of_a_wrong_part_are_registered_one_by_one(long_ring, long_graph):
    """Another scene with the same matches: its poses fit neither the other parts nor the matches."""

    def one_is_wrong(parts):
        found = [map_part(part, IN_PARTS) for part in parts]
        poses = found[-1].cams_from_world
        rng = np.random.default_rng(0)
        wrong = Rigid3(poses.rotation, rng.normal(0.0, 3.0, poses.translation.shape))
        return [*found[:-1], replace(found[-1], cams_from_world=wrong)]

    mapper = mapper_of(long_ring, long_graph, IN_PARTS)
    assert map_divided(mapper, np.ones(30, bool), one_is_wrong)
    assert mapper.model.registered.all()
    off, _ = errors_of(mapper, long_ring)
    assert off.max() < 1e-6


@in_whole_run
def test_parts_that_cannot_be_joined_are_said(long_ring, long_graph, monkeypatch):
    monkeypatch.setattr(growth, "join_models", lambda _model, parts, _config: dict(parts[0]))
    mapper = mapper_of(long_ring, long_graph, IN_PARTS)
    assert map_divided(mapper, np.ones(30, bool)) and mapper.model.registered.all()
    (note,) = mapper.notes
    assert "parts have too few points in common" in note and "registered one by one" in note


def test_parts_without_a_model_are_left_out(long_ring, long_graph):
    def nothing(parts):
        empty = Rigid3(np.zeros((0, 3, 3)), np.zeros((0, 3)))
        return [MappedPart(np.zeros(0, np.int64), empty, part.cameras.params) for part in parts]

    mapper = mapper_of(long_ring, long_graph, IN_PARTS)
    assert not map_divided(mapper, np.ones(30, bool), nothing)
    assert "gave no model" in mapper.notes[0] and "mapped together" in mapper.notes[1]


@pytest.mark.parametrize("executor", ["inline"] + IS_WHOLE * ["processes"])
def test_photographs_in_parts(rendered, reconstructed, tmp_path, executor):
    """Parts of three of six photographs, in files of units; the part's own file is removed again."""
    reports: list[Progress] = []
    found = reconstruct(rendered, tmp_path / "out", _in_parts(3), progress=reports.append, executor=executor)
    assert found.summary["models"][0]["mapper"] == "divided"
    assert found.summary["num_registered"] == reconstructed.summary["num_registered"] == 6
    assert any(report.stage == "parts" for report in reports)
    names = sorted(path.name for path in (found.out / "work" / "parts").iterdir())
    assert names == ["00000.npz", "00001.npz"] and not (found.out / "work" / "parts-input").exists()
    before, after = reconstructed.model.camera_centers_in_world(), found.model.camera_centers_in_world()
    near, far = (np.linalg.norm(c - c[0], axis=1)[1:] for c in (before, after))
    np.testing.assert_allclose(near / near[-1], far / far[-1], rtol=0.01)


@in_whole_run
def test_the_same_bytes_whoever_maps_the_parts(rendered, tmp_path):
    first = reconstruct(rendered, tmp_path / "first", _in_parts(3), executor="inline")
    second = reconstruct(rendered, tmp_path / "second", _in_parts(3), executor="threads")
    for name in ("images.bin", "points3D.bin", "cameras.bin"):
        assert (first.out / "sparse/0" / name).read_bytes() == (second.out / "sparse/0" / name).read_bytes()


def test_mapped_parts_are_used_again(rendered, tmp_path, monkeypatch):
    reconstruct(rendered, tmp_path / "out", _in_parts(3), executor="inline")

    def refuse(task):
        raise AssertionError(f"{task.file} is mapped again")

    monkeypatch.setattr(part_stage, "map_part_in_file", refuse)
    again = reconstruct(rendered, tmp_path / "out", _in_parts(3), executor="inline")
    assert again.summary["num_registered"] == 6


def test_a_damaged_part_is_named(tmp_path):
    (tmp_path / "part.npz").write_bytes(b"PK")
    with pytest.raises(WorkspaceError, match=r"part\.npz is damaged"):
        load_part(tmp_path / "part.npz")


def test_sizes_are_checked():
    with pytest.raises(ConfigError, match="part_images"):
        MapperConfig(part_images=2)


def _in_parts(size: int) -> ReconstructConfig:
    return ReconstructConfig(mapper=MapperConfig(divide_above=3, part_images=size))
