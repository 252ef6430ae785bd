"""One focal length for the images of one camera, where it is unknown or their points contradict it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from epipole.cameras import Camera
from epipole.mapping import camera_with_focal
from epipole.pipelines.localization.localized_image import LocalizedImage
from epipole.pipelines.localization.localizer import FocalKnowledge
from epipole.pipelines.localization.query_cameras import QueryCamera

MIN_IMAGES = 3
"""Localized images that can confirm each other's focal length."""
MAX_SCATTER = 0.02
"""Median relative deviation of the focal lengths of single images up to which they share one."""


def localize_images_of_camera(
    query: QueryCamera,
    images: Sequence[int],
    localize_all: Callable[[Sequence[int], Camera, FocalKnowledge], list[LocalizedImage]],
) -> list[LocalizedImage]:
    """Localize images of one camera.

    A focal length of the user is kept. One of the model is kept if the points of at least half of the images agree with it; the others get
    their own. Otherwise, it is estimated from each image. If these estimates agree, all images are localized again with their
    median, except those that contradict it.

    Args:
        query: the camera.
        images: rows of its images.
        localize_all: localizes images with a camera, whose focal length is known, approximate or unknown.
    """
    found = localize_all(images, query.camera, "known" if query.is_known else "unknown")
    if query.is_given:
        return found
    if query.is_known:
        num_judged = sum(image.success or image.is_focal_contradicted for image in found)
        wrong = [k for k, image in enumerate(found) if image.is_focal_contradicted]
        if 2 * len(wrong) <= num_judged:
            freed = localize_all([images[k] for k in wrong], query.camera, "unknown")
            better = {k: new for k, new in zip(wrong, freed) if new.success}
            return [better.get(k, image) for k, image in enumerate(found)]
        found = localize_all(images, query.camera, "unknown")
    good = [image.camera for image in found if image.success]
    if len(good) < MIN_IMAGES:
        return found
    logs = np.log([camera.focal_px for camera in good])
    middle = float(np.median(logs))
    if np.median(np.abs(logs - middle)) > MAX_SCATTER:  # the zoom changed, or the images do not determine it
        return found
    camera = camera_with_focal(query.camera, float(np.exp(middle)) / query.camera.focal_px)
    shared = localize_all(images, camera, "approximate")
    # An image that contradicts the shared focal length keeps its own.
    return [
        own if own.success and (not new.success or new.is_focal_contradicted) else new
        for own, new in zip(found, shared)
    ]
