"""Export of the map as a `Reconstruction`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap
from epipole.scene import CameraRig, Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks


def reconstruction_of(model: SlamMap, camera: Camera | CameraRig, names: Sequence[str]) -> Reconstruction:
    """Reconstruction of the keyframes and of the points that at least two of them see.

    Args:
        model: the map.
        camera: camera of all keyframes, or the rig, of which every keyframe has one image per camera.
        names: image names of the keyframes; for a rig those of cam0, which contain its name.
    """
    keyframes = [k for k in model.keyframes if len(k.point)]  # rotation-only keyframes see no points
    n, counts = len(keyframes), model.counts(list(range(len(model.keyframes))))
    rows = np.flatnonzero((counts >= 2) & np.isfinite(model.xyz[:, 0]))
    column = np.full(model.num_points, -1)
    column[rows] = np.arange(len(rows))
    rig = camera if isinstance(camera, CameraRig) else None
    cameras = camera.cameras if isinstance(camera, CameraRig) else (camera,)
    num = len(cameras)
    images = [_image_rows(keyframe, rig) for keyframe in keyframes]
    own = [row for rows_of_frame in images for row in rows_of_frame]  # observations of each image
    frame = np.repeat(np.arange(n), num)
    pixels = [
        keyframes[i].straight_px[row] - _top(rig, k)
        for i, k, row in zip(frame, np.tile(np.arange(num), n), own)
    ]
    image = np.repeat(np.arange(len(own)), [len(row) for row in own])
    keypoint = np.concatenate([np.arange(len(row)) for row in own] or [np.zeros(0, int)])
    point = column[
        np.concatenate([keyframes[i].point[row] for i, row in zip(frame, own)] or [np.zeros(0, int)])
    ]
    order = np.argsort(point, kind="stable")
    order = order[point[order] >= 0]
    offsets = np.concatenate([[0], np.cumsum(np.bincount(point[order], minlength=len(rows)))])
    gray = np.full(len(rows), 128, np.uint8)
    for j, row in enumerate(rows):
        x, y = np.rint(model.anchor_px[row]).astype(int)
        name = model.keyframes[int(model.anchor[row])].gray
        gray[j] = name[np.clip(y, 0, name.shape[0] - 1), np.clip(x, 0, name.shape[1] - 1)]
    first_from_body = Rigid3.identity() if rig is None else rig.cam_from_rig[0]
    positions = [first_from_body @ k.cam_from_world for k in keyframes]
    made = Reconstruction(
        Cameras.from_list(cameras, is_constant=[True] * num),
        _rigs(rig),
        Frames(
            np.zeros(n, np.int32),
            Rigid3(
                np.array([p.rotation for p in positions]).reshape(-1, 3, 3),
                np.array([p.translation for p in positions]).reshape(-1, 3),
            ),
            np.array([k.timestamp_s for k in keyframes], np.float64),
        ),
        Images(
            tuple(
                name_of_camera(name, k, rig)
                for name, keyframe in zip(names, model.keyframes)
                if len(keyframe.point)
                for k in range(num)
            ),
            frame.astype(np.int32),
            np.tile(np.arange(num, dtype=np.int32), n),
            np.concatenate([[0], np.cumsum([len(row) for row in own])]).astype(np.int64),
            np.concatenate(pixels or [np.zeros((0, 2))]),
        ),
        Points(model.xyz[rows].copy(), np.repeat(gray[:, None], 3, axis=1), np.zeros(len(rows))),
        Tracks(offsets.astype(np.int64), image[order].astype(np.int32), keypoint[order].astype(np.int32)),
    )
    return replace(made, points=replace(made.points, error_px=_mean_errors_px(made)))


def name_of_camera(name: str, k: int, rig: CameraRig | None) -> str:
    """The image name of another camera of the rig: cam0/NAME becomes cam1/NAME."""
    if rig is None or k == 0:
        return name
    first, *rest = name.split("/")
    return "/".join([f"cam{k}", *(rest if first == "cam0" else [name])])


def _image_rows(keyframe: Keyframe, rig: CameraRig | None) -> list[np.ndarray]:
    """The observations of each camera's image."""
    if rig is None:
        return [np.arange(len(keyframe.point))]
    which = rig.camera_of(keyframe.pixels)
    return [np.flatnonzero(which == k) for k in range(len(rig.cameras))]


def _top(rig: CameraRig | None, k: int) -> np.ndarray:
    return np.zeros(2) if rig is None else np.array([0.0, float(rig.tops[k])])


def _rigs(rig: CameraRig | None) -> Rigs:
    if rig is None:
        return Rigs.of_single_cameras(1)
    num = len(rig.cameras)
    from_first = rig.cam_from_rig @ rig.cam_from_rig[0].inverse()
    return Rigs(np.array([0, num], np.int32), np.arange(num, dtype=np.int32), from_first)


def _mean_errors_px(model: Reconstruction) -> np.ndarray:
    """(p,) mean reprojection error of each point; NaN if it is in front of none of its cameras."""
    errors, n = model.reprojection_errors_px(), len(model.points)
    point = np.repeat(np.arange(n), np.diff(model.tracks.offsets))
    is_seen = np.isfinite(errors)
    count = np.bincount(point[is_seen], minlength=n)
    total = np.bincount(point[is_seen], errors[is_seen], n)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
