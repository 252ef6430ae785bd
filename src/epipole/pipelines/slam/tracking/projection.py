"""Projection with one camera or with a rig, whose pixels are those of its stacked image.

The body frame is that of the camera or of the rig. A point that several cameras of a rig see has a pixel in each of them: the
functions take the pixels that say which camera is meant.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from epipole.cameras import Camera
from epipole.geometry import Rigid3
from epipole.image.pixels_without_ray import pixels_without_ray
from epipole.scene import CameraRig

LEAST_COSINE = 0.05
"""Of the angle between a direction and its camera's axis, in a rig: 87 degrees."""
SEAM_PX = 8.0
"""Least distance of a point from the edges of its camera's image in a stacked image; patches have half widths of 6 px."""


def project_as(camera: Camera | CameraRig, points_in_body: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(n, 2) pixels of points, each in the camera to which the given pixel belongs."""
    if isinstance(camera, CameraRig):
        return camera.project(points_in_body, camera.camera_of(pixels))
    return camera.project(points_in_body)


def project_in_sight(
    camera: Camera | CameraRig, points_in_body: np.ndarray, margin_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) pixels of points, and a mask of those in sight, at least `margin_px` from the image's edges.

    If several cameras of a rig see a point, the pixel is in the one in whose image it is farthest from the edges; these are seams of
    the stacked image, across which no patch may reach.
    """
    if not isinstance(camera, CameraRig):
        pixels = camera.project(points_in_body)
        inside = (pixels >= margin_px).all(axis=1) & (
            pixels < [camera.width - margin_px, camera.height - margin_px]
        ).all(axis=1)
        return pixels, inside & (points_in_body[:, 2] > 0)
    best, pixels = np.full(len(points_in_body), -1.0), np.full((len(points_in_body), 2), np.nan)
    for k, one in enumerate(camera.cameras):
        top = [0.0, float(camera.tops[k])]
        in_cam = camera.cam_from_rig[k].apply(points_in_body)
        at = one.project(in_cam)
        room = np.minimum(at, [one.width, one.height] - at).min(axis=1)
        better = (in_cam[:, 2] > 0) & (room >= max(margin_px, SEAM_PX)) & (room > best)
        pixels[better], best[better] = at[better] + top, room[better]
    return pixels, best >= 0


def points_at_depth(
    camera: Camera | CameraRig, pixels: np.ndarray, depth: np.ndarray, like: np.ndarray
) -> np.ndarray:
    """(n, 3) points in the body frame; NaN for directions at 90 degrees or more from the axis, which have no such depth.

    Args:
        camera: the camera or the rig.
        pixels: (n, 2), possibly just beyond the edge of their camera's image.
        depth: (n,) along the optical axis.
        like: (n, 2) pixels that say which camera is meant.
    """
    if not isinstance(camera, CameraRig):
        return _to_depth(camera.unproject(pixels), depth)
    which = camera.camera_of(like)
    return _into_rig(camera, _to_depth(camera.unproject(pixels, which), depth), which)


def depth_of(camera: Camera | CameraRig, points_in_body: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(n,) depth of points along the optical axis of the camera to which each pixel belongs."""
    if not isinstance(camera, CameraRig):
        return points_in_body[:, 2]
    which, mounted = camera.camera_of(pixels), camera.cam_from_rig
    return np.einsum("nj,nj->n", mounted.rotation[which, 2], points_in_body) + mounted.translation[which, 2]


def centers_of(camera: Camera | CameraRig, body_from_world: Rigid3, pixels: np.ndarray) -> np.ndarray:
    """(n, 3) or (3,) center, in the world, of the camera to which each pixel belongs."""
    world_from_body = body_from_world.inverse()
    if not isinstance(camera, CameraRig):
        return world_from_body.translation
    return world_from_body.apply(camera.centers_in_rig)[camera.camera_of(pixels)]


def stay_in_camera(camera: Camera | CameraRig, start_px: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(n,) whether pixels are still in the camera in which they started, and not near a seam of a stacked image."""
    if not isinstance(camera, CameraRig):
        return np.ones(len(pixels), bool)
    return camera.sees(pixels, camera.camera_of(start_px), SEAM_PX)


@lru_cache(maxsize=4)
def blind_pixels(camera: Camera | CameraRig) -> np.ndarray | None:
    """Mask of the pixels without a ray; None if there are none.

    In a stacked image also of those beside the images, and of directions near 90 degrees and more from their camera's axis.
    """
    if isinstance(camera, Camera):
        return pixels_without_ray(camera)
    blind = np.ones((camera.height, camera.width), bool)
    for part, one in zip(camera.parts(blind), camera.cameras):
        at = np.stack(np.meshgrid(np.arange(one.width), np.arange(one.height)), axis=-1).reshape(-1, 2)
        part[:] = ~(one.unproject(at.astype(np.float64))[:, 2] > LEAST_COSINE).reshape(part.shape)
        own = pixels_without_ray(one)
        part[:] |= False if own is None else own
    return blind if blind.any() else None


def _to_depth(rays: np.ndarray, depth: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rays[:, 2:] > 0, rays / rays[:, 2:] * depth[:, None], np.nan)


def _into_rig(rig: CameraRig, points_in_cam: np.ndarray, which: np.ndarray) -> np.ndarray:
    back = rig.cam_from_rig.inverse()
    return np.einsum("nij,nj->ni", back.rotation[which], points_in_cam) + back.translation[which]
