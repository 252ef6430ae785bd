"""Division of a view graph into parts that few matches connect: recursive bisection by the normalized cut (Shi and Malik, PAMI 2000)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int32, Int64
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import eigsh

from epipole import _parallel
from epipole._checks import check_indices, checked
from epipole.errors import ConfigError

LEAST_SHARE = 1.0 / 3.0
"""Smallest fraction of the images on one side of a cut."""
SHIFT = 1e-6
"""Keeps the matrix of the eigenvector regular, whose smallest eigenvalue is 0; below the eigenvalues of long chains of images."""


@checked
def connected_images(
    num_images: int, image1: Int32[np.ndarray, " n"], image2: Int32[np.ndarray, " n"]
) -> Int32[np.ndarray, " i"]:
    """Number of the connected component of each image.

    Raises:
        ShapeError: an image does not exist.
    """
    check_indices(image1, "image1", num_images)
    check_indices(image2, "image2", num_images)
    pairs = coo_array((np.ones(len(image1)), (image1, image2)), shape=(num_images, num_images))
    return np.asarray(connected_components(pairs, directed=False)[1], np.int32)


@checked
def divide_images(
    num_images: int,
    image1: Int32[np.ndarray, " n"],
    image2: Int32[np.ndarray, " n"],
    weight: Float64[np.ndarray, " n"],
    most: int,
) -> tuple[Int64[np.ndarray, " _"], ...]:
    """Divide the connected components of the images, largest first, until no part has more than `most` images.

    Each part is cut in two where the weight across the cut is smallest relative to the weight inside the lighter side, among the cuts
    along the second eigenvector of the normalized Laplacian that leave a third of the images on either side.

    Args:
        num_images: number of images.
        image1: one image of each pair.
        image2: the other image.
        weight: strength of the connection, such as the number of matches; positive and finite.
        most: largest size of a part; at least 2.

    Returns:
        Images of each part, sorted and connected by its pairs. Images without a pair are in none, nor are those that a cut leaves without one.

    Raises:
        ShapeError: an image does not exist.
        ConfigError: a weight or the size is invalid.
    """
    check_indices(image1, "image1", num_images)
    check_indices(image2, "image2", num_images)
    if most < 2 or not (np.isfinite(weight) & (weight > 0)).all():
        raise ConfigError(
            f"parts need two images or more, got {most}, and weights that are positive and finite"
        )
    shape = (num_images, num_images)
    upper = coo_array((weight, (image1, image2)), shape=shape).tocsr()
    adjacency = csr_array(upper + upper.T)
    waiting = _components(adjacency, np.arange(num_images))
    done = []
    with _parallel.single_threaded_blas():  # its sums depend on the number of threads
        while waiting:
            rows = waiting.pop()
            if len(rows) <= most:
                done.append(rows)
                continue
            first = _bisect(csr_array(adjacency[rows][:, rows]))
            waiting += [*_components(adjacency, rows[~first]), *_components(adjacency, rows[first])]
    return tuple(
        np.sort(rows).astype(np.int64) for rows in sorted(done, key=lambda rows: (-len(rows), rows[0]))
    )


def _components(adjacency: csr_array, rows: np.ndarray) -> list[np.ndarray]:
    """The connected components of some images, smallest first, without single images: a cut may leave a side in pieces."""
    component = connected_components(adjacency[rows][:, rows], directed=False)[1]
    members = [rows[component == k] for k in range(component.max(initial=-1) + 1)]
    return sorted((one for one in members if len(one) > 1), key=len)


def _bisect(adjacency: csr_array) -> np.ndarray:
    """Mask of one side of the best cut of a connected graph."""
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    scale = diags_array(1.0 / np.sqrt(degree))
    laplacian = diags_array(np.ones(len(degree))) - scale @ adjacency @ scale
    start = np.cos(np.arange(len(degree)))  # any fixed vector
    _, vectors = eigsh(laplacian.tocsc(), k=2, sigma=-SHIFT, v0=start)
    order = np.argsort(vectors[:, 1] / np.sqrt(degree), kind="stable")
    if order[0] > order[-1]:  # the sign of an eigenvector is arbitrary
        order = order[::-1]
    first = np.zeros(len(order), bool)
    first[order[: _best_cut(adjacency, degree, order)]] = True
    return first


def _best_cut(adjacency: csr_array, degree: Float64[np.ndarray, " n"], order: Int64[np.ndarray, " n"]) -> int:
    """Number of images before the best cut of an ordering."""
    count = len(order)
    position = np.empty(count, np.int64)
    position[order] = np.arange(count)
    pairs = adjacency.tocoo()
    low = np.minimum(position[pairs.row], position[pairs.col])
    high = np.maximum(position[pairs.row], position[pairs.col])
    # A pair crosses the cuts after its first image and before its second one; both directions of each pair are stored.
    change = np.bincount(low, pairs.data / 2.0, count) - np.bincount(high, pairs.data / 2.0, count)
    across = np.cumsum(change)[:-1]
    before = np.cumsum(degree[order])[:-1]
    lighter = np.minimum(before, degree.sum() - before)
    least = max(1, int(np.ceil(LEAST_SHARE * count)))
    allowed = np.arange(least, count - least + 1)
    return int(allowed[np.argmin((across / lighter)[allowed - 1])])


@checked
def nearest_outside(
    part: Int64[np.ndarray, " p"],
    num_images: int,
    image1: Int32[np.ndarray, " n"],
    image2: Int32[np.ndarray, " n"],
    weight: Float64[np.ndarray, " n"],
    most: int,
) -> Int64[np.ndarray, " _"]:
    """The images outside a part with the strongest connection to it, at most `most`, strongest first.

    Raises:
        ShapeError: an image does not exist.
    """
    for images, name in ((part, "part"), (image1, "image1"), (image2, "image2")):
        check_indices(images, name, num_images)
    inside = np.zeros(num_images, bool)
    inside[part] = True
    strength = np.zeros(num_images)
    np.add.at(strength, image1[inside[image2]], weight[inside[image2]])
    np.add.at(strength, image2[inside[image1]], weight[inside[image1]])
    strength[inside] = 0.0
    order = np.argsort(-strength, kind="stable")[: max(most, 0)]
    return order[strength[order] > 0.0]
