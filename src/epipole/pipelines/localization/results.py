"""Files of localized images: one line per pose, and everything known about each image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from epipole.geometry import Rotation3
from epipole.pipelines.localization.localized_image import LocalizedImage
from epipole.pipelines.localization.query_cameras import QueryCamera
from epipole.scene import Georeference, Reconstruction

NEIGHBORS_SHOWN = 5
"""Neighbors of each image in `localized.json`."""


def poses_text(names: Sequence[str], images: Sequence[LocalizedImage]) -> str:
    """A line `name qw qx qy qz tx ty tz` (cam_from_world) for each localized image, as in hloc and visuallocalization.net."""
    lines = []
    for name, image in zip(names, images):
        if image.success:
            pose = image.cam_from_world
            numbers = [*Rotation3(pose.rotation).as_quat_wxyz().tolist(), *pose.translation.tolist()]
            lines.append(" ".join([name, *(repr(float(value)) for value in numbers)]))
    return "".join(f"{line}\n" for line in lines)


def _on_earth(image: LocalizedImage, georeference: Georeference | None) -> dict[str, Any]:
    """Latitude and longitude in degrees and altitude in meters, in a georeferenced model."""
    if georeference is None:
        return {}
    return {"lat_lon_alt": georeference.lat_lon_alt_of(image.position_in_world()[None])[0].tolist()}


def image_summary(image: LocalizedImage, model: Reconstruction, *, camera: QueryCamera) -> dict[str, Any]:
    """Everything known about an image, for `localized.json`."""
    out: dict[str, Any] = {"is_localized": image.success, "reason": image.reason.value}
    if image.success:
        pose = image.cam_from_world
        out |= {
            "cam_from_world": {
                "quaternion_wxyz": Rotation3(pose.rotation).as_quat_wxyz().tolist(),
                "translation": pose.translation.tolist(),
            },
            "position_in_world": image.position_in_world().tolist(),
            **_on_earth(image, model.georeference),
            "position_sigma": image.position_sigma(),
            "rotation_sigma_deg": math.degrees(image.rotation_sigma_rad()),
            "covariance": image.covariance.tolist(),
            "num_points": len(image.point),
            "error_px": image.error_px,
            "camera": {
                "model": image.camera.model.name,
                "width": image.camera.width,
                "height": image.camera.height,
                "params": image.camera.params.tolist(),
            },
            "focal_source": camera.source
            if image.camera.focal_px == camera.camera.focal_px
            else "estimated from the points",
            "focal_correction": image.focal_correction,
            "is_focal_contradicted": image.is_focal_contradicted,
        }
    return out | {
        "num_matches": image.num_matches,
        "num_inliers": image.num_inliers,
        "num_confirmed": image.num_confirmed,
        "num_by_chance": image.num_by_chance,
        "neighbors": [model.images.name[row] for row in image.neighbors[:NEIGHBORS_SHOWN]],
    }
