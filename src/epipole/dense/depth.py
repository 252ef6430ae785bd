"""Depth of each pixel of a view, from semi-global matching with several other views.

Each source is rectified with the reference view and matched (Hirschmueller, PAMI 2008); the depths of all sources are combined by
agreement, as by Rothermel, Wenzel, Fritsch and Haala (SURE, LC3D 2012).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from epipole import _parallel
from epipole._checks import checked
from epipole.dense import _depth_kernels as kernels
from epipole.dense.depth_edges import choose_at_edges
from epipole.dense.pair_rectification import RectifiedPair, rectify_views
from epipole.dense.view import DenseView, intrinsics_of
from epipole.disparity_search.config import DisparityConfig
from epipole.disparity_search.search import match_stereo
from epipole.errors import ConfigError, DegenerateGeometryError
from epipole.scene import StereoReason
from epipole.scene.view_depth import DepthReason, ViewDepth

AGREEING_SIGMAS, AGREEING_FRACTION = 3.0, 0.003
"""Two sources agree up to this number of standard deviations plus this fraction of the inverse depth."""
SHARED = 0.3
"""Part of the variance that all sources share, as they see the same pixels of the reference (chosen on the courtyard, so that two thirds of the errors are within one sigma)."""
PRIOR = 4.0
"""Weight of the view's variance against that of a pixel, in observations."""
MEDIAN_CHI_SQUARE, LEAST_PIXELS, SCALES = 0.77, 1000, (0.05, 20.0)
"""Median of chi-square per degree of freedom (3 of them); fewest pixels; smallest and largest variance, relative to the pair's."""
LEAST_AGREEING = 2
"""Sources that must agree, unless only one has the pixel in its image."""
MOST_COST, ALONE_COST, ONLY_COST = 0.3, 0.2, 0.4
"""Largest cost (`choose_at_edges`) of a depth at an edge that several sources have, one source has, or one has and no other matches. The cost of the
last is a mean with a source that does not match."""
MOST_SIGMA = 0.05
"""Largest standard deviation, relative to the depth."""
LEAST_CHANGE, BLANK_PX, FLAT_PX = 6, 25, 5
"""Smallest gray-level difference that is texture; sides of the windows without texture that begin and extend a blank area."""
_ROWS = 32
_NAMES = np.array(
    [
        DepthReason.OK,
        DepthReason.OCCLUDED,
        DepthReason.OUT_OF_VIEW,
        DepthReason.AMBIGUOUS,
        DepthReason.AMBIGUOUS,
        DepthReason.TEXTURELESS,
        DepthReason.UNCERTAIN,
    ],
    np.uint8,
)
"""Reason of each `StereoReason`."""


@checked
def view_depth(
    reference: DenseView,
    sources: Sequence[DenseView],
    depths: tuple[float, float],
    model_sigma_px: float = 0.1,
) -> ViewDepth:
    """Depth of a view from its sources.

    Args:
        reference: the view whose depth is wanted.
        sources: views of the same surfaces from other positions.
        depths: smallest and largest depth in the view.
        model_sigma_px: standard deviation of a pixel due to errors of the poses.

    Raises:
        ConfigError: depths is not an increasing pair of positive numbers.
    """
    if not 0.0 < depths[0] < depths[1] < np.inf:
        raise ConfigError(f"depths must be two increasing positive numbers, got {depths}")
    if not 0.0 <= model_sigma_px < np.inf:
        raise ConfigError(f"model_sigma_px must not be negative, got {model_sigma_px}")
    height, width = reference.rgb.shape[:2]
    shape = (max(len(sources), 1), height, width)
    inverse, sigma = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    reason = np.full(shape, DepthReason.OUT_OF_VIEW, np.uint8)
    gray = _gray(reference)
    for k, source in enumerate(sources):
        try:
            pair = rectify_views(reference, source, depths, k / len(sources))
        except DegenerateGeometryError:
            continue
        _match(pair, gray, source, reference, model_sigma_px, (inverse[k], sigma[k], reason[k]))
    return _combined(reference, sources, inverse, sigma, reason)


def _gray(view: DenseView) -> np.ndarray:
    return np.asarray(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY))


def _match(
    pair: RectifiedPair,
    gray: np.ndarray,
    source: DenseView,
    reference: DenseView,
    model_sigma_px: float,
    out: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Match one source, and write inverse depth, sigma and reason in the reference view."""
    config = DisparityConfig(max_disparity_px=min(pair.num_disparities, pair.size[0] - 1))
    found = match_stereo(*pair.apply(gray, _gray(source)), config)
    why = found.reason.copy()
    outside, masked = _beyond(pair, source, found.disparity_px)
    why[outside & (why == StereoReason.OK)] = StereoReason.OUT_OF_VIEW
    why[masked & (why == StereoReason.OK)] = StereoReason.OCCLUDED
    geometry = (
        np.linalg.inv(pair.reference_from_rectified).ravel(),
        pair.inverse_depth_of_ray,
        pair.first_disparity_px,
        intrinsics_of(reference.camera),
    )
    arrays = found.disparity_px, found.sigma_px, np.ascontiguousarray(why, np.uint8)
    _by_rows(
        len(gray),
        lambda start, stop, _: kernels.sample_pair(
            geometry, arrays, (_NAMES, np.float32(model_sigma_px)), start, stop, out
        ),
    )


def _beyond(pair: RectifiedPair, source: DenseView, disparity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether the match of each rectified pixel is outside the source's image, and whether it is masked there."""
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    image = np.full(source.rgb.shape[:2], 2, np.uint8)
    if source.used_mask is not None:
        image[~source.used_mask] = 1
    warped = cv2.warpPerspective(image, pair.source_from_rectified, pair.size, None, flags)
    columns = np.arange(pair.size[0]) - np.nan_to_num(disparity)
    at = np.clip(np.rint(columns).astype(np.int64), 0, pair.size[0] - 1)
    matched = np.take_along_axis(np.asarray(warped), at, axis=1)
    return matched == 0, matched == 1


def _combined(
    reference: DenseView,
    sources: Sequence[DenseView],
    inverse: np.ndarray,
    sigma: np.ndarray,
    reason: np.ndarray,
) -> ViewDepth:
    """Depth where enough sources agree, with its standard deviation, and reasons elsewhere."""
    height, width = inverse.shape[1:]
    q, spread, chi = (np.empty((height, width), np.float32) for _ in range(3))
    agreeing, differing, seeing, why = (np.empty((height, width), np.uint8) for _ in range(4))
    views = _views_of(reference, sources)
    out, options = (q, spread, chi, agreeing, differing, seeing, why), (AGREEING_SIGMAS, AGREEING_FRACTION)
    _by_rows(
        height,
        lambda start, stop, _: kernels.merge_rows(inverse, sigma, reason, views, options, start, stop, out),
    )
    for source in sources:
        seeing -= _is_masked(reference, source, q).astype(np.uint8)
    few = agreeing < np.minimum(LEAST_AGREEING, seeing)
    why[(why == DepthReason.OK) & (few | (differing > agreeing))] = DepthReason.DISAGREEING
    grays = [_gray(view) for view in (reference, *sources)]
    if sources:
        _choose_at_edges(inverse, sigma, grays, views, seeing, (q, spread, chi, agreeing, why))
    spread *= _scale_of_sigma(chi, agreeing)
    why[(why == DepthReason.OK) & (spread > MOST_SIGMA * q)] = DepthReason.UNCERTAIN
    why[(why == DepthReason.OK) & _is_blank(grays[0])] = DepthReason.TEXTURELESS
    if reference.used_mask is not None:
        why[~reference.used_mask] = DepthReason.MASKED
    known, nan = why == DepthReason.OK, np.float32(np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(known, 1.0 / q, nan).astype(np.float32)
        return ViewDepth(depth, np.where(known, spread * depth * depth, nan), why, agreeing)


def _choose_at_edges(
    inverse: np.ndarray,
    sigma: np.ndarray,
    grays: Sequence[np.ndarray],
    views: tuple[np.ndarray, ...],
    seeing: np.ndarray,
    merged: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """At edges and in holes, combine the sources that agree with the depth that the images support there.

    seeing: number of sources in whose image the point is. merged: inverse depth, standard deviation, chi-square, number agreeing, and reason,
    all of which change.
    """
    q, spread, chi, agreeing, why = merged
    known = np.where(why == DepthReason.OK, q, np.float32(np.nan))
    is_hole = (why == DepthReason.DISAGREEING) | (why == DepthReason.OCCLUDED)
    choice = choose_at_edges(known, is_hole, inverse, grays, views)
    out, options = (q, spread, chi, agreeing), (AGREEING_SIGMAS, AGREEING_FRACTION)
    arrays = inverse, sigma, choice.zone, choice.inverse_depth
    _by_rows(len(q), lambda start, stop, _: kernels.merge_near_rows(*arrays, options, start, stop, out))
    alone = (agreeing == 1) & (choice.cost <= np.where(choice.num_matching == 1, ONLY_COST, ALONE_COST))
    only = (
        (agreeing == 1) & (seeing == 1) & (why == DepthReason.OK)
    )  # there is no other source to compare with
    accepted = only | alone | ((agreeing >= LEAST_AGREEING) & (choice.cost <= MOST_COST))
    why[choice.zone & accepted] = DepthReason.OK
    why[choice.zone & ~accepted & (why == DepthReason.OK)] = DepthReason.DISAGREEING


def _views_of(reference: DenseView, sources: Sequence[DenseView]) -> tuple[np.ndarray, ...]:
    """Intrinsics of the reference; motions to the sources, their intrinsics and sizes."""
    world_from_reference = reference.cam_from_world.inverse()
    motions = [source.cam_from_world @ world_from_reference for source in sources]
    return (
        intrinsics_of(reference.camera),
        np.array([motion.rotation.ravel() for motion in motions]).reshape(-1, 9),
        np.array([motion.translation for motion in motions]).reshape(-1, 3),
        np.array([intrinsics_of(source.camera) for source in sources]).reshape(-1, 4),
        np.array([[source.camera.width, source.camera.height] for source in sources], np.float64).reshape(
            -1, 2
        ),
    )


def _is_masked(reference: DenseView, source: DenseView, inverse_depth: np.ndarray) -> np.ndarray:
    """(h, w) whether the mask of a source excludes the point of each pixel; false outside its image."""
    out = np.zeros(inverse_depth.shape, bool)
    if source.used_mask is None:
        return out
    row, column = np.nonzero(inverse_depth > 0)
    k = intrinsics_of(reference.camera)
    z = 1.0 / inverse_depth[row, column].astype(np.float64)
    points = np.stack([(column - k[2]) / k[0] * z, (row - k[3]) / k[1] * z, z], axis=1)
    in_cam = (source.cam_from_world @ reference.cam_from_world.inverse()).apply(points)
    pixels = source.camera.project(in_cam)
    limits = [source.camera.width - 0.5, source.camera.height - 0.5]
    inside = (in_cam[:, 2] > 0) & (pixels > -0.5).all(axis=1) & (pixels < limits).all(axis=1)
    at = np.rint(pixels[inside]).astype(np.int64)
    out[row[inside], column[inside]] = ~source.used_mask[at[:, 1], at[:, 0]]
    return out


def _is_blank(gray: np.ndarray) -> np.ndarray:
    """Pixels of areas without texture, up to their borders.

    The smoothness term extends the depth at the border of a blank area into it, so that walls would grow into the sky in all views alike. Small
    areas without texture are kept.
    """
    changes = np.zeros(gray.shape, np.uint8)
    signed = gray.astype(np.int16)
    changes[:, 1:-1] |= np.abs(signed[:, 2:] - signed[:, :-2]) >= LEAST_CHANGE
    changes[1:-1] |= np.abs(signed[2:] - signed[:-2]) >= LEAST_CHANGE
    wide, near = (np.ones((side, side), np.uint8) for side in (BLANK_PX, FLAT_PX))
    core = (cv2.dilate(changes, wide) == 0).astype(np.uint8)
    return np.asarray((cv2.dilate(core, wide) > 0) & (cv2.dilate(changes, near) == 0))


def _scale_of_sigma(chi: np.ndarray, agreeing: np.ndarray) -> np.ndarray:
    """(h, w) factor of the standard deviations: how much the sources really differ, in the view and at the pixel.

    The variance of a pixel is a mean of the view's, weighted as PRIOR observations, and of the chi-square at the pixel; the part that sources share is added.
    """
    extra = np.maximum(agreeing.astype(np.float32) - 1, 0)
    many = agreeing >= 3
    view = 1.0
    if many.sum() >= LEAST_PIXELS:
        view = float(np.median(chi[many] / extra[many])) / MEDIAN_CHI_SQUARE
    view = float(np.clip(view, *SCALES))
    with np.errstate(invalid="ignore"):
        variance = (PRIOR * view + chi) / (PRIOR + extra)
        return np.asarray(np.sqrt(variance * (1.0 + SHARED * extra)), np.float32)


def _by_rows(height: int, work: Callable[[int, int, int], None]) -> None:
    _parallel.map_chunks(work, height, -(-height // _ROWS))
