"""Retrieval: similar images, by a vocabulary of their own descriptors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from epipole._checks import checked
from epipole.errors import ConfigError, ShapeError

_BLOCK_ROWS = 2048
"""Images compared with all others at a time, so that memory grows linearly with their number."""


@checked
def train_vocabulary(
    descriptors: Sequence[UInt8[np.ndarray, "_ d"]], num_words: int = 64, seed: int = 0, rounds: int = 10
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
        sums = np.stack([np.bincount(word, sample[:, c], num_words) for c in range(sample.shape[1])], axis=1)
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
        np.add.at(out, word, values - words[word])
        out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)
    flat = np.sign(out) * np.sqrt(np.abs(out))
    return (flat / max(float(np.linalg.norm(flat)), 1e-12)).ravel()


@checked
def most_similar(vectors: Float32[np.ndarray, "n v"], count: int) -> Int32[np.ndarray, "n c"]:
    """For each image, the `count` other images with the largest cosine, best first."""
    n = len(vectors)
    kept = max(0, min(count, n - 1))
    out = np.empty((n, kept), np.int32)
    for start in range(0, n, _BLOCK_ROWS):
        block = vectors[start : start + _BLOCK_ROWS]
        similarity = block @ vectors.T
        similarity[np.arange(len(block)), start + np.arange(len(block))] = -np.inf
        out[start : start + _BLOCK_ROWS] = np.argsort(-similarity, axis=1, kind="stable")[:, :kept]
    return out


def _nearest_word(values: np.ndarray, words: np.ndarray) -> np.ndarray:
    return np.argmax(values @ words.T - 0.5 * (words**2).sum(axis=1), axis=1)
