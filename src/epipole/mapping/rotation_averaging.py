"""Rotations of all cameras from the relative rotations of pairs, robustly, and the pairs that contradict them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float64, Int32
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from epipole._checks import Declared, check_count, check_indices, checked, require_same_length
from epipole.errors import ConfigError
from epipole.geometry import Rotation3
from epipole.mapping.positions.laplacian import solve_laplacian

L1_ROUNDS, ROBUST_ROUNDS = 10, 30
SCALE_RAD = np.deg2rad(5.0)
"""Scale of the robust loss: five degrees, as in Chatterjee and Govindu's experiments and in COLMAP."""
SMALLEST_RAD = np.deg2rad(0.1)
"""Residual below which the L1 norm is treated as a square, so that weights stay finite."""
CONVERGED_RAD = 1e-5
ROTATION_TOLERANCE = 1e-6
MAX_TRIANGLE_RAD = np.deg2rad(5.0)
"""Largest angle by which the product of a triangle's rotations may differ from the identity."""
LEAST_TRUST = 1e-6
"""Factor of the weight of a pair that no triangle confirms: it counts only if nothing else connects its images."""


@dataclass(frozen=True, slots=True, eq=False)
class AveragedRotations(Declared):
    """Rotations in one frame per connected component."""

    cams_from_world: Float64[np.ndarray, "n 3 3"]
    component: Int32[np.ndarray, " n"]
    """Connected component of each image; rotations of different components cannot be compared."""
    residuals_rad: Float64[np.ndarray, " p"]
    """Angle between each pair's relative rotation and the averaged one."""

    def __repr__(self) -> str:
        median = np.degrees(np.median(self.residuals_rad)) if len(self.residuals_rad) else 0.0
        return f"AveragedRotations({len(self.component)} images, median residual {median:.2f} degrees)"


@checked
def average_rotations(
    num_images: int,
    image1: Int32[np.ndarray, " p"],
    image2: Int32[np.ndarray, " p"],
    cams2_from_cams1: Float64[np.ndarray, "p 3 3"],
    weights: Float64[np.ndarray, " p"],
) -> AveragedRotations:
    """Minimize the robust sum of the angles between R_j R_i^T and the measured relative rotations.

    It starts from a spanning tree of the pairs that most triangles of images confirm, then alternates weights and a linear
    system in the Lie algebra: first the L1 norm, then a redescending loss (Chatterjee and Govindu, ICCV 2013;
    Geman-McClure instead of their l_1/2). The work of a round is one sparse factorization of the graph's Laplacian.

    Args:
        num_images: number of images.
        image1: first image of each pair.
        image2: second image.
        cams2_from_cams1: relative rotation of each pair.
        weights: positive, such as the number of inliers.

    Raises:
        ShapeError: an image does not exist, or the arrays have different lengths.
        ConfigError: a matrix is no rotation, a weight is not positive and finite, or there are too many images.
    """
    require_same_length(image1=image1, image2=image2, cams2_from_cams1=cams2_from_cams1, weights=weights)
    check_count(num_images, "num_images")
    if not ((weights > 0) & np.isfinite(weights)).all():
        raise ConfigError("weights must be positive and finite")
    with np.errstate(all="ignore"):
        product = np.swapaxes(cams2_from_cams1, 1, 2) @ cams2_from_cams1
    if not (np.abs(product - np.eye(3)) < ROTATION_TOLERANCE).all():
        raise ConfigError("cams2_from_cams1 must be rotations")
    check_indices(image1, "image1", num_images)
    check_indices(image2, "image2", num_images)
    weights = weights / weights.max(initial=0.0) if len(weights) else weights
    support, possible = triangle_support(num_images, image1, image2, cams2_from_cams1, weights)
    first = support + LEAST_TRUST * weights
    rotations, component = _along_the_tree(num_images, image1, image2, cams2_from_cams1, first)
    weights = weights * np.where(
        possible > 0, np.maximum(support / np.maximum(possible, 1e-300), LEAST_TRUST), 1.0
    )
    for round_ in range(L1_ROUNDS + ROBUST_ROUNDS):
        residuals = _residuals(rotations, image1, image2, cams2_from_cams1)
        angle = np.linalg.norm(residuals, axis=1)
        is_l1 = round_ < L1_ROUNDS
        robust = 1.0 / np.maximum(angle, SMALLEST_RAD) if is_l1 else (1.0 + (angle / SCALE_RAD) ** 2) ** -2.0
        step = solve_laplacian(image1, image2, component, weights * robust, residuals)
        rotations = rotations @ Rotation3.exp(step).matrix
        if np.abs(step).max(initial=0.0) < CONVERGED_RAD and not is_l1:
            break
    final = np.linalg.norm(_residuals(rotations, image1, image2, cams2_from_cams1), axis=1)
    return AveragedRotations(rotations, component, final)


def triangle_support(
    num_images: int, image1: np.ndarray, image2: np.ndarray, relative: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Confirmation of each pair by the triangles of images that it is a side of.

    Returns:
        (p,) sum of the smaller weight of the other two pairs over the triangles whose rotations multiply to the identity,
        and over all triangles.
    """
    low, high = np.minimum(image1, image2), np.maximum(image1, image2)
    upward = np.where((image1 <= image2)[:, None, None], relative, np.swapaxes(relative, 1, 2))
    support, possible = np.zeros(len(image1)), np.zeros(len(image1))
    for first, second, third in _triangles(num_images, low, high):
        # From the lowest image to the highest, by the middle one and directly.
        around = upward[second] @ upward[first]
        cosine = 0.5 * (np.einsum("kab,kab->k", around, upward[third]) - 1.0)
        agrees = cosine >= np.cos(MAX_TRIANGLE_RAD)
        for own, *others in ((first, second, third), (second, first, third), (third, first, second)):
            smaller = np.minimum(weights[others[0]], weights[others[1]])
            support += np.bincount(own[agrees], smaller[agrees], len(support))
            possible += np.bincount(own, smaller, len(possible))
    return support, possible


def _triangles(
    num_images: int, low: np.ndarray, high: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """For each image, the triangles in which it is lowest: pairs (lowest, middle), (middle, highest), (lowest, highest)."""
    _, last = np.unique((low.astype(np.int64) * num_images + high)[::-1], return_index=True)
    pairs = len(low) - 1 - last  # of repeated pairs, the last one
    shape = (num_images, num_images)
    pair_of = sparse.csr_array((pairs + 1, (low[pairs], high[pairs])), shape=shape)
    pair_of.sort_indices()
    for image in range(num_images):
        row = slice(pair_of.indptr[image], pair_of.indptr[image + 1])
        neighbors, own = pair_of.indices[row], pair_of.data[row] - 1
        if len(neighbors) < 2:
            continue
        between = pair_of[neighbors][:, neighbors].tocoo()
        if between.nnz:
            yield own[between.row], between.data - 1, own[between.col]


def _along_the_tree(
    num_images: int, image1: np.ndarray, image2: np.ndarray, relative: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations composed along the spanning forest with the largest weights, and the component of each image."""
    best: dict[tuple[int, int], int] = {}
    for edge in np.argsort(weights, kind="stable"):
        best[int(image1[edge]), int(image2[edge])] = int(edge)
    edges = np.fromiter(best.values(), np.int64, len(best))
    shape = (num_images, num_images)
    cost = sparse.csr_array((1.0 / weights[edges], (image1[edges], image2[edges])), shape=shape)
    _, component = connected_components(cost, directed=False)
    tree = minimum_spanning_tree(cost)
    rotations = np.tile(np.eye(3), (num_images, 1, 1))
    for root in np.unique(component, return_index=True)[1]:
        order, before = breadth_first_order(tree, root, directed=False)
        for image in order[1:]:
            i, j = int(before[image]), int(image)
            step = relative[best[i, j]] if (i, j) in best else relative[best[j, i]].T
            rotations[j] = step @ rotations[i]
    return rotations, component.astype(np.int32)


def _residuals(
    rotations: np.ndarray, image1: np.ndarray, image2: np.ndarray, relative: np.ndarray
) -> np.ndarray:
    """(p, 3) log of R_j^T R_ij R_i, zero where a pair agrees."""
    return Rotation3(np.swapaxes(rotations[image2], 1, 2) @ relative @ rotations[image1]).log()
