"""Export of the map as a `Reconstruction`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.pipelines.slam.map.slam_map import Keyframe, SlamMap
from epipole.scene import CameraRig, Cameras, Frames, Images, Points, Reconstruction, Rigs, Tracks


def reconstruction_of(
    model: SlamMap,
    camera: Camera | CameraRig,
    names: Sequence[str],
    rig_names: Mapping[str, Sequence[str]] | None = None,
) -> Reconstruction:
    """Reconstruction of the keyframes and of the points that at least two of them see.

    Args:
        model: the map.
        camera: camera of all keyframes, or the rig, of which every keyframe has one image per camera.
        names: image names of the keyframes; for a rig those of cam0.
        rig_names: names of the images of all cameras of a rig by that of cam0; for others, the same name in cam1, cam2 ...
    """
    rig = camera if isinstance(camera, CameraRig) else None
    cameras = camera.cameras if isinstance(camera, CameraRig) else (camera,)
    keyframes = [k for k in model.keyframes if len(k.point)]  # rotation-only keyframes see no points
    named = [name for name, k in zip(names, model.keyframes) if len(k.point)]
    images = [
        i
        for n, k in enumerate(keyframes)
        for i in _images_of(k, n, _names_of(named[n], rig, rig_names or {}), rig)
    ]
    rows = np.flatnonzero(
        (model.counts(list(range(len(model.keyframes)))) >= 2) & np.isfinite(model.xyz[:, 0])
    )
    column = np.full(model.num_points, -1)
    column[rows] = np.arange(len(rows))
    counts = [len(image.point) for image in images]
    point = column[np.concatenate([image.point for image in images] or [np.zeros(0, int)])]
    order = np.argsort(point, kind="stable")
    order = order[point[order] >= 0]
    keypoint = np.concatenate([np.arange(count) for count in counts] or [np.zeros(0, int)])
    made = Reconstruction(
        Cameras.from_list(cameras, is_constant=[True] * len(cameras)),
        _rigs(rig),
        _frames(keyframes, rig),
        Images(
            tuple(image.name for image in images),
            np.array([image.keyframe for image in images], np.int32),
            np.array([image.sensor for image in images], np.int32),
            np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            np.concatenate([image.pixels for image in images] or [np.zeros((0, 2))]),
        ),
        Points(model.xyz[rows].copy(), _colors(model, rows), np.zeros(len(rows))),
        Tracks(
            np.concatenate([[0], np.cumsum(np.bincount(point[order], minlength=len(rows)))]).astype(np.int64),
            np.repeat(np.arange(len(images)), counts)[order].astype(np.int32),
            keypoint[order].astype(np.int32),
        ),
    )
    return replace(made, points=replace(made.points, error_px=_mean_errors_px(made)))


class _Image(NamedTuple):
    keyframe: int
    sensor: int
    name: str
    pixels: np.ndarray
    point: np.ndarray


def _images_of(keyframe: Keyframe, number: int, names: Sequence[str], rig: CameraRig | None) -> list[_Image]:
    """The image of a keyframe, or those of the rig's cameras, with their observations."""
    pixels = keyframe.straight_px
    if rig is None:
        return [_Image(number, 0, names[0], pixels, keyframe.point)]
    which, out = rig.camera_of(keyframe.pixels), []
    for k, top in enumerate(rig.tops[:-1].tolist()):
        own = which == k
        out.append(_Image(number, k, names[k], pixels[own] - [0.0, top], keyframe.point[own]))
    return out


def _frames(keyframes: Sequence[Keyframe], rig: CameraRig | None) -> Frames:
    first_from_body = Rigid3.identity() if rig is None else rig.cam_from_rig[0]
    positions = [first_from_body @ k.cam_from_world for k in keyframes]
    return Frames(
        np.zeros(len(keyframes), np.int32),
        Rigid3(
            np.array([p.rotation for p in positions]).reshape(-1, 3, 3),
            np.array([p.translation for p in positions]).reshape(-1, 3),
        ),
        np.array([k.timestamp_s for k in keyframes], np.float64),
    )


def _colors(model: SlamMap, rows: np.ndarray) -> np.ndarray:
    """(n, 3) gray values of points in their anchor keyframes."""
    gray = np.full(len(rows), 128, np.uint8)
    for j, row in enumerate(rows):
        x, y = np.rint(model.anchor_px[row]).astype(int)
        image = model.keyframes[int(model.anchor[row])].gray
        gray[j] = image[np.clip(y, 0, image.shape[0] - 1), np.clip(x, 0, image.shape[1] - 1)]
    return np.repeat(gray[:, None], 3, axis=1)


def _names_of(name: str, rig: CameraRig | None, rig_names: Mapping[str, Sequence[str]]) -> Sequence[str]:
    """The names of a keyframe's images; if not given, those of other cameras are cam1/NAME for cam0/NAME."""
    if rig is None or name in rig_names:
        return rig_names.get(name, (name,))
    first, *rest = name.split("/")
    return [
        name,
        *("/".join([f"cam{k}", *(rest if first == "cam0" else [name])]) for k in range(1, len(rig.cameras))),
    ]


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
