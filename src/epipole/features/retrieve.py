"""Retrieval: similar images, by a vocabulary of their own descriptors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Int32, UInt8
from scipy.sparse import csr_array

from epipole import _parallel
from epipole._checks import checked
from epipole.errors import ConfigError, ShapeError

_BLOCK_ROWS = 128
"""Images compared with all others at a time, so that memory grows linearly with their number."""
_BY_THEMSELVES, _AVERAGED = 30, 5
"""Most similar images by their own vectors, after which averages decide, and images averaged with each. Averages prefer images next to
each other to distant views of the same, which keep a model from bending: they do not decide on the first ones."""
_COMPONENTS, _COMPONENT_SAMPLE = 512, 1024
"""Principal components that more images than the sample are compared by, and images that these are computed from."""


@checked
def train_vocabulary(
    descriptors: Sequence[UInt8[np.ndarray, "_ d"]], num_words: int = 128, seed: int = 0, rounds: int = 10
) -> Float32[np.ndarray, "w d"]:
    """Visual words: Lloyd's k-means over a sample of all images' descriptors (Lloyd 1982)."""
    if num_words < 1 or seed < 0 or rounds < 0:
        raise ConfigError("num_words must be positive, seed and rounds not negative")
    if len({d.shape[1] for d in descriptors}) > 1:
        raise ShapeError("descriptors must have one width")
    random = np.random.default_rng(seed)
    per_image = max(1, 50_000 // max(len(descriptors), 1))
    picked = [d[np.sort(random.permutation(len(d))[:per_image])] for d in descriptors if len(d)]
    sample = np.concatenate(picked).astype(np.float32) if picked else np.zeros((0, 128), np.float32)
    if len(sample) <= num_words:
        return sample
    words = sample[np.sort(random.choice(len(sample), num_words, replace=False))]
    for _ in range(rounds):
        word = _nearest_word(sample, words)
        counts = np.bincount(word, minlength=num_words)
        is_of_word = csr_array((np.ones(len(word)), (word, np.arange(len(word)))), (num_words, len(word)))
        sums = is_of_word @ sample  # integers in double precision: exact in any order
        before = words
        words = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], words).astype(np.float32)
        if np.array_equal(words, before):  # further rounds would change nothing
            break
    return words


@checked
def describe_image(
    descriptors: UInt8[np.ndarray, "n d"], words: Float32[np.ndarray, "w d"]
) -> Float32[np.ndarray, " v"]:
    """VLAD with signed square roots, unit length (Jegou et al., CVPR 2010; Arandjelovic and Zisserman 2013)."""
    if descriptors.shape[1] != words.shape[1]:
        raise ShapeError(f"descriptors have {descriptors.shape[1]} columns, words {words.shape[1]}")
    out = np.zeros_like(words)
    if len(descriptors) and len(words):
        values = descriptors.astype(np.float32)
        word = _nearest_word(values, words)
        order = np.argsort(word, kind="stable")
        starts = np.flatnonzero(np.diff(word[order], prepend=-1))
        out[word[order[starts]]] = np.add.reduceat((values - words[word])[order], starts, axis=0)
        out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)
    flat = np.sign(out) * np.sqrt(np.abs(out))
    return (flat / max(float(np.linalg.norm(flat)), 1e-12)).ravel()


@checked
def describe_images(
    descriptors: Sequence[UInt8[np.ndarray, "_ d"]], words: Float32[np.ndarray, "w d"]
) -> Float32[np.ndarray, "n v"]:
    """`describe_image` of all images, in parallel; each image's descriptors are in memory only then."""
    out = np.empty((len(descriptors), words.size), np.float32)

    def describe(start: int, stop: int, _: int) -> None:
        for i in range(start, stop):
            out[i] = describe_image(descriptors[i], words)

    with _parallel.single_threaded_blas():
        _parallel.map_chunks(describe, len(descriptors))
    return out


@checked
def most_similar(vectors: Float32[np.ndarray, "n v"], count: int) -> Int32[np.ndarray, "n c"]:
    """For each image, the `count` other images with the largest cosine, best first.

    After the first 30, those follow whose averages with their five most similar images have the largest cosine: they find images that
    show the same from elsewhere, by way of those in between (Turcot and Lowe, Better matching with fewer features, 2009; Arandjelovic
    and Zisserman, CVPR 2012). More than 1,024 images are compared by 512 principal components of their centered vectors (Jegou and
    Chum, ECCV 2012, without whitening), with work of n v 512 + n^2 512 instead of n^2 v.
    """
    with _parallel.single_threaded_blas():
        compared = _principal_components(vectors) if len(vectors) > _COMPONENT_SAMPLE else vectors
        nearest = _nearest(compared, count)
        if nearest.shape[1] > _BY_THEMSELVES:
            averages = compared.copy()
            for column in nearest[:, :_AVERAGED].T:
                averages += compared[column]
            averages /= np.maximum(np.linalg.norm(averages, axis=1, keepdims=True), 1e-12)
            for own, other in zip(nearest, _nearest(averages, count)):
                others = other[np.isin(other, own[:_BY_THEMSELVES], invert=True)]
                own[_BY_THEMSELVES:] = others[: len(own) - _BY_THEMSELVES]
    return nearest


def _nearest(vectors: np.ndarray, count: int) -> np.ndarray:
    """(n, c) rows of the other vectors with the largest scalar product, best first."""
    n = len(vectors)
    kept = max(0, min(count, n - 1))
    out = np.empty((n, kept), np.int32)

    def compare(block: int) -> None:
        rows = np.arange(block * _BLOCK_ROWS, min((block + 1) * _BLOCK_ROWS, n))
        similarity = vectors[rows] @ vectors.T
        similarity[np.arange(len(rows)), rows] = -np.inf
        np.negative(similarity, out=similarity)
        best = np.argpartition(similarity, kept - 1, axis=1)[:, :kept]
        best.sort(axis=1)
        order = np.argsort(np.take_along_axis(similarity, best, axis=1), axis=1, kind="stable")
        out[rows] = np.take_along_axis(best, order, axis=1)

    if kept:
        _parallel.map_items(compare, -(-n // _BLOCK_ROWS))
    return out


def _principal_components(vectors: np.ndarray) -> np.ndarray:
    """Coordinates of the vectors along the largest principal components of a sample of them, at unit length."""
    sample = vectors[np.linspace(0, len(vectors) - 1, _COMPONENT_SAMPLE).astype(np.int64)]
    mean = sample.mean(axis=0)
    centered = (sample - mean).astype(np.float64)
    values, combinations = np.linalg.eigh(centered @ centered.T)  # the sample is smaller than a vector
    largest = values > 1e-9 * values[-1]
    largest[:-_COMPONENTS] = False
    axes = (centered.T @ (combinations[:, largest] / np.sqrt(values[largest]))).astype(np.float32)
    out = np.empty((len(vectors), axes.shape[1]), np.float32)

    def project(start: int, stop: int, _: int) -> None:
        is_blank = ~vectors[start:stop].any(axis=1, keepdims=True)  # similar to nothing
        out[start:stop] = np.where(is_blank, 0.0, (vectors[start:stop] - mean) @ axes)

    _parallel.map_chunks(project, len(vectors), 64)
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12))


def _nearest_word(values: np.ndarray, words: np.ndarray) -> np.ndarray:
    return np.argmax(values @ words.T - 0.5 * (words**2).sum(axis=1), axis=1)
