"""Weakly connected images get learned features beside SIFT's; here a stand-in for the network knows the scene."""

import json

import cv2
import numpy as np
import pytest

import epipole
from epipole.cameras import Camera, CameraModel
from epipole.errors import ConfigError, FileFormatError
from epipole.features.learned import ScoredFeatures, match_mutual_nearest
from epipole.geometry import Rotation3
from epipole.io import read_colmap_model
from epipole.metrics import camera_errors
from epipole.pipelines.sfm.config import ReconstructConfig
from epipole.pipelines.sfm.matching import rescue_stage
from epipole.pipelines.sfm.matching.rescue_stage import MAX_PARTNERS, merged, rescue_pairs, weak_images
from epipole.synthetic import look_at
from mapping_graphs import graph_of_rotations

pytestmark = pytest.mark.usefixtures("unchecked")  # a stand-in takes the position of the network

CAMERA = Camera(CameraModel.PINHOLE, 320, 240, np.array([260.0, 260.0, 159.5, 119.5]))
NUM_IMAGES = 6


def graph(pairs, counts):
    return graph_of_rotations(pairs, np.tile(np.eye(3), (len(pairs), 1, 1)), counts)


def test_images_with_few_strong_pairs_or_apart_from_the_others_are_weak():
    ring = [(0, 1), (1, 2), (0, 2), (2, 3), (4, 5), (5, 6), (4, 6), (3, 4)]
    weak = weak_images(graph(ring, [60, 60, 60, 60, 60, 60, 60, 49]), 8)
    np.testing.assert_array_equal(weak, [False, False, False, True, True, True, True, True])
    assert weak_images(graph(ring, [49] * 8), 8).all()
    assert not weak_images(graph(ring[:3], [50] * 3), 3).any()


def test_weak_images_are_matched_with_the_most_similar_and_the_next_images():
    pairs = np.array([(i, j) for i in range(40) for j in range(i + 1, 40)], np.int32)
    putative = {(3, 35): np.zeros((9, 2), np.int32), (0, 3): np.zeros((5, 2), np.int32)}
    chosen = rescue_pairs(np.arange(40) == 3, pairs, putative)
    assert chosen == sorted(chosen) and {(3, 35), (0, 3), (2, 3), (3, 4), (3, 8)} <= {*chosen}
    assert len(chosen) <= MAX_PARTNERS and all(3 in pair for pair in chosen)
    assert rescue_pairs(np.zeros(40, bool), pairs, putative) == []


def with_rotations(pairs, counts, off_rad):
    """Pairs of images that are rotated by their number, with errors about another axis."""
    rotation = Rotation3.exp(np.outer([j - i for i, j in pairs], [0.0, 1.0, 0.0])).matrix
    error = Rotation3.exp(np.outer(off_rad, [1.0, 0.0, 0.0])).matrix
    return graph_of_rotations(pairs, error @ rotation, counts)


def test_only_better_pairs_replace_those_of_sift():
    before = with_rotations([(0, 1), (1, 2), (3, 4)], [40, 90, 20], [0, 0, 0])
    pairs = [(0, 1), (0, 2), (1, 2), (2, 3), (3, 4)]
    joined, count = merged(before, with_rotations(pairs, [80, 35, 70, 29, 90], [0, 0.02, 0, 0, 1.0]))
    found = dict(zip(zip(joined.image1.tolist(), joined.image2.tolist()), joined.num_inliers().tolist()))
    assert found == {(0, 1): 80, (1, 2): 90, (3, 4): 20, (0, 2): 35} and count == 2
    np.testing.assert_array_equal(joined.match_offsets, [0, *np.cumsum(joined.num_inliers())])
    assert len(joined.keypoint1) == len(joined.keypoint2) == joined.match_offsets[-1]


@pytest.mark.parametrize("off_rad, count", [(0.0, 3), (0.06, 3), (0.2, 0)])
def test_new_pairs_need_a_triangle(off_rad, count):
    none = with_rotations([(5, 6)], [50], [0])
    pairs = [(0, 1), (1, 2), (0, 2), (2, 3)]
    joined, added = merged(none, with_rotations(pairs, [60, 60, 60, 500], [0, 0, off_rad, 0]))
    assert added == count and len(joined) == 1 + count


class KnownScene:
    """A network that sees the points of a scene in images whose first pixel is their number."""

    def __init__(self, rng):
        self.points = rng.uniform([-2, -1.5, -1], [2, 1.5, 1], (400, 3))
        centers = [(0.5 * k - 1.2, -0.3 + 0.1 * k, -5.0) for k in range(NUM_IMAGES)]
        self.poses = [look_at(center, (0.0, 0.0, 0.0)) for center in centers]
        self.descriptors = Rotation3.exp(rng.normal(size=(400, 3))).matrix.reshape(400, 9).astype(np.float32)
        self.descriptors /= np.linalg.norm(self.descriptors, axis=1, keepdims=True)

    def detect(self, image, max_num):
        at = CAMERA.project(self.poses[int(image[0, 0, 0])].apply(self.points))
        inside = ((at > 1) & (at < [318, 238])).all(axis=1)
        count = min(int(inside.sum()), max_num)
        rows = np.flatnonzero(inside)[:count]
        return ScoredFeatures(at[rows].astype(np.float32), np.ones(count, np.float32), self.descriptors[rows])

    def match(self, features1, size1, features2, size2):
        assert size1 == size2 == (320, 240)
        matches = match_mutual_nearest(features1.descriptors, features2.descriptors, 0.999)
        return matches, np.ones(len(matches), np.float32)


@pytest.fixture
def photographs(tmp_path, rng):
    """Images of noise, in which SIFT finds nothing in common."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for k in range(NUM_IMAGES):
        image = rng.integers(0, 255, (240, 320, 3), dtype=np.uint8)
        image[0, 0] = k
        cv2.imwrite(str(folder / f"{k}.png"), image)
    return folder


def test_images_without_common_sift_features_are_registered(photographs, tmp_path, rng, monkeypatch):
    scene = KnownScene(rng)
    monkeypatch.setattr(rescue_stage, "_loaded", lambda folder, network, checksums: scene)
    config = ReconstructConfig(
        camera_model="PINHOLE", camera_params="260,260,160,120", learned=tmp_path, executor="inline"
    )
    out = tmp_path / "out"
    epipole.reconstruct(photographs, out, config)
    summary = json.loads((out / "summary.json").read_text())
    names = [f"{k}.png" for k in range(NUM_IMAGES)]
    assert summary["rescue"] == {"images": names, "num_pairs": 15, "num_registered": NUM_IMAGES}
    model = read_colmap_model(out / "sparse" / "0")
    poses = model.cams_from_world()[[model.images.name.index(name) for name in names]]
    truth = type(poses)(
        np.array([p.rotation for p in scene.poses]), np.array([p.translation for p in scene.poses])
    )
    assert camera_errors(poses, truth).max_position < 1e-3
    before = (out / "sparse" / "0" / "images.bin").read_bytes()
    epipole.reconstruct(photographs, out, config)  # again, from stored units
    assert (out / "sparse" / "0" / "images.bin").read_bytes() == before


def test_a_folder_without_weights_is_refused(photographs, tmp_path):
    config = ReconstructConfig(learned=tmp_path / "nothing", executor="inline")
    with pytest.raises(FileFormatError, match="convert_learned_features"):
        epipole.reconstruct(photographs, tmp_path / "out", config)


def test_a_database_has_features_already(tmp_path):
    with pytest.raises(ConfigError, match="database"):
        ReconstructConfig(learned=tmp_path, database=tmp_path / "database.db")
