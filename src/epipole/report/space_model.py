"""A reconstruction as layers of a 3D view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from epipole.report.markup import number, plural
from epipole.report.space_scene import (
    CameraLayer,
    LoadImage,
    PointLayer,
    PointMeasure,
    SpaceScene,
)
from epipole.scene import Curve, Extent, Reconstruction, extent_of
from epipole.scene.curve import path_segments
from epipole.scene.point_accuracy import covariances_of_points, pixel_noise

MAX_POINTS = 40_000
"""Largest number of points in a report."""
_RADIUS_PERCENT = 95.0
RIGS, RIG_RGB = "Cameras of one rig", (214, 150, 255)
"""Name and color of the lines between the cameras of a rig."""
_LEAST_BASELINE = 1e-9
"""Smallest distance between cameras of a rig, relative to the largest coordinate: views of one panorama have none."""


def stage_of(reconstruction: Reconstruction) -> Extent:
    """The extent of most points and most cameras."""
    points, centers = reconstruction.points.xyz_in_world, reconstruction.camera_centers_in_world()
    return extent_of(points, centers, _RADIUS_PERCENT)


def scene_of_model(
    model: Reconstruction,
    *,
    title: str,
    unit: str,
    cameras: str = "Cameras",
    curves: Sequence[Curve] = (),
    load_image: LoadImage | None = None,
    num_given: int | None = None,
) -> SpaceScene:
    """Scene with points and their errors, cameras, curves, and lines between the cameras of each rig.

    Args:
        model: upright, +z is up.
        title: title of the view.
        unit: unit of lengths; empty: up to scale.
        cameras: name of the camera layer.
        curves: curves; empty ones are omitted.
        load_image: loads an image by name.
        num_given: number of input images, registered or not; None: unknown.
    """
    num_registered = int(model.is_registered().sum())
    images = (
        plural(num_registered, "image")
        if num_given is None
        else f"{num_registered} of {num_given} images registered"
    )
    words = f"{images}, {plural(len(model.points), 'point')}"
    return SpaceScene(
        title=title,
        words=words,
        unit=unit,
        points=(points_of_model(model),),
        cameras=cameras_of_model(model, cameras, load_image),
        curves=tuple(curve for curve in (*curves, rig_curve(model)) if len(curve.segments_in_world)),
        is_enu=model.georeference is not None,
    )


def points_of_model(model: Reconstruction) -> PointLayer:
    """The points, with reprojection errors, track lengths, and covariances."""
    noise = pixel_noise(model)
    known = np.isfinite(noise)
    return PointLayer(
        "Points",
        model.points.xyz_in_world,
        model.points.rgb,
        (
            PointMeasure("error", model.points.error_px, "px"),
            PointMeasure(
                "images that see it", np.diff(model.tracks.offsets).astype(float), "", is_at_least=True
            ),
        ),
        covariances_of_points(model, noise) if known else None,
        f"for pixel noise of {number(noise)} px, with exact cameras" if known else "",
    )


def cameras_of_model(model: Reconstruction, name: str, load_image: LoadImage | None) -> CameraLayer:
    """The registered cameras, without distortion."""
    images = np.flatnonzero(model.is_registered())
    cameras = [model.cameras[int(c)] for c in model.camera_of_image[images]]
    return CameraLayer(
        name,
        tuple(str(model.images.name[k]) for k in images),
        model.cams_from_world()[images],
        np.array([camera.K for camera in cameras]).reshape(-1, 3, 3),
        np.array([[camera.width, camera.height] for camera in cameras], np.int64).reshape(-1, 2),
        load_image,
    )


def rig_curve(model: Reconstruction, *, is_shown: bool = True) -> Curve:
    """Lines between the registered cameras of each instant of a rig, in the order of its sensors."""
    images = np.flatnonzero(model.is_registered())
    images = images[np.lexsort((model.images.sensor[images], model.images.frame[images]))]
    centers, frame = model.camera_centers_in_world()[images], model.images.frame[images]
    segments = path_segments(centers, np.diff(frame, prepend=-1) == 0)
    least = _LEAST_BASELINE * float(np.abs(centers).max(initial=0.0))
    is_apart = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1) > least
    return Curve(RIGS, segments[is_apart], RIG_RGB, is_shown)
