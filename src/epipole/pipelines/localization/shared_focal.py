"""One focal length for the images of one camera, where it is unknown or their points contradict it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from epipole.cameras import Camera
from epipole.pipelines.localization.localizer import LocalizedImage
from epipole.pipelines.localization.query_cameras import QueryCamera

MIN_IMAGES = 3
"""Localized images that can confirm each other's focal length."""
MAX_SCATTER = 0.02
"""Median relative deviation of the focal lengths of single images up to which they share one."""


def localize_images_of_camera(
    query: QueryCamera,
    images: Sequence[int],
    localize_all: Callable[[Sequence[int], Camera, bool], list[LocalizedImage]],
) -> list[LocalizedImage]:
    """Localize images of one camera.

    A known focal length is kept if the user gave it, or if the points of at least half of the images agree with it. Otherwise, it is
    estimated from each image. If these estimates agree, all images are localized again with their median, as with a known one.

    Args:
        query: the camera.
        images: rows of its images.
        localize_all: localizes images with a camera, whose focal length is estimated if the flag is set.
    """
    found = localize_all(images, query.camera, not query.is_known)
    if query.is_given:
        return found
    if query.is_known:
        judged = [image for image in found if image.success or image.is_focal_contradicted]
        if 2 * sum(image.is_focal_contradicted for image in judged) <= len(judged):
            return found
        found = localize_all(images, query.camera, True)
    good = [image.camera for image in found if image.success]
    if len(good) < MIN_IMAGES:
        return found
    logs = np.log([camera.focal_px for camera in good])
    middle = float(np.median(logs))
    if np.median(np.abs(logs - middle)) > MAX_SCATTER:  # the zoom changed, or the images do not determine it
        return found
    params = query.camera.params.copy()
    params[list(query.camera.model.focal_indices)] *= np.exp(middle) / query.camera.focal_px
    shared = localize_all(images, replace(query.camera, params=params), False)
    # An image that the shared focal length does not fit keeps its own.
    return [own if own.success and not new.success else new for own, new in zip(found, shared)]
