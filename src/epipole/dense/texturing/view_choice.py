"""The view that gives each face its texture: visibility, size in the image, agreement of colors, and few seams."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64, Int64

from epipole import _parallel
from epipole._checks import checked
from epipole.dense.texturing import _choice_kernels as kernels
from epipole.dense.texturing import _raster_kernels as raster
from epipole.dense.texturing.texture_view import TextureView
from epipole.scene import Mesh

CANDIDATES = 6
"""Views of each face that are kept: those in which it is largest."""
LEAST_COSINE = 0.15
"""Smallest cosine between normal and viewing direction."""
SAME_DEPTH = 0.01
"""Largest depth by which a face is behind what its view shows, relative to the depth."""
MOST_COLOR, COLOR_SPREADS = 45.0, 3.0
"""A view is an outlier of a face if its color differs from the median by more gray levels, and more than this multiple of the median
difference."""
JUMP, ITERATIONS = 0.35, 24
"""Cost of a different view across an edge, where a view in which the face is half as large costs 0.5; steps of belief propagation."""
_FACES = 1 << 14


class FaceViews(NamedTuple):
    """Candidate views of each face."""

    label: np.ndarray
    """(m, k) view, -1 for none."""
    size_px: np.ndarray
    """(m, k) area of the face in the view, in pixels."""
    rgb: np.ndarray
    """(m, k, 3) color of the face in the view."""


@checked
def face_neighbors(faces: Int64[np.ndarray, "m 3"]) -> Int64[np.ndarray, "m 3"]:
    """Faces across the edges (0, 1), (1, 2) and (2, 0); -1 at a border, or where more than two faces share the edge."""
    m = len(faces)
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    same = (ends[order[1:]] == ends[order[:-1]]).all(axis=1)
    alone_before = np.concatenate([[True], ~same[:-1]]) if len(same) else same
    alone_after = np.concatenate([~same[1:], [True]]) if len(same) else same
    pairs = np.flatnonzero(same & alone_before & alone_after)
    out = np.full(3 * m, -1, np.int64)
    out[order[pairs]], out[order[pairs + 1]] = order[pairs + 1] // 3, order[pairs] // 3
    return out.reshape(m, 3)


def _occluders(inverse: np.ndarray, view: TextureView) -> np.ndarray:
    """(h, w) inverse depth of what hides others: the mesh and the view's own depth, which sees things that the mesh lacks; one pixel wider."""
    depth = view.read_depth()
    if depth is not None:
        with np.errstate(divide="ignore"):
            inverse = np.fmax(inverse, np.float32(1.0) / depth)
    return np.asarray(cv2.dilate(inverse, np.ones((3, 3), np.uint8)))


@checked
def visible_faces(mesh: Mesh, view: TextureView) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:
    """Faces that a view shows completely, with their areas in pixels."""
    camera, vertices = view.camera, mesh.vertices_in_world
    in_cam = view.cam_from_world.apply(vertices)
    depth = in_cam[:, 2].copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = in_cam[:, :2] / depth[:, None] * [camera.K[0, 0], camera.K[1, 1]] + camera.K[:2, 2]
    inverse = np.zeros((camera.height, camera.width), np.float32)
    nearest = np.full(inverse.shape, -1, np.int32)
    raster.render_faces(pixels, depth, mesh.faces, inverse, nearest)
    inside = (
        (depth > 0)
        & (pixels >= 0).all(axis=1)
        & (pixels <= [camera.width - 1, camera.height - 1]).all(axis=1)
    )
    used = view.used_mask()
    at = np.zeros((len(depth), 2), np.int64)
    at[inside] = np.rint(pixels[inside]).astype(np.int64)
    front = _occluders(inverse, view)[at[:, 1], at[:, 0]]
    inside &= (1.0 - SAME_DEPTH) * depth * front <= 1.0
    if used is not None:
        inside &= used[at[:, 1], at[:, 0]]
    found = np.flatnonzero(inside[mesh.faces].all(axis=1))
    a, b, c = (in_cam[mesh.faces[found, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    middle = (a + b + c) / 3.0
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(middle, axis=1)
    facing = -(normal * middle).sum(axis=1) > LEAST_COSINE * length
    found = found[facing]
    pa, pb, pc = (pixels[mesh.faces[found, k]] for k in range(3))
    area = 0.5 * np.abs((pb - pa)[:, 0] * (pc - pa)[:, 1] - (pb - pa)[:, 1] * (pc - pa)[:, 0])
    return found, area


def candidate_views(
    mesh: Mesh, views: Sequence[TextureView], progress: Callable[[int], None] = lambda _: None
) -> FaceViews:
    """The views in which each face is largest, one view after the other, with the color that they give it."""
    m = len(mesh)
    label, size = np.full((m, CANDIDATES), -1, np.int32), np.zeros((m, CANDIDATES), np.float32)
    rgb = np.zeros((m, CANDIDATES, 3), np.float32)
    for n, view in enumerate(views):
        progress(n)
        found, area = visible_faces(mesh, view)
        smallest = np.argmin(size[found], axis=1)
        better = area > size[found, smallest]
        rows, columns = found[better], smallest[better]
        label[rows, columns], size[rows, columns] = n, area[better]
        middle = mesh.vertices_in_world[mesh.faces[rows]].mean(axis=1)
        rgb[rows, columns] = view.colors_at(middle)
    return FaceViews(label, size, rgb)


def choose_views(found: FaceViews, neighbors: np.ndarray) -> np.ndarray:
    """(m,) the view of each face; -1 for a face that no view shows."""
    label, cost = _without_outliers(found)
    messages, after = (np.zeros((*neighbors.shape, label.shape[1]), np.float32) for _ in range(2))
    chunks = -(-len(label) // _FACES)
    for _ in range(ITERATIONS):
        _send(label, cost, neighbors, messages, after)
        messages, after = after, messages
    out = np.full(len(label), -1, np.int32)
    _parallel.map_chunks(
        lambda a, b, _: kernels.choose_labels(label, cost, neighbors, messages, a, b, out), len(label), chunks
    )
    return out


def _send(
    label: np.ndarray, cost: np.ndarray, neighbors: np.ndarray, before: np.ndarray, after: np.ndarray
) -> None:
    """One step of belief propagation."""
    jump = np.float32(JUMP)
    _parallel.map_chunks(
        lambda a, b, _: kernels.send_messages(label, cost, neighbors, jump, before, a, b, after),
        len(label),
        -(-len(label) // _FACES),
    )


def _without_outliers(found: FaceViews) -> tuple[np.ndarray, np.ndarray]:
    """Labels without views whose color the others contradict (someone walked by), and the cost of each: 1 - size / largest size."""
    valid = found.label >= 0
    rgb = np.where(valid[..., None], found.rgb, np.nan)
    enough = valid.sum(axis=1) >= 3
    label = found.label.copy()
    if enough.any():
        median = np.nanmedian(rgb[enough], axis=1, keepdims=True)
        off = np.abs(rgb[enough] - median).max(axis=2)
        spread = np.nanmedian(off, axis=1, keepdims=True)
        label[enough] = np.where(off > np.maximum(MOST_COLOR, COLOR_SPREADS * spread), -1, label[enough])
    size = np.where(label >= 0, found.size_px, 0.0)
    largest = np.maximum(size.max(axis=1, keepdims=True), 1e-12)
    return label, np.asarray(1.0 - size / largest, np.float32)
