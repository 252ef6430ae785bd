"""Learned features for images that SIFT cannot match: networks run by onnxruntime, on upright images.

There are two pairs of a detector and a matcher:

- XFeat (Potje et al., CVPR 2024) and LighterGlue, the same authors' small version of LightGlue: faster.
- ALIKED (Zhao et al., IEEE TIM 2023) and LightGlue (Lindenberger, Sarlin and Pollefeys, ICCV 2023): more right matches, with
  keypoints of subpixel accuracy.

epipole has no copy of the weights: `tools/convert_learned_features.py` makes a folder of ONNX files from the published ones.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float32, Int32, Int64, UInt8

from epipole._checks import Declared, as_path, check_count, checked
from epipole._parallel import num_threads
from epipole.errors import ConfigError, FileFormatError, MissingDependencyError, ShapeError
from epipole.features.learned_aliked import detect_aliked
from epipole.features.learned_xfeat import detect_xfeat

CHECKSUMS = "SHA256SUMS"
_MATCHER = (
    ("keypoints1", "descriptors1", "keypoints2", "descriptors2"),
    ("log_assignment", "rows", "columns"),
)
"""Inputs and outputs of both matchers."""


class Network(NamedTuple):
    """A detector and its matcher."""

    detect: Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]
    """From the detector's networks, an image and two limits: pixels, scores and descriptors."""
    files: tuple[str, ...]
    """Files of the detector, then that of the matcher."""
    signatures: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...]
    """Inputs and outputs of each file."""
    width: int
    """Length of a descriptor."""
    max_size_px: int
    """Longest side of the images that the network usually gets."""
    most_threads: int | None
    """With more, results would depend on the number of threads; None: they do not."""


NETWORKS = {
    "xfeat": Network(
        detect_xfeat,
        ("xfeat.onnx", "lighterglue.onnx"),
        ((("image",), ("descriptors", "logits", "reliability")), _MATCHER),
        64,
        1600,
        None,  # equal to the last bit with 1, 2, 3, 4 and 7 threads
    ),
    "aliked": Network(
        detect_aliked,
        ("aliked.onnx", "aliked_descriptors.onnx", "lightglue.onnx"),
        ((("image",), ("features", "scores")), (("features", "keypoints"), ("descriptors",)), _MATCHER),
        128,
        1024,
        1,  # onnxruntime divides larger sums among its threads: 3e-5 px of difference with 7
    ),
}
_CONVERT = "make the folder with tools/convert_learned_features.py"
_MIN_SIZE_PX = 32
"""The networks take images whose sides are multiples of it."""
_MOST_KEYPOINTS = 1 << 14
"""The matchers' matrices grow with the square; at this number, each takes 1 GiB per head."""
_BLOCK_ROWS = 512


@dataclass(frozen=True, slots=True, eq=False)
class ScoredFeatures(Declared):
    """Learned features of one image, one row each, highest score first."""

    pixels: Float32[np.ndarray, "n 2"]
    """In pixels of the full image; (0, 0) is the center of the top-left pixel."""
    scores: Float32[np.ndarray, " n"]
    """From 0 to 1. XFeat: probability of the keypoint times reliability of its descriptor. ALIKED: the score map's maximum."""
    descriptors: Float32[np.ndarray, "n d"]
    """Unit vectors; d is 64 for XFeat and 128 for ALIKED."""

    def __len__(self) -> int:
        return len(self.pixels)

    def __repr__(self) -> str:
        return f"ScoredFeatures({len(self)})"


class LearnedFeatures:
    """A detector and its matcher, loaded from a folder.

    XFeat and LighterGlue use as many threads as the rest of epipole when they are loaded. ALIKED and LightGlue use one, because
    their results would depend on the number; process several images or pairs at a time instead. Instances can be shared by
    threads, and are loaded again from the folder by a process that receives one.
    """

    @checked
    def __init__(self, folder: Path | str, network: Literal["xfeat", "aliked"] = "xfeat") -> None:
        """Load the networks.

        Args:
            folder: what tools/convert_learned_features.py wrote.
            network: "xfeat" with LighterGlue, or "aliked" with LightGlue.

        Raises:
            ConfigError: there is no such network.
            FileFormatError: a file is missing, damaged, or was made by another program.
            MissingDependencyError: onnxruntime is not installed.
        """
        self._folder, self._name, self._network = as_path(folder), network, NETWORKS[network]
        contents = _checked_files(self._folder, self._network.files)
        runtime = _runtime()
        threads = min(num_threads(), self._network.most_threads or num_threads())
        sessions = [
            _open(runtime, self._folder / name, data, signature, threads)
            for name, data, signature in zip(self._network.files, contents, self._network.signatures)
        ]
        self._detector, self._matcher = sessions[:-1], sessions[-1]

    def __reduce__(self) -> tuple[type[LearnedFeatures], tuple[Path, str]]:
        """The folder and the network, as sessions of onnxruntime cannot be pickled."""
        return type(self), (self._folder, self._name)

    @checked
    def detect(
        self,
        image: UInt8[np.ndarray, "h w *channels"],
        max_num: int = 2048,
        max_size_px: int | None = None,
    ) -> ScoredFeatures:
        """Detect and describe features; none in an image with a side below 32 pixels.

        Args:
            image: gray (h, w) or RGB (h, w, 3).
            max_num: maximum number of features, those with the highest scores.
            max_size_px: images are downscaled for detection to this longest side. None: 1600 for XFeat, 1024 for ALIKED,
                which takes 2.5 GB of memory at this size.

        Returns:
            Features in pixels of the given image. XFeat's are at pixel centers of the image that the network sees.

        Raises:
            ShapeError: the image is not 8-bit gray or RGB.
            ConfigError: max_num is negative or too large, or max_size_px below 32.
        """
        if image.ndim != 2 and image.shape[2:] != (3,):
            raise ShapeError(f"the image must be gray (h, w) or RGB (h, w, 3), got {image.shape}")
        check_count(max_num, "max_num", _MOST_KEYPOINTS)
        longest = self._network.max_size_px if max_size_px is None else max_size_px
        if longest < _MIN_SIZE_PX:
            raise ConfigError(f"max_size_px must be at least {_MIN_SIZE_PX}, got {longest}")
        if min(image.shape[:2]) < _MIN_SIZE_PX:
            empty = np.empty((0, self._network.width), np.float32)
            return ScoredFeatures(empty[:, :2], empty[:, 0], empty)
        return ScoredFeatures(*self._network.detect(*self._detector, image, max_num, longest))

    @checked
    def match(
        self,
        features1: ScoredFeatures,
        size1: tuple[int, int],
        features2: ScoredFeatures,
        size2: tuple[int, int],
        min_score: float = 0.1,
    ) -> tuple[Int32[np.ndarray, "k 2"], Float32[np.ndarray, " k"]]:
        """Match the features of two images. Time and memory grow with the product of their numbers.

        Args:
            features1: features of image 1.
            size1: width and height of image 1, in pixels.
            features2: features of image 2.
            size2: width and height of image 2, in pixels.
            min_score: matches that are less probable are dropped.

        Returns:
            Rows (feature in image 1, feature in image 2), each feature once at most, and the probability of each match.

        Raises:
            ShapeError: a feature is outside its image, or its descriptor is of another network.
            ConfigError: min_score is not between 0 and 1.
        """
        if not 0 <= min_score <= 1:
            raise ConfigError(f"min_score must be between 0 and 1, got {min_score:g}")
        for each in (features1, features2):
            if each.descriptors.shape[1] != self._network.width:
                raise ShapeError(
                    f"descriptors of {self._name} have {self._network.width} columns, got {each.descriptors.shape[1]}"
                )
        if min(len(features1), len(features2)) == 0:
            return np.empty((0, 2), np.int32), np.empty(0, np.float32)
        log_assignment, rows, columns = self._matcher.run(
            None,
            {
                "keypoints1": normalized_keypoints(features1.pixels, size1)[None],
                "descriptors1": features1.descriptors[None],
                "keypoints2": normalized_keypoints(features2.pixels, size2)[None],
                "descriptors2": features2.descriptors[None],
            },
        )
        matches, scores = mutual_matches(log_assignment[0], min_score)
        kept = np.stack([rows[matches[:, 0]], columns[matches[:, 1]]], axis=1)
        return kept.astype(np.int32), scores


@checked
def match_mutual_nearest(
    descriptors1: Float32[np.ndarray, "n d"],
    descriptors2: Float32[np.ndarray, "m d"],
    min_cosine: float = 0.82,
) -> Int32[np.ndarray, "k 2"]:
    """Mutual nearest neighbors of unit descriptors; much faster than a matching network, for smaller changes of viewpoint.

    Args:
        descriptors1: of image 1, unit vectors.
        descriptors2: of image 2, unit vectors.
        min_cosine: smallest cosine of the angle between matching descriptors; by default that of XFeat's authors.
    """
    if min(len(descriptors1), len(descriptors2)) == 0:
        return np.empty((0, 2), np.int32)
    best1, cosine = _nearest(descriptors1, descriptors2)
    best2, _ = _nearest(descriptors2, descriptors1)
    row = np.arange(len(best1))
    keep = (best2[best1] == row) & (cosine >= min_cosine)
    return np.stack([row[keep], best1[keep]], axis=1).astype(np.int32)


def _nearest(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For every row of `first` its nearest row of `second`, and the cosine; in blocks, to bound the memory."""
    best, cosine = np.empty(len(first), np.int64), np.empty(len(first), np.float32)
    for start in range(0, len(first), _BLOCK_ROWS):
        here = slice(start, start + _BLOCK_ROWS)
        similarity = first[here] @ second.T
        best[here] = similarity.argmax(axis=1)
        cosine[here] = similarity.max(axis=1)
    return best, cosine


def normalized_keypoints(
    pixels: Float32[np.ndarray, "n 2"], size: tuple[int, int]
) -> Float32[np.ndarray, "n 2"]:
    """Pixels relative to the image's center, from -1 to 1 along its longer side (LightGlue's normalization).

    Raises:
        ShapeError: a pixel is outside the image.
    """
    sides = np.array(size, np.float32)
    if not ((pixels >= -0.5) & (pixels <= sides - 0.5)).all():
        raise ShapeError(f"features must be inside their image of {size[0]} x {size[1]} pixels")
    return (pixels - sides / 2) / (sides.max() / 2)


def mutual_matches(
    log_assignment: Float32[np.ndarray, "n m"], min_score: float
) -> tuple[Int64[np.ndarray, "k 2"], Float32[np.ndarray, " k"]]:
    """Pairs that are each other's most probable match and more probable than `min_score`, with their probability."""
    best1, best2 = log_assignment.argmax(axis=1), log_assignment.argmax(axis=0)
    row = np.arange(len(best1))
    scores = np.exp(log_assignment[row, best1])
    keep = (best2[best1] == row) & (scores > min_score)
    return np.stack([row[keep], best1[keep]], axis=1), scores[keep]


def _checked_files(folder: Path, names: Sequence[str]) -> list[bytes]:
    """The contents of files, which have the checksums that were written with them.

    Raises:
        FileFormatError: a file is missing, cannot be read or has changed.
    """
    lines = _contents(folder / CHECKSUMS).decode(errors="replace").splitlines()
    expected = {name.strip(): digest for digest, _, name in (line.partition(" ") for line in lines)}
    out = []
    for name in names:
        path = folder / name
        data = _contents(path)
        if name not in expected:
            raise FileFormatError(folder / CHECKSUMS, f"it has no checksum of {name}; {_CONVERT}")
        if hashlib.sha256(data).hexdigest() != expected[name]:
            raise FileFormatError(path, f"damaged or replaced: it differs from {CHECKSUMS}; {_CONVERT}")
        out.append(data)
    return out


def _contents(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise FileFormatError(path, f"cannot be read ({error.strerror}); {_CONVERT}") from error


def _runtime() -> Any:
    try:
        return import_module("onnxruntime")
    except ImportError as error:
        raise MissingDependencyError(
            "learned features need onnxruntime: run pip install 'epipole[learned]'"
        ) from error


def _open(runtime: Any, path: Path, data: bytes, signature: Any, threads: int) -> Any:
    """A session for the network in `data`, the contents of `path`.

    Raises:
        FileFormatError: it is not a network made by the conversion script.
    """
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors, which are raised as well
    # Idle threads of the runtime would otherwise keep processors busy that the rest of epipole uses.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = runtime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions have no common base
        raise FileFormatError(path, f"onnxruntime cannot load it: {error}; {_CONVERT}") from error
    found = tuple(tuple(each.name for each in ends) for ends in (session.get_inputs(), session.get_outputs()))
    if found != signature:
        raise FileFormatError(path, f"it has inputs and outputs {found}, not {signature}; {_CONVERT}")
    return session
