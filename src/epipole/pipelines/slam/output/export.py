"""Export of the map as a `Reconstruction`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.pipelines.slam.map.slam_map import SlamMap
from epipole.scene import Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks


def reconstruction_of(model: SlamMap, camera: Camera, names: Sequence[str]) -> Reconstruction:
    """Reconstruction of the keyframes and of the points that at least two of them see.

    Args:
        model: the map.
        camera: camera of all keyframes.
        names: image names of the keyframes.
    """
    keyframes = [k for k in model.keyframes if len(k.point)]  # rotation-only keyframes see no points
    n, counts = len(keyframes), model.counts(list(range(len(model.keyframes))))
    rows = np.flatnonzero((counts >= 2) & np.isfinite(model.xyz[:, 0]))
    column = np.full(model.num_points, -1)
    column[rows] = np.arange(len(rows))
    image = np.concatenate([np.full(len(k.point), i) for i, k in enumerate(keyframes)] or [np.zeros(0, int)])
    keypoint = np.concatenate([np.arange(len(k.point)) for k in keyframes] or [np.zeros(0, int)])
    point = column[np.concatenate([k.point for k in keyframes] or [np.zeros(0, int)])]
    order = np.argsort(point, kind="stable")
    order = order[point[order] >= 0]
    offsets = np.concatenate([[0], np.cumsum(np.bincount(point[order], minlength=len(rows)))])
    gray = np.full(len(rows), 128, np.uint8)
    for j, row in enumerate(rows):
        x, y = np.rint(model.anchor_px[row]).astype(int)
        name = model.keyframes[int(model.anchor[row])].gray
        gray[j] = name[np.clip(y, 0, name.shape[0] - 1), np.clip(x, 0, name.shape[1] - 1)]
    positions = [k.cam_from_world for k in keyframes]
    made = Reconstruction(
        Cameras.from_list([camera], is_constant=[True]),
        Rigs.of_single_cameras(1),
        Frames(
            np.zeros(n, np.int32),
            Rigid3(
                np.array([p.rotation for p in positions]).reshape(-1, 3, 3),
                np.array([p.translation for p in positions]).reshape(-1, 3),
            ),
            np.array([k.timestamp_s for k in keyframes], np.float64),
        ),
        Images(
            tuple(n for n, k in zip(names, model.keyframes) if len(k.point)),
            np.arange(n, dtype=np.int32),
            np.zeros(n, np.int32),
            np.concatenate([[0], np.cumsum([len(k.point) for k in keyframes])]).astype(np.int64),
            np.concatenate([k.straight_px for k in keyframes] or [np.zeros((0, 2))]),
        ),
        Points(model.xyz[rows].copy(), np.repeat(gray[:, None], 3, axis=1), np.zeros(len(rows))),
        Tracks(offsets.astype(np.int64), image[order].astype(np.int32), keypoint[order].astype(np.int32)),
    )
    return replace(made, points=replace(made.points, error_px=_mean_errors_px(made)))


def _mean_errors_px(model: Reconstruction) -> np.ndarray:
    """(p,) mean reprojection error of each point; NaN if it is in front of none of its cameras."""
    errors, n = model.reprojection_errors_px(), len(model.points)
    point = np.repeat(np.arange(n), np.diff(model.tracks.offsets))
    is_seen = np.isfinite(errors)
    count = np.bincount(point[is_seen], minlength=n)
    total = np.bincount(point[is_seen], errors[is_seen], n)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
