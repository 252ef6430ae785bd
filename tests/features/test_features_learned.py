"""What epipole adds to the networks of learned features has known answers; files that cannot be used are refused by name."""

import hashlib
import os
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest

import epipole.features.learned as learned
from epipole._parallel import set_num_threads
from epipole.errors import ConfigError, FileFormatError, MissingDependencyError, ShapeError
from epipole.features.learned import (
    CHECKSUMS,
    NETWORKS,
    LearnedFeatures,
    ScoredFeatures,
    match_mutual_nearest,
    mutual_matches,
    normalized_keypoints,
)

XFEAT, LIGHTERGLUE = NETWORKS["xfeat"].files
WEIGHTS = os.environ.get("EPIPOLE_LEARNED")
needs_weights = pytest.mark.skipif(
    WEIGHTS is None, reason="EPIPOLE_LEARNED names no folder made by tools/convert_learned_features.py"
)


def folder_with(path: Path, contents: dict[str, bytes]) -> Path:
    """A folder of these files and their checksums."""
    path.mkdir()
    for name, data in contents.items():
        (path / name).write_bytes(data)
    lines = [f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in contents.items()]
    (path / CHECKSUMS).write_text("".join(lines))
    return path


def test_a_missing_folder_is_named_and_the_conversion_as_well(tmp_path):
    with pytest.raises(FileFormatError, match=r"nowhere.*convert_learned_features"):
        LearnedFeatures(tmp_path / "nowhere")


@pytest.mark.parametrize("missing", [XFEAT, LIGHTERGLUE, CHECKSUMS])
def test_a_missing_file_is_named(tmp_path, missing):
    folder = folder_with(tmp_path / "weights", {XFEAT: b"x", LIGHTERGLUE: b"y"})
    (folder / missing).unlink()
    with pytest.raises(FileFormatError, match=f"{missing}: cannot be read"):
        LearnedFeatures(folder)


def test_a_file_without_checksum_is_named(tmp_path):
    folder = folder_with(tmp_path / "weights", {XFEAT: b"x"})
    (folder / LIGHTERGLUE).write_bytes(b"y")
    with pytest.raises(FileFormatError, match=f"no checksum of {LIGHTERGLUE}"):
        LearnedFeatures(folder)


def test_a_damaged_file_is_named(tmp_path):
    folder = folder_with(tmp_path / "weights", {XFEAT: b"x" * 100, LIGHTERGLUE: b"y" * 100})
    (folder / LIGHTERGLUE).write_bytes(b"y" * 99)
    with pytest.raises(FileFormatError, match=f"{LIGHTERGLUE}: damaged or replaced"):
        LearnedFeatures(folder)


def test_a_file_that_is_no_network_is_named(tmp_path):
    pytest.importorskip("onnxruntime")
    folder = folder_with(tmp_path / "weights", {XFEAT: b"not a network", LIGHTERGLUE: b"y"})
    with pytest.raises(FileFormatError, match=f"{XFEAT}: onnxruntime cannot load it"):
        LearnedFeatures(folder)


def test_without_onnxruntime_the_extra_is_named(tmp_path, monkeypatch):
    folder = folder_with(tmp_path / "weights", {XFEAT: b"x", LIGHTERGLUE: b"y"})
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'epipole\[learned\]'"):
        LearnedFeatures(folder)


class Runtime:
    """Stands in for onnxruntime: its networks return the given outputs and keep their inputs."""

    def __init__(self, outputs: dict[bytes, list[np.ndarray]], names: dict[bytes, tuple]) -> None:
        self.outputs, self.names = outputs, names
        self.seen: dict[bytes, dict] = {}
        self.options: list[Runtime.SessionOptions] = []

    class SessionOptions:
        def add_session_config_entry(self, key: str, value: str) -> None:
            self.entry = (key, value)

    def InferenceSession(self, data, options, providers):
        self.options.append(options)
        return Session(self, data)


class Named:
    def __init__(self, name: str) -> None:
        self.name = name


class Session:
    def __init__(self, runtime: Runtime, data: bytes) -> None:
        self.runtime, self.data = runtime, data

    def get_inputs(self) -> list[Named]:
        return [Named(name) for name in self.runtime.names[self.data][0]]

    def get_outputs(self) -> list[Named]:
        return [Named(name) for name in self.runtime.names[self.data][1]]

    def run(self, _names, inputs):
        self.runtime.seen[self.data] = inputs
        return self.runtime.outputs[self.data]


def stand_in(tmp_path, monkeypatch, outputs) -> tuple[LearnedFeatures, Runtime]:
    """Networks with the given outputs."""
    runtime = Runtime(outputs, dict(zip((b"x", b"y"), NETWORKS["xfeat"].signatures)))
    monkeypatch.setattr(learned, "_runtime", lambda: runtime)
    return LearnedFeatures(folder_with(tmp_path / "weights", {XFEAT: b"x", LIGHTERGLUE: b"y"})), runtime


def one_keypoint(x: int, y: int, columns: int, rows: int) -> list[np.ndarray]:
    """Outputs of XFeat for an image of 8 x 8 pixel cells with one keypoint."""
    logits = np.zeros((1, 65, rows, columns), np.float32)
    logits[0, 64] = 20.0
    logits[0, (y % 8) * 8 + x % 8, y // 8, x // 8] = 40.0
    descriptors = np.zeros((1, 64, rows, columns), np.float32)
    descriptors[0, 7] = 1.0
    return [descriptors, logits, np.full((1, 1, rows, columns), 0.5, np.float32)]


def test_pixels_are_those_of_the_given_image(tmp_path, monkeypatch):
    networks, runtime = stand_in(tmp_path, monkeypatch, {b"x": one_keypoint(37, 21, 12, 8)})
    found = networks.detect(np.zeros((64, 96), np.uint8))
    np.testing.assert_array_equal(found.pixels, [[37, 21]])
    np.testing.assert_allclose(found.scores, [0.5], rtol=1e-5)
    np.testing.assert_allclose(found.descriptors, np.eye(64)[[7]], atol=1e-6)
    # 127 x 95 pixels are resized to 96 x 64, edges on edges
    found = networks.detect(np.zeros((95, 127, 3), np.uint8))
    np.testing.assert_allclose(found.pixels, [[37.5 * 127 / 96 - 0.5, 21.5 * 95 / 64 - 0.5]], rtol=1e-6)
    assert runtime.seen[b"x"]["image"].shape == (1, 1, 64, 96)
    # and 960 x 640 pixels, for detection at 96 pixels
    found = networks.detect(np.zeros((640, 960), np.uint8), max_size_px=96)
    np.testing.assert_allclose(found.pixels, [[374.5, 214.5]])
    assert runtime.seen[b"x"]["image"].shape == (1, 1, 64, 96)


def test_networks_use_the_threads_of_epipole_if_results_do_not_depend_on_them(tmp_path, monkeypatch):
    for network, expected in (("xfeat", [3, 3]), ("aliked", [1, 1, 1])):
        names = NETWORKS[network].files
        runtime = Runtime(
            {}, {name.encode(): each for name, each in zip(names, NETWORKS[network].signatures)}
        )
        monkeypatch.setattr(learned, "_runtime", lambda runtime=runtime: runtime)
        folder = folder_with(tmp_path / network, {name: name.encode() for name in names})
        set_num_threads(3)
        try:
            LearnedFeatures(folder, network)
        finally:
            set_num_threads(None)
        assert [options.intra_op_num_threads for options in runtime.options] == expected


def test_a_network_with_other_inputs_is_refused(tmp_path, monkeypatch):
    names = {b"x": (("pixels",), ("keypoints",)), b"y": NETWORKS["xfeat"].signatures[1]}
    monkeypatch.setattr(learned, "_runtime", lambda: Runtime({}, names))
    with pytest.raises(FileFormatError, match=r"pixels.*keypoints"):
        LearnedFeatures(folder_with(tmp_path / "weights", {XFEAT: b"x", LIGHTERGLUE: b"y"}))


def test_networks_are_loaded_again_by_another_process(tmp_path, monkeypatch):
    networks, _ = stand_in(tmp_path, monkeypatch, {b"x": one_keypoint(3, 5, 4, 4)})
    again = pickle.loads(pickle.dumps(networks))
    np.testing.assert_array_equal(again.detect(np.zeros((32, 32), np.uint8)).pixels, [[3, 5]])


def test_unusable_images_and_numbers_are_refused(tmp_path, monkeypatch):
    networks, _ = stand_in(tmp_path, monkeypatch, {})
    assert len(networks.detect(np.zeros((31, 400), np.uint8))) == 0
    with pytest.raises(ShapeError, match="gray"):
        networks.detect(np.zeros((64, 64, 4), np.uint8))
    with pytest.raises(ConfigError, match="max_num"):
        networks.detect(np.zeros((64, 64), np.uint8), max_num=-1)
    with pytest.raises(ConfigError, match="max_size_px"):
        networks.detect(np.zeros((64, 64), np.uint8), max_size_px=31)


def features_at(*pixels: tuple[float, float]) -> ScoredFeatures:
    n = len(pixels)
    descriptors = np.eye(64, dtype=np.float32)[:n]
    return ScoredFeatures(np.array(pixels, np.float32).reshape(n, 2), np.ones(n, np.float32), descriptors)


def test_matches_are_rows_of_the_features_although_the_network_drops_some(tmp_path, monkeypatch):
    log_assignment = np.log(np.array([[[0.9, 0.02], [0.03, 0.05]]], np.float32))
    rows, columns = np.array([1, 2]), np.array([0, 3])
    networks, runtime = stand_in(tmp_path, monkeypatch, {b"y": [log_assignment, rows, columns]})
    first, second = features_at((0, 0), (99, 49), (50, 25)), features_at((1, 1), (2, 2), (3, 3), (4, 4))
    matches, scores = networks.match(first, (100, 50), second, (10, 20))
    np.testing.assert_array_equal(matches, [[1, 0]])
    assert matches.dtype == np.int32
    np.testing.assert_allclose(scores, [0.9], rtol=1e-6)
    np.testing.assert_allclose(
        runtime.seen[b"y"]["keypoints1"][0], [[-1, -0.5], [0.98, 0.48], [0, 0]], atol=1e-6
    )
    matches, _ = networks.match(first, (100, 50), second, (10, 20), min_score=0.01)
    np.testing.assert_array_equal(matches, [[1, 0], [2, 3]])
    for one, other in ((features_at(), second), (first, features_at())):
        assert networks.match(one, (100, 50), other, (100, 50))[0].shape == (0, 2)
    with pytest.raises(ShapeError, match="99 x 50"):
        networks.match(first, (99, 50), second, (10, 20))
    with pytest.raises(ShapeError, match="64 columns"):
        wide = ScoredFeatures(first.pixels, first.scores, np.zeros((3, 128), np.float32))
        networks.match(first, (100, 50), wide, (100, 50))
    with pytest.raises(ConfigError, match="min_score"):
        networks.match(first, (100, 50), second, (10, 20), min_score=1.5)


def test_aliked_pixels_are_those_of_the_given_image(tmp_path, monkeypatch):
    scores = np.zeros((1, 1, 64, 96), np.float32)
    scores[0, 0, 30, 40] = (
        1.0  # the image of 95 x 60 pixels has a border of 0 and 2 pixels at the left and top
    )
    outputs = {
        b"x": [np.zeros((1, 128, 64, 96), np.float32), scores],
        b"h": [np.eye(128, dtype=np.float32)[:1]],
    }
    runtime = Runtime(outputs, dict(zip((b"x", b"h", b"y"), NETWORKS["aliked"].signatures)))
    monkeypatch.setattr(learned, "_runtime", lambda: runtime)
    contents = dict(zip(NETWORKS["aliked"].files, (b"x", b"h", b"y")))
    networks = LearnedFeatures(folder_with(tmp_path / "weights", contents), "aliked")
    found = networks.detect(np.zeros((60, 95), np.uint8))
    np.testing.assert_allclose(found.pixels, [[40, 28]], atol=1e-5)
    assert found.scores == [1.0] and found.descriptors.shape == (1, 128)
    assert runtime.seen[b"x"]["image"].shape == (1, 3, 64, 96)
    assert runtime.seen[b"h"]["features"].shape == (1, 128, 60, 95)
    found = networks.detect(np.zeros((600, 950, 3), np.uint8), max_size_px=95)
    np.testing.assert_allclose(found.pixels, [[404.5, 284.5]], atol=1e-4)
    outputs[b"x"][1][:] = 0
    assert networks.detect(np.zeros((60, 95), np.uint8)).descriptors.shape == (0, 128)
    with pytest.raises(ConfigError, match="network"):
        LearnedFeatures(tmp_path / "weights", "sift")


def test_keypoints_are_normalized_by_the_longer_side():
    pixels = np.array([[50, 100], [0, 0], [99.5, 199.5]], np.float32)
    np.testing.assert_allclose(
        normalized_keypoints(pixels, (100, 200)), [[0, 0], [-0.5, -1], [0.495, 0.995]], atol=1e-6
    )
    with pytest.raises(ShapeError, match="inside"):
        normalized_keypoints(np.array([[np.nan, 0]], np.float32), (100, 200))


def test_matches_are_mutual():
    assignment = np.array([[0.6, 0.1, 0.1], [0.7, 0.2, 0.05], [0.01, 0.02, 0.09]], np.float32)
    matches, scores = mutual_matches(np.log(assignment), 0.1)
    np.testing.assert_array_equal(
        matches, [[1, 0]]
    )  # (0, 0) is better for the second row, (2, 2) too improbable
    np.testing.assert_allclose(scores, [0.7], rtol=1e-6)


def test_nearest_neighbors_are_mutual_and_close(rng):
    first = rng.normal(size=(700, 64)).astype(np.float32)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    order = rng.permutation(700)[:600]
    matches = match_mutual_nearest(first, first[order])
    expected = np.stack([order, np.arange(600)], axis=1)
    np.testing.assert_array_equal(matches, expected[np.argsort(order)])
    assert len(match_mutual_nearest(first, -first)) == 0
    assert match_mutual_nearest(first[:0], first).shape == (0, 2)


def blobs(shift: int) -> np.ndarray:
    """A random texture of blobs (256, 320), shifted to the left."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:256, : 320 + 64]
    image = np.full(x.shape, 128.0)
    for cx, cy, sigma, sign in rng.uniform([0, 0, 2, -1], [384, 256, 6, 1], (250, 4)):
        image += 90 * np.sign(sign) * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))
    return np.clip(image, 0, 255).astype(np.uint8)[:, shift : shift + 320]


@needs_weights
@pytest.mark.parametrize("network", ["xfeat", "aliked"])
def test_real_networks_match_shifted_images_and_do_not_depend_on_threads(network):
    pytest.importorskip("onnxruntime")
    results = []
    for count in (1, 2):
        set_num_threads(count)
        try:
            networks = LearnedFeatures(WEIGHTS, network)
        finally:
            set_num_threads(None)
        first, second = networks.detect(blobs(0), 500), networks.detect(blobs(32), 500)
        matches, scores = networks.match(first, (320, 256), second, (320, 256))
        results.append((first.pixels, first.scores, first.descriptors, matches, scores))
        shift = first.pixels[matches[:, 0]] - second.pixels[matches[:, 1]]
        assert len(matches) > 50
        assert np.mean(np.abs(shift - [32, 0]).max(axis=1) <= 1.5) > 0.95
        nearest = match_mutual_nearest(first.descriptors, second.descriptors)
        assert len(nearest) > 20
    for one, other in zip(*results):
        np.testing.assert_array_equal(one, other)


@needs_weights
@pytest.mark.parametrize("count", [1, 2, 3])
def test_real_networks_match_few_keypoints(count):
    pytest.importorskip("onnxruntime")
    networks = LearnedFeatures(WEIGHTS)
    found = networks.detect(blobs(0), count)
    matches, _ = networks.match(found, (320, 256), found, (320, 256))
    assert len(found) == count and len(matches) <= count
    assert len(networks.detect(np.full((100, 100), 7, np.uint8))) == 0
